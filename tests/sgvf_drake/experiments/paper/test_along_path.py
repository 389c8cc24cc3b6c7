"""Which way a field runs along a path: planted turns on rings, on pieces, on an open line."""

import numpy as np
import pytest

from sgvf_drake.experiments.paper.ablation.along_path import (
    SHORTEST,
    STEP,
    directions,
    sample_path,
)
from sgvf_drake.experiments.paper.ablation.measures import direction_row
from sgvf_drake.paths import Piece, ReferencePath, shape_path

UNIT = 1.0


def around(x, center=(0.0, 0.0)):
    """A quarter turn of the direction from a centre: counter-clockwise on its rings."""
    away = x - center
    return np.column_stack([-away[:, 1], away[:, 0]]) / np.linalg.norm(
        away, axis=1, keepdims=True
    )


def angles(points, center=(0.0, 0.0)):
    return np.degrees(np.arctan2(*(points - center).T[::-1]))


def test_samples_are_at_equal_steps_with_unit_tangents_on_both_rings():
    samples = sample_path(shape_path("concentric-circles"), UNIT)
    radii = np.linalg.norm(samples.points, axis=1)
    np.testing.assert_allclose(radii, np.where(samples.pieces == 0, 2.0, 4.0), rtol=1e-6)
    np.testing.assert_allclose(samples.tangents, around(samples.points), atol=2e-3)
    for piece, step in enumerate(samples.steps):
        here = samples.points[samples.pieces == piece]
        gaps = np.linalg.norm(here - np.roll(here, 1, axis=0), axis=1)
        np.testing.assert_allclose(gaps, step, rtol=1e-4)
        assert STEP / 2 < step <= STEP


def test_a_tangent_at_a_corner_is_between_those_of_its_sides():
    samples = sample_path(shape_path("square"), UNIT)
    corner = np.linalg.norm(samples.points - [3.0, -3.0], axis=1).argmin()
    np.testing.assert_allclose(samples.tangents[corner], np.sqrt([0.5, 0.5]), atol=1e-9)


def test_a_field_around_the_rings_has_no_conflict_either_way_around():
    samples = sample_path(shape_path("concentric-circles"), UNIT)
    for sign in (1, -1):
        row = direction_row(directions(samples, sign * around(samples.points), UNIT))
        assert row == {"sources": 0.0, "sinks": 0.0, "conflicted": 0.0, "opposed": 0.0}


def test_two_flips_on_a_ring_make_one_source_and_one_sink_where_they_are():
    # Counter-clockwise on three quarters of the circle, from 90 degrees on: the arrows part
    # at 90 degrees, and meet at 0.
    samples = sample_path(shape_path("circle"), UNIT)
    angle = angles(samples.points)
    backward = (angle > 0) & (angle < 90)
    vectors = around(samples.points) * np.where(backward, -1, 1)[:, None]
    (piece,) = directions(samples, vectors, UNIT)
    assert piece.has_conflict
    np.testing.assert_allclose(angles(piece.sources), [90.0], atol=0.5)
    np.testing.assert_allclose(angles(piece.sinks), [0.0], atol=0.5)
    assert piece.against == pytest.approx(0.25, abs=0.002)


def test_pieces_are_judged_apart():
    path = shape_path("separated-circles")
    samples = sample_path(path, UNIT)
    vectors = around(samples.points, (2.0, 0.0))
    left = samples.pieces == 0
    # A uniform wind on the left ring: from its lowest point to its highest... sideways.
    vectors[left] = [1.0, 0.0]
    first, second = directions(samples, vectors, UNIT)
    assert not second.has_conflict
    np.testing.assert_allclose(first.sources, [[-3.5, 0.0]], atol=STEP)
    np.testing.assert_allclose(first.sinks, [[-0.5, 0.0]], atol=STEP)
    row = direction_row([first, second])
    assert row["sources"] == row["sinks"] == row["conflicted"] == 0.5
    assert row["opposed"] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(("length", "conflicts"), [(0.8, 0), (1.3, 1)])
def test_only_a_stretch_of_some_length_is_a_conflict(length, conflicts):
    samples = sample_path(shape_path("circle"), UNIT)
    half = np.degrees(length * SHORTEST / 3.0) / 2
    # Across the first sample, where the list of samples begins and ends.
    backward = np.abs(angles(samples.points)) < half
    vectors = around(samples.points) * np.where(backward, -1, 1)[:, None]
    (piece,) = directions(samples, vectors, UNIT)
    assert (len(piece.sources), len(piece.sinks)) == (conflicts, conflicts)


def test_the_unit_scales_what_is_long():
    small = ReferencePath((Piece(shape_path("circle").pieces[0].vertices / 10, closed=True),))
    samples = sample_path(small, UNIT / 10)
    assert len(samples.points) == len(sample_path(shape_path("circle"), UNIT).points)
    backward = np.abs(angles(samples.points)) < 10
    vectors = around(samples.points) * np.where(backward, -1, 1)[:, None]
    # 20 degrees of 0.3 are 0.1: one U here, and less than the shortest stretch of a larger U.
    assert directions(samples, vectors, UNIT / 10)[0].has_conflict
    assert not directions(samples, vectors, UNIT)[0].has_conflict


def test_an_open_line_may_have_a_source_alone():
    line = ReferencePath((Piece(np.array([[-2.0, 0.0], [2.0, 0.0]]), closed=False),))
    samples = sample_path(line, UNIT)
    np.testing.assert_allclose(samples.tangents, [[1.0, 0.0]] * len(samples.points))
    (piece,) = directions(samples, samples.points - [0.5, 0.0], UNIT)
    np.testing.assert_allclose(piece.sources, [[0.5, 0.0]], atol=STEP)
    assert len(piece.sinks) == 0
    assert piece.against == pytest.approx(1.5 / 4, abs=0.01)
