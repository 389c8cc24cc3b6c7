"""Functions of one variable with bounds of what their tangents leave.

The library's elementary functions are taken to be right within `LIBRARY` units of roundoff,
relative to their value.  This is assumed; the tests hold what follows against ball arithmetic.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import math

import numpy as np
from scipy.special import erf

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import kernels
from sgvf_drake.certificate.kernels import TINY, UNIT
from sgvf_drake.certificate.taylor_model import Expansion, Univariate
from sgvf_drake.exceptions import ConfigurationError

# More than the units of roundoff by which the formulas here can be off: the functions below
# combine at most three values of the library, each of size one and off by LIBRARY units, by
# fewer than ten operations.
FORMULA = 64 * UNIT

Jet = tuple[FloatArray, FloatArray, FloatArray]


@dataclass(frozen=True)
class Smooth:
    """A function whose second derivative and its slope are bounded everywhere.

    Attributes:
        jet: The function and its first two derivatives.
        least: Of the second derivative.
        most: Of the second derivative.
        third: The largest absolute value of the third.
        growth: Whether the rounding of the jet grows with |u|, as that of u times a bounded
            function does.
        higher: Its third and fourth derivatives; None: they are not used.
        bounds: The largest absolute values of the fourth and of the fifth.
    """

    jet: Callable[[FloatArray], Jet]
    least: float
    most: float
    third: float
    growth: bool = False
    higher: Callable[[FloatArray], tuple[FloatArray, FloatArray]] | None = None
    bounds: tuple[float, float] = (np.inf, np.inf)

    def expand(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion; see `Univariate`."""
        value, slope, curvature = self.jet(u)
        bounds = (self.least, self.most, self.third)
        growth = FORMULA if self.growth else 0.0
        rest = kernels.cubic_rests(u, low, high, curvature, bounds, FORMULA, growth)
        return Expansion(value, slope, curvature, rest)

    def expand_slope(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion of the derivative; see `Differentiable`."""
        _, slope, curvature = self.jet(u)
        reach = np.maximum(high - u, u - low)
        anywhere = np.maximum(np.abs(curvature - self.least), np.abs(self.most - curvature))
        bend = np.minimum(self.third * np.maximum(reach / 2, TINY), anywhere)
        error = FORMULA * (1 + np.abs(u)) if self.growth else FORMULA
        rest = (1 + FORMULA) * bend * reach + error * (1 + reach) + TINY
        flat = Expansion(slope, curvature, np.zeros_like(u), rest)
        if self.higher is None:
            return flat
        error = 4 * FORMULA * (1 + np.abs(u)) * (1 + reach + reach**2)
        rest = (1 + FORMULA) * self.bounds[0] * (reach / 6 + TINY) * reach**2 + error + TINY
        return _better(flat, Expansion(slope, curvature, self.higher(u)[0], rest))

    def expand_curvature(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion of the second derivative; see `TwiceDifferentiable`."""
        curvature, nothing = self.jet(u)[2], np.zeros_like(u)
        reach = np.maximum(high - u, u - low)
        bend = np.maximum(np.abs(curvature - self.least), np.abs(self.most - curvature))
        bend = np.minimum(self.third * np.maximum(reach, TINY), bend)
        error = 4 * FORMULA * (1 + np.abs(u)) * (1 + reach + reach**2)
        rest = (1 + FORMULA) * bend + error + TINY + 0 * reach
        flat = Expansion(curvature, nothing, nothing, rest)
        if self.higher is None:
            return flat
        rest = (1 + FORMULA) * self.bounds[1] * (reach / 6 + TINY) * reach**2 + error + TINY
        return _better(flat, Expansion(curvature, *self.higher(u), rest))


def _better(one: Expansion, other: Expansion) -> Expansion:
    """Returns where of two expansions the one that leaves less."""
    takes = other.rest < one.rest
    names = ("value", "slope", "curvature", "rest")
    return Expansion(
        *(np.where(takes, getattr(other, name), getattr(one, name)) for name in names)
    )


def _silu_higher(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    _, bell, curve = _sigmoid(u)
    third = bell * (1 - 6 * bell)
    fourth = curve * (1 - 12 * bell)
    return 3 * curve + u * third, 4 * third + u * fourth


def _tanh(u: FloatArray) -> Jet:
    value = np.tanh(u)
    slope = 1 - value**2
    return value, slope, -2 * value * slope


def _sigmoid(u: FloatArray) -> Jet:
    value = 0.5 + 0.5 * np.tanh(0.5 * u)
    slope = value * (1 - value)
    return value, slope, slope * (1 - 2 * value)


def _softplus(u: FloatArray) -> Jet:
    gate, bell, _ = _sigmoid(u)
    return np.maximum(u, 0) + np.log1p(np.exp(-np.abs(u))), gate, bell


def _gelu(u: FloatArray) -> Jet:
    share = 0.5 + 0.5 * erf(u / math.sqrt(2))
    density = np.exp(-0.5 * u**2) / math.sqrt(2 * math.pi)
    return u * share, share + u * density, density * (2 - u**2)


def _elu(u: FloatArray) -> Jet:
    decay = np.exp(np.minimum(u, 0))
    return np.where(u > 0, u, decay - 1), decay, np.where(u > 0, 0.0, decay)


def _sine(u: FloatArray) -> Jet:
    sine = np.sin(u)
    return sine, np.cos(u), -sine


def _cosine(u: FloatArray) -> Jet:
    cosine = np.cos(u)
    return cosine, -np.sin(u), -cosine


def _waves(u: FloatArray) -> Jet:
    angles, _ = np.split(u, 2, axis=-1)
    sine, cosine = np.sin(angles), np.cos(angles)
    value = np.concatenate([sine, cosine], axis=-1)
    return value, np.concatenate([cosine, -sine], axis=-1), -value


def _waves_higher(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    value, slope, _ = _waves(u)
    return -slope, value


def _fall(y: FloatArray) -> Jet:
    fourth = y**4
    value = 1 / (1 + fourth)
    slope = -4 * y**3 * value**2
    return value, slope, y**2 * (20 * fourth - 12) * value**3


SINE = Smooth(
    _sine, -1.0, 1.0, 1.0, higher=lambda u: (-np.cos(u), np.sin(u)), bounds=(1.0, 1.0)
)
COSINE = Smooth(
    _cosine, -1.0, 1.0, 1.0, higher=lambda u: (np.sin(u), np.cos(u)), bounds=(1.0, 1.0)
)
WAVES = Smooth(_waves, -1.0, 1.0, 1.0, higher=_waves_higher, bounds=(1.0, 1.0))
"""Sines of the first half of functions, and cosines of the second, which is the first again."""


def _or_flat(
    found: Expansion, least: FloatArray, most: FloatArray, error: FloatArray | float
) -> Expansion:
    """Returns an expansion, or where it leaves more than the range is wide, the middle of that.

    Args:
        found: The expansion.
        least: A lower bound of the function, but for rounding.
        most: An upper bound.
        error: What the two are off by, relative to the larger one.
    """
    rounding = 2 * error * np.maximum(np.abs(least), np.abs(most))
    rest = (most - least) / 2 + rounding + TINY
    flat = ~(found.rest <= rest) & np.isfinite(rest)
    return Expansion(
        np.where(flat, least + (most - least) / 2, found.value),
        np.where(flat, 0.0, found.slope),
        np.where(flat, 0.0, found.curvature),
        np.where(flat, rest, found.rest),
    )


@dataclass(frozen=True)
class Bell(Smooth):
    """An even function between 0 and 1 that falls where u >= 0, and is convex where u >= 1.

    Attributes:
        steepest: The largest absolute value of its slope.
    """

    steepest: float = np.inf

    def expand(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion; see `Univariate`."""
        falls = low >= 0
        least = np.where(falls, self.jet(high)[0], 0.0)
        most = np.where(falls, self.jet(low)[0], 1.0)
        return _or_flat(super().expand(u, low, high), least, most, FORMULA)

    def expand_slope(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion of the derivative; see `Differentiable`."""
        convex = low >= 1
        least = np.where(convex, self.jet(low)[1], -self.steepest)
        most = np.where(convex, self.jet(high)[1], np.where(low >= 0, 0.0, self.steepest))
        return _or_flat(super().expand_slope(u, low, high), least, most, FORMULA)


FALL = Bell(_fall, -2.378, 1.47, 12.0, steepest=1.0653)
"""1 / (1 + u^4)."""


@dataclass(frozen=True)
class Rectifier:
    """max(u, 0), by the chord over an interval that holds zero."""

    def expand(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion; see `Univariate`."""
        straddles = (low < 0) & (high > 0)
        width = np.where(straddles, high - low, 1.0)
        slope = np.where(straddles, high / width, np.where(low >= 0, 1.0, 0.0))
        value, zero = np.maximum(u, 0), np.zeros_like(u)
        # Convex and piecewise linear: what is over is largest at an end, least at the kink.
        over = [np.maximum(at, 0) - value - slope * (at - u) for at in (low, high, zero)]
        most = np.maximum(np.maximum(over[0], over[1]), 0)
        least = np.where(straddles, np.minimum(over[2], 0), np.minimum(over[0], over[1]))
        least = np.minimum(least, 0)
        rounding = FORMULA * (np.abs(low) + np.abs(high))
        return Expansion(
            value + (least + most) / 2, slope, zero, (most - least) / 2 + rounding + TINY
        )


ACTIVATIONS: Mapping[str, Univariate] = {
    "SiLU": Smooth(
        kernels.silu,
        -0.037,
        0.501,
        0.3082,
        growth=True,
        higher=_silu_higher,
        bounds=(0.51, 0.9),
    ),
    "Tanh": Smooth(_tanh, -0.77, 0.77, 2.001),
    "Sigmoid": Smooth(_sigmoid, -0.0963, 0.0963, 0.1251),
    "Softplus": Smooth(_softplus, -0.001, 0.251, 0.0963, growth=True),
    "GELU": Smooth(_gelu, -0.108, 0.798, 0.779, growth=True),
    # Its second derivative jumps from 1 to 0.
    "ELU": Smooth(_elu, 0.0, 1.0, np.inf, growth=True),
    "ReLU": Rectifier(),
}
"""The activations of `sgvf_drake.fields.activation`, by name."""


def find_expansion(activation: str) -> Univariate:
    """Returns what bounds an activation.

    Raises:
        ConfigurationError: Nothing does.
    """
    try:
        return ACTIVATIONS[activation]
    except KeyError:
        raise ConfigurationError(
            f"no bounds are known of the activation {activation}"
        ) from None


@dataclass(frozen=True)
class Convex:
    """A convex function of u >= 0 whose second derivative falls.

    That of a completely monotone function does, and all here are: 1 / u and u^(-1/2) are;
    tanh(sqrt u) / sqrt u = sum_n 2 / (u + a_n^2) with a_n = (n - 1/2) pi, by the partial
    fractions of tanh; sech(sqrt u), the Laplace transform of the time at which a Brownian
    motion leaves an interval; and sqrt u / sinh(sqrt u), the product of 1 / (1 + u / (n pi)^2).

    Attributes:
        value_and_slope: The function and its derivative, right within `FORMULA` (1 + u) of
            themselves: rounding changes the exponential in sech by that of its argument.
        curvature: A lower and an upper bound of the second derivative.
    """

    value_and_slope: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
    curvature: Callable[[FloatArray], tuple[FloatArray, FloatArray]]

    def expand(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion; see `Univariate`."""
        value, slope = self.value_and_slope(u)
        reach = np.maximum(high - u, u - low)
        curvature, bend = self._bend(u, low, high)
        rounding = FORMULA * (1 + u) * (np.abs(value) + np.abs(slope) * reach)
        rest = (1 + FORMULA) * reach**2 / 2 * bend
        found = Expansion(value, slope, curvature, rest + rounding + TINY)
        least, most = self.value_and_slope(high)[0], self.value_and_slope(low)[0]
        return _or_flat(found, least, most, FORMULA * (1 + high))

    def expand_slope(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion of the derivative; see `Differentiable`."""
        _, slope = self.value_and_slope(u)
        reach = np.maximum(high - u, u - low)
        curvature, bend = self._bend(u, low, high)
        rest = (1 + FORMULA) * reach * bend
        rounding = FORMULA * (1 + u) * np.abs(slope)
        found = Expansion(slope, curvature, np.zeros_like(u), rest + rounding + TINY)
        least, most = self.value_and_slope(low)[1], self.value_and_slope(high)[1]
        return _or_flat(found, least, most, FORMULA * (1 + high))

    def expand_curvature(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns bounds of the second derivative; see `TwiceDifferentiable`."""
        curvature, bend = self._bend(u, low, high)
        flat = np.zeros_like(u)
        return Expansion(curvature, flat, flat, (1 + FORMULA) * bend + TINY)

    def _bend(
        self, u: FloatArray, low: FloatArray, high: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns the second derivative at u, and how far it is from that on [low, high]."""
        most, least = self.curvature(low)[1], self.curvature(high)[0]
        here = self.curvature(u)
        curvature = (here[0] + here[1]) / 2
        return curvature, np.maximum(most - curvature, curvature - least) + FORMULA * most


# Below the first, u^(-5/2) could overflow; below the second, a bound by formula cancels.
SMALLEST, SMALL = 1e-100, 1e-2
# Beyond, sqrt u / sinh(sqrt u) is below `TINY`.
LARGEST = 1e6
# Partial fractions that are summed, and what the others come to at most: the terms fall, and
# their sum is below the integral of 4 / (pi t)^6 from the last of them on.
_POLES = (np.arange(1, 9) - 0.5) * np.pi
_OTHERS = 4 / (5 * np.pi**6 * 8.0**5)
# Of (sinh 2r - 2r) / (4 r^3) = sum_n 2^(2n - 1) u^(n - 1) / (2n + 1)!, with u = r^2.
_SINH_SERIES = tuple(2.0 ** (2 * n - 1) / math.factorial(2 * n + 1) for n in range(1, 16))


def _inverse_root(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    u = np.maximum(u, SMALLEST)
    value = 1 / np.sqrt(u)
    return value, -0.5 * value / u


def _inverse_root_curvature(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    curvature = 0.75 * np.maximum(u, SMALLEST) ** -2.5
    return (1 - FORMULA) * curvature, (1 + FORMULA) * curvature


def _squash(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    root = np.sqrt(np.maximum(u, SMALLEST))
    value, square = np.tanh(root) / root, _sech(root) ** 2
    # (sech^2 - tanh / root) / (2 u), which cancels near zero; there by the series of sinh.
    far = (square - value) / (2 * np.maximum(u, 1.0))
    near = _series(_SINH_SERIES, np.minimum(u, 1.0))
    return value, np.where(u < 1, -square * near, far)


def _squash_curvature(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """By the partial fractions, or from one on by -(sech^2 f + 3 f') / (2 u)."""
    poles = (4 / (np.minimum(u, 1.0)[..., None] + _POLES**2) ** 3).sum(axis=-1)
    value, slope = _squash(u)
    far = -(_sech(np.sqrt(u)) ** 2 * value + 3 * slope) / (2 * np.maximum(u, 1.0))
    least = np.where(u < 1, poles, far)
    return (1 - FORMULA) * least, (1 + FORMULA) * (least + np.where(u < 1, _OTHERS, 0.0))


def _sech_of_root(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    value = _sech(np.sqrt(u))
    return value, -0.5 * value * _squash(u)[0]


def _sech_curvature(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(sech / 4 u) (tanh / root - 1 + 2 tanh^2), and near zero between 5/12 and its tangent."""
    far = np.maximum(u, SMALL)
    ratio = _squash(far)[0]
    exact = _sech(np.sqrt(far)) / (4 * far) * (ratio - 1 + 2 * far * ratio**2)
    least = np.where(u < SMALL, 5 / 12 - 61 / 120 * u, exact - FORMULA / SMALL)
    most = np.where(u < SMALL, 5 / 12, exact + FORMULA / SMALL)
    return least, most


def _sech(r: FloatArray) -> FloatArray:
    decay = np.exp(-r)
    return 2 * decay / (1 + decay**2)


# Of (r cosh r - sinh r) / r^3 and of sinh r / r, with u = r^2.
_LANGEVIN_SERIES = tuple(2 * n / math.factorial(2 * n + 1) for n in range(1, 12))
_SINHC_SERIES = tuple(1 / math.factorial(2 * n + 1) for n in range(12))
# As above, of coth: the integral of 2 / (pi t)^4 from the eighth pole on.
_COTH_POLES = np.arange(1, 9) * np.pi
_COTH_OTHERS = 2 / (3 * np.pi**4 * 8.0**3)


def _inverse_sinhc(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    # Far out, where the function underflows, infinity times zero is no number.
    root = np.sqrt(np.clip(u, SMALLEST, LARGEST))
    value = 2 * root * np.exp(-root) / -np.expm1(-2 * root)
    return value, -0.5 * value * _langevin(u)


def _inverse_sinhc_curvature(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(L^2 / 4 - L' / 2) times the function; L' by the poles, or from one on by a formula."""
    value, L = _inverse_sinhc(u)[0], _langevin(u)
    poles = -2 * (1 / (np.minimum(u, 1.0)[..., None] + _COTH_POLES**2) ** 2).sum(axis=-1)
    far = np.maximum(u, 1.0)
    most = np.where(u < 1, poles, (1 - value**2 - far * L) / (2 * far**2) + FORMULA)
    least = np.where(u < 1, poles - _COTH_OTHERS, most - 2 * FORMULA)
    # The exponential in the function is off by what its argument is.
    off = FORMULA * (1 + u)
    low, high = (value * (L**2 / 4 - end / 2) for end in (most, least))
    return low - off * np.abs(low), high + off * np.abs(high)


def _langevin(u: FloatArray) -> FloatArray:
    """(r coth r - 1) / u, which cancels near zero; there by series."""
    root = np.sqrt(np.maximum(u, 1.0))
    far = (root / np.tanh(root) - 1) / np.maximum(u, 1.0)
    near = np.minimum(u, 1.0)
    return np.where(u < 1, _series(_LANGEVIN_SERIES, near) / _series(_SINHC_SERIES, near), far)


def _series(coefficients: tuple[float, ...], u: FloatArray) -> FloatArray:
    total = np.zeros_like(u)
    for coefficient in reversed(coefficients):
        total = total * u + coefficient
    return total


def _decay(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    value = np.exp(-u)
    return value, -value


def _decay_curvature(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    # The exponential is off by what its argument is.
    value, off = np.exp(-u), FORMULA * (1 + u)
    return (1 - off) * value, (1 + off) * value


def _reciprocal(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    value = 1 / np.maximum(u, SMALLEST)
    return value, -(value**2)


def _reciprocal_curvature(u: FloatArray) -> tuple[FloatArray, FloatArray]:
    curvature = 2 * np.maximum(u, SMALLEST) ** -3
    return (1 - FORMULA) * curvature, (1 + FORMULA) * curvature


DECAY = Convex(_decay, _decay_curvature)
"""exp(-u)."""

RECIPROCAL = Convex(_reciprocal, _reciprocal_curvature)
"""1 / u."""

INVERSE_ROOT = Convex(_inverse_root, _inverse_root_curvature)
"""1 / sqrt(u)."""

SQUASH = Convex(_squash, _squash_curvature)
"""tanh(sqrt u) / sqrt u."""

SECH_OF_ROOT = Convex(_sech_of_root, _sech_curvature)
"""sech(sqrt u)."""

INVERSE_SINHC = Convex(_inverse_sinhc, _inverse_sinhc_curvature)
"""sqrt u / sinh(sqrt u)."""
