"""Ordered waypoints with known curves, and derivatives by differences."""

import numpy as np
import pytest

from sgvf_drake.paths import PointCloud

RADIUS = 4.0


@pytest.fixture(scope="session")
def circle():
    """Forty waypoints on a circle about (3, -1), counter-clockwise; U is a half."""
    angle = 2 * np.pi * np.arange(40) / 40
    return PointCloud(2.0 * np.column_stack([np.cos(angle), np.sin(angle)]) + [3.0, -1.0])


@pytest.fixture(scope="session")
def flower():
    """Sixty waypoints on a curve that is not convex, in order."""
    angle = 2 * np.pi * np.arange(60) / 60
    radius = 30 * (1 + 0.3 * np.cos(3 * angle))
    return PointCloud(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]))


@pytest.fixture(scope="session")
def check_derivatives():
    """Holds Jacobian and Hessian of a field at points (n, d) against central differences."""

    def check(field, x, unit):
        steps = 1e-5 * unit * np.eye(field.dim)
        J, H = field.value_and_jacobian(x)[1], field.hessian(x)
        difference = [(field(x + e) - field(x - e)) / (2e-5 * unit) for e in steps]
        np.testing.assert_allclose(J, np.stack(difference, axis=-1), atol=1e-6 / unit)
        difference = [
            (field.value_and_jacobian(x + e)[1] - field.value_and_jacobian(x - e)[1])
            / (2e-5 * unit)
            for e in steps
        ]
        np.testing.assert_allclose(H, np.stack(difference, axis=-1), atol=1e-4 / unit**2)
        m = field(x)
        np.testing.assert_allclose(field.value_and_jacobian(x)[0], m, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(field(x[0]), m[0], rtol=1e-12, atol=1e-15)
        assert field.value_and_jacobian(x[0])[1].shape == (field.dim, field.dim)
        with pytest.raises(ValueError, match=r"of shape"):
            field(np.zeros(field.dim + 1))

    return check
