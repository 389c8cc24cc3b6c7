"""Pursuit: which waypoint is headed for."""

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import Field, PursuitField
from sgvf_drake.paths import PointCloud

# Corners of a square of half-extent 4, so that U is 1, and points between them.
SQUARE = np.array([[4, -4], [4, 0], [4, 4], [0, 4], [-4, 4], [-4, 0], [-4, -4], [0, -4]], float)


def heading(field, x):
    """The waypoint that a field heads for, from x."""
    away = field.cloud.points - x
    cosine = away @ field(x) / np.linalg.norm(away, axis=1)
    assert np.isclose(cosine.max(), 1.0)
    return int(cosine.argmax())


@pytest.mark.parametrize(
    ("look_ahead", "target"), [(0.5, 2), (4.0, 2), (4.01, 3), (8.1, 4), (30.0, 1), (99.0, 1)]
)
def test_it_heads_for_the_first_waypoint_that_is_far_enough_ahead(look_ahead, target):
    field = PursuitField(PointCloud(SQUARE), look_ahead)
    assert isinstance(field, Field)
    # Nearest to number 1, and on no line through two waypoints.
    assert heading(field, np.array([3.1, 0.3])) == target


def test_after_the_last_waypoint_comes_the_first():
    field = PursuitField(PointCloud(SQUARE))
    assert heading(field, np.array([0.2, -4.3])) == 0
    assert heading(PursuitField(PointCloud(SQUARE), 10.0), np.array([0.2, -4.3])) == 2


def test_the_order_is_taken_as_given():
    field = PursuitField(PointCloud(SQUARE[::-1]))
    target = field.cloud.points[heading(field, np.array([3.1, 0.3]))]
    assert target.tolist() == [4, -4]


def test_derivatives_between_the_jumps(check_derivatives):
    field = PursuitField(PointCloud(SQUARE))
    x = np.array([[3.0, 0.5], [-1.0, 2.9], [4.5, 4.5]])
    np.testing.assert_allclose(np.linalg.norm(field(x), axis=1), 1.0, atol=1e-9)
    check_derivatives(field, x, 1.0)


def test_a_bad_look_ahead_is_refused():
    with pytest.raises(ConfigurationError, match="look_ahead must be a positive number"):
        PursuitField(PointCloud(SQUARE), -1.0)
