"""The guiding vector field of curves through waypoints: to the nearest point, and along."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.classical.base import DEFAULT_GAIN, ClassicalField, check_positive
from sgvf_drake.fields.classical.curve import Curve
from sgvf_drake.paths import PointCloud


@dataclass(frozen=True, eq=False)
class CurveField(ClassicalField):
    """m = n / |n|, n = T - k r, with r from the nearest point of a curve and T its tangent.

    The paper's u = T - k_n phi grad phi (Section II-A), where phi is the distance to the
    curve, and only its direction used.  Near the end of an open curve T fades out, as
    f = tanh(k s) with s the distance from the end, and so that robots come to rest there
    |n| becomes sqrt(|n|^2 + 1 - f^2).

    Attributes:
        cloud: The waypoints.
        curves: One or more, in the normalised units of the cloud; the nearest counts.
        gain: k, 1/U.

    Raises:
        ConfigurationError: There is no curve, or the gain is not a positive number.
    """

    cloud: PointCloud
    curves: Sequence[Curve]
    gain: float = DEFAULT_GAIN

    def __post_init__(self) -> None:
        check_positive("gain", self.gain)
        if not self.curves:
            raise ConfigurationError("a field needs a curve to follow")

    @property
    def ends(self) -> FloatArray:
        last = [curve.points[-1] for curve in self.curves if not curve.closed]
        return self.cloud.denormalize(np.array(last).reshape(-1, self.dim))

    def _value(self, z: FloatArray) -> FloatArray:
        m = np.empty(z.shape, z.dtype)
        for curve, own in self._owned(z):
            w, _, (c, c_w, _) = curve.nearest(z[own])
            T = c_w / np.sqrt((c_w * c_w).sum(axis=1))[:, None]
            fade = self._fade(curve, w)[0]
            n = fade * T - self.gain * (z[own] - c)
            m[own] = n / np.sqrt((n * n).sum(axis=1)[:, None] + 1 - fade**2)
        return m

    def _value_and_jacobian(self, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        m, J = np.empty(z.shape, z.dtype), np.empty((*z.shape, self.dim), z.dtype)
        for curve, own in self._owned(z):
            m[own], J[own] = self._along(curve, z[own])
        return m, J

    def _owned(self, z: FloatArray) -> Iterator[tuple[Curve, BoolArray]]:
        """Gives each curve with the points, (n,) booleans, to which it is the nearest."""
        if len(self.curves) == 1:
            yield self.curves[0], np.ones(len(z), dtype=bool)
            return
        owner = np.argmin([curve.distance(z) for curve in self.curves], axis=0)
        for number, curve in enumerate(self.curves):
            if (owner == number).any():
                yield curve, owner == number

    def _along(self, curve: Curve, z: FloatArray) -> tuple[FloatArray, FloatArray]:
        w, dw, (c, c_w, c_ww) = curve.nearest(z)
        speed = np.sqrt((c_w * c_w).sum(axis=1))[:, None]
        T = c_w / speed
        T_w = (c_ww - T * (T * c_ww).sum(axis=1)[:, None]) / speed
        fade, fade_w = self._fade(curve, w)
        k = self.gain
        n = fade * T - k * (z - c)
        n_w = fade_w * T + fade * T_w + k * c_w
        dn = n_w[:, :, None] * dw[:, None, :] - k * np.eye(self.dim)
        norm = np.sqrt((n * n).sum(axis=1)[:, None] + 1 - fade**2)
        m = n / norm
        dnorm = (m[:, None, :] @ dn)[:, 0] - fade * fade_w / norm * dw
        return m, (dn - m[:, :, None] * dnorm[:, None, :]) / norm[:, :, None]

    def _fade(self, curve: Curve, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the weight of T and its derivative by w, (n, 1) each."""
        if curve.closed:
            return np.ones((len(w), 1)), np.zeros((len(w), 1))
        speed = float(np.linalg.norm(curve.derivatives(np.array([curve.length]), 1)[1, 0]))
        fade = np.tanh(self.gain * speed * (curve.length - w))[:, None]
        return fade, -self.gain * speed * (1 - fade**2)
