"""The singularity-free guiding vector field of a parametric curve, in one more dimension."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.classical.base import DEFAULT_GAIN, ClassicalField, check_positive
from sgvf_drake.fields.classical.curve import Curve
from sgvf_drake.paths import PointCloud

# |chi| on the path where |f'| is 1: what makes the speed in space 1 there.
NORM_ON_PATH = np.sqrt(2.0)


@dataclass(frozen=True, eq=False)
class ParametricField(ClassicalField):
    """m = sqrt(2) chi / |chi| of states (x, w), w the parameter of a curve f.

        chi = (f'(w) - k phi,  1 + k phi . f'(w)),   phi = x - f(w)

    (Yao, de Marina, Lin and Cao, IEEE T-RO 2021).  In the space of x and
    w the curve is a helix without a crossing, and chi vanishes nowhere: where the first part
    is zero, k phi = f', the second is 1 + |f'|^2.  With it, a robot chases the point f(w),
    which waits for it.  The scale makes the speed of x one on the path where |f'| is 1, that
    is, where the waypoints are evenly spaced.

    The state (x, w) is in the user's unit of length throughout; see `lift`.

    Attributes:
        cloud: The waypoints.
        curve: Closed, in the normalised units of the cloud.
        gain: k, 1/U.

    Raises:
        ConfigurationError: The curve is open, or the gain is not a positive number.
    """

    cloud: PointCloud
    curve: Curve
    gain: float = DEFAULT_GAIN

    def __post_init__(self) -> None:
        check_positive("gain", self.gain)
        if not self.curve.closed:
            raise ConfigurationError("a parametric field needs a closed curve")

    @property
    def dim(self) -> int:
        """The dimension of the state: that of the space, and one more."""
        return self.cloud.dim + 1

    def lift(self, x: FloatArray) -> FloatArray:
        """Returns states (n, d + 1) at positions (n, d), each with the nearest w."""
        w = self.curve.nearest(self.cloud.normalize(x))[0]
        return np.column_stack([x, w * self.cloud.unit_length])

    def _value(self, z: FloatArray) -> FloatArray:
        f, f_w = self.curve.derivatives(z[:, -1], 1)
        chi = self.chi(z[:, :-1] - f, f_w)
        return np.asarray(NORM_ON_PATH * chi / np.sqrt((chi * chi).sum(axis=1))[:, None])

    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        k, d = self.gain, self.cloud.dim
        f, f_w, f_ww = self.curve.derivatives(z[:, -1], 2)
        phi = z[:, :-1] - f
        chi = self.chi(phi, f_w)
        dchi = np.empty((*z.shape, self.dim), z.dtype)
        dchi[:, :d, :d] = -k * np.eye(d)
        dchi[:, d, :d] = k * f_w
        dchi[:, :d, d] = f_ww + k * f_w
        dchi[:, d, d] = k * (phi * f_ww - f_w * f_w).sum(axis=1)
        norm = np.sqrt((chi * chi).sum(axis=1))[:, None]
        u = chi / norm
        along = (u[:, None, :] @ dchi)[:, 0]
        J = (dchi - u[:, :, None] * along[:, None, :]) / norm[:, :, None]
        return NORM_ON_PATH * u, NORM_ON_PATH * J

    def chi(self, phi: FloatArray, f_w: FloatArray) -> FloatArray:
        """Returns the field before it is scaled, (n, d + 1), in normalised units.

        Args:
            phi: Positions less those of the curve at the parameters, (n, d).
            f_w: The derivatives of the curve there, (n, d).
        """
        chase = 1 + self.gain * (phi * f_w).sum(axis=1)
        return np.column_stack([f_w - self.gain * phi, chase])

    def _normalized(self, x: FloatArray) -> tuple[FloatArray, tuple[int, ...]]:
        x = np.asarray(x, dtype=np.float64)
        if x.ndim not in (1, 2) or x.shape[-1] != self.dim:
            raise ValueError(
                f"expected states of shape ({self.dim},) or (n, {self.dim}), not {x.shape}"
            )
        state = np.atleast_2d(x)
        position = self.cloud.normalize(state[:, :-1])
        return np.column_stack([position, state[:, -1] / self.cloud.unit_length]), x.shape
