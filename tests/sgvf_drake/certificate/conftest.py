"""Fields that are bounded fast: the closed-form score of rings, and linear tangents."""

import numpy as np
import pytest

from sgvf_drake import load_field
from sgvf_drake.certificate import Certificate
from sgvf_drake.paths import Piece, ReferencePath
from tests.data.make import FOLDER, field_file
from tests.fields import TURN, exact_field
from tests.helpers import circle

SIGMA = 0.4


@pytest.fixture(scope="session")
def make_ring():
    """Makes a field around circles, of a tangent network without a hidden layer."""

    def make(*radii, tangent=TURN, scale=1.0):
        pieces = [scale * circle(radius, 80) for radius in radii]
        field = exact_field(np.concatenate(pieces), tangent, SIGMA, gain=2 * SIGMA)
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
