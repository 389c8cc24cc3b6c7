"""Flights that are shown: what is drawn, the pages that stay, and that nothing else changes."""

import base64
import re

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.experiments import FlightScene, View, fly, fly_tour, tube_curves
from sgvf_drake.paths import Piece, ReferencePath
from systems import MakeFlightDiagram, MakeMeshcat, MakeSimulator, SensorParameters

SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, -0.5]])


@pytest.fixture(scope="module")
def server():
    return MakeMeshcat(port=0)


@pytest.fixture
def meshcat(server):
    """A server with an empty scene and no recording."""
    server.Delete()
    server.DeleteRecording()
    return server


def commands_in(text):
    """The commands of a page to the viewer, which stand there in base64."""
    return b"".join(
        base64.b64decode(found) for found in re.findall(r"base64,([A-Za-z0-9+/=]{40,})", text)
    )


def check_page(path):
    """A page that needs no network, with a scene and a recording."""
    text = path.read_text()
    commands = commands_in(text)
    for part in (b"set_animation", b"/waypoints", b"/field", b"/trail"):
        assert part in commands
    assert not re.findall(r"<(?:script|link)[^>]+(?:src|href)=[\"']https?:", text)


@pytest.mark.parametrize("tube", [(), (SQUARE, 2 * SQUARE)])
def test_what_stands_still_is_drawn(flight_field, meshcat, tube):
    FlightScene(meshcat, tube=tube).draw(flight_field, 0.45, 1.0)
    assert meshcat.HasPath("/waypoints")
    assert meshcat.HasPath("/field")
    assert meshcat.HasPath("/tube") == bool(tube)
    assert not meshcat.HasPath("/trail")


def test_every_flight_leaves_its_page(flight_field, rings, meshcat, tmp_path):
    fly(flight_field, rings, speed=3.0, laps=1.0, scene=FlightScene(meshcat, tmp_path))
    pages = sorted(tmp_path.iterdir())
    assert [page.name for page in pages] == ["flight_1.html", "flight_2.html"]
    for page in pages:
        check_page(page)
    assert meshcat.HasPath("/trail")


def test_a_tour_leaves_one_page(flight_field, rings, meshcat, tmp_path):
    scene = FlightScene(meshcat, tmp_path, tube=(SQUARE,))
    fly_tour(flight_field, rings, (0,), 2.0, scene=scene)
    assert [page.name for page in tmp_path.iterdir()] == ["tour.html"]
    check_page(tmp_path / "tour.html")
    assert meshcat.HasPath("/tube")


def test_the_page_of_a_flight_holds_the_proved_tube(
    ring_field, ring_certificate, meshcat, tmp_path
):
    ring_certificate.save(tmp_path / "certificate.json")
    curves = tube_curves(ring_field, tmp_path, 0.1)
    path = ReferencePath((Piece(0.1 * ring_field.cloud.points, closed=True),))
    scene = FlightScene(meshcat, tmp_path, tube=curves)
    fly(ring_field.rescaled(0.1), path, speed=2.0, laps=1.0, scene=scene)
    commands = commands_in((tmp_path / "flight_1.html").read_text())
    # Its points are told as float32, three to each end of a segment.
    drawn = commands[commands.index(b"/tube") :]
    for curve in curves:
        for x, y in (curve[0], curve[len(curve) // 2]):
            assert np.array([x, y, 1.0], np.float32).tobytes() in drawn


@pytest.mark.parametrize("sensors", [None, SensorParameters()])
def test_to_watch_a_flight_does_not_change_it(flight_field, rings, meshcat, sensors):
    inner = ReferencePath(rings.pieces[:1])

    def flown(scene):
        (flight,) = fly(
            flight_field, inner, 2.0, 1.0, sensors=sensors, seed=2, scene=scene
        ).flights
        return flight.log

    # Publishing cuts the integrator's steps; see the tests of the visualization.
    pd.testing.assert_frame_equal(
        flown(FlightScene(meshcat)), flown(None), check_exact=False, rtol=0.0, atol=1e-6
    )
    assert meshcat.HasPath("/trail")


def test_to_watch_a_tour_does_not_change_it(flight_field, rings, meshcat):
    watched, alone = (
        fly_tour(flight_field, rings, (0, 1), 2.0, scene=scene).log
        for scene in (FlightScene(meshcat), None)
    )
    pd.testing.assert_frame_equal(watched, alone, check_exact=False, rtol=0.0, atol=1e-6)


@pytest.mark.parametrize(("live", "rate"), [(True, 1.0), (False, 0.0)])
def test_who_watches_sees_it_at_the_pace_of_the_clock(flight_field, meshcat, live, rate):
    simulator = MakeSimulator(MakeFlightDiagram(flight_field, meshcat=meshcat))
    with FlightScene(meshcat, live=live).show(simulator, "flight"):
        assert simulator.get_target_realtime_rate() == rate


def test_a_view_makes_a_scene_where_one_is_wanted(meshcat, tmp_path):
    assert View().scene(tmp_path) is None
    assert View(tube=(SQUARE,)).scene(tmp_path) is None
    pages = View(pages=True, tube=(SQUARE,)).scene(tmp_path)
    assert (pages.pages, pages.live, pages.tube) == (tmp_path, False, (SQUARE,))
    assert pages.meshcat is not meshcat
    live = View(meshcat=meshcat).scene(tmp_path)
    assert (live.meshcat, live.pages, live.live) == (meshcat, None, True)
    both = View(True, meshcat).scene(tmp_path)
    assert (both.meshcat, both.pages, both.live) == (meshcat, tmp_path, True)
