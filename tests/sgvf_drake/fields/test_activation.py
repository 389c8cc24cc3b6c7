import numpy as np
import pytest
import torch
from torch import nn

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.activation import ACTIVATIONS, SILU, find_activation

EACH = pytest.mark.parametrize(
    "activation", ACTIVATIONS, ids=[activation.name for activation in ACTIVATIONS]
)
# Both sides of every kink and of zero, and out to where all of them are straight.
Z = np.concatenate([np.linspace(-6, 6, 120), [-50.0, -25.0, -1e-9, 1e-9, 25.0, 50.0]])
# Torch's Softplus is straight above its threshold of 20: it leaves out log(1 + e^-20).
ATOL = {"Softplus": 3e-9}


def derivatives(activation, z):
    """The function, its first and its second derivative, by torch's own class."""
    z = torch.tensor(z, dtype=torch.float64, requires_grad=True)
    value = getattr(nn, activation.name)()(z)
    (slope,) = torch.autograd.grad(value.sum(), z, create_graph=True)
    # The slope of a function of straight pieces does not depend on z.
    second = torch.zeros_like(z)
    if slope.requires_grad:
        (second,) = torch.autograd.grad(slope.sum(), z)
    return [each.detach().numpy() for each in (value, slope, second)]


@EACH
def test_value_and_slope_are_those_of_torch(activation):
    value, slope = activation.value_and_slope(Z)
    expected_value, expected_slope, _ = derivatives(activation, Z)
    atol = ATOL.get(activation.name, 1e-15)
    np.testing.assert_allclose(value, expected_value, rtol=1e-14, atol=atol)
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-14, atol=atol)
    np.testing.assert_array_equal(activation.value(Z), value)


@EACH
def test_at_zero_the_slope_is_that_of_torch(activation):
    """Where ReLU has a kink, torch takes the side on which it is flat."""
    _, slope = activation.value_and_slope(np.zeros(1))
    np.testing.assert_array_equal(slope, derivatives(activation, [0.0])[1])


@EACH
def test_a_complex_step_gives_both_derivatives(activation):
    step = 1e-30
    _, expected_slope, expected_second = derivatives(activation, Z)
    value, slope = activation.value_and_slope(Z + 1j * step)
    atol = ATOL.get(activation.name, 1e-15)
    np.testing.assert_allclose(value.imag / step, expected_slope, rtol=1e-13, atol=atol)
    # The second derivative of SiLU is a sum that cancels, from terms of order one.
    np.testing.assert_allclose(
        slope.imag / step, expected_second, rtol=1e-13, atol=max(atol, 1e-14)
    )
    np.testing.assert_array_equal(activation.value(Z + 1j * step), value)


@EACH
@pytest.mark.parametrize("imaginary", [0, 1e-30j])
def test_nothing_overflows(activation, imaginary):
    # Warnings are errors here.
    z = np.array([1e3, 1e8, 1e100, 1e200, 1e300])
    for sign in (-1, 1):
        value, slope = activation.value_and_slope(sign * z + imaginary)
        # What is left of each of them: its limits, or the straight line z.
        ends = activation.value(np.array([sign * 1e3]))
        limit = ends if abs(ends[0]) < 2 else sign * z
        np.testing.assert_allclose(value.real, np.broadcast_to(limit, z.shape), rtol=1e-15)
        np.testing.assert_allclose(slope.real, float(abs(ends[0]) > 2), atol=1e-300)


@EACH
@pytest.mark.parametrize("spell", [str, str.lower, str.upper])
def test_found_by_name(activation, spell):
    assert find_activation(spell(activation.name)) is activation


def test_swish_is_silu():
    assert find_activation("swish") is find_activation("Swish") is SILU


@pytest.mark.parametrize("name", ["Mish", "", "SiLU()", None, 3, ["SiLU"]])
def test_other_names_are_refused(name):
    with pytest.raises(ConfigurationError, match=r"unknown activation .* SiLU, Tanh") as error:
        find_activation(name)
    assert repr(name) in str(error.value)
