"""Networks over patches: one Taylor model of all outputs, by one pass forth and one back.

Forth, every unit is bounded layer by layer, where the errors of a layer reach the next one by
the absolute weights.  That is far too much for the outputs, since the errors of 64 units do not
all push one way; so what each unit's own curve adds is carried to the outputs by the signed
product of the weights and slopes behind it (as backward bounds of networks do, CROWN among
them).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.expansions import COSINE, SINE, find_expansion
from sgvf_drake.certificate.kernels import SLACK, TINY, UNIT
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import (
    Differentiable,
    DualModel,
    Model,
    TaylorModel,
    Univariate,
)
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.perceptron import FourierFeatures, Perceptron

CHUNK = 96
"""Patches that are asked about at once: what a network makes of them stays in the cache, and
rows are no power of two apart, which would make them fall on each other there."""


def _keep_memory() -> None:
    """Frees one block that is larger than what the models take, 16 MB that are never touched.

    From then on glibc keeps what is freed for the next layer.  Before, it gives it back to the
    system, which clears the pages again: up to a third of the time of a model.
    """
    np.empty(2**21)


_keep_memory()


@dataclass(frozen=True, eq=False)
class _Layer:
    """What the way back needs of a layer of units.

    Attributes:
        slope: (n, k) of each unit.
        own: (n, k) what its curve and its rounding add to what it gives, at most.
    """

    slope: FloatArray
    own: FloatArray


def model_network(
    network: Perceptron, patches: Patches, held: Sequence[float] = ()
) -> TaylorModel:
    """Returns the models of the outputs of a network.

    Args:
        network: The network.
        patches: Where its first d inputs are.
        held: The values of its other inputs.

    Raises:
        ConfigurationError: Nothing is known that bounds its activation.
    """
    starts = range(0, len(patches), CHUNK) or (0,)
    models = [_model(network, patches[start : start + CHUNK], held) for start in starts]
    return TaylorModel(
        np.concatenate([model.parts for model in models]),
        np.concatenate([model.remainder for model in models]),
    )


def _model(network: Perceptron, patches: Patches, held: Sequence[float]) -> TaylorModel:
    units = TaylorModel.position(patches, held)
    if network.features is not None:
        units = _features(network.features, units)
    activation = find_expansion(network.activation.name)
    entry, layers = units.remainder, []
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        units, layer = _activate(activation, *affine(units, weight, bias))
        layers.append(layer)
    outputs, rounding = affine(units, network.weights[-1], network.biases[-1])
    return replace(outputs, remainder=_carried(network, layers, entry) + rounding + TINY)


def _features(features: FourierFeatures, inputs: Model) -> Model:
    d = features.frequencies.shape[1]
    angles = _affine(inputs.functions(slice(d)), features.frequencies, features.phases)
    return angles.apply(SINE).joined(angles.apply(COSINE), inputs.functions(slice(d, None)))


def _affine(units: Model, weight: FloatArray, bias: FloatArray) -> Model:
    """Returns the models of weight units + bias; see `affine`."""
    if isinstance(units, TaylorModel):
        return affine(units, weight, bias)[0]
    slopes = tuple(affine(slope, weight, np.zeros_like(bias))[0] for slope in units.slopes)
    return DualModel(affine(units.value, weight, bias)[0], slopes)


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
    # Products with a matrix in the order of its memory are half as fast again.
    across = np.ascontiguousarray(weight.T)
    mapped = (units.parts.reshape(-1, inputs) @ across).reshape(n, parts, len(bias))
    mapped[:, 0] += bias
    remainder = (1 + gamma) * (units.remainder @ size.T) + rounding
    return TaylorModel(mapped, remainder), rounding


def _activate(
    activation: Univariate, inputs: TaylorModel, rounding: FloatArray
) -> tuple[TaylorModel, _Layer]:
    """Returns the models of the units of a layer, and what the way back needs."""
    found = activation.expand(inputs.value, inputs.lower, inputs.upper)
    parts, own = inputs.composed(found, inputs.value)
    size = np.abs(found.slope)
    remainder = (1 + SLACK) * (size * inputs.remainder + own)
    own = (1 + SLACK) * (own + size * rounding)
    return TaylorModel(parts, remainder), _Layer(found.slope, own)


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


def dual_network(
    network: Perceptron, patches: Patches, held: Sequence[float] = ()
) -> DualModel:
    """Returns the outputs of a network and their derivatives by position; see `model_network`.

    Raises:
        ConfigurationError: Nothing bounds its activation, or it has no derivative.
    """
    units = DualModel.position(patches, held)
    if network.features is not None:
        units = _features(network.features, units)
    activation = find_expansion(network.activation.name)
    if not isinstance(activation, Differentiable):
        raise ConfigurationError(f"{network.activation.name} has no derivative everywhere")
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        units = _affine(units, weight, bias).apply(activation)
    return _affine(units, network.weights[-1], network.biases[-1])
