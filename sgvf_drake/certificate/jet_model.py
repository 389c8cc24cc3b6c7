"""Second derivatives of fields over patches: `DualModel` carried on by one order.

A `JetModel` holds models of functions, of their first and of their second derivatives, by the
chain rule in every operation.  Of the functions of one variable the second derivative is only
known between two bounds on a patch, so that patches are to be small.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Protocol, runtime_checkable

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.expansions import COSINE, SINE, find_expansion
from sgvf_drake.certificate.field_model import Algebra, BoundedField
from sgvf_drake.certificate.mixture_model import Components
from sgvf_drake.certificate.network_model import affine
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import (
    Differentiable,
    DualModel,
    Expansion,
    Numbers,
    TaylorModel,
)
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.perceptron import Perceptron


@runtime_checkable
class TwiceDifferentiable(Differentiable, Protocol):
    """A function of one variable whose second derivative can be bounded too."""

    def expand_curvature(self, u: FloatArray, low: FloatArray, high: FloatArray) -> Expansion:
        """Returns the expansion of the second derivative about u that holds on [low, high]."""


@dataclass(frozen=True, eq=False)
class JetModel:
    """Models of f functions with their derivatives up to the second, over each of n patches.

    It has the operations of a `TaylorModel` that a composition asks for.

    Attributes:
        first: The values, and the derivatives by each of the d coordinates.
        second: The second derivatives by coordinates a <= b, in the order of `pairs`.
    """

    first: DualModel
    second: tuple[TaylorModel, ...]

    @classmethod
    def position(cls, patches: Patches, held: Sequence[float] = ()) -> "JetModel":
        """Returns the models of the d coordinates, and of numbers after them."""
        first = DualModel.position(patches, held)
        value = first.value
        zero = TaylorModel(np.zeros_like(value.parts), np.zeros_like(value.remainder))
        return cls(first, tuple(zero for _ in pairs(len(first.slopes))))

    @property
    def value(self) -> TaylorModel:
        """The models of the functions themselves."""
        return self.first.value

    def functions(self, columns: slice) -> "JetModel":
        """Returns some of the functions."""
        return self._each(lambda model: model.functions(columns))

    def __add__(self, other: "JetModel") -> "JetModel":
        both = zip(self.second, other.second, strict=True)
        return JetModel(self.first + other.first, tuple(a + b for a, b in both))

    def __sub__(self, other: "JetModel") -> "JetModel":
        return self + other.scaled(-1.0)

    def scaled(self, factor: Numbers) -> "JetModel":
        """Returns the functions times numbers."""
        return self._each(lambda model: model.scaled(factor))

    def shifted(self, offset: Numbers) -> "JetModel":
        """Returns the functions plus numbers."""
        return JetModel(self.first.shifted(offset), self.second)

    def __mul__(self, other: "JetModel") -> "JetModel":
        return self._product(other, TaylorModel.__mul__, DualModel.__mul__)

    def dot(self, other: "JetModel") -> "JetModel":
        """Returns the sum of the products of the functions."""
        return self._product(other, TaylorModel.dot, DualModel.dot)

    def apply(self, function: TwiceDifferentiable, *, least: float = -np.inf) -> "JetModel":
        """Returns a function of each; see `TaylorModel.apply`."""
        value, slopes = self.value, self.first.slopes
        slope = value.apply_slope(function, least=least)
        bend = value.apply_curvature(function.expand_curvature, least=least)
        first = DualModel(
            value.apply(function, least=least), tuple(slope * inner for inner in slopes)
        )
        second = tuple(
            slope * own + bend * (slopes[a] * slopes[b])
            for own, (a, b) in zip(self.second, pairs(len(slopes)), strict=True)
        )
        return JetModel(first, second)

    def joined(self, *others: "JetModel") -> "JetModel":
        """Returns these functions and those of others over the same patches, in order."""
        columns = zip(*(model.second for model in (self, *others)), strict=True)
        second = tuple(first.joined(*rest) for first, *rest in columns)
        return JetModel(self.first.joined(*(model.first for model in others)), second)

    def affine(self, weight: FloatArray, bias: FloatArray) -> "JetModel":
        """Returns the models of weight f + bias."""
        nothing = np.zeros_like(bias)
        changed = self._each(lambda model: affine(model, weight, nothing)[0])
        value = affine(self.value, weight, bias)[0]
        return JetModel(DualModel(value, changed.first.slopes), changed.second)

    def _product(
        self,
        other: "JetModel",
        times: Callable[[TaylorModel, TaylorModel], TaylorModel],
        first: Callable[[DualModel, DualModel], DualModel],
    ) -> "JetModel":
        x, y = self.first, other.first
        second = []
        for own, theirs, (a, b) in zip(
            self.second, other.second, pairs(len(x.slopes)), strict=True
        ):
            ends = times(own, y.value) + times(x.value, theirs)
            if a == b:
                mixed = times(x.slopes[a], y.slopes[a]).scaled(2.0)
            else:
                mixed = times(x.slopes[a], y.slopes[b]) + times(x.slopes[b], y.slopes[a])
            second.append(ends + mixed)
        return JetModel(first(x, y), tuple(second))

    def _each(self, change: Callable[[TaylorModel], TaylorModel]) -> "JetModel":
        first = DualModel(change(self.value), tuple(map(change, self.first.slopes)))
        return JetModel(first, tuple(map(change, self.second)))


def pairs(dim: int) -> list[tuple[int, int]]:
    """Returns the coordinates of second derivatives, a <= b."""
    return list(combinations_with_replacement(range(dim), 2))


def jet_network(
    network: Perceptron, patches: Patches, held: Sequence[float] = ()
) -> JetModel:
    """Returns the outputs of a network with their derivatives; see `model_network`.

    Raises:
        ConfigurationError: Nothing bounds its activation, or it has no second derivative.
    """
    units, features = JetModel.position(patches, held), network.features
    if features is not None:
        d = features.frequencies.shape[1]
        angles = units.functions(slice(d)).affine(features.frequencies, features.phases)
        others = units.functions(slice(d, None))
        units = angles.apply(SINE).joined(angles.apply(COSINE), others)
    activation = find_expansion(network.activation.name)
    if not isinstance(activation, TwiceDifferentiable):
        raise ConfigurationError(f"{network.activation.name} has no second derivative")
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        units = units.affine(weight, bias).apply(activation)
    return units.affine(network.weights[-1], network.biases[-1])


def _no_components(components: Components, patches: Patches) -> JetModel:
    raise ConfigurationError(
        "nothing bounds the second derivatives of a score in closed form: the flight of a "
        "vehicle is proved of fields whose score is a network (recipes robust and paper)"
    )


JET = Algebra(JetModel.position, jet_network, _no_components)


def jet_field(field: BoundedField, patches: Patches) -> JetModel:
    """Returns the models of m and of its derivatives, by normalised units of length.

    Raises:
        ConfigurationError: The field is of a kind whose second derivatives nothing here bounds.
    """
    return JET.field(field, patches)
