"""Rows of a coverage as near to each other as their waypoints are right, or unsure."""

import numpy as np
from numpy.typing import NDArray
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import PointCloudError
from sgvf_drake.paths.finding import find_paths
from tests.networks import STRAND, Topology, topology

Array = NDArray[np.float64]

STEPS = 36
"""Of a row, each of length 1."""


def coverage(rows: int, distance: float, turns: bool) -> Array:
    """Rows there and back, with waypoints also on the turns or without, in their order."""
    corners = np.array([(x, distance * row) for row in range(rows) for x in (0.0, STEPS)])
    corners[2::4], corners[3::4] = corners[3::4].copy(), corners[2::4].copy()
    if turns:
        arc = np.append(0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))
        at = np.linspace(0, arc[-1], round(arc[-1]) + 1)
        return np.column_stack([np.interp(at, arc, x) for x in corners.T])
    return np.concatenate([np.linspace(*ends, STEPS + 1) for ends in corners.reshape(-1, 2, 2)])


def is_unsure_or_right(points: Array, rows: int, distance: float) -> bool:
    """Whether one serpentine is found, or the rows alone, or it says that it is unsure."""
    try:
        network = find_paths(PointCloud(points))
    except PointCloudError:
        return True
    lengths = {
        STRAND: rows * STEPS + (rows - 1) * distance,
        Topology(rows, 0, ends=2 * rows): rows * STEPS,
    }
    found = topology(network)
    right = found in lengths and abs(network.length / lengths[found] - 1) < 0.1
    return right or network.unsure is not None


@pytest.mark.parametrize(
    "rows", [3, *(pytest.param(rows, marks=pytest.mark.full) for rows in (6, 14))]
)
@pytest.mark.parametrize("distance", [1.0, 1.5, 2.0])
@pytest.mark.parametrize("turns", [False, True])
def test_near_rows_are_never_wrong_and_sure(rows: int, distance: float, turns: bool) -> None:
    points = coverage(rows, distance, turns)
    assert is_unsure_or_right(points, rows, distance)
    for seed in (0, 1):
        rng = np.random.default_rng(seed)
        noisy = points + rng.normal(0, 0.05, points.shape)
        assert is_unsure_or_right(rng.permutation(noisy), rows, distance)


@pytest.mark.parametrize("turns", [False, True])
def test_far_rows_are_sure(turns: bool) -> None:
    points = coverage(6, 3.0, turns)
    network = find_paths(PointCloud(points))
    assert network.unsure is None
    assert topology(network) == STRAND
    assert network.length == pytest.approx(6 * STEPS + 5 * 3, rel=0.02)


def test_rows_name_the_option_that_decides() -> None:
    points = coverage(6, 1.5, turns=False)
    assert "rows along it" in str(find_paths(PointCloud(points)).unsure)
    band = find_paths(PointCloud(points), passes=True)
    assert band.unsure is None
    assert topology(band) == STRAND


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.full)])
@pytest.mark.parametrize("dim", [2, 3])
def test_scatter_about_a_line_is_no_row(seed: int, dim: int) -> None:
    rng = np.random.default_rng(seed)
    x = np.linspace(-4, 4, 800)
    points = np.column_stack([x, 0.5 * np.sin(x), 0 * x])[:, :dim]
    network = find_paths(PointCloud(points + rng.normal(0, 0.08, points.shape)))
    assert network.unsure is None
    assert topology(network) == STRAND


@pytest.mark.parametrize(
    "count", [300, *(pytest.param(count, marks=pytest.mark.full) for count in (1_000, 5_000))]
)
def test_lanes_far_apart_for_their_scatter_are_no_line(count: int) -> None:
    """They are eight times their scatter from each other, with waypoints at random."""
    rng = np.random.default_rng(0)
    lane = 0.4 * rng.integers(0, 5, count)
    points = np.column_stack([rng.uniform(-4, 4, count), lane + rng.normal(0, 0.05, count)])
    network = find_paths(PointCloud(points))
    assert topology(network) == Topology(5, 0, ends=10) or network.unsure is not None
