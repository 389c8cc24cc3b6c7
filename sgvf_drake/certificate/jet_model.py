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
from sgvf_drake.certificate.field_model import Algebra, ExactField
from sgvf_drake.certificate.kernels import SLACK, TINY, UNIT
from sgvf_drake.certificate.mixture_model import Components
from sgvf_drake.certificate.network_model import CHUNK, affine
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


def jet_network(network: Perceptron, patches: Patches, held: Sequence[float] = ()) -> JetModel:
    """Returns the outputs of a network with their derivatives; see `model_network`.

    Raises:
        ConfigurationError: Nothing bounds its activation, or it has no second derivative.
    """
    starts = range(0, len(patches), CHUNK) or (0,)
    found = [_jet(network, patches[start : start + CHUNK], held) for start in starts]
    return _of_channels([_stacked(models) for models in zip(*found, strict=True)])


def _stacked(models: Sequence[TaylorModel]) -> TaylorModel:
    parts = [np.concatenate([getattr(model, name) for model in models]) for name in _FIELDS]
    return TaylorModel(*parts)


_FIELDS = ("parts", "remainder")

Coefficients = dict[tuple[int, int], FloatArray]
"""By numbers of channels: what an error of the second makes of the first."""


def _channels(jet: JetModel) -> list[TaylorModel]:
    """Returns the values, the first and the second derivatives: the channels."""
    return [jet.value, *jet.first.slopes, *jet.second]


def _of_channels(models: Sequence[TaylorModel]) -> JetModel:
    d = next(d for d in range(len(models)) if 1 + d + len(pairs(d)) == len(models))
    return JetModel(DualModel(models[0], tuple(models[1 : 1 + d])), tuple(models[1 + d :]))


def _jet(network: Perceptron, patches: Patches, held: Sequence[float]) -> list[TaylorModel]:
    """Returns the channels of the outputs; errors are carried as in `network_model`."""
    units, features = JetModel.position(patches, held), network.features
    if features is not None:
        d = features.frequencies.shape[1]
        angles = units.functions(slice(d)).affine(features.frequencies, features.phases)
        others = units.functions(slice(d, None))
        units = angles.apply(SINE).joined(angles.apply(COSINE), others)
    activation = find_expansion(network.activation.name)
    if not isinstance(activation, TwiceDifferentiable):
        raise ConfigurationError(f"{network.activation.name} has no second derivative")
    own, layers = [[model.remainder for model in _channels(units)]], []
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        inputs, rounding = _affine(units, weight, bias)
        units, coefficients = inputs.apply(activation), _coefficients(activation, inputs)
        own.append(_own(units, inputs, rounding, coefficients))
        layers.append(coefficients)
    outputs, rounding = _affine(units, network.weights[-1], network.biases[-1])
    carried = _carried(network.weights, layers, own)
    return [
        TaylorModel(model.parts, np.minimum(model.remainder, total + off + TINY))
        for model, total, off in zip(_channels(outputs), carried, rounding, strict=True)
    ]


def _affine(
    units: JetModel, weight: FloatArray, bias: FloatArray
) -> tuple[JetModel, list[FloatArray]]:
    """Returns weight units + bias, and what the rounding of each channel is at most."""
    biases = [bias, *([np.zeros_like(bias)] * (len(_channels(units)) - 1))]
    found = [
        affine(model, weight, own) for model, own in zip(_channels(units), biases, strict=True)
    ]
    return _of_channels([model for model, _ in found]), [rounding for _, rounding in found]


def _coefficients(activation: TwiceDifferentiable, inputs: JetModel) -> Coefficients:
    """Returns what errors of inputs make of activations, to first order about the centres.

    With the numbers D, c_1, E and c_2 that the expansions of the activation and of its first
    two derivatives begin with: an activation h(z) has the derivatives h' z_a and
    h' z_ab + h'' z_a z_b.
    """
    value = inputs.value
    limits = value.value, value.lower, value.upper
    D, slope = activation.expand(*limits).slope, activation.expand_slope(*limits)
    bend = activation.expand_curvature(*limits)
    d = len(inputs.first.slopes)
    z = [model.value for model in inputs.first.slopes]
    found: Coefficients = {(0, 0): D}
    for a in range(d):
        found[1 + a, 1 + a], found[1 + a, 0] = slope.value, slope.slope * z[a]
    for row, (a, b) in enumerate(pairs(d), start=1 + d):
        found[row, row] = slope.value
        found[row, 0] = slope.slope * inputs.second[row - 1 - d].value
        found[row, 0] += bend.slope * (z[a] * z[b])
        found[row, 1 + a] = bend.value * z[b]
        if a == b:
            found[row, 1 + a] = 2 * found[row, 1 + a]
        else:
            found[row, 1 + b] = bend.value * z[a]
    return found


def _own(
    units: JetModel,
    inputs: JetModel,
    rounding: list[FloatArray],
    coefficients: Coefficients,
) -> list[FloatArray]:
    """Returns what is left of errors of activations but for what `coefficients` carry."""
    errors = [model.remainder for model in _channels(inputs)]
    left = []
    for channel, model in enumerate(_channels(units)):
        carried = sum(
            np.abs(factor) * (errors[source] - rounding[source])
            for (target, source), factor in coefficients.items()
            if target == channel
        )
        left.append(np.maximum(model.remainder - carried, 0) + SLACK * model.remainder)
    return left


def _carried(
    weights: Sequence[FloatArray], layers: list[Coefficients], own: list[list[FloatArray]]
) -> list[FloatArray]:
    """What the errors of all units make of the channels of the outputs, (n, outputs) each."""
    last, n = weights[-1], len(own[0][0])
    count = len(own[0])
    backward = {(q, q): np.broadcast_to(last, (n, *last.shape)) for q in range(count)}
    # What rounding changes of `backward`, by the absolute weights and the largest factors.
    sizes, gamma = {(q, q): np.abs(last) for q in range(count)}, 0.0
    totals = [np.zeros((n, len(last))) for _ in range(count)]
    for number in range(len(layers), -1, -1):
        for (q, c), reach in backward.items():
            reached = np.abs(reach) + gamma * sizes[q, c]
            totals[q] += np.einsum("nok,nk->no", reached, own[number][c])
        if number == 0:
            break
        factors, weight = layers[number - 1], weights[number - 1]
        most = {key: np.abs(factor).max(axis=0) for key, factor in factors.items()}
        backward = _through(backward, {k: f[:, None] for k, f in factors.items()}, weight)
        sizes = _through(sizes, most, np.abs(weight))
        gamma += 2 * (weight.shape[0] + 12) * UNIT
    return [total * (1 + 16 * (4 + last.shape[1]) * UNIT * len(own)) for total in totals]


def _through(reach: Coefficients, factors: Coefficients, weight: FloatArray) -> Coefficients:
    """Returns what reaches the outputs through an activation and a matrix before it."""
    found: Coefficients = {}
    for (q, c), own in reach.items():
        for (target, source), factor in factors.items():
            if target == c:
                found[q, source] = found.get((q, source), 0) + own * factor
    flat = weight.shape[0]
    return {
        key: (own.reshape(-1, flat) @ weight).reshape(*own.shape[:-1], weight.shape[1])
        for key, own in found.items()
    }


def _no_components(components: Components, patches: Patches) -> JetModel:
    raise ConfigurationError(
        "nothing bounds the second derivatives of a score in closed form: the flight of a "
        "vehicle is proved of fields whose score is a network (recipes robust and paper)"
    )


JET = Algebra(JetModel.position, jet_network, _no_components)  # type: ignore[type-var]


def jet_field(field: ExactField, patches: Patches) -> JetModel:
    """Returns the models of m and of its derivatives, by normalised units of length.

    Raises:
        ConfigurationError: The field is of a kind whose second derivatives nothing here bounds.
    """
    return JET.field(field, patches)
