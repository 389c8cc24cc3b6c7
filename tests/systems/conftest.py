"""Guiding fields whose value, Jacobian and Hessian are known in closed form."""

import pytest

from .flying import CircleField


@pytest.fixture(scope="session")
def circle_field():
    """The planar field."""
    return CircleField(dim=2)


@pytest.fixture(scope="session")
def spatial_circle_field():
    """The field in three dimensions."""
    return CircleField(dim=3)
