"""Second-order Taylor models over patches: a small arithmetic of functions and their errors.

A model says of a function that f(c + A u) = value + slopes . u + q(u) + rest, with the
quadratic form q and |rest| <= remainder, for all |u_j| <= 1 (Makino and Berz, 2003, at order
two).
Every operation gives a model of its result that holds in exact arithmetic, rounding included:
an operation makes fewer than `ROUNDINGS` roundings one after another, each of which is at most
`UNIT` of a magnitude that is bounded on the way.

At order one the arithmetic is simpler and a square costs less, but the bounds of m near the
path of a trained field are twice as wide at a half-side of a sixty-fourth.

A `DualModel` is a dual number of such models: functions and their derivatives by the
coordinates of the space, which a patch may have more of than parameters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, TypeVar, runtime_checkable

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate import kernels
from sgvf_drake.certificate.kernels import LOWER, MAGNITUDE, SLACK, TINY, UPPER
from sgvf_drake.certificate.patches import Patches


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


Numbers = float | FloatArray
"""One for all functions, or (f,) one for each."""


@dataclass(frozen=True, eq=False)
class TaylorModel:
    """Models of f functions over each of n patches of k parameters.

    Attributes:
        parts: (n, 1 + k + k (k + 1) / 2, f) the value, the k slopes, and the factors of u_a u_b
            for a <= b: of two parameters those of u_0^2, u_0 u_1 and u_1^2.
        remainder: (n, f), at least zero.
    """

    parts: FloatArray
    remainder: FloatArray

    @classmethod
    def position(cls, patches: Patches, held: Sequence[float] = ()) -> "TaylorModel":
        """Returns the models of the d coordinates, and of numbers after them."""
        (n, d), k = patches.centers.shape, patches.axes.shape[2]
        parts = np.zeros((n, 1 + k + k * (k + 1) // 2, d + len(held)))
        parts[:, 0, :d], parts[:, 0, d:] = patches.centers, held
        parts[:, 1 : 1 + k, :d] = np.swapaxes(patches.axes, 1, 2)
        return cls(parts, np.zeros((n, d + len(held))))

    @classmethod
    def over_all(cls, models: Sequence["TaylorModel"]) -> "TaylorModel":
        """Returns models over some patches and over others, after each other."""
        return cls(
            np.concatenate([model.parts for model in models]),
            np.concatenate([model.remainder for model in models]),
        )

    def __getitem__(self, rows: BoolArray) -> "TaylorModel":
        """Returns the models over some of the patches."""
        return TaylorModel(self.parts[rows], self.remainder[rows])

    def functions(self, columns: slice) -> "TaylorModel":
        """Returns the models of some of the functions."""
        parts, remainder = self.parts[..., columns], self.remainder[:, columns]
        return TaylorModel(np.ascontiguousarray(parts), np.ascontiguousarray(remainder))

    @property
    def value(self) -> FloatArray:
        """The values at the centres, but for the remainder, (n, f)."""
        return self.parts[:, 0]

    @property
    def slopes(self) -> FloatArray:
        """The factors of the parameters, (n, k, f)."""
        return self.parts[:, 1 : 1 + self.num_parameters]

    @property
    def quadratic(self) -> FloatArray:
        """The factors of u_a u_b for a <= b, (n, k (k + 1) / 2, f)."""
        return self.parts[:, 1 + self.num_parameters :]

    @property
    def num_parameters(self) -> int:
        """The number k of parameters of a patch."""
        return int(kernels.num_parameters(self.parts.shape[1]))

    @property
    def lower(self) -> FloatArray:
        """What each function is at least, (n, f)."""
        return self._ranges[LOWER]

    @property
    def upper(self) -> FloatArray:
        """What each function is at most, (n, f)."""
        return self._ranges[UPPER]

    @property
    def magnitude(self) -> FloatArray:
        """What the absolute value of each function and of its parts is at most, (n, f)."""
        return self._ranges[MAGNITUDE]

    @cached_property
    def _ranges(self) -> FloatArray:
        """See `kernels.ranges`."""
        return np.asarray(kernels.ranges(self.parts, self.remainder))

    def __add__(self, other: "TaylorModel") -> "TaylorModel":
        return _rounded(
            self.parts + other.parts,
            self.remainder + other.remainder,
            self.magnitude + other.magnitude,
        )

    def __sub__(self, other: "TaylorModel") -> "TaylorModel":
        return self + other.scaled(-1.0)

    def scaled(self, factor: Numbers) -> "TaylorModel":
        """Returns the models times numbers."""
        size = np.abs(factor)
        return _rounded(factor * self.parts, size * self.remainder, size * self.magnitude)

    def shifted(self, offset: Numbers) -> "TaylorModel":
        """Returns the models plus numbers."""
        parts = self.parts.copy()
        parts[:, 0] += offset
        return _rounded(parts, self.remainder, np.abs(self.value) + np.abs(offset))

    def __mul__(self, other: "TaylorModel") -> "TaylorModel":
        """Returns the models of products; one function multiplies all of the other's."""
        a, b = ((models.parts, models._ranges, models.remainder) for models in (self, other))
        return TaylorModel(*kernels.product(*a, *b))

    def dot(self, other: "TaylorModel") -> "TaylorModel":
        """Returns the model (n, 1) of the sum of the products of the functions."""
        products = self * other
        return products.weighted(np.ones((1, products.remainder.shape[1])))

    def weighted(self, weights: FloatArray) -> "TaylorModel":
        """Returns the model (n, 1) of the sum of the functions, times weights (n or 1, f)."""
        weights = np.ascontiguousarray(weights, dtype=float)
        return TaylorModel(
            *kernels.weighted_sum(self.parts, self._ranges, self.remainder, weights)
        )

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

    def apply_curvature(self, expand: Expand, *, least: float = -np.inf) -> "TaylorModel":
        """Returns the models of what else can be expanded about each; see `apply`."""
        return self._applied(expand, least)

    def _applied(self, expand: Expand, least: float) -> "TaylorModel":
        about = np.maximum(self.value, least)
        found = expand(about, np.maximum(self.lower, least), np.maximum(self.upper, least))
        parts, own = self.composed(found, about)
        remainder = np.abs(found.slope) * self.remainder + own
        return TaylorModel(parts, (1 + SLACK) * remainder)

    def composed(self, found: Expansion, about: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the parts of functions of these, and what they leave out, (n, f).

        That is besides the slope times the remainder of the argument.

        Args:
            found: The expansions of the functions.
            about: What they are about, (n, f); `value`, or near it.
        """
        expansion = (found.value, found.slope, found.curvature, found.rest)
        parts, own = kernels.composed(
            self.parts, self._ranges, np.ascontiguousarray(about), *expansion
        )
        return np.asarray(parts), np.asarray(own)

    def bend(
        self, found: Expansion, about: FloatArray, rounding: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Makes these the models of functions of them, in place; see `kernels.bend_layer`.

        For a layer of a network, which asks for nothing of its arguments afterwards.

        Args:
            found: The expansions of the functions.
            about: What they are about, (n, f).
            rounding: (n, f) what the last affine map added to the remainders.
        """
        expansion = (about, found.value, found.slope, found.curvature, found.rest)
        return kernels.bend_layer(
            self.parts, self._ranges, self.remainder, rounding, *expansion
        )

    def at_end(self, parameter: int, side: int) -> "TaylorModel":
        """Returns the models over the faces of patches where a parameter is 1 or -1."""
        k = self.num_parameters
        pairs = [(a, b) for a in range(k) for b in range(a, k)]
        parts, kept = self.parts.copy(), [0]
        for row, pair in enumerate(pairs, start=1 + k):
            match pair.count(parameter):
                case 2:
                    parts[:, 0] += parts[:, row]
                case 1:
                    parts[:, 1 + sum(pair) - parameter] += side * parts[:, row]
        parts[:, 0] += side * parts[:, 1 + parameter]
        kept += [1 + a for a in range(k) if a != parameter]
        kept += [row for row, pair in enumerate(pairs, start=1 + k) if parameter not in pair]
        return _rounded(parts[:, kept], self.remainder, self.magnitude)

    def joined(self, *others: "TaylorModel") -> "TaylorModel":
        """Returns these functions and those of others over the same patches, in order."""
        models = (self, *others)
        return TaylorModel(
            np.concatenate([model.parts for model in models], axis=-1),
            np.concatenate([model.remainder for model in models], axis=-1),
        )


def _rounded(parts: FloatArray, remainder: FloatArray, magnitude: FloatArray) -> TaylorModel:
    """Returns a model with its rounding, relative to a magnitude, in the remainder."""
    return TaylorModel(parts, (1 + SLACK) * remainder + SLACK * magnitude + TINY)


@dataclass(frozen=True, eq=False)
class DualModel:
    """Models of f functions and of their d partial derivatives, over each of n patches.

    It has the operations of a `TaylorModel` that a composition asks for.

    Attributes:
        value: The values of the functions.
        slopes: Their derivatives by each of the d coordinates.
    """

    value: TaylorModel
    slopes: tuple[TaylorModel, ...]

    @classmethod
    def position(cls, patches: Patches, held: Sequence[float] = ()) -> "DualModel":
        """Returns the models of the d coordinates, and of numbers after them."""
        value, d = TaylorModel.position(patches, held), patches.centers.shape[1]
        slopes = []
        for unit in np.eye(d, d + len(held)):
            parts = np.zeros_like(value.parts)
            parts[:, 0] = unit
            slopes.append(TaylorModel(parts, value.remainder))
        return cls(value, tuple(slopes))

    @classmethod
    def over_all(cls, models: Sequence["DualModel"]) -> "DualModel":
        """Returns models over some patches and over others, after each other."""
        slopes = zip(*(model.slopes for model in models), strict=True)
        value = TaylorModel.over_all([model.value for model in models])
        return cls(value, tuple(map(TaylorModel.over_all, slopes)))

    @property
    def divergence(self) -> TaylorModel:
        """The model (n, 1) of the divergence of d functions."""
        first, *others = (
            slope.functions(slice(i, i + 1)) for i, slope in enumerate(self.slopes)
        )
        return sum(others, first)

    def functions(self, columns: slice) -> "DualModel":
        """Returns some of the functions."""
        return self._each(lambda model: model.functions(columns))

    def __add__(self, other: "DualModel") -> "DualModel":
        pairs = zip(self.slopes, other.slopes, strict=True)
        return DualModel(self.value + other.value, tuple(a + b for a, b in pairs))

    def __sub__(self, other: "DualModel") -> "DualModel":
        return self + other.scaled(-1.0)

    def scaled(self, factor: Numbers) -> "DualModel":
        """Returns the functions times numbers."""
        return self._each(lambda model: model.scaled(factor))

    def shifted(self, offset: Numbers) -> "DualModel":
        """Returns the functions plus numbers."""
        return DualModel(self.value.shifted(offset), self.slopes)

    def __mul__(self, other: "DualModel") -> "DualModel":
        a, b = self.value, other.value
        pairs = zip(self.slopes, other.slopes, strict=True)
        return DualModel(a * b, tuple(mine * b + a * theirs for mine, theirs in pairs))

    def dot(self, other: "DualModel") -> "DualModel":
        """Returns the sum of the products of the functions."""
        a, b = self.value, other.value
        pairs = zip(self.slopes, other.slopes, strict=True)
        slopes = tuple(mine.dot(b) + a.dot(theirs) for mine, theirs in pairs)
        return DualModel(a.dot(b), slopes)

    def apply(self, function: Differentiable, *, least: float = -np.inf) -> "DualModel":
        """Returns a function of each; see `TaylorModel.apply`."""
        slope = self.value.apply_slope(function, least=least)
        value = self.value.apply(function, least=least)
        return DualModel(value, tuple(slope * inner for inner in self.slopes))

    def joined(self, *others: "DualModel") -> "DualModel":
        """Returns these functions and those of others over the same patches, in order."""
        columns = zip(*(model.slopes for model in (self, *others)), strict=True)
        slopes = tuple(first.joined(*rest) for first, *rest in columns)
        return DualModel(self.value.joined(*(model.value for model in others)), slopes)

    def _each(self, change: Callable[[TaylorModel], TaylorModel]) -> "DualModel":
        return DualModel(change(self.value), tuple(map(change, self.slopes)))


Model = TypeVar("Model", TaylorModel, DualModel)
