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
from sgvf_drake.certificate.taylor_model import (
    SLACK,
    TINY,
    UNIT,
    TaylorModel,
    Univariate,
    concatenate,
)
from sgvf_drake.fields.perceptron import FourierFeatures, Perceptron


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
    model = TaylorModel(
        units.half,
        units.value @ weight.T + bias,
        units.jacobian @ weight.T,
        units.quadratic @ weight.T,
        (1 + gamma) * (units.remainder @ size.T) + rounding,
    )
    return model, rounding


def _activate(
    activation: Univariate, inputs: TaylorModel, rounding: FloatArray
) -> tuple[TaylorModel, _Layer]:
    """Returns the models of the units of a layer, and what the way back needs."""
    found = activation.expand(inputs.value, inputs.lower, inputs.upper)
    units, own = inputs.carried(found, inputs.value)
    size = np.abs(found.slope)
    remainder = (1 + SLACK) * (size * inputs.remainder + own)
    own = (1 + SLACK) * (own + size * rounding)
    return replace(units, remainder=remainder), _Layer(found.slope, own)


def _carried(network: Perceptron, layers: list[_Layer], entry: FloatArray) -> FloatArray:
    """What the errors of all units make of the outputs, at most, (n, outputs)."""
    last = network.weights[-1]
    backward = np.broadcast_to(last, (len(entry), *last.shape))
    # What rounding changes of `backward`, by the absolute weights and the largest slope.
    size, gamma = np.abs(last), 0.0
    total = np.zeros((len(entry), len(last)))
    for layer, weight in zip(reversed(layers), reversed(network.weights[:-1]), strict=True):
        reached = np.abs(backward) + gamma * size
        total += (reached @ layer.own[:, :, None])[:, :, 0]
        backward = (backward * layer.slope[:, None, :]) @ weight
        size = (size * np.abs(layer.slope).max(axis=0, initial=0.0)) @ np.abs(weight)
        gamma += 2 * (weight.shape[0] + 4) * UNIT
    reached = np.abs(backward) + gamma * size
    total += (reached @ entry[:, :, None])[:, :, 0]
    return total * (1 + 2 * (4 + entry.shape[1]) * UNIT * (1 + len(layers)))
