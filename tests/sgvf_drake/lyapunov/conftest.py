"""Fields around rings whose score, tangent and Lyapunov function are known in closed form."""

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import (
    GaussianMixture,
    GuidingField,
    PaperComposition,
    Perceptron,
    RobustComposition,
)
from sgvf_drake.paths import Piece, ReferencePath

TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


def linear_network(matrix, point=(0.0, 0.0)):
    """The network N(z) = matrix (z - point), normalised units."""
    matrix = np.asarray(matrix, dtype=np.float64)
    return Perceptron((matrix,), (-matrix @ np.asarray(point, dtype=np.float64),))


def ring_cloud(radii=(4.0,), spacing=0.1, unit=1.0, center=(0.0, 0.0)):
    """Equal waypoints on concentric rings, and the rings; of half-extent 4 times the unit."""
    pieces, points = [], []
    for radius in radii:
        count = round(2 * np.pi * radius / spacing)
        angle = 2 * np.pi * np.arange(count) / count
        ring = radius * np.column_stack([np.cos(angle), np.sin(angle)])
        points.append(np.asarray(center) + unit * ring)
        fine = 2 * np.pi * np.arange(4096) / 4096
        vertices = radius * np.column_stack([np.cos(fine), np.sin(fine)])
        pieces.append(Piece(np.asarray(center) + unit * vertices, closed=True))
    return PointCloud(np.concatenate(points)), ReferencePath(tuple(pieces))


def make_ring_field(
    radii=(4.0,), tangent=None, sigma=0.1, composition="robust", gain=0.2, **cloud_options
):
    """The exact score of rings with a linear tangent network, by default the rotation."""
    cloud, path = ring_cloud(radii, **cloud_options)
    kinds = {"robust": RobustComposition(gain, sigma), "paper": PaperComposition(gain)}
    field = GuidingField(
        cloud=cloud,
        sigma=sigma,
        score_model=GaussianMixture(cloud.normalize(cloud.points), sigma),
        tangent_network=linear_network(TURN) if tangent is None else tangent,
        composition=kinds[composition],
        recipe="exact",
        seed=0,
    )
    return field, path


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
