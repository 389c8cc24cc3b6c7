"""Fields around rings whose score, tangent and Lyapunov function are known in closed form."""

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.lyapunov import find_singularities
from sgvf_drake.paths import Piece, ReferencePath
from tests.fields import TURN, exact_field, linear_network
from tests.helpers import circle


def make_ring_field(radii=(4.0,), tangent=TURN, spacing=0.1, **options):
    """The exact score of rings of equal waypoints, and the rings; see `exact_field`."""
    counts = [round(2 * np.pi * radius / spacing) for radius in radii]
    cloud = PointCloud(
        np.concatenate([circle(*ring) for ring in zip(radii, counts, strict=True)])
    )
    path = ReferencePath(tuple(Piece(circle(radius, 4096), closed=True) for radius in radii))
    return exact_field(cloud, tangent, **options), path


@pytest.fixture(scope="session")
def ring_field():
    """Makes fields around rings: see `make_ring_field`."""
    return make_ring_field


@pytest.fixture(scope="session")
def linear():
    """Makes linear networks: (matrix, point)."""
    return linear_network


@pytest.fixture(scope="session")
def ring():
    """A field around one ring of radius 4, and the ring."""
    return make_ring_field()


@pytest.fixture(scope="session")
def robust_zeros(robust_field):
    """The singularities of a trained field around two rings."""
    return find_singularities(robust_field)
