"""Strands that pass each other are never joined in silence, and those that meet stay sure."""

import numpy as np
from numpy.typing import NDArray
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.paths.assembly import Graph, Strand
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.meetings import strands_pass
from tests.networks import SHAPES, Topology, topology

Array = NDArray[np.float64]


def two_circles(gap: float, count: int, random: bool, noise: float, seed: int) -> Array:
    """Circles this many spacings of their `count` points apart; noise in U."""
    rng = np.random.default_rng(seed)
    half = count // 2
    spacing = 2 * np.pi / half
    parts = []
    for x in (0, 2 + gap * spacing):
        even = np.arange(half) * spacing + rng.uniform(0, spacing)
        angle = rng.uniform(0, 2 * np.pi, half) if random else even
        parts.append(np.column_stack([x + np.cos(angle), np.sin(angle)]))
    points = np.concatenate(parts)
    U = np.ptp(points, axis=0).max() / 8
    return rng.permutation(points + noise * U * rng.normal(size=points.shape))


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.full)])
@pytest.mark.parametrize("gap", [1.5, 2, 3, 4])
@pytest.mark.parametrize(("random", "noise"), [(False, 0.0), (True, 0.0), (False, 0.02)])
def test_circles_that_nearly_touch_are_two_or_unsure(
    seed: int, gap: float, random: bool, noise: float
) -> None:
    network = find_paths(PointCloud(two_circles(gap, 500, random, noise, seed)))
    if network.unsure is None:
        assert topology(network) == Topology(2, 2)
    else:
        # It is said what would decide.
        assert "(sigma)" in network.unsure


@pytest.mark.parametrize("name", ["eight", "X", "trefoil", "roundabout"])
@pytest.mark.parametrize("noise", [0.0, 0.05])
@pytest.mark.parametrize("seed", [5, pytest.param(6, marks=pytest.mark.full)])
def test_strands_that_meet_are_sure(name: str, noise: float, seed: int) -> None:
    network = find_paths(PointCloud(SHAPES[name].sample(500, noise, random=False, seed=seed)))
    assert topology(network) in SHAPES[name].topologies
    assert network.unsure is None


def crossing(angle: float) -> Graph:
    """Two straight strands that cross in the origin at an angle in degrees, as a graph."""
    half = np.radians(angle / 2)
    ends = [(x, y * np.tan(half)) for x, y in ((-4, -4), (4, 4), (-4, 4), (4, -4))]
    graph = Graph({k: np.array(end) for k, end in enumerate(ends)}, {})
    graph.places[4] = np.zeros(2)
    for k, end in enumerate(ends):
        graph.strands[k] = Strand(np.linspace((0, 0), end, 50), [4, k])
    graph.through = {(0, 0): (1, 0), (1, 0): (0, 0), (2, 0): (3, 0), (3, 0): (2, 0)}
    return graph


@pytest.mark.parametrize("angle", [20.0, 35.0, 50.0])
def test_curves_tell_a_crossing_from_strands_that_bend_away(angle: float) -> None:
    """The ridge of both is the same: the waypoints are not."""
    x = np.linspace(-4, 4, 161)
    slope = np.tan(np.radians(angle / 2))
    straight = np.concatenate([np.column_stack([x, s * slope * x]) for s in (-1, 1)])
    # Hyperbolas have the same lines as asymptotes, .1 apart in the middle.
    bent = np.concatenate(
        [np.column_stack([x, s * np.hypot(slope * x, 0.05)]) for s in (-1, 1)]
    )
    assert not strands_pass(crossing(angle), straight, sigma=0.1)
    assert strands_pass(crossing(angle), bent, sigma=0.1)
