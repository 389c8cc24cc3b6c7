"""The classical fields, each computed by a formula of waypoints or of a curve through them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import BoolArray, IntArray
from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.analytic import AnalyticField, check_positive
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.classical.algebraic import AlgebraicCurve
from sgvf_drake.fields.classical.curves import Curve
from sgvf_drake.fields.composition import UNIT_SOFTENING

# 1/U.  The fields turn to the path over a tenth of a unit, the default noise level of a
# learned score, so that all of them see the path at the same scale.
DEFAULT_GAIN = 10.0
# Turns a gradient into a tangent, a quarter to the left: with a function that is positive
# outside, a loop is followed counter-clockwise.
QUARTER_TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
# U.  Ahead by L, a robot cuts a curve of radius R by about L^2 / 2 R: within a tenth of a
# unit on radii above one, and L is still several waypoints of the usual two hundred.
LOOK_AHEAD = 0.5
# |chi| on the path where |f'| is 1: what makes the speed in space 1 there.
NORM_ON_PATH = np.sqrt(2.0)


class ClassicalField(AnalyticField):
    """A field that is computed from waypoints by a formula; nothing is learned.

    What it is made of is in the normalised units of its cloud; calls are in the user's.
    """

    gain: float
    """1/U: at a small distance r from the path, the part of m that points to it is gain r."""

    @property
    def approach_length(self) -> float:
        """The distance over which m turns to the path, 1 / gain, in the user's unit."""
        return self.cloud.unit_length / self.gain

    @property
    def sigma(self) -> float:
        """The scale of the field across its path, U: the approach length."""
        return 1 / self.gain

    @property
    def ends(self) -> FloatArray:
        """Where robots come to rest, (E, d) in the user's unit; none unless a kind has them."""
        return np.empty((0, self.cloud.dim))


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


def direction(n: FloatArray, softening: float) -> FloatArray:
    """Returns n / sqrt(|n|^2 + softening^2): (k, d) -> (k, d), real or complex."""
    return n / np.sqrt((n * n).sum(axis=1) + softening**2)[:, None]


def direction_and_jacobian(
    n: FloatArray, dn: FloatArray, softening: float
) -> tuple[FloatArray, FloatArray]:
    """Returns `direction` and its derivative (k, d, d), where n has the derivative dn."""
    norm = np.sqrt((n * n).sum(axis=1) + softening**2)
    m = n / norm[:, None]
    along = (m[:, None, :] @ dn)[:, 0]
    return m, (dn - m[:, :, None] * along[:, None, :]) / norm[:, None, None]
