"""What the fields of one cloud share: normalisation, shapes, and derivatives."""

from abc import ABC, abstractmethod

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import FloatArray

# The step of the complex-step derivative: no difference is taken, so nothing cancels and
# the error is of the order of its square.
COMPLEX_STEP = 1e-30


class NormalisedByCloud:
    """What is given in the unit of the waypoints, and computed in normalised units."""

    cloud: PointCloud
    """The waypoints; their extent is the normalisation."""

    @property
    def dim(self) -> int:
        """The dimension d of the space."""
        return self.cloud.dim

    def _normalized(self, x: FloatArray) -> tuple[FloatArray, tuple[int, ...]]:
        x = np.asarray(x, dtype=np.float64)
        if x.ndim not in (1, 2) or x.shape[-1] != self.dim:
            raise ValueError(
                f"expected positions of shape ({self.dim},) or (n, {self.dim}), not {x.shape}"
            )
        return self.cloud.normalize(np.atleast_2d(x)), x.shape


class AnalyticField(NormalisedByCloud, ABC):
    """A field whose formulas are analytic, in the normalised units of its cloud.

    Calls take and return NumPy float64 in the unit of the waypoints, for one point (d,) or
    a batch (n, d).  Kinds give the value and the Jacobian at normalised points, real or
    complex.
    """

    def __call__(self, x: FloatArray) -> FloatArray:
        """Returns the value: (d,) -> (d,), or (n, d) -> (n, d).

        Raises:
            ValueError: x is not of shape (d,) or (n, d).
        """
        z, shape = self._normalized(x)
        return self._value(z).reshape(shape)

    def value_and_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the value, and J[..., i, j] = dm_i/dx_j of shape (d, d) or (n, d, d)."""
        z, shape = self._normalized(x)
        value, J = self._value_and_jacobian(z)
        return value.reshape(shape), J.reshape(*shape, self.dim) / self.cloud.unit_length

    def hessian(self, x: FloatArray) -> FloatArray:
        """Returns H[..., i, j, k] = d^2 m_i / dx_j dx_k, shape (d, d, d) or (n, d, d, d).

        By a complex step through the exact Jacobian (Squire and Trapp, SIAM Review 1998):
        exact to rounding, since every part of the field is analytic.
        """
        z, shape = self._normalized(x)
        steps = COMPLEX_STEP * 1j * np.eye(self.dim)
        columns = [self._value_and_jacobian(z + step)[1].imag for step in steps]
        H = np.stack(columns, axis=-1) / COMPLEX_STEP
        return H.reshape(*shape, self.dim, self.dim) / self.cloud.unit_length**2

    @abstractmethod
    def _value(self, z: FloatArray) -> FloatArray:
        """Returns the value at normalised points: (n, d) -> (n, d)."""

    @abstractmethod
    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the value (n, d) and its derivative by z (n, d, d)."""


def check_positive(name: str, value: float) -> None:
    """Raises ConfigurationError unless a value is a positive number."""
    if not (np.isfinite(value) and value > 0):
        raise ConfigurationError(f"{name} must be a positive number, not {value}")
