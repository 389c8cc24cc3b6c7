"""Guiding fields whose value, Jacobian and Hessian are known in closed form, and a V."""

import pytest

from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
from tests.helpers import circle

from .flying import CircleField


@pytest.fixture(scope="session")
def circle_field():
    """The planar field."""
    return CircleField(dim=2)


@pytest.fixture(scope="session")
def spatial_circle_field():
    """The field in three dimensions."""
    return CircleField(dim=3)


@pytest.fixture(scope="session")
def ring_function():
    """V of 200 waypoints on the circle of the fields: {V <= 1/2} is 0.1 wide on either side."""
    return LyapunovFunction(GaussianMixture(circle(1.0, 200), 0.1))
