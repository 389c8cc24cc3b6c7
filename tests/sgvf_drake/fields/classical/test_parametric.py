"""The singularity-free parametric field, against its definition by a wedge product."""

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import Field, FourierCurve, ParametricField
from sgvf_drake.paths import PointCloud


def states(field, n=60, seed=1):
    lower, upper = field.cloud.box
    rng = np.random.default_rng(seed)
    x = rng.uniform(lower, upper, (n, field.cloud.dim))
    length = field.curve.length * field.cloud.unit_length
    return np.column_stack([x, rng.uniform(-length, 2 * length, n)])


@pytest.fixture
def field(flower):
    return ParametricField(flower, FourierCurve.through(flower), gain=2.0)


def test_it_is_the_wedge_product_less_the_gradients(field):
    """chi = grad phi_1 x grad phi_2 - k (phi_1 grad phi_1 + phi_2 grad phi_2)."""
    assert isinstance(field, Field)
    assert field.dim == 3
    x = states(field)
    unit = field.cloud.unit_length
    f, f_w = field.curve.derivatives(x[:, 2] / unit, 1)
    phi = field.cloud.normalize(x[:, :2]) - f
    gradients = [
        np.column_stack([np.broadcast_to(e, f.shape), -f_w[:, i]])
        for i, e in enumerate(np.eye(2))
    ]
    chi = np.cross(*gradients)
    chi -= field.gain * sum(phi[:, [i]] * gradient for i, gradient in enumerate(gradients))
    chi *= np.sqrt(2) / np.linalg.norm(chi, axis=1, keepdims=True)
    np.testing.assert_allclose(field(x), chi, atol=1e-12)


def test_it_vanishes_nowhere(field):
    """Not even where the first part does, at k phi = f', or in the middle of the loop."""
    x = states(field)
    f, f_w = field.curve.derivatives(x[:, 2] / field.cloud.unit_length, 1)
    x[:, :2] = field.cloud.denormalize(f + f_w / field.gain)
    m = field(x)
    np.testing.assert_allclose(m[:, :2], 0.0, atol=1e-9)
    np.testing.assert_allclose(m[:, 2], np.sqrt(2), rtol=1e-12)


def test_the_speed_on_the_path_is_one(circle):
    field = ParametricField(circle, FourierCurve.through(circle))
    m = field(field.lift(circle.points))
    # The parameter runs along the polyline, which is shorter than the circle by this.
    stretch = np.pi / 40 / np.sin(np.pi / 40)
    exact = np.sqrt(2) * np.array([stretch, 1.0]) / np.sqrt(1 + stretch**2)
    np.testing.assert_allclose(np.linalg.norm(m[:, :2], axis=1), exact[0], rtol=1e-9)
    np.testing.assert_allclose(m[:, 2], exact[1], rtol=1e-9)
    assert exact[0] == pytest.approx(1.0, abs=1e-3)


def test_lifting_gives_the_nearest_parameter(circle):
    field = ParametricField(circle, FourierCurve.through(circle))
    x = np.array([[3.0, 5.0], [3.0, -1.1]])
    quarter = field.curve.length / 4 * circle.unit_length
    lifted = field.lift(x)
    np.testing.assert_array_equal(lifted[:, :2], x)
    np.testing.assert_allclose(lifted[:, 2] % (4 * quarter), [quarter, 3 * quarter], rtol=1e-9)


def test_derivatives(field, check_derivatives):
    check_derivatives(field, states(field, 20), field.cloud.unit_length)


def test_a_curve_in_space_has_a_state_of_four(check_derivatives):
    angle = 2 * np.pi * np.arange(30) / 30
    cloud = PointCloud(np.column_stack([np.cos(angle), np.sin(angle), np.cos(2 * angle)]))
    field = ParametricField(cloud, FourierCurve.through(cloud), gain=2.0)
    assert field.dim == 4
    check_derivatives(field, states(field, 10), cloud.unit_length)


def test_open_curves_are_refused(flower):
    with pytest.raises(ConfigurationError, match="closed curve"):
        ParametricField(flower, FourierCurve.through(flower, closed=False))
