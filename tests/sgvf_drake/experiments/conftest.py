"""A stored field for flight, what it did, and a certificate by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from sgvf_drake.certificate import Certificate, PieceResult, Walls
from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments import fly, follow
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import Piece, ReferencePath, shape_path
from sgvf_drake.paths.finding import find_paths
from tests.fields import exact_field
from tests.helpers import circle

# m, m/s
ARC_RADIUS = 4.0
ARC_SPEED = 0.3


class ConstantField:
    """A field that knows nothing of its cloud: everywhere the same value."""

    sigma = 0.1
    recipe, seed = "none", 0

    def __init__(self, cloud, value):
        self.cloud = cloud
        self.value = np.array(value, dtype=np.float64)
        self.ends = np.empty((0, cloud.dim))

    @property
    def dim(self):
        return self.cloud.dim

    @property
    def path(self):
        return find_paths(self.cloud).path

    def __call__(self, x):
        return np.broadcast_to(self.value, x.shape).copy()

    def value_and_jacobian(self, x):
        return self(x), np.zeros((*x.shape, self.dim))


@pytest.fixture(scope="session")
def constant_field():
    """Makes a constant field: (cloud, value)."""
    return ConstantField


@pytest.fixture(scope="session")
def circle_of_points():
    """Makes clouds on a circle: (radius, num_points=40), phase 0, no true shape."""

    return lambda radius, num_points=40: PointCloud(circle(radius, num_points))


@pytest.fixture(scope="session")
def rings():
    """The true path: circles of 1 m and 2 m."""
    return shape_path("concentric-flight")


@pytest.fixture(scope="session")
def half_circle():
    """An open true path of 4 m radius, from (-4, 0) over (0, 4) to (4, 0)."""
    angle = np.linspace(np.pi, 0, 2_001)
    vertices = ARC_RADIUS * np.column_stack([np.cos(angle), np.sin(angle)])
    return ReferencePath((Piece(vertices, closed=False),))


@pytest.fixture(scope="session")
def flown_to_the_end(half_circle_field, half_circle):
    """A flight along it, to the end of the field at (-4, 0), where the reference begins."""
    return fly(half_circle_field, half_circle, speed=ARC_SPEED)


@pytest.fixture(scope="session")
def followed(flight_field, rings):
    """Sixteen agents that follow it."""
    return follow(flight_field, rings, starts=16)


@pytest.fixture(scope="session")
def flown(flight_field, rings):
    """The flights along the inner circle, slow, and along both, fast."""
    inner = ReferencePath(rings.pieces[:1])
    return SimpleNamespace(
        slow=fly(flight_field, inner, speed=0.45, laps=1.0),
        fast=fly(flight_field, rings, speed=2.0, laps=1.5),
    )


# Of the planted walls: how far they are from the ring, and what they tolerate.
WALL_HALF_WIDTHS, WALL_E_STAR = (0.1, 0.3, 0.8), (0.1, 0.25, 0.5)


@pytest.fixture(scope="session")
def ring_field():
    """A field around a circle of 4 units, with the closed-form score and a turning tangent."""
    return exact_field(circle(4.0, 80), sigma=0.4, gain=0.8)


@pytest.fixture(scope="session")
def planted_certificate():
    """Makes a certificate with walls around circles about the origin, of radii in units."""

    def planted(field, *radii, half_widths=WALL_HALF_WIDTHS, e_star=WALL_E_STAR):
        walls = (
            Walls.through(
                *(
                    field.cloud.normalize([circle(radius + side * w, 360) for w in half_widths])
                    for side in (-1, 1)
                )
            )
            for radius in radii
        )
        piece = PieceResult(
            orbit_exists=True,
            wall_half_widths=half_widths,
            e_star=e_star,
            entry_times=half_widths,
        )
        return Certificate(
            certified=True,
            reason="planted",
            field_digest=field_digest(field),
            tubes=(None,) * len(radii),
            walls=tuple(walls),
            pieces=(piece,) * len(radii),
        )

    return planted


@pytest.fixture(scope="session")
def ring_certificate(ring_field, planted_certificate):
    """A certificate of it by hand, since a proof takes seconds and says what it finds."""
    return planted_certificate(ring_field, 4.0)
