"""Activations and networks in NumPy are those of torch, with their derivatives."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
import torch
from torch import nn

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.activation import ACTIVATIONS, SILU, find_activation
from sgvf_drake.learning.networks import POSITION_SCALE, Network

EACH = pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda one: one.name)
# Both sides of every kink and of zero, and out to where all of them are straight.
Z = np.concatenate([np.linspace(-6, 6, 120), [-50.0, -25.0, -1e-9, 1e-9, 25.0, 50.0]])
# Torch's Softplus is straight above its threshold of 20: it leaves out log(1 + e^-20).
ATOL = {"Softplus": 3e-9}
# Plain as in the paper, with Fourier features, with features and time, and of one layer.
KINDS = (
    {"num_inputs": 2, "hidden": (128,), "num_outputs": 2},
    {"num_inputs": 3, "hidden": (64,) * 4, "num_outputs": 2},
    {"num_inputs": 3, "hidden": (16, 16), "num_outputs": 3, "num_frequencies": 8},
    {
        "num_inputs": 3,
        "hidden": (16, 16, 16),
        "num_outputs": 2,
        "num_frequencies": 8,
        "has_time": True,
    },
    {"num_inputs": 2, "hidden": (), "num_outputs": 2},
)


def in_torch(activation, z):
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
def test_an_activation_and_its_two_derivatives_are_those_of_torch(activation):
    expected = in_torch(activation, Z)
    atol = ATOL.get(activation.name, 1e-15)
    found = activation.value_and_slope(Z)
    np.testing.assert_array_equal(activation.value(Z), found[0])
    np.testing.assert_allclose(found, expected[:2], rtol=1e-14, atol=atol)
    # Where ReLU has a kink, torch takes the side on which it is flat.
    at_zero = activation.value_and_slope(np.zeros(1))[1]
    np.testing.assert_array_equal(at_zero, in_torch(activation, [0.0])[1])
    # A complex step gives both; SiLU's second is a sum that cancels, from terms of order one.
    value, slope = activation.value_and_slope(Z + 1e-30j)
    np.testing.assert_array_equal(activation.value(Z + 1e-30j), value)
    np.testing.assert_allclose(value.imag / 1e-30, expected[1], rtol=1e-13, atol=atol)
    atol = max(atol, 1e-14)
    np.testing.assert_allclose(slope.imag / 1e-30, expected[2], rtol=1e-13, atol=atol)


@EACH
@pytest.mark.parametrize("imaginary", [0, 1e-30j])
def test_nothing_overflows(activation, imaginary, make_perceptron):
    # Warnings are errors here.
    z = np.array([1e3, 1e8, 1e100, 1e200, 1e300])
    for sign in (-1, 1):
        value, slope = activation.value_and_slope(sign * z + imaginary)
        # What is left of each of them: its limits, or the straight line z.
        ends = activation.value(np.array([sign * 1e3]))
        limit = ends if abs(ends[0]) < 2 else sign * z
        np.testing.assert_allclose(value.real, np.broadcast_to(limit, z.shape), rtol=1e-15)
        np.testing.assert_allclose(slope.real, float(abs(ends[0]) > 2), atol=1e-300)
    z = np.random.default_rng(6).uniform(-3, 3, (20, 2))
    for num_frequencies, magnitude in product((0, 5), (1e3, 1e100, 1e150)):
        network = make_perceptron(np.random.default_rng(5), 2, (9, 8), 3, num_frequencies)
        network = replace(network, activation=activation)
        for values in network.value_and_jacobian(magnitude * z + imaginary):
            assert np.isfinite(values).all()


def test_activations_are_found_by_name():
    for activation in ACTIVATIONS:
        for spell in (str, str.lower, str.upper):
            assert find_activation(spell(activation.name)) is activation
    assert find_activation("swish") is find_activation("Swish") is SILU
    for name in ("Mish", "", "SiLU()", None, 3, ["SiLU"]):
        with pytest.raises(ConfigurationError, match=r"unknown .* SiLU, Tanh") as error:
            find_activation(name)
        assert repr(name) in str(error.value)


@pytest.fixture(params=KINDS, ids=["tangent", "score", "fourier", "fourier-time", "linear"])
def network(request):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return Network(**request.param)


@pytest.fixture
def z(network):
    inputs = network.to_perceptron().num_inputs
    return np.random.default_rng(4).uniform(-3, 3, (20, inputs))


def test_a_network_and_its_derivatives_are_those_of_torch(network, z):
    perceptron = network.to_perceptron()
    single = network(torch.as_tensor(z, dtype=torch.float32)).detach().numpy()
    assert single.dtype == np.float32
    # Angles up to 30 rad lose 30 eps; a few layers add a few times eps.
    np.testing.assert_allclose(perceptron(z), single, rtol=0, atol=2e-5)
    network = network.double()
    value, jacobian = perceptron.value_and_jacobian(z)
    np.testing.assert_allclose(value, perceptron(z), rtol=1e-12, atol=1e-13)
    expected = network(torch.as_tensor(z)).detach().numpy()
    np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-13)
    # Summing over the batch gives each sample's own derivative.
    automatic = torch.autograd.functional.jacobian(
        lambda batch: network(batch).sum(dim=0), torch.as_tensor(z)
    )
    expected = np.swapaxes(automatic.numpy(), 0, 1)
    np.testing.assert_allclose(jacobian, expected, rtol=1e-11, atol=1e-12)
    for j, axis in enumerate(np.eye(z.shape[1])):
        ahead, behind = (perceptron.value_and_jacobian(z + s * axis) for s in (1e-5, -1e-5))
        # Third derivatives of the features reach 20^3: 20^3 h^2 / 6 ~ 1e-7.
        numeric = (ahead[0] - behind[0]) / 2e-5
        np.testing.assert_allclose(jacobian[:, :, j], numeric, atol=1e-6)
        value, second = perceptron.value_and_jacobian(z + 1e-30j * axis)
        np.testing.assert_allclose(
            value.imag / 1e-30, jacobian[:, :, j], rtol=1e-11, atol=1e-12
        )
        numeric = (ahead[1] - behind[1]) / 2e-5
        np.testing.assert_allclose(second.imag / 1e-30, numeric, rtol=1e-5, atol=2e-5)


def test_the_last_input_can_be_held(network, z):
    perceptron = network.to_perceptron()
    held = perceptron.with_last_input(0.75)
    assert held.num_inputs == perceptron.num_inputs - 1
    full = np.column_stack([z[:, :-1], np.full(len(z), 0.75)])
    value, jacobian = perceptron.value_and_jacobian(full)
    found, found_jacobian = held.value_and_jacobian(z[:, :-1])
    np.testing.assert_allclose(held(z[:, :-1]), found, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(found, value, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(found_jacobian, jacobian[:, :, :-1], rtol=1e-12, atol=1e-13)


def test_features_see_positions_of_order_one_and_time_from_minus_one_to_one():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        network = Network(3, (4,), 2, num_frequencies=5, has_time=True)
    features = network.to_perceptron().features
    x, t = np.array([0.3, -2.0]), 0.9
    draw = network.frequencies.numpy() / [1 / POSITION_SCALE, 1 / POSITION_SCALE, 2]
    angles = draw @ [*(x / POSITION_SCALE), 2 * t - 1]
    expected = [*np.sin(angles), *np.cos(angles)]
    np.testing.assert_allclose(features(np.array([[*x, t]]))[0], expected, atol=1e-5)
