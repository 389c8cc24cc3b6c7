"""Second-order Taylor models over squares: a small arithmetic of functions and their errors.

A model says of a function that f(c + d) = value + jacobian d + q(d) + rest, with the quadratic
form q and |rest| <= remainder, for all |d_k| <= half (Makino and Berz, 2003, at order two).
Every operation gives a model of its result that holds in exact arithmetic, rounding included:
an operation makes fewer than `ROUNDINGS` roundings one after another, each of which is at most
`UNIT` of a magnitude that is bounded on the way.

At order one the arithmetic is simpler and a square costs less, but the bounds of m near the
path of a trained field are twice as wide at a half-side of a sixty-fourth.

A `DualModel` is a dual number of such models: functions and their partial derivatives.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate import kernels
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.kernels import LOWER, MAGNITUDE, SLACK, TINY, UPPER


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
        parts: (n, 6, k) the value, the two slopes, and the factors of d_0^2, d_0 d_1 and d_1^2.
        remainder: (n, k), at least zero.
    """

    half: FloatArray
    parts: FloatArray
    remainder: FloatArray

    @classmethod
    def position(cls, boxes: Boxes) -> "TaylorModel":
        """Returns the models of the two coordinates."""
        models = cls.constant(boxes.half, boxes.centers)
        models.parts[:, 1:3] = np.eye(2)
        return models

    @classmethod
    def constant(cls, half: FloatArray, value: FloatArray) -> "TaylorModel":
        """Returns the models of numbers (n, k)."""
        n, k = value.shape
        parts = np.zeros((n, 6, k))
        parts[:, 0] = value
        return cls(half, parts, np.zeros((n, k)))

    def __getitem__(self, rows: BoolArray) -> "TaylorModel":
        """Returns the models over some of the squares."""
        return TaylorModel(self.half[rows], self.parts[rows], self.remainder[rows])

    @property
    def value(self) -> FloatArray:
        """The values at the centres, but for the remainder, (n, k)."""
        return self.parts[:, 0]

    @property
    def jacobian(self) -> FloatArray:
        """The slopes, (n, 2, k)."""
        return self.parts[:, 1:3]

    @property
    def quadratic(self) -> FloatArray:
        """The factors of d_0^2, d_0 d_1 and d_1^2, (n, 3, k)."""
        return self.parts[:, 3:]

    @property
    def lower(self) -> FloatArray:
        """What each function is at least, (n, k)."""
        return self._ranges[LOWER]

    @property
    def upper(self) -> FloatArray:
        """What each function is at most, (n, k)."""
        return self._ranges[UPPER]

    @property
    def magnitude(self) -> FloatArray:
        """What the absolute value of each function and of its parts is at most, (n, k)."""
        return self._ranges[MAGNITUDE]

    @cached_property
    def _ranges(self) -> FloatArray:
        """See `kernels.ranges`."""
        return np.asarray(kernels.ranges(self.half, self.parts, self.remainder))

    def __add__(self, other: "TaylorModel") -> "TaylorModel":
        return self._with(
            self.parts + other.parts,
            self.remainder + other.remainder,
            self.magnitude + other.magnitude,
        )

    def __sub__(self, other: "TaylorModel") -> "TaylorModel":
        return self + other.scaled(-1.0)

    def scaled(self, factor: float) -> "TaylorModel":
        """Returns the models times a number."""
        size = abs(factor)
        return self._with(factor * self.parts, size * self.remainder, size * self.magnitude)

    def shifted(self, offset: float) -> "TaylorModel":
        """Returns the models plus a number."""
        parts = self.parts.copy()
        parts[:, 0] += offset
        return self._with(parts, self.remainder, np.abs(self.value) + abs(offset))

    def __mul__(self, other: "TaylorModel") -> "TaylorModel":
        """Returns the models of products; one function multiplies all of the other's."""
        a, b = ((models.parts, models._ranges, models.remainder) for models in (self, other))
        return TaylorModel(self.half, *kernels.product(*a, *b))

    def dot(self, other: "TaylorModel") -> "TaylorModel":
        """Returns the model (n, 1) of the sum of the products of the functions."""
        return (self * other)._sum()

    def weighted(self, weights: FloatArray) -> "TaylorModel":
        """Returns the model (n, 1) of the sum of the functions, times weights (n, k)."""
        size = np.abs(weights)
        parts = weights[:, None] * self.parts
        return self._with(parts, size * self.remainder, size * self.magnitude)._sum()

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
        parts, own = self.composed(found, about)
        remainder = np.abs(found.slope) * self.remainder + own
        return TaylorModel(self.half, parts, (1 + SLACK) * remainder)

    def composed(self, found: Expansion, about: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the parts (n, 6, k) of functions of these, and what they leave out, (n, k).

        That is besides the slope times the remainder of the argument.

        Args:
            found: The expansions of the functions.
            about: What they are about, (n, k); `value`, or near it.
        """
        expansion = (found.value, found.slope, found.curvature, found.rest)
        parts, own = kernels.composed(
            self.half, self.parts, self._ranges, np.ascontiguousarray(about), *expansion
        )
        return np.asarray(parts), np.asarray(own)

    def _sum(self) -> "TaylorModel":
        """Returns the model (n, 1) of the sum of the functions."""
        sums = (
            part.sum(axis=-1, keepdims=True)
            for part in (self.parts, self.remainder, self.magnitude)
        )
        return self._with(*sums)

    def _with(
        self, parts: FloatArray, remainder: FloatArray, magnitude: FloatArray
    ) -> "TaylorModel":
        """Returns a model with its rounding, relative to a magnitude, in the remainder."""
        rounded = (1 + SLACK) * remainder + SLACK * magnitude + TINY
        return TaylorModel(self.half, parts, rounded)


def concatenate(models: list[TaylorModel]) -> TaylorModel:
    """Returns the functions of several models over the same squares, one after another."""
    return TaylorModel(
        models[0].half,
        np.concatenate([model.parts for model in models], axis=-1),
        np.concatenate([model.remainder for model in models], axis=-1),
    )


@dataclass(frozen=True, eq=False)
class DualModel:
    """Models of k functions and of their two partial derivatives, over each of n squares.

    It has the operations of a `TaylorModel` that a composition asks for.

    Attributes:
        value: The values of the functions.
        slopes: Their derivatives by each coordinate.
    """

    value: TaylorModel
    slopes: tuple[TaylorModel, TaylorModel]

    @classmethod
    def position(cls, boxes: Boxes) -> "DualModel":
        """Returns the models of the two coordinates."""
        value = TaylorModel.position(boxes)
        first, second = (
            TaylorModel.constant(boxes.half, np.broadcast_to(unit, (len(boxes), 2)))
            for unit in np.eye(2)
        )
        return cls(value, (first, second))

    @property
    def divergence(self) -> TaylorModel:
        """The model (n, 1) of the divergence of two functions."""
        along = np.zeros_like(self.value.value)
        first, second = along.copy(), along.copy()
        first[:, 0], second[:, 1] = 1.0, 1.0
        return self.slopes[0].weighted(first) + self.slopes[1].weighted(second)

    def __add__(self, other: "DualModel") -> "DualModel":
        a, b = self.slopes, other.slopes
        return DualModel(self.value + other.value, (a[0] + b[0], a[1] + b[1]))

    def __sub__(self, other: "DualModel") -> "DualModel":
        return self + other.scaled(-1.0)

    def scaled(self, factor: float) -> "DualModel":
        """Returns the functions times a number."""
        first, second = self.slopes
        return DualModel(
            self.value.scaled(factor), (first.scaled(factor), second.scaled(factor))
        )

    def shifted(self, offset: float) -> "DualModel":
        """Returns the functions plus a number."""
        return DualModel(self.value.shifted(offset), self.slopes)

    def __mul__(self, other: "DualModel") -> "DualModel":
        a, b = self.value, other.value
        first, second = (
            mine * b + a * theirs
            for mine, theirs in zip(self.slopes, other.slopes, strict=True)
        )
        return DualModel(a * b, (first, second))

    def dot(self, other: "DualModel") -> "DualModel":
        """Returns the sum of the products of the functions."""
        a, b = self.value, other.value
        first, second = (
            mine.dot(b) + a.dot(theirs)
            for mine, theirs in zip(self.slopes, other.slopes, strict=True)
        )
        return DualModel(a.dot(b), (first, second))

    def apply(self, function: Differentiable, *, least: float = -np.inf) -> "DualModel":
        """Returns a function of each; see `TaylorModel.apply`."""
        slope = self.value.apply_slope(function, least=least)
        first, second = self.slopes
        return DualModel(
            self.value.apply(function, least=least), (slope * first, slope * second)
        )
