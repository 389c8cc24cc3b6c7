"""Networks over squares: one Taylor model of all outputs, by one pass forth and one back.

Forth, every unit is bounded layer by layer, where the errors of a layer reach the next one by
the absolute weights.  That is far too much for the outputs, since the errors of 64 units do not
all push one way; so what each unit's own curve adds is carried to the outputs by the signed
product of the weights and slopes behind it (as backward bounds of networks do, CROWN among
them).
"""

from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.expansions import COSINE, SINE, find_expansion
from sgvf_drake.certificate.kernels import SLACK, TINY, UNIT
from sgvf_drake.certificate.taylor_model import (
    Differentiable,
    DualModel,
    TaylorModel,
    Univariate,
    concatenate,
)
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.perceptron import FourierFeatures, Perceptron

CHUNK = 96
"""Squares that are asked about at once: what a network makes of them stays in the cache, and
rows are no power of two apart, which would make them fall on each other there."""


@dataclass(frozen=True, eq=False)
class _Layer:
    """What the way back needs of a layer of units.

    Attributes:
        slope: (n, k) of each unit.
        own: (n, k) what its curve and its rounding add to what it gives, at most.
    """

    slope: FloatArray
    own: FloatArray


def model_network(network: Perceptron, boxes: Boxes) -> TaylorModel:
    """Returns the models of the outputs of a network of two inputs.

    Args:
        network: The network.
        boxes: The squares, in the unit of its inputs.

    Raises:
        ConfigurationError: Nothing is known that bounds its activation.
    """
    starts = range(0, len(boxes), CHUNK) or (0,)
    models = [_model(network, boxes[start : start + CHUNK]) for start in starts]
    return TaylorModel(
        boxes.half,
        np.concatenate([model.parts for model in models]),
        np.concatenate([model.remainder for model in models]),
    )


def _model(network: Perceptron, boxes: Boxes) -> TaylorModel:
    position = TaylorModel.position(boxes)
    units = position if network.features is None else _features(network.features, position)
    activation = find_expansion(network.activation.name)
    entry, layers = units.remainder, []
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        units, layer = _activate(activation, *affine(units, weight, bias))
        layers.append(layer)
    outputs, rounding = affine(units, network.weights[-1], network.biases[-1])
    return replace(outputs, remainder=_carried(network, layers, entry) + rounding + TINY)


def _features(features: FourierFeatures, position: TaylorModel) -> TaylorModel:
    angles, _ = affine(position, features.frequencies, features.phases)
    return concatenate([angles.apply(SINE), angles.apply(COSINE)])


def affine(
    units: TaylorModel, weight: FloatArray, bias: FloatArray
) -> tuple[TaylorModel, FloatArray]:
    """Returns the models of weight units + bias, and what their own rounding is at most."""
    # Every product and sum is off by less than (inputs + 2) units of the sum of magnitudes.
    gamma = 2 * (weight.shape[1] + 2) * UNIT
    size = np.abs(weight)
    largest = units.magnitude.max(axis=1, keepdims=True)
    rounding = gamma * (largest * size.sum(axis=1) + np.abs(bias)) + TINY
    n, parts, inputs = units.parts.shape
    mapped = (units.parts.reshape(-1, inputs) @ weight.T).reshape(n, parts, len(bias))
    mapped[:, 0] += bias
    remainder = (1 + gamma) * (units.remainder @ size.T) + rounding
    return TaylorModel(units.half, mapped, remainder), rounding


def _activate(
    activation: Univariate, inputs: TaylorModel, rounding: FloatArray
) -> tuple[TaylorModel, _Layer]:
    """Returns the models of the units of a layer, and what the way back needs."""
    found = activation.expand(inputs.value, inputs.lower, inputs.upper)
    parts, own = inputs.composed(found, inputs.value)
    size = np.abs(found.slope)
    remainder = (1 + SLACK) * (size * inputs.remainder + own)
    own = (1 + SLACK) * (own + size * rounding)
    return TaylorModel(inputs.half, parts, remainder), _Layer(found.slope, own)


def _carried(network: Perceptron, layers: list[_Layer], entry: FloatArray) -> FloatArray:
    """What the errors of all units make of the outputs, at most, (n, outputs)."""
    last, n = network.weights[-1], len(entry)
    backward = np.broadcast_to(last, (n, *last.shape))
    # What rounding changes of `backward`, by the absolute weights and the largest slope.
    size, gamma = np.abs(last), 0.0
    total = np.zeros((n, len(last)))
    for layer, weight in zip(reversed(layers), reversed(network.weights[:-1]), strict=True):
        reached = np.abs(backward) + gamma * size
        total += np.einsum("nok,nk->no", reached, layer.own)
        signed = (backward * layer.slope[:, None, :]).reshape(-1, len(weight))
        backward = (signed @ weight).reshape(n, len(last), weight.shape[1])
        size = (size * np.abs(layer.slope).max(axis=0, initial=0.0)) @ np.abs(weight)
        gamma += 2 * (weight.shape[0] + 4) * UNIT
    reached = np.abs(backward) + gamma * size
    total += np.einsum("nok,nk->no", reached, entry)
    return total * (1 + 2 * (4 + entry.shape[1]) * UNIT * (1 + len(layers)))


def dual_network(network: Perceptron, boxes: Boxes) -> DualModel:
    """Returns the outputs of a network of two inputs, and their derivatives.

    Raises:
        ConfigurationError: Nothing bounds its activation, or it has no derivative.
    """
    units = DualModel.position(boxes)
    if network.features is not None:
        angles = _dual_affine(units, network.features.frequencies, network.features.phases)
        units = _concatenate(angles.apply(SINE), angles.apply(COSINE))
    activation = find_expansion(network.activation.name)
    if not isinstance(activation, Differentiable):
        raise ConfigurationError(f"{network.activation.name} has no derivative everywhere")
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        units = _dual_affine(units, weight, bias).apply(activation)
    return _dual_affine(units, network.weights[-1], network.biases[-1])


def _dual_affine(units: DualModel, weight: FloatArray, bias: FloatArray) -> DualModel:
    nothing = np.zeros_like(bias)
    first, second = (affine(slope, weight, nothing)[0] for slope in units.slopes)
    return DualModel(affine(units.value, weight, bias)[0], (first, second))


def _concatenate(a: DualModel, b: DualModel) -> DualModel:
    first, second = (
        concatenate([mine, theirs]) for mine, theirs in zip(a.slopes, b.slopes, strict=True)
    )
    return DualModel(concatenate([a.value, b.value]), (first, second))
