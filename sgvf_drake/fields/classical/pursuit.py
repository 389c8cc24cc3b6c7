"""Pursuit of waypoints in their order."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import IntArray
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.classical.base import (
    ClassicalField,
    check_positive,
    direction,
    direction_and_jacobian,
)
from sgvf_drake.fields.composition import UNIT_SOFTENING
from sgvf_drake.paths import PointCloud

# U.  Ahead by L, a robot cuts a curve of radius R by about L^2 / 2 R: within a tenth of a
# unit on radii above one, and L is still several waypoints of the usual two hundred.
LOOK_AHEAD = 0.5


@dataclass(frozen=True, eq=False)
class PursuitField(ClassicalField):
    """m points from x to a waypoint ahead of the nearest one (Coulter's pure pursuit, 1992).

    Ahead is the first waypoint that comes at least the look-ahead distance after the nearest
    one, along the waypoints in the order in which they are given; the last is followed by
    the first.  The field jumps where the nearest waypoint changes; its Jacobian is that
    between the jumps.

    Attributes:
        cloud: The waypoints, in order.
        look_ahead: U.

    Raises:
        ConfigurationError: The look-ahead distance is not a positive number.
    """

    cloud: PointCloud
    look_ahead: float = LOOK_AHEAD

    def __post_init__(self) -> None:
        check_positive("look_ahead", self.look_ahead)

    @property
    def gain(self) -> float:  # type: ignore[override]
        """1/U: beside the path m turns to it over the look-ahead distance."""
        return 1 / self.look_ahead

    def _value(self, z: FloatArray) -> FloatArray:
        return direction(self._targets(z) - z, UNIT_SOFTENING)

    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        dn = np.broadcast_to(-np.eye(self.dim), (*z.shape, self.dim))
        return direction_and_jacobian(self._targets(z) - z, dn, UNIT_SOFTENING)

    def _targets(self, z: FloatArray) -> FloatArray:
        nearest = self._tree.query(z.real)[1]
        return np.asarray(self._tree.data[self._ahead[nearest]])

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.cloud.normalize(self.cloud.points))

    @cached_property
    def _ahead(self) -> IntArray:
        """The waypoint ahead of each one."""
        points = self._tree.data
        steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
        # Twice around, so that those ahead of the last waypoints are found as well.
        arc = np.concatenate([[0.0], np.cumsum(np.tile(steps, 2))])
        numbers = np.arange(len(points))
        ahead = np.searchsorted(arc, arc[numbers] + self.look_ahead)
        return np.asarray(np.minimum(ahead, numbers + len(points)) % len(points))
