"""How score and tangent are put together into the guiding field m.

Everything here is in normalised units (half-extent 4) and batched over n points.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from sgvf_drake.fields.base import FloatArray

PAPER_GAIN = 0.2
"""k_s of the paper's simulations (Section V-A)."""

# |N| at which the smooth unit vector N / sqrt(|N|^2 + delta^2) starts to shrink.
DIRECTION_SOFTENING = 0.05
# The same for m where it is normalised: |m| is 1 to 1e-6 wherever |s + v| is above 1e-3.
UNIT_SOFTENING = 1e-6
# The score's part along the tangent is removed within this many noise levels of the path...
PROJECTION_RANGE = 3.0
# ... and given back outside, with this (even) power of the distance.
PROJECTION_POWER = 8


@dataclass(frozen=True)
class Composition(ABC):
    """m as a function of the raw score S and the output N of the tangent network.

    Attributes:
        gain: k_s of the paper's normalised score tanh(k_s |S|) S / |S|.
    """

    gain: float

    def tangent(self, N: FloatArray) -> FloatArray:
        """Returns the tangent field v, N as it comes unless a kind has another: (n, d)."""
        return N

    def tangent_and_partial(self, N: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns v (n, d) and dv/dN (n, d, d)."""
        return N, _identity(N)

    @abstractmethod
    def components(self, S: FloatArray, N: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the two parts of m = s + v, (n, d) each: that of the score, the rest."""

    def value(self, S: FloatArray, N: FloatArray) -> FloatArray:
        """Returns m: (n, d), (n, d) -> (n, d)."""
        s, v = self.components(S, N)
        return s + v

    @abstractmethod
    def value_and_partials(
        self, S: FloatArray, N: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Returns m (n, d), dm/dS and dm/dN, each (n, d, d)."""


@dataclass(frozen=True)
class PaperComposition(Composition):
    """m = s + v with s = tanh(k_s |S|) S / |S| (paper, Section III), v = N as it comes."""

    def components(self, S: FloatArray, N: FloatArray) -> tuple[FloatArray, FloatArray]:
        a, _ = _squash_factors(self.gain, _dot(S, S))
        return a[:, None] * S, N

    def value_and_partials(
        self, S: FloatArray, N: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        a, _ = _squash_factors(self.gain, _dot(S, S))
        slope, _ = _squash_slopes(self.gain, _dot(S, S))
        eye = _identity(S)
        dm_dS = a[:, None, None] * eye + slope[:, None, None] * _outer(S, S)
        return a[:, None] * S + N, dm_dS, eye


@dataclass(frozen=True)
class NormalisedComposition(Composition):
    """m = n / sqrt(|n|^2 + delta^2), the direction of the paper's sum n = s + v.

    delta is tiny, and keeps m finite and smooth where s and v cancel.
    """

    def components(self, S: FloatArray, N: FloatArray) -> tuple[FloatArray, FloatArray]:
        s, v = self._sum.components(S, N)
        norm = _softened_norm(s + v, UNIT_SOFTENING)[:, None]
        return s / norm, v / norm

    def value_and_partials(
        self, S: FloatArray, N: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        n, dn_dS, dn_dN = self._sum.value_and_partials(S, N)
        m, dm_dn = _direction_and_partial(n, UNIT_SOFTENING)
        return m, dm_dn @ dn_dS, dm_dn @ dn_dN

    @property
    def _sum(self) -> PaperComposition:
        return PaperComposition(self.gain)


@dataclass(frozen=True)
class RobustComposition(Composition):
    """m = tanh(k_s |S'|) S'/|S'| + sech(k_s |S'|) v, smooth everywhere and |m| ~ 1.

    It is the paper's m = s + v with the unit-length constraint built in, since
    tanh^2 + sech^2 = 1 and S' is orthogonal to v near the path:

        v  = N / sqrt(|N|^2 + delta^2),
        S' = S - g (S . v) v,   g = 1 / (1 + (r / 3 sigma)^8),   r = sigma^2 |S|.

    r is the distance to the path as the score tells it.  The tangential part is taken out
    of the score and not the other way round: were v exactly orthogonal to grad log p, V
    could never rise along the path and the robot would stop at its densest waypoint.

    Attributes:
        sigma: The noise level of the score, normalised units.
        projects: Whether g is as above, or zero: then the score stops the robot where the
            density ends, as it should at the end of an open path, and can where it peaks.
        tangent_share: What is left of the second term, sech(k_s |S'|) v.
    """

    sigma: float
    projects: bool = True
    tangent_share: float = 1.0

    def tangent(self, N: FloatArray) -> FloatArray:
        return N / _softened_norm(N, DIRECTION_SOFTENING)[:, None]

    def tangent_and_partial(self, N: FloatArray) -> tuple[FloatArray, FloatArray]:
        return _direction_and_partial(N, DIRECTION_SOFTENING)

    def components(self, S: FloatArray, N: FloatArray) -> tuple[FloatArray, FloatArray]:
        v = self.tangent(N)
        normal = S - (self._projection(_dot(S, S)) * _dot(S, v))[:, None] * v
        a, b = _squash_factors(self.gain, _dot(normal, normal))
        return a[:, None] * normal, self.tangent_share * b[:, None] * v

    def value_and_partials(
        self, S: FloatArray, N: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        eye = np.eye(S.shape[1])
        v, dv_dN = self.tangent_and_partial(N)
        along, square = _dot(S, v), _dot(S, S)
        g = self._projection(square)
        dg_dS = (2 * self._projection_slope(square, g))[:, None] * S
        normal = S - (g * along)[:, None] * v
        dn_dS = eye - _outer(v, g[:, None] * v + along[:, None] * dg_dS)
        dn_dv = -g[:, None, None] * (_outer(v, S) + along[:, None, None] * eye)

        a, b = _squash_factors(self.gain, _dot(normal, normal))
        da, db = _squash_slopes(self.gain, _dot(normal, normal))
        b, db = self.tangent_share * b, self.tangent_share * db
        m = a[:, None] * normal + b[:, None] * v
        weights = da[:, None] * normal + db[:, None] * v
        dm_dn = a[:, None, None] * eye + _outer(weights, normal)
        return m, dm_dn @ dn_dS, (dm_dn @ dn_dv + b[:, None, None] * eye) @ dv_dN

    def _projection(self, score_square: FloatArray) -> FloatArray:
        if not self.projects:
            return np.zeros_like(score_square)
        ratio = (self.sigma / PROJECTION_RANGE) ** 2 * score_square
        return 1 / (1 + ratio ** (PROJECTION_POWER // 2))

    def _projection_slope(self, score_square: FloatArray, g: FloatArray) -> FloatArray:
        """Dg / d|S|^2."""
        half = PROJECTION_POWER // 2
        factor = (self.sigma / PROJECTION_RANGE) ** 2
        return -half * factor * (factor * score_square) ** (half - 1) * g**2


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    # Not np.vdot or a norm: no conjugate, so that a complex step passes through.
    return (a[:, None, :] @ b[:, :, None])[:, 0, 0]


def _identity(a: FloatArray) -> FloatArray:
    return np.broadcast_to(np.eye(a.shape[1]), (*a.shape, a.shape[1]))


def _outer(a: FloatArray, b: FloatArray) -> FloatArray:
    return a[:, :, None] * b[:, None, :]


def _softened_norm(a: FloatArray, softening: float) -> FloatArray:
    return np.sqrt(_dot(a, a) + softening**2)


def _direction_and_partial(a: FloatArray, softening: float) -> tuple[FloatArray, FloatArray]:
    norm = _softened_norm(a, softening)[:, None, None]
    return a / norm[:, :, 0], np.eye(a.shape[1]) / norm - _outer(a, a) / norm**3


def _squash_factors(gain: float, square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """tanh(k r)/r and sech(k r) as functions of r^2."""
    r = np.sqrt(_away_from_zero(square))
    return np.tanh(gain * r) / r, _sech(gain * r)


def _squash_slopes(gain: float, square: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(d/dr)/r of tanh(k r)/r and of sech(k r): both even and smooth in r."""
    square = _away_from_zero(square)
    r = np.sqrt(square)
    tanh, sech = np.tanh(gain * r) / r, _sech(gain * r)
    # Where k r is small the difference cancels; its series starts at -2/3 k^3.
    z = gain**2 * square
    series = gain**3 * (-2 / 3 + 8 / 15 * z - 34 / 105 * z**2)
    exact = (gain * sech**2 - tanh) / square
    return np.where(z.real < 1e-4, series, exact), -gain * tanh * sech


def _sech(z: FloatArray) -> FloatArray:
    # By the decaying exponential, which cannot overflow far from the path.
    decay = np.exp(-z)
    return 2 * decay / (1 + decay**2)


def _away_from_zero(square: FloatArray) -> FloatArray:
    # The functions of r^2 above are flat at zero to far below the last bit of this.
    return np.where(square.real < 1e-24, square - square.real + 1e-24, square)
