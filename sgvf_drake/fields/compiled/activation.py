"""The activation functions with their slopes, for one real number."""

import math

from sgvf_drake.compiling import part
from sgvf_drake.fields.activation import ACTIVATIONS, NORMAL_RANGE, Activation


def activation_code(activation: Activation) -> int:
    """Returns the number by which `value_and_slope` knows an activation."""
    return ACTIVATIONS.index(activation)


_SILU, _TANH, _SIGMOID, _SOFTPLUS, _GELU, _ELU, _RELU = range(len(ACTIVATIONS))


@part
def value_and_slope(code: int, z: float) -> tuple[float, float]:
    """Returns the activation and its derivative at z."""
    if code == _SILU:
        gate = _sigmoid(z)
        value = z * gate
        return value, gate + value * (1.0 - gate)
    if code == _TANH:
        value = math.tanh(z)
        return value, 1.0 - value * value
    if code == _SIGMOID:
        value = _sigmoid(z)
        return value, value * (1.0 - value)
    if code == _SOFTPLUS:
        return _relu(z) + math.log1p(math.exp(-abs(z))), _sigmoid(z)
    if code == _GELU:
        return _gelu_and_slope(z)
    if code == _ELU:
        value = z if z > 0.0 else math.expm1(z)
        return value, 1.0 if z > 0.0 else value + 1.0
    return _relu(z), 1.0 if z > 0.0 else 0.0


@part
def _sigmoid(z: float) -> float:
    # Far below zero the exponential is infinite, and its inverse zero, as it should be.
    return 1.0 / (1.0 + math.exp(-z))


@part
def _relu(z: float) -> float:
    # In this order a NaN stays one.
    return 0.0 if z <= 0.0 else z


@part
def _gelu_and_slope(z: float) -> tuple[float, float]:
    near = min(max(z, -NORMAL_RANGE), NORMAL_RANGE)
    share = 0.5 + 0.5 * math.erf(near / math.sqrt(2.0))
    density = math.exp(-0.5 * near * near) / math.sqrt(2.0 * math.pi)
    return z * share, share + near * density
