"""Flights that are changed while they are watched: what is flown, told, logged and measured."""

import numpy as np
from pydrake.systems.analysis import Simulator
import pytest

from sgvf_drake.experiments import CertifiedField, FlightScene, fly, fly_route, fly_tour
from sgvf_drake.experiments.fly import PieceFlight
from sgvf_drake.experiments.results import plain
from sgvf_drake.experiments.scene import MARGIN_GAUGES
from sgvf_drake.experiments.velocity_error import flight_margin
from sgvf_drake.paths import Piece, ReferencePath
from sgvf_drake.paths.planning import covering
from systems import Disturbance, MakeMeshcat, live_controls

SPEED, WIND = "speed [m/s]", "wind x [m/s]"
PRESSED = b"\x82\xa4type\xa6button\xa4name\xa4Stop"


@pytest.fixture(scope="module")
def server():
    return MakeMeshcat(port=0)


@pytest.fixture
def meshcat(server, monkeypatch):
    """A viewer whose flights do not wait for the clock."""
    monkeypatch.setattr(Simulator, "set_target_realtime_rate", lambda simulator, rate: None)
    server.DeleteAddedControls()
    return server


@pytest.fixture
def inner(rings):
    return ReferencePath(rings.pieces[:1])


def moving(meshcat, *moves):
    """Moves sliders, (time, label, value), or presses Stop when a flight has come so far."""
    left = list(moves)

    def progress(stage, done, total):
        while left and done > left[0][0] - 1e-6:
            _, label, value = left.pop(0)
            if label == live_controls.STOP:
                meshcat._InjectWebsocketMessage(PRESSED)
            else:
                meshcat.SetSliderValue(label, value)

    return progress


def changes_of(live):
    return [(round(c["time"], 6), c["name"], c["before"], c["after"]) for c in live["changes"]]


def test_a_flight_is_changed_and_its_log_tells_so(flight_field, inner, meshcat):
    moves = moving(meshcat, (0.5, SPEED, 0.8), (2.0, SPEED, 1.2), (3.0, WIND, 2.0))
    options = {"duration": 4.0, "disturbance": Disturbance(), "progress": moves}
    scene = FlightScene(meshcat, live=True)
    (flight,) = fly(flight_field, inner, scene=scene, **options).flights
    live = flight.summary["live"]
    # The first one waits for the end of the take-off.
    assert changes_of(live) == [
        (1.0, "speed", 0.45, 0.8),
        (2.0, "speed", 0.8, 1.2),
        (3.0, "wind_x", 0.0, 2.0),
    ]
    assert not live["stopped"]
    assert live["lost_control"] is None
    log = flight.log.set_index(np.round(flight.log["time"], 6))
    assert log["live_speed"][[0.0, 1.0, 1.01, 2.0, 2.01, 4.0]].tolist() == [
        *(0.45, 0.45),
        *(0.8, 0.8),
        *(1.2, 1.2),
    ]
    assert log["live_wind_x"][[3.0, 3.01]].tolist() == [0.0, 2.0]
    commanded = np.linalg.norm(log[["vx_command", "vy_command"]], axis=1)
    np.testing.assert_allclose(commanded, log["live_speed"], rtol=0.005)
    # The air takes drag / (mass velocity_gain) of the speed.
    flown = np.linalg.norm(log.loc[2.9, ["vx", "vy"]])
    assert flown == pytest.approx(1.2 * (1.0 - 0.1 / (0.46 * 3.0)), abs=0.01)
    # The sliders go with the flight.
    assert not meshcat.GetSliderNames()


def test_who_only_watches_flies_as_without_sliders(flight_field, inner, meshcat):
    flown = [
        fly(flight_field, inner, duration=2.0, scene=FlightScene(meshcat, live=live)).flights[0]
        for live in (True, False)
    ]
    assert changes_of(flown[0].summary["live"]) == []
    assert flown[1].summary["live"] is None
    kept = flown[1].log
    np.testing.assert_allclose(flown[0].log[list(kept)], kept, rtol=0.0, atol=1e-9)


def test_the_slider_of_the_speed_ends_at_what_is_feasible(flight_field, inner, meshcat):
    seen = {}

    def progress(stage, done, total):
        seen[done] = meshcat.SetSliderValue(SPEED, 100.0)

    for speed in (0.45, 4.0):
        options = {"speed": speed, "duration": 1.1, "progress": progress}
        result = fly(flight_field, inner, scene=FlightScene(meshcat, live=True), **options)
        ratio = np.sqrt(result.feasibility.limit / result.feasibility.demand)
        assert seen[0.1] == pytest.approx(speed * min(5.0, ratio), abs=0.1)


@pytest.mark.parametrize("pressed", [0.2, 1.6])
def test_the_button_ends_a_flight_after_the_take_off(flight_field, rings, meshcat, pressed):
    moves = moving(meshcat, (pressed, live_controls.STOP, 1))
    scene = FlightScene(meshcat, live=True)
    first, second = fly(flight_field, rings, duration=3.0, scene=scene, progress=moves).flights
    assert first.log["time"].iloc[-1] == pytest.approx(max(pressed, 1.1))
    assert first.summary["live"]["stopped"] is True
    # The next flight has a button of its own.
    assert second.log["time"].iloc[-1] == pytest.approx(3.0)
    assert second.summary["live"]["stopped"] is False
    moves = moving(meshcat, (pressed, live_controls.STOP, 1))
    tour = fly_tour(flight_field, rings, (0, 1), scene=scene, progress=moves).summary()
    assert tour["completed"] is False
    assert tour["live"]["stopped"] is True
    assert tour["duration_s"] == pytest.approx(max(pressed, 1.1))
    plain(tour)


def test_a_route_is_left_at_the_next_edge_or_stopped(tee_field, meshcat):
    route = covering(tee_field.network, 0)
    scene, stop = FlightScene(meshcat, live=True), (1.0, live_controls.STOP, 1)
    short = fly_route(tee_field, route, scene=scene, progress=moving(meshcat, stop)).summary()
    assert short["live"]["stopped"] is True
    assert short["route_completed"] is False
    # The edge after the first, and the one that is flown when the other is wanted.
    others = {1, 2, 3} - {abs(route.edges[0]), abs(route.edges[1])}
    node = tee_field.network.edges[abs(route.edges[0]) - 1].nodes[route.edges[0] > 0]
    (edge,) = (k if tee_field.network.edges[k - 1].nodes[0] == node else -k for k in others)
    moves = moving(meshcat, (0.5, "next edge", edge))
    options = {"speed": 1.0, "duration": 6.0, "progress": moves}
    result = fly_route(tee_field, route, scene=scene, **options)
    edges = result.log["edge"].drop_duplicates().tolist()
    assert edges[:3] == [0, route.edges[0], edge]
    assert result.log["live_next_edge"].iloc[-1] == edge
    assert result.summary()["route_completed"] is False


def test_gains_that_lose_control_end_the_flight_in_one_line(
    flight_field, inner, meshcat, monkeypatch
):
    wide = {"attitude_bandwidth": (1.0, 60.0, 1.0), "damping_ratio": (0.01, 1.0, 0.01)}
    monkeypatch.setattr(live_controls, "GAINS", {"velocity_gain": (1.0, 60.0, 1.0), **wide})
    gains = {"velocity gain": 60.0, "attitude bandwidth": 60.0, "damping ratio": 0.01}
    moves = moving(meshcat, *((2.0, name, gain) for name, gain in gains.items()))
    scene = FlightScene(meshcat, live=True)
    (flight,) = fly(flight_field, inner, scene=scene, progress=moves).flights
    live = flight.summary["live"]
    assert live["lost_control"].startswith("t = 2.")
    assert "is not finite" in live["lost_control"]
    assert len(live["changes"]) == 3
    assert 2.0 < flight.log["time"].iloc[-1] < 3.0
    assert np.isfinite(flight.log.to_numpy()).all()
    assert (flight.log[["roll", "pitch"]].abs() < np.pi / 2).all(axis=None)


SCALE = 0.6


def test_the_gauges_show_the_error_and_the_margin(ring_field, ring_certificate, meshcat):
    certified = CertifiedField(ring_field, ring_certificate, SCALE)
    path = ReferencePath((Piece(SCALE * ring_field.cloud.points, closed=True),))
    scene, shown = FlightScene(meshcat, live=True, certified=certified), {}
    moves = moving(meshcat, (2.0, SPEED, 0.6), (4.0, SPEED, 0.0))

    def progress(stage, done, total):
        # What was shown at the look before this part of the flight.
        shown[round(done - 0.1, 6)] = [meshcat.GetSliderValue(name) for name in MARGIN_GAUGES]
        moves(stage, done, total)

    # From beyond the walls, where nothing is tolerated.
    options = {"duration": 5.0, "start": (5.4 * SCALE, 0.0, 1.0), "progress": progress}
    (flight,) = fly(ring_field.rescaled(SCALE), path, scene=scene, **options).flights
    margin = flight_margin(certified, flight, 0.45)
    log = margin.log.set_index(np.round(margin.log["time"], 6))
    # At a change the gauges tell of the new speed, and the log of the old one.
    looks = [time for time in shown if time >= 1.0 and time not in (2.0, 4.0)]
    figures = log.loc[looks, ["error", "e_star"]].clip(upper=1.0)
    np.testing.assert_allclose([shown[time] for time in looks], figures, atol=0.00051)
    assert figures["e_star"].nunique() > 1
    assert figures["error"].min() < 0.1
    # A vehicle that is to stand still is in error by any motion.
    assert figures["error"][4.5] == 1.0
    # With the speed of the beginning in place of that of each sample the error is another.
    old = PieceFlight(0, flight.log.drop(columns="live_speed"), {})
    assert flight_margin(certified, old, 0.45).log["error"][350] > 0.3 > log["error"][3.5]
