"""The field to the nearest point of a curve, against the known one of a circle."""

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import CurveField, Field, FourierCurve, LagrangeCurve
from sgvf_drake.paths import PointCloud


@pytest.fixture
def line():
    """Waypoints on a straight line, to be followed to (4, 0); U is 1."""
    return PointCloud(np.column_stack([np.linspace(-4, 4, 17), np.zeros(17)]))


def test_on_a_circle_the_field_is_the_known_one(circle):
    k = 5.0
    field = CurveField(circle, [FourierCurve.through(circle)], gain=k)
    assert isinstance(field, Field)
    x = np.random.default_rng(2).uniform(*circle.box, (60, 2))
    z = circle.normalize(x)
    r = np.linalg.norm(z, axis=1)[:, None]
    around = np.column_stack([-z[:, 1], z[:, 0]]) / r
    expected = (around - k * (r - 4) * z / r) / np.sqrt(1 + k**2 * (r - 4) ** 2)
    np.testing.assert_allclose(field(x), expected, atol=1e-9)
    assert len(field.ends) == 0


def test_the_unit_of_the_waypoints_does_not_matter(flower):
    field = CurveField(flower, [FourierCurve.through(flower)])
    larger = PointCloud(1e3 * flower.points)
    other = CurveField(larger, [FourierCurve.through(larger)])
    x = np.random.default_rng(6).uniform(*flower.box, (20, 2))
    np.testing.assert_allclose(other(1e3 * x), field(x), atol=1e-9)
    assert other.approach_length == pytest.approx(1e3 * field.approach_length)


def test_it_comes_to_rest_at_the_end_of_an_open_curve(line):
    k = 5.0
    field = CurveField(line, [FourierCurve.through(line, closed=False)], gain=k)
    np.testing.assert_allclose(field.ends, [[4.0, 0.0]], atol=1e-12)
    x = np.array([[0.0, 0.0], [3.9, 0.0], [4.0, 0.0], [4.2, 0.0], [4.0, 0.3], [-5.0, 0.0]])
    beyond, beside = (k * r / np.sqrt(1 + (k * r) ** 2) for r in (0.2, 0.3))
    expected = [
        *([1.0, 0.0], [np.tanh(k * 0.1), 0.0], [0.0, 0.0]),
        *([-beyond, 0.0], [0.0, -beside], [1.0, 0.0]),
    ]
    np.testing.assert_allclose(field(x), expected, atol=1e-9)


def test_the_nearest_of_several_curves_counts(circle):
    inner = PointCloud(np.concatenate([circle.points, (circle.points - [3, -1]) / 2 + [3, -1]]))
    halves = (np.arange(40), np.arange(40, 80))
    curves = [FourierCurve.through(inner, half) for half in halves]
    both = CurveField(inner, curves)
    alone = [CurveField(inner, [curve]) for curve in curves]
    x = np.random.default_rng(3).uniform(*inner.box, (50, 2))
    near_inner = np.linalg.norm(x - [3, -1], axis=1) < 1.5
    assert 0 < near_inner.sum() < len(x)
    expected = np.where(near_inner[:, None], alone[1](x), alone[0](x))
    np.testing.assert_allclose(both(x), expected, atol=1e-12)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("kind", [FourierCurve, LagrangeCurve])
def test_derivatives(flower, check_derivatives, kind, closed):
    order = np.arange(0, 60, 5) if closed else np.arange(8, 20)
    field = CurveField(flower, [kind.through(flower, order, closed)], gain=2.0)
    c = field.curves[0].derivatives(np.linspace(0.1, 0.9, 25) * field.curves[0].length, 1)
    beside = np.random.default_rng(8).uniform(-0.15, 0.15, c[0].shape)
    x = flower.denormalize(c[0] + beside)
    check_derivatives(field, x, flower.unit_length)


def test_derivatives_beyond_an_end(line, check_derivatives):
    field = CurveField(line, [FourierCurve.through(line, closed=False)], gain=2.0)
    x = np.array([[4.3, 0.2], [5.0, -1.0], [-4.4, 0.3], [3.7, 0.1]])
    check_derivatives(field, x, 1.0)


def test_what_cannot_be_followed_is_refused(circle):
    with pytest.raises(ConfigurationError, match="needs a curve"):
        CurveField(circle, [])
    with pytest.raises(ConfigurationError, match="gain must be a positive number, not nan"):
        CurveField(circle, [FourierCurve.through(circle)], gain=float("nan"))
