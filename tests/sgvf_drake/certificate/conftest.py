"""Fields that are bounded fast: the closed-form score of rings, and linear tangents."""

from dataclasses import replace

import numpy as np
import pytest

from sgvf_drake import load_field
from sgvf_drake.certificate import Certificate
from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import GaussianMixture, Perceptron
from sgvf_drake.paths import Piece, ReferencePath
from tests.data.make import FOLDER, field_file

TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
SIGMA = 0.4


def circle(radius, count=80):
    angles = 2 * np.pi * np.arange(count) / count
    return radius * np.column_stack([np.cos(angles), np.sin(angles)])


@pytest.fixture(scope="session")
def make_ring(make_field):
    """Makes a field around circles, of a tangent network without a hidden layer."""

    def make(*radii, tangent=TURN, scale=1.0):
        pieces = [scale * circle(radius) for radius in radii]
        cloud = PointCloud(np.concatenate(pieces))
        field = replace(
            make_field("exact", sigma=SIGMA, gain=2 * SIGMA),
            cloud=cloud,
            sigma=SIGMA,
            score_model=GaussianMixture(cloud.normalize(cloud.points), SIGMA),
            tangent_network=Perceptron((np.asarray(tangent, float),), (np.zeros(2),)),
        )
        return field, ReferencePath(tuple(Piece(piece, True) for piece in pieces))

    return make


@pytest.fixture(scope="session")
def ring_file():
    """The stored certificate of `ring`: what `certify(*make_ring(4.0))` wrote in November 2026.

    It has to stay readable, and what it claims has to stay provable.
    """
    return FOLDER.parent / "certificates" / "ring.json"


@pytest.fixture(scope="session")
def ring(make_ring, ring_file):
    """The ring of radius 4 of `make_ring`, its path and its certificate, all from files."""
    return load_field(field_file("ring")), make_ring(4.0)[1], Certificate.load(ring_file)
