"""Measures along a path: planted turns, and lengths and drifts of fields in closed form."""

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import GuidingField
from sgvf_drake.paper.along_path import (
    GRID_SIZE,
    SHORTEST,
    SPACING,
    direction_row,
    directions,
    drift_row,
    lengths_row,
    sample_path,
)
from sgvf_drake.paths import Piece, ReferencePath, shape_path

RADIUS = 3.0


def turned(samples, backward=False, center=(0.0, 0.0)):
    """Unit vectors counter-clockwise around a centre, the other way where it is told."""
    away = samples.points - center
    around = np.column_stack([-away[:, 1], away[:, 0]])
    signs = np.where(backward, -1, 1) / np.linalg.norm(away, axis=1)
    return around * signs[:, None]


def angles(points):
    return np.degrees(np.arctan2(points[:, 1], points[:, 0]))


def test_samples_are_at_equal_steps_with_tangents_along_both_rings():
    samples = sample_path(shape_path("concentric-circles"), 1.0)
    radii = np.linalg.norm(samples.points, axis=1)
    np.testing.assert_allclose(radii, np.where(samples.pieces == 0, 2.0, 4.0), rtol=1e-6)
    np.testing.assert_allclose(samples.tangents, turned(samples), atol=2e-3)
    for piece, step in enumerate(samples.steps):
        here = samples.points[samples.pieces == piece]
        gaps = np.linalg.norm(here - np.roll(here, 1, axis=0), axis=1)
        np.testing.assert_allclose(gaps, step, rtol=1e-4)
        assert SPACING / 2 < step <= SPACING
    for backward in (False, True):
        row = direction_row(directions(samples, turned(samples, backward), 1.0))
        assert row == {"sources": 0.0, "conflicted": 0.0}
    # At a corner, between those of its sides.
    square = sample_path(shape_path("square"), 1.0)
    corner = np.linalg.norm(square.points - [3.0, -3.0], axis=1).argmin()
    np.testing.assert_allclose(square.tangents[corner], np.sqrt([0.5, 0.5]), atol=1e-9)


def test_two_flips_on_a_ring_make_one_source_and_one_sink_where_they_are():
    # Counter-clockwise on three quarters of the circle, from 90 degrees on: the arrows part
    # at 90 degrees, and meet at 0.
    samples = sample_path(shape_path("circle"), 1.0)
    angle = angles(samples.points)
    (piece,) = directions(samples, turned(samples, (angle > 0) & (angle < 90)), 1.0)
    np.testing.assert_allclose(angles(piece.sources), [90.0], atol=0.5)
    np.testing.assert_allclose(angles(piece.sinks), [0.0], atol=0.5)


def test_pieces_are_judged_apart():
    samples = sample_path(shape_path("separated-circles"), 1.0)
    vectors = turned(samples, center=(2.0, 0.0))
    # A uniform wind on the left ring.
    vectors[samples.pieces == 0] = [1.0, 0.0]
    first, second = directions(samples, vectors, 1.0)
    np.testing.assert_allclose(first.sources, [[-3.5, 0.0]], atol=SPACING)
    np.testing.assert_allclose(first.sinks, [[-0.5, 0.0]], atol=SPACING)
    assert len(second.sources) == len(second.sinks) == 0
    row = direction_row([first, second])
    assert row["sources"] == row["conflicted"] == 0.5


@pytest.mark.parametrize(("length", "conflicts"), [(0.8, 0), (1.3, 1)])
@pytest.mark.parametrize("unit", [1.0, 0.1])
def test_only_a_stretch_of_some_length_is_a_conflict(length, conflicts, unit):
    vertices = unit * shape_path("circle").pieces[0].vertices
    samples = sample_path(ReferencePath((Piece(vertices, closed=True),)), unit)
    half = np.degrees(length * SHORTEST / RADIUS) / 2
    # Across the first sample, where the list of samples begins and ends.
    (piece,) = directions(samples, turned(samples, abs(angles(samples.points)) < half), unit)
    assert (len(piece.sources), len(piece.sinks)) == (conflicts, conflicts)


def test_a_stretch_of_the_least_length_is_one_wherever_the_samples_begin():
    samples = sample_path(shape_path("circle"), 1.0)
    least = int(np.ceil(SHORTEST / samples.steps[0]))
    for first in (10, -2):
        for length, conflicts in ((least, 1), (least - 1, 0)):
            vectors = samples.tangents.copy()
            vectors[np.arange(first, first + length)] *= -1
            (piece,) = directions(samples, vectors, 1.0)
            assert (len(piece.sources), len(piece.sinks)) == (conflicts, conflicts)


def test_an_open_line_may_have_a_source_alone():
    line = ReferencePath((Piece(np.array([[-2.0, 0.0], [2.0, 0.0]]), closed=False),))
    samples = sample_path(line, 1.0)
    np.testing.assert_allclose(samples.tangents, [[1.0, 0.0]] * len(samples.points))
    (piece,) = directions(samples, samples.points - [0.5, 0.0], 1.0)
    np.testing.assert_allclose(piece.sources, [[0.5, 0.0]], atol=SPACING)
    assert len(piece.sinks) == 0


@pytest.fixture(scope="module")
def circle():
    """A circle, its samples, and waypoints on it."""
    path = shape_path("circle")
    return path, sample_path(path, RADIUS / 4), PointCloud(path.pieces[0].sample(200))


def test_lengths_are_those_of_a_linear_tangent(circle, turning_field):
    path, _, cloud = circle
    # The other is twice as long, and without a score.
    once, twice = (
        lengths_row(turning_field(cloud, **options), path)
        for options in ({}, {"size": 2.0, "gain": 1e-12})
    )
    # Over the box of half-size h = 5 U = 1.25 R, |v| is r = |x| / R.
    assert once["v_box_max"] == pytest.approx(1.25 * np.sqrt(2), rel=1e-6)
    assert twice["v_box_max"] == pytest.approx(2 * once["v_box_max"])
    # Near: less than 0.1 U = R / 40 from the circle.  Away: more than U.
    r = np.hypot(*np.meshgrid(*[np.linspace(-1.25, 1.25, GRID_SIZE)] * 2))
    fading = r[np.abs(r - 1) < 0.025].mean() / r[np.abs(r - 1) > 0.25].mean()
    assert once["fading"] == pytest.approx(fading, rel=1e-3)
    assert twice["fading"] == pytest.approx(once["fading"])
    # Without a score, m is v, which is longer.
    assert twice["m_error"] == pytest.approx(np.sqrt(((2 * r - 1) ** 2).mean()), rel=1e-6)
    assert twice["leads_away"] == 1.0


@pytest.mark.parametrize("angle", [0.0, 0.05, 0.2])
def test_a_tilt_is_found_with_its_angle_and_its_drift(circle, turning_field, angle):
    path, samples, cloud = circle
    row = drift_row(turning_field(cloud, angle), path, samples)
    # The score of the waypoints is radial up to what lies between them.
    assert row["beside_cosine"] == pytest.approx(np.sin(angle), abs=1e-3)
    # Inside the ring the same tilt is toward it: away and toward cancel.
    assert row["outward"] == pytest.approx(0.0, abs=1e-3)
    # A logarithmic spiral: the distance grows by sin(angle) a unit of way.
    assert row["drift_u"] == pytest.approx(3.0 * np.sin(angle), rel=0.01, abs=1e-3)


def test_the_unit_of_the_waypoints_changes_no_drift(circle, turning_field):
    path, samples, cloud = circle
    row = drift_row(turning_field(cloud, 0.2), path, samples)
    small = path.rescaled(0.01)
    again = drift_row(
        turning_field(PointCloud(0.01 * cloud.points), 0.2),
        *(small, sample_path(small, 0.01 * RADIUS / 4)),
    )
    assert again == pytest.approx(row, abs=1e-6)


def test_away_from_the_ring_on_both_sides_is_outward(circle, turning_field):
    path, samples, cloud = circle

    class Fleeing(GuidingField):
        """The score backwards is outward everywhere."""

        def components(self, x):
            s, _ = super().components(x)
            return s, -s

    row = drift_row(Fleeing(**vars(turning_field(cloud))), path, samples)
    assert row["outward"] == pytest.approx(1.0, abs=1e-3)
    assert row["beside_cosine"] == pytest.approx(1.0, abs=1e-9)
