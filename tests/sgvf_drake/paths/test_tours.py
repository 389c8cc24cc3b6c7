"""Through sparse waypoints run the shortest paths, or it is said that they do not decide."""

import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.spatial.distance import cdist

from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments.clouds import make_cloud
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.tours import DOUBT, GAP, MOST_WAYPOINTS, Tours, find_tours
from tests.networks import LOOP, SHAPES, STRAND, Shape, Topology, topology

Array = NDArray[np.float64]

NAMED = (
    *("concentric-circles", "separated-circles", "circle", "square"),
    *("hexagon", "octagon", "triangle", "star"),
)


def arc(degrees: float, radius: float = 4.0) -> Array:
    angle = np.radians(np.linspace(0, degrees, 1_000))
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def sparse_cloud(shape: Shape, seed: int) -> PointCloud:
    return PointCloud(shape.sample(40, 0.05, random=False, seed=seed))


@pytest.mark.parametrize("name", NAMED)
@pytest.mark.parametrize("seed", range(3))
def test_forty_waypoints_show_the_named_shapes(name: str, seed: int) -> None:
    cloud, truth = make_cloud(name, "forty", seed)
    network = find_paths(cloud)
    assert network.unsure is None
    assert topology(network) == Topology(len(truth.pieces), len(truth.pieces))
    true_points = np.concatenate([piece.sample(500) for piece in truth.pieces])
    # At a corner it is at most half a step that no waypoint marks.
    assert network.path.project(true_points).distance.max() < 0.4 * network.unit_length


def test_lines_run_through_all_waypoints() -> None:
    cloud, _ = make_cloud("star", "forty", seed=0)
    network = find_paths(cloud)
    assert network.path.project(cloud.points).distance.max() < 1e-9 * network.unit_length
    assert network.dropped == 0


@pytest.mark.parametrize(
    ("strands", "found"),
    [
        ([arc(180)], STRAND),
        ([arc(270)], STRAND),
        ([arc(360, 1.5), arc(200)], Topology(2, 1, ends=2)),
    ],
)
def test_paths_end_where_the_next_waypoint_is_far(
    strands: list[Array], found: Topology
) -> None:
    network = find_paths(sparse_cloud(Shape(strands, (found,)), seed=0))
    assert (topology(network), network.unsure) == (found, None)


def test_a_knot_in_space() -> None:
    network = find_paths(sparse_cloud(SHAPES["trefoil in space"], seed=0))
    assert (topology(network), network.unsure) == (LOOP, None)


@pytest.mark.parametrize("name", ["eight", "T", "Y", "X", "Y in space"])
def test_where_strands_meet_the_ridge_decides(name: str) -> None:
    cloud = sparse_cloud(SHAPES[name], seed=0)
    sparse = find_tours(cloud.normalize(cloud.points))
    assert sparse is not None
    assert not sparse.apart
    network = find_paths(cloud)
    assert topology(network) in SHAPES[name].topologies
    assert network.unsure is None


@pytest.mark.parametrize("name", ["grid", "trefoil", "rose of three", "rose of four"])
@pytest.mark.parametrize("random", [False, True])
def test_what_is_too_sparse_is_unsure(name: str, random: bool) -> None:
    network = find_paths(PointCloud(SHAPES[name].sample(40, 0.05, random, seed=0)))
    assert network.unsure is not None


def test_a_short_loop_may_be_a_path_there_and_back() -> None:
    """That is half of its steps and a gap in place of all of them."""
    angle = 2 * np.pi * np.arange(8) / 8
    octagon = np.column_stack([np.cos(angle), np.sin(angle)]) / (2 * np.sin(np.pi / 8))
    loop = Tours([np.arange(8)], cdist(octagon, octagon), GAP)
    assert loop.margin() == pytest.approx(8 / 2 - GAP)


def test_strands_as_near_as_their_waypoints_are_unsure() -> None:
    x = np.linspace(-4, 4, 14)
    lines = np.concatenate([np.column_stack([x, 0 * x]), np.column_stack([x, 0 * x + 0.8])])
    assert find_paths(PointCloud(lines)).unsure == DOUBT


def test_neither_the_order_nor_a_turn_of_the_waypoints_matters() -> None:
    cloud, _ = make_cloud("concentric-circles", "forty", seed=4)
    angle = np.radians(31.0)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    network = find_paths(cloud)
    shuffled = np.random.default_rng(0).permutation(cloud.points)
    assert find_paths(PointCloud(shuffled)).to_json() == network.to_json()
    turned = find_paths(PointCloud(cloud.points @ rotation.T))
    assert topology(turned) == topology(network)
    assert turned.length == pytest.approx(network.length)


def test_a_stray_is_left_out_of_a_loop() -> None:
    cloud, _ = make_cloud("circle", "forty", seed=0)
    for stray in ([4.5, 4.5], [0.2, 0.1]):
        network = find_paths(PointCloud(np.vstack([cloud.points, [stray]])))
        assert (topology(network), network.unsure, network.dropped) == (LOOP, None, 1)


def test_options_still_decide() -> None:
    cloud, _ = make_cloud("circle", "forty", seed=0)
    opened = find_paths(cloud, closed=False)
    assert topology(opened) == STRAND
    arc_cloud = sparse_cloud(Shape([arc(270)], (STRAND,)), seed=0)
    assert topology(find_paths(arc_cloud, closed=True)) == LOOP


def test_dense_and_many_waypoints_are_left_to_the_ridge() -> None:
    rng = np.random.default_rng(0)
    assert find_tours(SHAPES["circle"].sample(200, 0.0, random=True, seed=0)) is None
    assert find_tours(rng.uniform(-4, 4, (MOST_WAYPOINTS + 1, 3))) is None
    # A waypoint that is given twice is one.
    points = SHAPES["circle"].sample(40, 0.0, random=False, seed=0)
    once, twice = find_tours(points), find_tours(np.tile(points, (2, 1)))
    assert once is not None
    assert twice is not None
    assert once.graph.signature == twice.graph.signature
