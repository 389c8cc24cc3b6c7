"""A line between two strands is told from one along the middle of scattered waypoints."""

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.paths.assembly import Graph, Strand
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.valleys import runs_in_valley

SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in (1, 2))]


def hairpin(gap, noise, count=200, seed=0):
    """Two legs of 8 U, this far apart, with a round end; evenly spaced, in random order."""
    radius = gap / 2
    s = np.linspace(0, 16 + np.pi * radius, count, endpoint=False)
    turn = (s - 8) / radius
    x = np.where(s < 8, s, np.where(turn < np.pi, 8 + radius * np.sin(turn), 0))
    y = np.where(s < 8, -radius, np.where(turn < np.pi, -radius * np.cos(turn), radius))
    back = turn >= np.pi
    x[back] = 8 - (s[back] - 8 - np.pi * radius)
    rng = np.random.default_rng(seed)
    points = np.column_stack([x, y]) + noise * rng.standard_normal((count, 2))
    return rng.permutation(points)


def strip(width, count=400, seed=0):
    """A straight path whose waypoints are spread evenly across this width."""
    rng = np.random.default_rng(seed)
    return np.column_stack(
        [rng.uniform(0, 8, count), rng.uniform(-width / 2, width / 2, count)]
    )


@pytest.mark.parametrize("seed", SEEDS)
def test_the_legs_of_a_hairpin_are_no_bundle(seed):
    """They are merged at most of the scales, which then have no vote."""
    for noise in (0.0, 0.02):
        network = find_paths(PointCloud(hairpin(0.4, noise, 300, seed)))
        assert network.unsure is None
        assert network.num_pieces == 1
        assert network.length == pytest.approx(16 + 0.2 * np.pi, rel=0.03)


@pytest.mark.parametrize("seed", SEEDS)
def test_waypoints_that_scatter_are_one_path(seed):
    for width in (0.1, 0.4):
        network = find_paths(PointCloud(strip(width, seed=seed)))
        assert network.unsure is None
        assert network.num_pieces == 1
        assert network.kind(0) == "open path"


def test_strands_nearer_than_their_spacing_are_scatter():
    """Nothing tells two strands .1 apart from one path, where waypoints are .2 apart."""
    network = find_paths(PointCloud(hairpin(0.1, 0.0, 80)))
    assert network.length == pytest.approx(8, rel=0.05)


@pytest.mark.parametrize("both_sides", [True, False])
def test_a_line_that_cuts_a_bend_is_in_no_valley(both_sides):
    x = np.linspace(0, 8, 161)
    side = np.where(both_sides & (np.arange(161) % 2 == 1), -1.0, 1.0)
    points = np.column_stack([x, 0.2 * side])
    line = np.array([[0.0, 0.0], [8.0, 0.0]])
    graph = Graph({0: line[0], 1: line[1]}, {0: Strand(line, [0, 1])})
    assert runs_in_valley(graph, points, 0.3) == both_sides
