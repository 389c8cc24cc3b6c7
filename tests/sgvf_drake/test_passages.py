"""What agents did on a network, from motions along its lines that are known."""

import numpy as np
from numpy.typing import NDArray
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.network_metrics import network_metrics
from sgvf_drake.passages import (
    errors_in_use,
    passages,
    runs_along,
    straight_fraction,
    straight_on,
    turn_fraction,
)
from sgvf_drake.paths import PathNetwork
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.itinerary import Itinerary, oriented_line
from sgvf_drake.paths.planning import covering
from tests.networks import clean_network, straight_network

Array = NDArray[np.float64]
STEP = 0.05


def along(itinerary: Itinerary, laps: float = 1.0) -> Array:
    """A motion (T, 1, d) along an itinerary."""
    length = laps * itinerary.length
    arc = np.linspace(0, length, round(length / STEP))
    if itinerary.closed:
        arc %= itinerary.length
    return itinerary.line.at(arc)[:, None]


def times_of(positions: Array) -> Array:
    steps = np.linalg.norm(np.diff(positions[:, 0], axis=0), axis=1)
    return np.append(0.0, np.cumsum(np.maximum(steps, 1e-9)))


def box_of(network: PathNetwork) -> tuple[Array, Array]:
    points = np.concatenate([edge.line.vertices for edge in network.edges])
    return points.min(axis=0) - 1, points.max(axis=0) + 1


@pytest.mark.parametrize("name", ["T", "Y", "eight", "grid", "roundabout", "Y in space"])
def test_a_motion_along_an_itinerary_passes_its_edges_in_order(name: str) -> None:
    network = clean_network(name)
    itinerary = covering(network)
    laps = 1.5 if itinerary.closed else 1.0
    edges = [p.edge for p in passages(along(itinerary, laps), network)[0]]
    wanted = [*itinerary.edges, *itinerary.edges]
    assert edges == wanted[: len(edges)]
    assert len(edges) >= len(itinerary.edges)
    own = passages(along(itinerary, laps), network)
    assert turn_fraction(own, itinerary) == 1
    assert errors_in_use(along(itinerary)[:, 0], own[0][:-1], network).max() < 1e-6


def test_an_itinerary_is_run_along_if_no_edge_is_left_out() -> None:
    network = clean_network("grid")
    tour = covering(network)
    whole = passages(along(tour, 1.3), network)[0]
    assert runs_along(whole, tour)
    for k in range(len(tour.edges) - 1):
        assert not runs_along([*whole[:k], *whole[k + 1 : len(tour.edges)]], tour)
    # An open one need not pass the middles of the edges on which it begins and ends.
    part = Itinerary.along(tour.edges[:4], network, closed=False)
    assert runs_along(whole[1:3], part)
    assert not runs_along(whole[1:2], part)


def test_to_and_fro_through_a_gate_is_no_passage() -> None:
    network = clean_network("T")
    line = oriented_line(network, 1)[:, None]
    middle = len(line) // 2
    there, back = line[: middle + 3], line[middle - 3 : middle + 3][::-1]
    motion = np.concatenate([there, back, line[middle - 3 :]])
    assert [p.edge for p in passages(motion, network)[0]] == [1]
    # Who went to the end and came back passed it twice.
    turned = np.concatenate([line, line[::-1]])
    assert [p.edge for p in passages(turned, network)[0]] == [1, -1]


def test_what_lies_ahead_of_a_crossing_is_known_both_ways() -> None:
    network = clean_network("eight")
    assert straight_on(network) == {1: 2, 2: 1, -1: -2, -2: -1}
    grid = straight_on(clean_network("grid"))
    # One crossing with four arms.
    assert len(grid) == 4
    assert all(grid[-after] == -before for before, after in grid.items())


def test_turns_at_a_crossing_are_not_straight() -> None:
    # A plus of four arms, each 4 long: 1 and 2 along x, 3 and 4 along y.
    network = clean_network("X")
    ahead = straight_on(network)
    inwards = next(number for number in ahead)
    straight = np.concatenate([oriented_line(network, n) for n in (inwards, ahead[inwards])])
    other = next(n for n in ahead.values() if abs(n) not in (abs(inwards), abs(ahead[inwards])))
    turned = np.concatenate([oriented_line(network, n) for n in (inwards, other)])
    for line, fraction in ((straight, 1.0), (turned, 0.0)):
        assert straight_fraction(passages(line[:, None], network), network) == fraction


def test_a_route_that_is_left_counts_as_left() -> None:
    network = clean_network("T")
    tour = covering(network)
    wish = Itinerary.along(tour.edges[:2], network, closed=False)
    # Straight to the third edge in place of the second.
    second = wish.edges[1]
    third = next(n for n in (1, 2, 3, -1, -2, -3) if abs(n) not in map(abs, wish.edges))
    if not np.allclose(oriented_line(network, third)[0], oriented_line(network, second)[0]):
        third = -third
    motion = np.concatenate([oriented_line(network, n) for n in (wish.edges[0], third)])
    assert turn_fraction(passages(motion[:, None], network), wish) == 0


def test_a_route_may_be_joined_on_an_edge_that_it_has_twice() -> None:
    network = clean_network("grid")
    tour = covering(network)
    assert len(set(tour.edges)) < len(tour.edges)
    whole = passages(along(tour, 2), network)[0]
    for joined in range(len(tour.edges)):
        assert turn_fraction([whole[joined:]], tour) == 1


def test_the_error_is_to_the_edge_in_use_and_not_to_the_nearest_one() -> None:
    network = clean_network("X")
    ahead = straight_on(network)
    inwards = next(iter(ahead))
    line = np.concatenate([oriented_line(network, n) for n in (inwards, ahead[inwards])])
    own = passages(line[:, None], network)[0]
    # Moved aside by .2 all along: near the crossing the other strand is nearer.
    tangent = np.gradient(line, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    aside = line + 0.2 * np.column_stack([-tangent[:, 1], tangent[:, 0]])
    between = slice(own[0].sample + 5, own[-1].sample - 5)
    nearest = network.path.project(aside).distance[between]
    errors = errors_in_use(aside, own, network)[between]
    assert nearest.min() < 0.05
    np.testing.assert_allclose(errors, 0.2, atol=0.03)


def test_a_lap_needs_every_edge_in_order_and_near() -> None:
    network = clean_network("eight")
    route = covering(network)
    whole, part = along(route, 1.9), along(route, 0.9)
    far = whole.copy()
    far[len(far) // 2 :, :, 0] += 0.5
    # Through all gates, and astray between them.
    middles = np.array([edge.line.at(np.array([edge.length / 2]))[0] for edge in network.edges])
    away = np.linalg.norm(whole - middles, axis=2).min(axis=1) > 1
    astray = whole + 0.5 * away[:, None, None]
    for positions, lapped in ((whole, True), (part, False), (far, False), (astray, False)):
        metrics = network_metrics(
            times_of(positions), positions, network, box_of(network), np.empty((0, 2))
        )
        assert metrics.lapped.tolist() == [lapped]
        assert metrics.summary()["lap_fraction"] == float(lapped)
        if lapped:
            # The errors are those of one whole lap.
            first, until = (times_of(positions)[k[0]] for k in (metrics.first, metrics.until))
            assert until - first == pytest.approx(route.length, abs=2 * STEP)
    assert metrics.straight_fraction == 1


@pytest.mark.parametrize("rests", [True, False])
def test_rest_at_an_end_of_a_network_is_no_stall_and_elsewhere_it_is(rests: bool) -> None:
    network = clean_network("T")
    ends = np.array([node.place for node in network.nodes if node.kind == "end"])
    place = ends[0] if rests else network.edges[0].line.at(np.array([1.0]))[0]
    positions = np.broadcast_to(place, (400, 1, 2))
    times = STEP * np.arange(400)
    metrics = network_metrics(times, positions, network, box_of(network), ends)
    assert metrics.stalled.tolist() == [not rests]
    assert metrics.kind == ["network"]


def test_an_agent_may_reach_the_path_after_it_has_come_to_an_end_beside_it() -> None:
    network = straight_network(np.array([[-4.0, 0.0], [4.0, 0.0]]), [(0, 1)])
    height = np.maximum(np.linspace(2.0, -2.0, 200), 0.09)
    positions = np.stack([np.full(200, 4.0), height], axis=1)[:, None]
    times = 0.02 * np.arange(200)
    ends = np.array([[4.0, 0.15]])
    found = network_metrics(times, positions, network, box_of(network), ends)
    assert found.ended.tolist() == [True]
    assert found.maximum == pytest.approx([0.1], abs=0.02)
    assert found.first <= found.until


def test_robots_that_cut_a_tip_short_ran_along_its_edge() -> None:
    """The tip of a letter A, at the middle of its edge: half a U of it is left out."""
    strokes = [[(-2, -4), (0, 4)], [(0, 4), (2, -4)], [(-1, 0), (1, 0)]]
    share = np.linspace(0, 1, 200)[:, None]
    network = find_paths(
        PointCloud(np.concatenate([a + share * np.subtract(b, a) for a, b in strokes]))
    )
    (tipped,) = [edge for edge in network.edges if edge.line.vertices[:, 1].max() > 3]
    assert tipped.line.at(np.array([tipped.length / 2]))[0, 1] > 3.8
    route = covering(network)
    positions = along(route)
    cut = positions[positions[:, 0, 1] < 3.5]
    for moved in (positions, cut):
        passed = passages(moved, network)
        assert [passage.edge for passage in passed[0]] == list(route.edges)
        assert turn_fraction(passed, route) == 1.0
