"""The classical guiding vector field of an implicit curve phi = 0."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.classical.algebraic import AlgebraicCurve
from sgvf_drake.fields.classical.base import (
    DEFAULT_GAIN,
    ClassicalField,
    check_positive,
    direction,
    direction_and_jacobian,
)
from sgvf_drake.fields.composition import UNIT_SOFTENING
from sgvf_drake.paths import PointCloud

# Turns a gradient into a tangent, a quarter to the left: with a function that is positive
# outside, a loop is followed counter-clockwise.
QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class ImplicitField(ClassicalField):
    """m = n / |n| with n = E grad phi - k phi grad phi, E a quarter turn.

    This is the paper's u = T - k_n phi grad phi (Section II-A) with the tangent T of an
    implicit curve, and only its direction used (Kapitanyuk, Proskurnikov and Cao, IEEE
    T-CST 2018).  Where the gradient of phi vanishes, as at a crossing and inside of every
    loop, there is no direction and m is zero.

    Attributes:
        cloud: The waypoints; phi is in their normalised units.
        phi: The curve.
        gain: k, 1/U, for a phi that is a distance near its zero set.

    Raises:
        ConfigurationError: The gain is not a positive number.
    """

    cloud: PointCloud
    phi: AlgebraicCurve
    gain: float = DEFAULT_GAIN

    def __post_init__(self) -> None:
        check_positive("gain", self.gain)

    def _value(self, z: FloatArray) -> FloatArray:
        g = self.phi.gradient(z)
        n = g @ QUARTER_TURN.T - self.gain * self.phi.value(z)[:, None] * g
        return direction(n, UNIT_SOFTENING)

    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        phi, g, H = self.phi.value(z), self.phi.gradient(z), self.phi.hessian(z)
        n = g @ QUARTER_TURN.T - self.gain * phi[:, None] * g
        pull = g[:, :, None] * g[:, None, :] + phi[:, None, None] * H
        return direction_and_jacobian(n, QUARTER_TURN @ H - self.gain * pull, UNIT_SOFTENING)
