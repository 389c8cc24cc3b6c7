"""Nodes and ends that lie in gaps between the waypoints are not sure."""

import numpy as np
from numpy.typing import NDArray
import pytest
from scipy.stats import gamma

from sgvf_drake.clouds import PointCloud
from sgvf_drake.paths import Piece
from sgvf_drake.paths.assembly import Graph, Strand
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.gaps import keep_away
from sgvf_drake.paths.geometry import Chain, Course
from tests.networks import LOOP, SHAPES, STRAND, Shape, Topology, topology

Array = NDArray[np.float64]

RING = SHAPES["circle"].strands[0] / 4
SEEDS = [0, 1, *(pytest.param(seed, marks=pytest.mark.full) for seed in (2, 3))]


def is_unsure_or_right(points: Array, right: Topology) -> bool:
    network = find_paths(PointCloud(points))
    return network.unsure is not None or topology(network) == right


@pytest.mark.parametrize(("name", "seed"), [("square", 5), ("rose of three", 1)])
def test_wrong_paths_beside_gaps(name: str, seed: int) -> None:
    network = find_paths(PointCloud(SHAPES[name].sample(120, 0.05, random=True, seed=seed)))
    assert topology(network) not in SHAPES[name].topologies
    assert "a path may go on from one end to another" in str(network.unsure)


@pytest.mark.parametrize(("name", "seed"), [("circle", 3), ("star", 1)])
def test_wrong_paths_through_gaps(name: str, seed: int) -> None:
    """A tenth of the waypoints are strays, and paths lead to them."""
    points = SHAPES[name].sample(500, 0.05, random=False, seed=seed)
    box = points.min(axis=0), points.max(axis=0)
    strays = np.random.default_rng(seed).uniform(*box, (50, 2))
    network = find_paths(PointCloud(np.concatenate([points, strays])))
    assert topology(network) not in SHAPES[name].topologies
    assert "strands meet where there are no waypoints" in str(network.unsure)


@pytest.mark.parametrize("name", ["X", "T", "roundabout", "spiral", "eight"])
@pytest.mark.parametrize("random", [False, True])
def test_nodes_and_ends_of_dense_clouds_are_sure(name: str, random: bool) -> None:
    network = find_paths(PointCloud(SHAPES[name].sample(1_000, 0.02, random, seed=7)))
    assert topology(network) in SHAPES[name].topologies
    assert network.unsure is None


def test_waypoints_that_are_there_twelve_times_stay_sure() -> None:
    points = SHAPES["roundabout"].sample(200, 0.02, random=False, seed=7)
    network = find_paths(PointCloud(np.repeat(points, 12, axis=0)))
    assert topology(network) in SHAPES["roundabout"].topologies
    assert network.unsure is None


@pytest.mark.parametrize("seed", SEEDS)
def test_a_path_that_is_ten_times_sparser_half_way(seed: int) -> None:
    """On average its waypoints are so near to each other that its gaps are no accident."""
    rng = np.random.default_rng(seed)
    share = np.linspace(0, 1, 4_001)
    density = 1 + 9 * np.cos(np.pi * share) ** 2
    u = np.interp(rng.uniform(0, 1, 900), np.cumsum(density) / density.sum(), share)
    x = 8 * u
    points = np.column_stack([x, (0.1 + 0.25 * x) * np.sin(2 * np.pi * x / 1.6)])
    assert is_unsure_or_right(points, STRAND)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_ring_narrower_than_the_scale(seed: int) -> None:
    """At random, its waypoints are seen as a path at scales alone at which it has no hole."""
    shape = Shape([RING * 3 - [1, 0], RING / 2 + [3.2, 0]], (Topology(2, 2),))
    points = shape.sample(274, 0.0, random=True, seed=seed)
    assert is_unsure_or_right(points, Topology(2, 2))
    alone = find_paths(PointCloud(shape.strands[0][::20]))
    assert topology(alone) == LOOP
    assert alone.unsure is None


def stars(ways: Array) -> tuple[Graph, list[Chain], list[Course]]:
    """Nodes with three arms of length one and nine waypoints, the first of them so far away."""
    graph, routes, courses = Graph({}, {}), [], []
    line = Piece(np.array([[0.0, 0.0], [1.0, 0.0]]), closed=False)
    for number, way in enumerate(ways):
        node = 4 * number
        graph.places |= {node + k: np.zeros(2) for k in range(4)}
        for arm in range(1, 4):
            graph.strands[node + arm] = Strand(line.vertices, [node, node + arm])
            routes.append(Chain(((node + arm, 0),), closed=False))
            arc = np.linspace(way, 0.99, 9)
            courses.append(Course(line, np.array([0.0, 1.0]), 0.0, np.arange(9), arc))
    return graph, routes, courses


@pytest.mark.parametrize(("chance", "nodes"), [(5e-4, 1), (5e-5, 10)])
def test_of_many_nodes_one_may_be_a_less_likely_one(chance: float, nodes: int) -> None:
    # The ways are a tenth on average; the sum of three of them has a gamma distribution.
    usual, rare = 0.1, float(gamma.isf(chance, 3)) / 30
    assert keep_away(*stars(np.array([rare] + (nodes - 1) * [usual])))
    more = 3 * nodes - 1
    assert not keep_away(*stars(np.array([rare] + more * [usual])))
