"""Flights along itineraries on networks: completed, turned as wished, and measured."""

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import FlightSpec, covering_routes, fly_route, run_routes, to_point
from sgvf_drake.experiments.flight import route_start
from sgvf_drake.experiments.route import routes_summary
from sgvf_drake.metrics import REACH_DISTANCE
from sgvf_drake.network_metrics import WAY_OFF
from sgvf_drake.passages import passages, straight_fraction
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.planning import shortest
from systems import Mode, SensorParameters
from tests.helpers import names_in, summary_of
from tests.networks import straight_network

SPEED = 0.55


@pytest.fixture(scope="module")
def covered(tee_field):
    """The T over all of its edges, by ideal measurements."""
    (route,) = covering_routes(tee_field.network)
    return fly_route(tee_field, route, speed=SPEED)


def rows(result, field):
    """The log since one U after the first reach, while the route is followed."""
    log, unit = result.log, field.cloud.unit_length
    reached = log["time"][log["cross_track_error"] <= REACH_DISTANCE * unit].min()
    since = reached + WAY_OFF * unit / SPEED
    return log[(log["time"] >= since - 1e-6) & (log["mode"] == Mode.FOLLOW)]


def test_a_network_is_flown_over_every_edge(covered, tee_field):
    summary = covered.summary()
    assert summary["route"] == list(covered.itinerary.edges)
    assert {abs(number) for number in summary["route"]} == {1, 2, 3}
    assert summary["route_completed"] is True
    assert summary["turn_fraction"] == 1.0
    unit = tee_field.cloud.unit_length
    assert summary["cross_track_rms_m"] <= 0.01 * unit
    # Three ends, where it turns round, and the junction.
    assert summary["turned_nodes"] == 4
    assert summary["speed_min_m_s"] > 0.4 * SPEED
    length = summary["route_length_m"]
    assert length / SPEED < summary["duration_s"] < 1.4 * length / SPEED


def test_figures_are_those_of_the_log(covered, tee_field):
    summary, flown = covered.summary(), rows(covered, tee_field)
    network, sigma = tee_field.network, tee_field.memory_length
    # Only one place of each row is needed: all nodes of a T are turned at.
    places = np.array([node.place for node in network.nodes])
    p = flown[["x", "y"]].to_numpy()
    near = np.linalg.norm(p[:, None] - places, axis=2).min(axis=1) <= 2 * sigma
    error = flown["cross_track_error"].to_numpy()
    assert summary["cross_track_rms_m"] == pytest.approx(np.sqrt(np.mean(error[~near] ** 2)))
    assert summary["cross_track_max_m"] == error[~near].max()
    assert summary["turn_error_max_m"] == error[near].max()
    # No edge is nearer than the one in use.
    assert (error >= network.path.project(p).distance - 1e-9).all()
    assert list(covered.log.columns[-4:]) == ["mode", "edge", "arc", "cross_track_error"]


@pytest.mark.full
def test_an_eight_is_flown_straight_on_with_noise_and_delay(eight_field):
    (route,) = covering_routes(eight_field.network)
    result = fly_route(eight_field, route, speed=SPEED, sensors=SensorParameters(), seed=3)
    summary, network = result.summary(), eight_field.network
    assert summary["route_completed"] is True
    assert summary["turned_nodes"] == 0
    assert summary["turn_error_max_m"] is None
    positions = result.log[["x", "y"]].to_numpy()[:, None]
    assert straight_fraction(passages(positions, network), network) == 1.0
    assert summary["turn_fraction"] == 1.0
    assert summary["cross_track_rms_m"] <= 0.02 * eight_field.cloud.unit_length
    assert summary["speed_min_m_s"] > 0.8 * SPEED


def test_a_point_is_flown_to_the_shortest_way(tee_field):
    network = tee_field.network
    below = next(node for node in network.nodes if node.degree == 1 and node.place[1] < -1)
    target = below.place + np.array([0.0, 1.0])
    route = to_point(network, target, FlightSpec(start=(-2.0, 0.1, 1.0)))
    assert len(route.edges) == 2
    assert route.length == pytest.approx(4.0, abs=0.1)
    result = fly_route(tee_field, route, speed=SPEED)
    summary = result.summary()
    assert summary["route_completed"] is True
    end = result.log[["x", "y"]].iloc[-1]
    np.testing.assert_allclose(end, target, atol=0.05)
    assert result.log["mode"].iloc[-1] == Mode.HOLD
    speed = np.hypot(result.log["vx"], result.log["vy"])
    assert speed.iloc[-1] < 0.01
    assert summary["speed_min_m_s"] > 0.4 * SPEED


@pytest.mark.parametrize("target", [(1.0,), (np.nan, 0.0), (1.0, 2.0, 3.0)])
def test_a_point_that_is_none_is_refused(tee_field, target):
    with pytest.raises(ConfigurationError, match="is no point in 2 dimensions"):
        to_point(tee_field.network, target, FlightSpec())


def test_a_start_is_beside_that_of_the_route_and_apart_from_other_edges():
    # A cross of four arms: the place that is farthest from all is between two of them.
    places = [[0, 0], [4, 0], [0, 4], [-4, 0], [0, -4]]
    network = straight_network(places, [(0, 1), (0, 2), (0, 3), (0, 4)])
    start, heading = route_start(Itinerary.along([1], network), 1.5)
    np.testing.assert_allclose(heading, [1.0, 0.0])
    assert start[2] == 1.5
    assert np.linalg.norm(start[:2]) == pytest.approx(0.5 * network.unit_length)
    np.testing.assert_allclose(np.abs(start[:2]), 0.5 * network.unit_length / np.sqrt(2))
    assert start[0] < 0
    # At an end it is behind it.
    start, heading = route_start(Itinerary.along([-1], network), 1.5)
    np.testing.assert_allclose(heading, [-1.0, 0.0])
    np.testing.assert_allclose(start, [4.0 + 0.5 * network.unit_length, 0.0, 1.5], atol=1e-9)


def test_several_routes_leave_a_log_and_a_figure_each(tee_field, tmp_path):
    network = tee_field.network
    routes = [shortest(network, (x, 1.5), (x + 1.0, 1.5)) for x in (-2.5, 1.0)]
    spec = FlightSpec(laps=1.0, speed=SPEED)
    summary = run_routes(tee_field, routes, tmp_path / "out", spec)
    kinds = {f"route_{n}.{kind}" for n in (1, 2) for kind in ("parquet", "png")}
    assert names_in(tmp_path / "out") == {"summary.json", *kinds}
    assert summary_of(tmp_path / "out") == summary
    assert [len(route["route"]) for route in summary["routes"]] == [1, 1]
    for n, route in enumerate(routes, start=1):
        log = pd.read_parquet(tmp_path / "out" / f"route_{n}.parquet")
        end = route.line.vertices[-1]
        np.testing.assert_allclose(log[["x", "y"]].iloc[-1], end, atol=0.05)


def test_of_several_routes_the_worst_is_told(covered):
    single = covered.summary()
    assert routes_summary([covered]) == single
    both = routes_summary([covered, covered])
    assert both["routes"] == [single, single]
    assert both["route_completed"] is True
    for name in ("cross_track_rms_m", "turn_error_max_m", "speed_min_m_s"):
        assert both[name] == single[name]
