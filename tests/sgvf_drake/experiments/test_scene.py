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


def commands_in(page):
    """The commands of a page to the viewer, which stand there in base64.

    The page needs no network, and has a scene and a recording.
    """
    text = page.read_text()
    assert not re.findall(r"<(?:script|link)[^>]+(?:src|href)=[\"']https?:", text)
    commands = b"".join(
        base64.b64decode(found) for found in re.findall(r"base64,([A-Za-z0-9+/=]{40,})", text)
    )
    for part in (b"set_animation", b"/waypoints", b"/field", b"/trail"):
        assert part in commands
    return commands


@pytest.mark.parametrize("tube", [(), (SQUARE, 2 * SQUARE)])
def test_what_stands_still_is_drawn(flight_field, meshcat, tube):
    FlightScene(meshcat, tube=tube).draw(flight_field, 0.45, 1.0)
    drawn = [meshcat.HasPath(f"/{name}") for name in ("waypoints", "field", "tube", "trail")]
    assert drawn == [True, True, bool(tube), False]


def test_every_flight_leaves_its_page(flight_field, rings, meshcat, tmp_path):
    scene = FlightScene(meshcat, tmp_path)
    fly(flight_field, rings, speed=3.0, duration=1.1, scene=scene)
    fly_tour(flight_field, rings, (0,), duration=1.1, scene=scene)
    pages = sorted(tmp_path.iterdir())
    assert [page.name for page in pages] == ["flight_1.html", "flight_2.html", "tour.html"]
    for page in pages:
        commands_in(page)


def test_the_page_of_a_flight_holds_the_proved_walls(
    ring_field, ring_certificate, meshcat, tmp_path
):
    ring_certificate.save(tmp_path / "certificate.json")
    curves = tube_curves(ring_field, tmp_path, 0.1)
    path = ReferencePath((Piece(0.1 * ring_field.cloud.points, closed=True),))
    scene = FlightScene(meshcat, tmp_path, tube=curves)
    fly(ring_field.rescaled(0.1), path, duration=1.1, scene=scene)
    commands = commands_in(tmp_path / "flight_1.html")
    # Its points are told as float32, three to each end of a segment.
    drawn = commands[commands.index(b"/tube") :]
    for curve in curves:
        for x, y in (curve[0], curve[len(curve) // 2]):
            assert np.array([x, y, 1.0], np.float32).tobytes() in drawn


def test_to_watch_a_flight_does_not_change_it(flight_field, rings, meshcat):
    inner = ReferencePath(rings.pieces[:1])

    def flown(scene, sensors):
        options = {"speed": 2.0, "duration": 2.0, "sensors": sensors, "seed": 2}
        return fly(flight_field, inner, scene=scene, **options).flights[0].log

    def toured(scene):
        options = {"speed": 2.0, "duration": 4.0}
        return fly_tour(flight_field, rings, (0, 1), scene=scene, **options).log

    for watched, alone in (
        *((flown(FlightScene(meshcat), s), flown(None, s)) for s in (None, SensorParameters())),
        (toured(FlightScene(meshcat)), toured(None)),
    ):
        # Publishing cuts the integrator's steps; see the tests of the visualization.
        pd.testing.assert_frame_equal(watched, alone, check_exact=False, rtol=0.0, atol=1e-6)
    assert meshcat.HasPath("/trail")


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
