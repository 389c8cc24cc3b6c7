"""Second-order Taylor models over squares: a small arithmetic of functions and their errors.

A model says of a function that f(c + d) = value + jacobian d + q(d) + rest, with the quadratic
form q and |rest| <= remainder, for all |d_k| <= half (Makino and Berz, 2003, at order two).
Every operation gives a model of its result that holds in exact arithmetic, rounding included:
an operation makes fewer than `ROUNDINGS` roundings one after another, each of which is at most
`UNIT` of a magnitude that is bounded on the way.

At order one the arithmetic is simpler and a square costs less, but the bounds of m near the
path of a trained field are twice as wide at a half-side of a sixty-fourth.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.boxes import Boxes

UNIT = 2.0**-53
"""The unit roundoff of float64."""

ROUNDINGS = 32
"""More than the roundings one after another in any operation on scalars here."""

SLACK = 2 * ROUNDINGS * UNIT
"""What the roundings of an operation change its result by, at most, relative to the sum of the
magnitudes that are added in it: n of them make (1 + UNIT)^n - 1, which is below 2 n UNIT."""

TINY = 1e-290
"""Above what underflow can change a result by."""


@dataclass(frozen=True, eq=False)
class Expansion:
    """A function of one variable about u: f(u + t) = value + slope t + curvature t^2/2 + rest.

    The first three need not be those of f; rest is what they leave, rounding included.

    Attributes:
        value: Of any shape, as the following.
        slope: The factor of t.
        curvature: That of t^2 / 2.
        rest: A bound of |rest|.
    """

    value: FloatArray
    slope: FloatArray
    curvature: FloatArray
    rest: FloatArray


Expand = Callable[[FloatArray, FloatArray, FloatArray], Expansion]


class Univariate(Protocol):
    """A function of one variable that can be bounded."""

    def expand(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion about u that holds on [low, high], which holds u."""


@runtime_checkable
class Differentiable(Univariate, Protocol):
    """One whose derivative can be bounded too."""

    def expand_slope(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion of the derivative about u that holds on [low, high]."""


@dataclass(frozen=True, eq=False)
class TaylorModel:
    """Models of k functions over each of n squares.

    Attributes:
        half: (n,) the half-sides.
        value: (n, k).
        jacobian: (n, 2, k).
        quadratic: (n, 3, k) factors of d_0^2, d_0 d_1 and d_1^2.
        remainder: (n, k), at least zero.
    """

    half: FloatArray
    value: FloatArray
    jacobian: FloatArray
    quadratic: FloatArray
    remainder: FloatArray

    @classmethod
    def position(cls, boxes: Boxes) -> "TaylorModel":
        """Returns the models of the two coordinates."""
        linear = np.broadcast_to(np.eye(2), (len(boxes), 2, 2))
        return replace(cls.constant(boxes.half, boxes.centers), jacobian=linear)

    @classmethod
    def constant(cls, half: FloatArray, value: FloatArray) -> "TaylorModel":
        """Returns the models of numbers (n, k)."""
        n, k = value.shape
        return cls(half, value, np.zeros((n, 2, k)), np.zeros((n, 3, k)), np.zeros((n, k)))

    def __getitem__(self, rows: BoolArray) -> "TaylorModel":
        """Returns the models over some of the squares."""
        parts = (self.half, self.value, self.jacobian, self.quadratic, self.remainder)
        return TaylorModel(*(part[rows] for part in parts))

    @property
    def linear_reach(self) -> FloatArray:
        """How far the linear part takes each function from `value`, (n, k)."""
        return self.half[:, None] * np.abs(self.jacobian).sum(axis=1)

    @property
    def curved_reach(self) -> FloatArray:
        """How far all but the linear part takes it, (n, k)."""
        return self.half[:, None] ** 2 * np.abs(self.quadratic).sum(axis=1) + self.remainder

    @property
    def lower(self) -> FloatArray:
        """What each function is at least, (n, k)."""
        return self.value - self._reach(-1) - SLACK * np.abs(self.value)

    @property
    def upper(self) -> FloatArray:
        """What each function is at most, (n, k)."""
        return self.value + self._reach(1) + SLACK * np.abs(self.value)

    @property
    def magnitude(self) -> FloatArray:
        """What the absolute value of each function and of its parts is at most, (n, k)."""
        reach = self.linear_reach + self.curved_reach
        return np.abs(self.value) + (1 + SLACK) * reach

    def _reach(self, side: int) -> FloatArray:
        """How far each function may be from `value` on one side."""
        first, mixed, second = np.moveaxis(side * self.quadratic, 1, 0)
        bend = np.maximum(first, 0) + np.maximum(second, 0) + np.abs(mixed)
        curved = self.half[:, None] ** 2 * bend + self.remainder
        return (1 + SLACK) * (self.linear_reach + curved)

    def __add__(self, other: "TaylorModel") -> "TaylorModel":
        return self._with(
            self.value + other.value,
            self.jacobian + other.jacobian,
            self.quadratic + other.quadratic,
            self.remainder + other.remainder,
            self.magnitude + other.magnitude,
        )

    def __sub__(self, other: "TaylorModel") -> "TaylorModel":
        return self + other.scaled(-1.0)

    def scaled(self, factor: float) -> "TaylorModel":
        """Returns the models times a number."""
        return self._with(
            factor * self.value,
            factor * self.jacobian,
            factor * self.quadratic,
            abs(factor) * self.remainder,
            abs(factor) * self.magnitude,
        )

    def shifted(self, offset: float) -> "TaylorModel":
        """Returns the models plus a number."""
        value = self.value + offset
        size = np.abs(self.value) + abs(offset)
        return self._with(value, self.jacobian, self.quadratic, self.remainder, size)

    def __mul__(self, other: "TaylorModel") -> "TaylorModel":
        """Returns the models of products; one function multiplies all of the other's."""
        a, b = self.value[:, None], other.value[:, None]
        return self._with(
            self.value * other.value,
            a * other.jacobian + b * self.jacobian,
            a * other.quadratic + b * self.quadratic + _form(self.jacobian, other.jacobian),
            np.abs(self.value) * other.remainder
            + np.abs(other.value) * self.remainder
            + self.linear_reach * other.curved_reach
            + self.curved_reach * (other.linear_reach + other.curved_reach),
            self.magnitude * other.magnitude,
        )

    def dot(self, other: "TaylorModel") -> "TaylorModel":
        """Returns the model (n, 1) of the sum of the products of the functions."""
        return (self * other)._sum()

    def weighted(self, weights: FloatArray) -> "TaylorModel":
        """Returns the model (n, 1) of the sum of the functions, times weights (n, k)."""
        parts = self._with(
            weights * self.value,
            weights[:, None] * self.jacobian,
            weights[:, None] * self.quadratic,
            np.abs(weights) * self.remainder,
            np.abs(weights) * self.magnitude,
        )
        return parts._sum()

    def apply(self, function: Univariate, *, least: float = -np.inf) -> "TaylorModel":
        """Returns the models of a function of each.

        Args:
            function: The function.
            least: What is known to be a lower bound of the functions themselves, as zero is
                of a square.
        """
        return self._applied(function.expand, least)

    def apply_slope(self, function: Differentiable, *, least: float = -np.inf) -> "TaylorModel":
        """Returns the models of the derivative of a function; see `apply`."""
        return self._applied(function.expand_slope, least)

    def _applied(self, expand: Expand, least: float) -> "TaylorModel":
        about = np.maximum(self.value, least)
        found = expand(about, np.maximum(self.lower, least), np.maximum(self.upper, least))
        models, own = self.carried(found, about)
        remainder = np.abs(found.slope) * self.remainder + own
        return TaylorModel(
            self.half,
            models.value,
            models.jacobian,
            models.quadratic,
            (1 + SLACK) * remainder,
        )

    def carried(self, found: Expansion, about: FloatArray) -> tuple["TaylorModel", FloatArray]:
        """Returns models of expansions without their remainders, and what these are.

        That is besides the slope times the remainder of the argument, (n, k).

        Args:
            found: The expansions.
            about: What they are about, (n, k); `value`, or near it.
        """
        linear, curved = self.linear_reach, self.curved_reach + np.abs(self.value - about)
        slope, bend = found.slope[:, None], found.curvature[:, None] / 2
        models = TaylorModel(
            self.half,
            found.value,
            slope * self.jacobian,
            slope * self.quadratic + bend * _form(self.jacobian, self.jacobian),
            np.zeros_like(found.value),
        )
        size = np.abs(found.slope)
        # t^2 less the square of its linear part.
        beyond = np.abs(found.curvature) / 2 * curved * (2 * linear + curved)
        own = found.rest + beyond + size * np.abs(self.value - about)
        magnitude = models.magnitude + size * curved + own
        return models, (1 + SLACK) * own + SLACK * magnitude + TINY

    def _sum(self) -> "TaylorModel":
        """Returns the model (n, 1) of the sum of the functions."""
        return self._with(
            self.value.sum(axis=1, keepdims=True),
            self.jacobian.sum(axis=2, keepdims=True),
            self.quadratic.sum(axis=2, keepdims=True),
            self.remainder.sum(axis=1, keepdims=True),
            self.magnitude.sum(axis=1, keepdims=True),
        )

    def _with(
        self,
        value: FloatArray,
        jacobian: FloatArray,
        quadratic: FloatArray,
        remainder: FloatArray,
        magnitude: FloatArray,
    ) -> "TaylorModel":
        """Returns a model with its rounding, relative to a magnitude, in the remainder."""
        rounded = (1 + SLACK) * remainder + SLACK * magnitude + TINY
        return TaylorModel(self.half, value, jacobian, quadratic, rounded)


def concatenate(models: list[TaylorModel]) -> TaylorModel:
    """Returns the functions of several models over the same squares, one after another."""
    return TaylorModel(
        models[0].half,
        np.concatenate([model.value for model in models], axis=-1),
        np.concatenate([model.jacobian for model in models], axis=-1),
        np.concatenate([model.quadratic for model in models], axis=-1),
        np.concatenate([model.remainder for model in models], axis=-1),
    )


def _form(a: FloatArray, b: FloatArray) -> FloatArray:
    """Returns the quadratic form (n, 3, k) of the product of linear ones (n, 2, k)."""
    mixed = a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0]
    return np.stack([a[:, 0] * b[:, 0], mixed, a[:, 1] * b[:, 1]], axis=1)
