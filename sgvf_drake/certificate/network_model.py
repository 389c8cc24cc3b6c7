"""Networks over patches: one Taylor model of all outputs, by one pass forth and one back.

Forth, every unit is bounded layer by layer, where the errors of a layer reach the next one by
the absolute weights.  That is far too much for the outputs, since the errors of 64 units do not
all push one way; so what each unit's own curve adds is carried to the outputs by the signed
product of the weights and slopes behind it (as backward bounds of networks do, CROWN among
them).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import kernels
from sgvf_drake.certificate.expansions import WAVES, find_expansion
from sgvf_drake.certificate.kernels import TINY, UNIT
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import (
    Differentiable,
    DualModel,
    TaylorModel,
    Univariate,
)
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.perceptron import FourierFeatures, Perceptron

CHUNK = 96
"""Patches that are asked about at once, at most: what a network makes of them stays in the
cache."""


def _keep_memory() -> None:
    """Frees one block that is larger than what the models take, 16 MB that are never touched.

    From then on glibc keeps what is freed for the next layer.  Before, it gives it back to the
    system, which clears the pages again: up to a third of the time of a model.
    """
    np.empty(2**21)


_keep_memory()


@dataclass(frozen=True, eq=False)
class _Affine:
    """An affine map as models ask for it.

    Attributes:
        weight: (outputs, inputs).
        bias: (outputs,).
        across: The weight, transposed in memory, which is half as fast again.
        size: The same of its absolute values.
        sizes: The sums of these over the inputs.
    """

    weight: FloatArray
    bias: FloatArray
    across: FloatArray
    size: FloatArray
    sizes: FloatArray

    @classmethod
    def of(cls, weight: FloatArray, bias: FloatArray) -> "_Affine":
        """Returns the map of a weight and a bias."""
        across = np.ascontiguousarray(weight.T)
        size = np.abs(across)
        return cls(weight, bias, across, size, size.sum(axis=0))

    @property
    def gamma(self) -> float:
        """What sums are off by relative to that of the magnitudes.

        Every product and sum is off by less than (inputs + 2) units.
        """
        return 2 * (self.weight.shape[1] + 2) * UNIT


@dataclass(frozen=True, eq=False)
class _Network:
    """The maps of a network, to the angles of its features first, if it has some."""

    angles: _Affine | None
    layers: tuple[_Affine, ...]
    outputs: _Affine
    activation: Univariate

    @classmethod
    def of(cls, network: Perceptron) -> "_Network":
        *layers, outputs = map(_Affine.of, network.weights, network.biases)
        activation = find_expansion(network.activation.name)
        return cls(_angles(network.features), tuple(layers), outputs, activation)


def _angles(features: FourierFeatures | None) -> _Affine | None:
    return None if features is None else _Affine.of(features.frequencies, features.phases)


@dataclass(frozen=True, eq=False)
class _Units:
    """Models of units, which the next layer takes the place of.

    Attributes:
        parts: See `TaylorModel`.
        remainder: The same.
        largest: (n,) what the units and their parts are at most.
    """

    parts: FloatArray
    remainder: FloatArray
    largest: FloatArray

    @classmethod
    def of(cls, model: TaylorModel) -> "_Units":
        return cls(model.parts, model.remainder, model.magnitude.max(axis=1))


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
    prepared = _Network.of(network)
    return TaylorModel.over_all([_model(prepared, some, held) for some in _in_chunks(patches)])


def affine(
    units: TaylorModel, weight: FloatArray, bias: FloatArray
) -> tuple[TaylorModel, FloatArray]:
    """Returns the models of weight units + bias, and what their own rounding is at most."""
    return _mapped(_Affine.of(weight, bias), _Units.of(units))


def _in_chunks(patches: Patches) -> Iterator[Patches]:
    """Yields patches, about as many each time."""
    count = max(-(-len(patches) // CHUNK), 1)
    for first, last in pairwise(np.linspace(0, len(patches), count + 1).astype(int)):
        yield patches[first:last]


def _model(network: _Network, patches: Patches, held: Sequence[float]) -> TaylorModel:
    units, layers = _entering(network.angles, TaylorModel.position(patches, held)), []
    entry = units.remainder
    for own in network.layers:
        units, layer = _activate(network.activation, *_mapped(own, units))
        layers.append(layer)
    outputs, rounding = _mapped(network.outputs, units)
    carried = _carried(network, layers, entry)
    return TaylorModel(outputs.parts, carried + rounding + TINY)


def _entering(angles: _Affine | None, inputs: TaylorModel) -> _Units:
    """Returns what the first layer sees."""
    if angles is None:
        return _Units.of(inputs)
    d = angles.weight.shape[1]
    found, rounding = _mapped(angles, _Units.of(inputs.functions(slice(d))))
    units, _ = _activate(WAVES, found.joined(found), np.tile(rounding, 2))
    if d == inputs.remainder.shape[1]:
        return units
    passed = inputs.functions(slice(d, None))
    return _Units.of(TaylorModel(units.parts, units.remainder).joined(passed))


def _mapped(affine: _Affine, units: _Units) -> tuple[TaylorModel, FloatArray]:
    """Returns the models of weight units + bias, and what their own rounding is at most."""
    n, rows, inputs = units.parts.shape
    parts = (units.parts.reshape(-1, inputs) @ affine.across).reshape(
        n, rows, affine.across.shape[1]
    )
    remainder = units.remainder @ affine.size
    rounding = kernels.shift_layer(
        parts, remainder, units.largest, affine.bias, affine.sizes, affine.gamma
    )
    return TaylorModel(parts, remainder), np.asarray(rounding)


def _activate(
    activation: Univariate, inputs: TaylorModel, rounding: FloatArray
) -> tuple[_Units, _Layer]:
    """Returns the units of a layer, in the place of its inputs, and what the way back needs."""
    about = np.ascontiguousarray(inputs.value)
    found = activation.expand(about, inputs.lower, inputs.upper)
    own, magnitude = inputs.bend(found, about, rounding)
    units = _Units(inputs.parts, inputs.remainder, magnitude.max(axis=1))
    return units, _Layer(found.slope, own)


def _carried(network: _Network, layers: list[_Layer], entry: FloatArray) -> FloatArray:
    """What the errors of all units make of the outputs, at most, (n, outputs)."""
    last, n = network.outputs.weight, len(entry)
    backward = np.tile(last, (n, 1, 1))
    # What rounding changes of `backward`, by the absolute weights and the largest slope.
    size, gamma = np.abs(last), 0.0
    total = np.zeros((n, len(last)))
    for layer, affine in zip(reversed(layers), reversed(network.layers), strict=True):
        kernels.carry_back(backward, size, gamma, layer.slope, layer.own, total)
        flat = backward.reshape(-1, backward.shape[2])
        backward = (flat @ affine.weight).reshape(n, len(last), affine.weight.shape[1])
        size = (size * np.abs(layer.slope).max(axis=0, initial=0.0)) @ affine.size.T
        gamma += 2 * (len(affine.weight) + 4) * UNIT
    kernels.carry_back(backward, size, gamma, np.ones_like(entry), entry, total)
    # Of each product three, of sums as often as halves are added, and one for each layer.
    widest = max(entry.shape[1], *(layer.own.shape[1] for layer in layers), 1)
    roundings = 4 + widest.bit_length() + len(layers)
    return np.asarray((1 + 2 * roundings * UNIT) * total)


def dual_network(
    network: Perceptron, patches: Patches, held: Sequence[float] = ()
) -> DualModel:
    """Returns the outputs of a network and their derivatives by position; see `model_network`.

    Raises:
        ConfigurationError: Nothing bounds its activation, or it has no derivative.
    """
    prepared = _Network.of(network)
    activation = prepared.activation
    if not isinstance(activation, Differentiable):
        raise ConfigurationError(f"{network.activation.name} has no derivative everywhere")
    return DualModel.over_all(
        [_dual(prepared, activation, some, held) for some in _in_chunks(patches)]
    )


def _dual(
    network: _Network, activation: Differentiable, patches: Patches, held: Sequence[float]
) -> DualModel:
    units = DualModel.position(patches, held)
    if network.angles is not None:
        d = network.angles.weight.shape[1]
        angles = _affine(network.angles, units.functions(slice(d)))
        waves = angles.joined(angles).apply(WAVES)
        units = waves.joined(units.functions(slice(d, None)))
    for affine in network.layers:
        units = _affine(affine, units).apply(activation)
    return _affine(network.outputs, units)


def _affine(affine: _Affine, units: DualModel) -> DualModel:
    """Returns the models of weight units + bias, and of their derivatives."""
    linear = replace(affine, bias=np.zeros_like(affine.bias))
    slopes = (_mapped(linear, _Units.of(slope))[0] for slope in units.slopes)
    return DualModel(_mapped(affine, _Units.of(units.value))[0], tuple(slopes))
