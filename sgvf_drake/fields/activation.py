"""The activation functions that a network may have, with their slopes, in NumPy.

Each one takes real or complex numbers and cannot overflow; those with a kink branch on the
real part, so that a complex step goes through either side.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math

import numpy as np
from scipy.special import erf

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import FloatArray

# The normal distribution is 0 or 1, and its density 0, to float64 this far out.
NORMAL_RANGE = 40.0


@dataclass(frozen=True)
class Activation:
    """An activation function, applied to each entry of an array of any shape.

    Attributes:
        name: The name of its class in torch.
        value: The function.
        value_and_slope: The function and its derivative.
    """

    name: str
    value: Callable[[FloatArray], FloatArray]
    value_and_slope: Callable[[FloatArray], tuple[FloatArray, FloatArray]]


def find_activation(name: str) -> Activation:
    """Returns an activation by its name in torch, in upper or lower case; "swish" is SiLU.

    Raises:
        ConfigurationError: There is none of this name.
    """
    try:
        return _BY_NAME[name.lower()]
    except (AttributeError, KeyError):
        names = ", ".join(activation.name for activation in ACTIVATIONS)
        raise ConfigurationError(
            f"unknown activation {name!r}; choose one of {names}"
        ) from None


def _sigmoid(z: FloatArray) -> FloatArray:
    # By tanh, which cannot overflow, is fast on batches, and takes complex numbers too.
    return 0.5 + 0.5 * np.tanh(0.5 * z)


def _sigmoid_and_slope(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    value = _sigmoid(z)
    return value, value * (1 - value)


def _silu(z: FloatArray) -> FloatArray:
    return z * _sigmoid(z)


def _silu_and_slope(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    gate = _sigmoid(z)
    value = z * gate
    slope = 1 - gate
    slope *= value
    slope += gate
    return value, slope


def _tanh(z: FloatArray) -> FloatArray:
    return np.tanh(z)


def _tanh_and_slope(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    value = np.tanh(z)
    return value, 1 - value**2


def _softplus(z: FloatArray) -> FloatArray:
    # log(1 + e^z), by the exponential that decays.
    return _relu(z) + np.log1p(np.exp(np.where(z.real > 0, -z, z)))


def _softplus_and_slope(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    return _softplus(z), _sigmoid(z)


def _gelu(z: FloatArray) -> FloatArray:
    return z * _normal_distribution(_in_normal_range(z))


def _gelu_and_slope(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    near = _in_normal_range(z)
    share = _normal_distribution(near)
    density = np.exp(-0.5 * near**2) / math.sqrt(2 * math.pi)
    return z * share, share + near * density


def _normal_distribution(z: FloatArray) -> FloatArray:
    return np.asarray(0.5 + 0.5 * erf(z / math.sqrt(2)))


def _in_normal_range(z: FloatArray) -> FloatArray:
    return z - z.real + np.clip(z.real, -NORMAL_RANGE, NORMAL_RANGE)


def _elu(z: FloatArray) -> FloatArray:
    return np.where(z.real > 0, z, np.expm1(np.where(z.real > 0, 0, z)))


def _elu_and_slope(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    value = _elu(z)
    return value, np.where(z.real > 0, 1.0, value + 1)


def _relu(z: FloatArray) -> FloatArray:
    return np.where(z.real > 0, z, 0)


def _relu_and_slope(z: FloatArray) -> tuple[FloatArray, FloatArray]:
    return _relu(z), np.where(z.real > 0, 1.0, 0.0)


SILU = Activation("SiLU", _silu, _silu_and_slope)
"""z / (1 + e^-z): what the paper's networks have."""

ACTIVATIONS = (
    SILU,
    Activation("Tanh", _tanh, _tanh_and_slope),
    Activation("Sigmoid", _sigmoid, _sigmoid_and_slope),
    Activation("Softplus", _softplus, _softplus_and_slope),
    Activation("GELU", _gelu, _gelu_and_slope),
    Activation("ELU", _elu, _elu_and_slope),
    Activation("ReLU", _relu, _relu_and_slope),
)
"""All of them, with torch's default parameters."""

_BY_NAME = {activation.name.lower(): activation for activation in ACTIVATIONS} | {"swish": SILU}
