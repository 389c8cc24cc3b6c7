"""Waypoints, fields and tubes as they reach Meshcat, against their own values."""

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems.scene_drawing import (
    ARROW_HEAD,
    ARROW_HEAD_ANGLE,
    ARROW_LENGTH,
    FIELD_ARROWS,
    DrawField,
    DrawTube,
    DrawWaypoints,
    PlaneBox,
)

ALTITUDE = 1.25
BOX = ([-2.0, -1.0], [2.0, 2.0])
SPACING = 4.0 / FIELD_ARROWS


class Paper:
    """Stands for Meshcat, and keeps what is drawn on it."""

    def __init__(self):
        self.objects = {}

    def SetLineSegments(self, path, start, end, line_width, rgba):  # noqa: N802
        assert path not in self.objects
        self.objects[path] = (start.T, end.T)

    def SetObject(self, path, cloud, point_size, rgba):  # noqa: N802
        assert path not in self.objects
        self.objects[path] = (cloud.xyzs().T, point_size)


class AnyField:
    """A field given by a function of points (n, d)."""

    def __init__(self, dim, function):
        self.dim, self._function = dim, function

    def __call__(self, x):
        assert x.shape[1] == self.dim
        return self._function(x)


def arrows(field, box=BOX):
    """The shafts and the two strokes of each head, as start and end (n, 3)."""
    paper = Paper()
    DrawField(paper, field, box, ALTITUDE)
    assert list(paper.objects) == ["/field"]
    start, end = paper.objects["/field"]
    return [(s, e) for s, e in zip(np.split(start, 3), np.split(end, 3), strict=True)]


def test_arrows_of_a_spatial_field_show_the_slice_at_the_altitude(spatial_circle_field):
    (tail, tip), *_ = arrows(spatial_circle_field, ([-2, -1, -9], [2, 2, 9]))
    middle = (tail + tip) / 2.0
    np.testing.assert_allclose(middle[:, 2], ALTITUDE)
    m = spatial_circle_field(middle)
    assert np.abs(m[:, 2]).min() > 0.0
    np.testing.assert_allclose(tip - tail, ARROW_LENGTH * SPACING * m, atol=1e-12)


def test_arrows_of_a_planar_field_lie_along_it_at_the_altitude():
    # As long as the field is, but no longer than one.
    def field(x):
        return np.where(np.abs(x) < 1.0, 0.3 * x[:, ::-1], 7.0 * x)

    (tail, tip), *heads = arrows(AnyField(2, field))
    m = field((tail + tip)[:, :2] / 2.0)
    m /= np.maximum(np.linalg.norm(m, axis=1, keepdims=True), 1.0)
    np.testing.assert_allclose((tip - tail)[:, :2], ARROW_LENGTH * SPACING * m, atol=1e-12)
    for points in (tail, tip, *(end for _, end in heads)):
        np.testing.assert_array_equal(points[:, 2], ALTITUDE)


@pytest.mark.parametrize("dim", [2, 3])
def test_both_strokes_of_a_head_go_back_from_its_tip(dim):
    direction = np.array([0.48, -0.64, 0.6])[:dim]
    shaft, *heads = arrows(AnyField(dim, lambda x: np.tile(direction, (len(x), 1))))
    along = shaft[1] - shaft[0]
    size = np.linalg.norm(along, axis=1)
    for start, end in heads:
        np.testing.assert_array_equal(start, shaft[1])
        stroke = end - start
        length = np.linalg.norm(stroke, axis=1)
        np.testing.assert_allclose(length, ARROW_HEAD * size)
        cosine = -np.sum(stroke * along, axis=1) / (length * size)
        np.testing.assert_allclose(np.arccos(cosine), ARROW_HEAD_ANGLE)
    # One on either side.
    np.testing.assert_allclose(
        (heads[0][1] + heads[1][1]) / 2.0,
        shaft[1] - ARROW_HEAD * np.cos(ARROW_HEAD_ANGLE) * along,
    )


def test_a_vertical_arrow_has_a_head_too():
    (tail, tip), (_, left), (_, right) = arrows(
        AnyField(3, lambda x: np.tile([0.0, 0.0, 1.0], (len(x), 1)))
    )
    np.testing.assert_allclose(tip - tail, [[0.0, 0.0, ARROW_LENGTH * SPACING]] * len(tip))
    spread = 2.0 * ARROW_HEAD * np.sin(ARROW_HEAD_ANGLE) * ARROW_LENGTH * SPACING
    np.testing.assert_allclose(np.linalg.norm(left - right, axis=1), spread)


@pytest.mark.parametrize(
    ("box", "counts"),
    [
        (([0.0, 0.0], [1.0, 1.0]), (FIELD_ARROWS, FIELD_ARROWS)),
        (BOX, (FIELD_ARROWS, 23)),
        (([3.0, -5.0], [3.001, 5.0]), (1, FIELD_ARROWS)),
    ],
)
def test_the_grid_is_square_and_covers_the_box(box, counts):
    (tail, tip), *_ = arrows(AnyField(2, np.zeros_like), box)
    lower, upper = np.array(box)
    points = (tail + tip)[:, :2] / 2.0
    assert len(points) == np.prod(counts)
    spacing = (upper - lower).max() / FIELD_ARROWS
    for axis, count in enumerate(counts):
        values = np.unique(points[:, axis].round(9))
        assert len(values) == count
        np.testing.assert_allclose(np.diff(values), spacing, atol=1e-8)
        assert values.mean() == pytest.approx((lower + upper)[axis] / 2.0)
    assert (points >= lower - 1e-9).all()
    assert (points <= upper + 1e-9).all()


def test_a_tube_is_each_of_its_curves_and_nothing_between():
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]], dtype=float)
    spiral = np.array([[5.0, 5.0, 0.5], [6.0, 5.0, 0.6], [6.0, 6.0, 0.7]])
    paper = Paper()
    DrawTube(paper, [square, spiral], ALTITUDE)
    assert list(paper.objects) == ["/tube"]
    start, end = paper.objects["/tube"]
    lifted = np.column_stack((square, np.full(5, ALTITUDE)))
    np.testing.assert_array_equal(start, np.vstack((lifted[:-1], spiral[:-1])))
    np.testing.assert_array_equal(end, np.vstack((lifted[1:], spiral[1:])))


@pytest.mark.parametrize("dim", [2, 3])
def test_waypoints_are_one_cloud(dim):
    points = np.random.default_rng(0).uniform(-2.0, 2.0, (50, dim))
    drawn, size = drawn_waypoints(points)
    # Meshcat draws in single precision.
    np.testing.assert_allclose(drawn[:, :dim], points, rtol=1e-6)
    if dim == 2:
        np.testing.assert_array_equal(drawn[:, 2], ALTITUDE)
    assert 0.0 < size < 0.05 * np.ptp(points, axis=0).max()
    drawn, size = drawn_waypoints([[1.0, 2.0]])
    assert drawn.tolist() == [[1.0, 2.0, ALTITUDE]]
    assert size > 0.0


def drawn_waypoints(points):
    paper = Paper()
    DrawWaypoints(paper, points, ALTITUDE)
    return paper.objects["/waypoints"]


def test_fields_that_cannot_be_drawn_are_refused(circle_field):
    def hole(x):
        return np.where(np.linalg.norm(x, axis=1, keepdims=True) < 0.1, np.nan, x)

    with pytest.raises(
        NonFiniteValueError, match=r"not finite at \[-?[0-9.e-]+, -?[0-9.e-]+\]"
    ):
        DrawField(Paper(), AnyField(2, hole), BOX, ALTITUDE)
    for dim in (1, 4):
        with pytest.raises(ConfigurationError, match=f"dimension 2 or 3 is drawn, got {dim}"):
            DrawField(Paper(), AnyField(dim, np.zeros_like), BOX, ALTITUDE)
    with pytest.raises(NonFiniteValueError, match="altitude"):
        DrawField(Paper(), circle_field, BOX, np.nan)
    for box, error, match in (
        (([0.0, 0.0], [1.0, 0.0]), ConfigurationError, "the box is empty"),
        (([2.0, 0.0], [1.0, 1.0]), ConfigurationError, "the box is empty"),
        (([0.0], [1.0]), ConfigurationError, r"got shape \(2, 1\)"),
        (([0.0, np.nan], [1.0, 1.0]), NonFiniteValueError, "the box must be finite"),
    ):
        with pytest.raises(error, match=match):
            PlaneBox(box)


@pytest.mark.parametrize(
    ("points", "error"),
    [
        ([1.0, 2.0], ConfigurationError),
        (np.zeros((0, 2)), ConfigurationError),
        (np.zeros((4, 4)), ConfigurationError),
        ([[0.0, np.inf]], NonFiniteValueError),
    ],
)
def test_points_and_curves_that_cannot_be_used_are_refused(points, error):
    with pytest.raises(error, match="points"):
        DrawWaypoints(Paper(), points, ALTITUDE)
    with pytest.raises(error, match="a curve"):
        DrawTube(Paper(), [points], ALTITUDE)
    with pytest.raises(ConfigurationError, match="there is no curve"):
        DrawTube(Paper(), [], ALTITUDE)
