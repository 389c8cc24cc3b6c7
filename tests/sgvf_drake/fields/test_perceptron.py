from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from sgvf_drake.fields.activation import ACTIVATIONS
from sgvf_drake.learning.networks import POSITION_SCALE, Network

# Plain as in the paper, with Fourier features, and with features and time.
KINDS = {
    "paper": {"num_inputs": 2, "hidden": (128,), "num_outputs": 2},
    "paper-score": {"num_inputs": 3, "hidden": (64,) * 4, "num_outputs": 2},
    "fourier": {"num_inputs": 3, "hidden": (16, 16), "num_outputs": 3, "num_frequencies": 8},
    "fourier-time": {
        "num_inputs": 3,
        "hidden": (16, 16, 16),
        "num_outputs": 2,
        "num_frequencies": 8,
        "has_time": True,
    },
    "linear": {"num_inputs": 2, "hidden": (), "num_outputs": 2},
}


@pytest.fixture(params=KINDS)
def network(request):
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return Network(**KINDS[request.param])


@pytest.fixture
def z(network):
    inputs = network.to_perceptron().num_inputs
    return np.random.default_rng(4).uniform(-3, 3, (20, inputs))


def test_value_is_that_of_torch_in_double_precision(network, z):
    expected = network.double()(torch.as_tensor(z)).detach().numpy()
    np.testing.assert_allclose(network.to_perceptron()(z), expected, rtol=1e-12, atol=1e-13)


def test_value_is_that_of_torch_to_single_rounding(network, z):
    expected = network(torch.as_tensor(z, dtype=torch.float32)).detach().numpy()
    assert expected.dtype == np.float32
    # Angles up to 30 rad lose 30 eps; a few layers add a few times eps.
    np.testing.assert_allclose(network.to_perceptron()(z), expected, rtol=0, atol=2e-5)


def test_jacobian_autograd_and_finite_differences_agree(network, z):
    perceptron = network.to_perceptron()
    value, jacobian = perceptron.value_and_jacobian(z)
    np.testing.assert_allclose(value, perceptron(z), rtol=1e-12, atol=1e-13)

    # Summing over the batch gives each sample's own derivative.
    automatic = torch.autograd.functional.jacobian(
        lambda batch: network.double()(batch).sum(dim=0), torch.as_tensor(z)
    )
    np.testing.assert_allclose(
        jacobian, np.swapaxes(automatic.numpy(), 0, 1), rtol=1e-11, atol=1e-12
    )

    step = 1e-5
    for j, axis in enumerate(np.eye(z.shape[1])):
        numeric = (perceptron(z + step * axis) - perceptron(z - step * axis)) / (2 * step)
        # Third derivatives of the features reach 20^3: 20^3 h^2 / 6 ~ 1e-7.
        np.testing.assert_allclose(jacobian[:, :, j], numeric, atol=1e-6)


def test_complex_step_is_the_derivative(network, z):
    perceptron = network.to_perceptron()
    _, jacobian = perceptron.value_and_jacobian(z)
    for j, axis in enumerate(np.eye(z.shape[1])):
        value, second = perceptron.value_and_jacobian(z + 1e-30j * axis)
        np.testing.assert_allclose(
            value.imag / 1e-30, jacobian[:, :, j], rtol=1e-11, atol=1e-12
        )
        numeric = (
            perceptron.value_and_jacobian(z + 1e-5 * axis)[1]
            - perceptron.value_and_jacobian(z - 1e-5 * axis)[1]
        ) / 2e-5
        np.testing.assert_allclose(second.imag / 1e-30, numeric, rtol=1e-5, atol=2e-5)


def test_the_last_input_can_be_held(network, z):
    perceptron = network.to_perceptron()
    held = perceptron.with_last_input(0.75)
    assert held.num_inputs == perceptron.num_inputs - 1
    full = np.column_stack([z[:, :-1], np.full(len(z), 0.75)])
    np.testing.assert_allclose(held(z[:, :-1]), perceptron(full), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(
        held.value_and_jacobian(z[:, :-1])[1],
        perceptron.value_and_jacobian(full)[1][:, :, :-1],
        rtol=1e-12,
        atol=1e-13,
    )


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


@pytest.mark.parametrize("magnitude", [1e3, 1e8, 1e100, 1e150])
def test_extreme_inputs_stay_finite(network, z, magnitude):
    perceptron = network.to_perceptron()
    for inputs in (magnitude * z, magnitude * z + 1e-30j):
        value, jacobian = perceptron.value_and_jacobian(inputs)
        assert np.isfinite(value).all()
        assert np.isfinite(jacobian).all()


def test_silu_saturates_to_zero_and_identity(make_perceptron):
    perceptron = make_perceptron(np.random.default_rng(0), 1, (1,), 1)
    (first, last), (bias, end) = perceptron.weights, perceptron.biases
    x = np.array([[-1e6], [1e6]]) / first
    before = x @ first.T + bias
    expected = np.where(before > 0, before, 0) @ last.T + end
    np.testing.assert_allclose(perceptron(x), expected, rtol=1e-15)


@pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda activation: activation.name)
def test_other_activations_are_those_of_torch(make_perceptron, activation):
    """Value, Jacobian and, by a complex step, the second derivatives."""
    rng = np.random.default_rng(5)
    perceptron = replace(make_perceptron(rng, 2, (9, 8), 3), activation=activation)
    z = rng.uniform(-3, 3, (20, 2))

    def evaluate(x):
        layers = zip(perceptron.weights, perceptron.biases, strict=True)
        for number, (weight, bias) in enumerate(layers):
            x = x if number == 0 else getattr(nn, activation.name)()(x)
            x = nn.functional.linear(x, torch.as_tensor(weight), torch.as_tensor(bias))
        return x

    value, jacobian = perceptron.value_and_jacobian(z)
    np.testing.assert_array_equal(perceptron(z), value)
    np.testing.assert_allclose(value, evaluate(torch.as_tensor(z)), rtol=1e-13, atol=1e-13)
    for point, J in zip(z, jacobian, strict=True):
        expected = torch.autograd.functional.jacobian(evaluate, torch.as_tensor(point))
        np.testing.assert_allclose(J, expected, rtol=1e-12, atol=1e-13)
    steps = [perceptron.value_and_jacobian(z + 1e-30j * axis)[1].imag for axis in np.eye(2)]
    second = np.stack(steps, axis=-1) / 1e-30
    for point, H in zip(z, second, strict=True):
        for output in range(3):
            expected = torch.autograd.functional.hessian(
                lambda x, output=output: evaluate(x)[output], torch.as_tensor(point)
            )
            np.testing.assert_allclose(H[output], expected, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda activation: activation.name)
@pytest.mark.parametrize("magnitude", [1e3, 1e100, 1e150])
def test_no_activation_overflows(make_perceptron, activation, magnitude):
    perceptron = make_perceptron(np.random.default_rng(5), 2, (9, 8), 3)
    perceptron = replace(perceptron, activation=activation)
    z = magnitude * np.random.default_rng(6).uniform(-3, 3, (20, 2))
    for inputs in (z, z + 1e-30j):
        value, jacobian = perceptron.value_and_jacobian(inputs)
        assert np.isfinite(value).all()
        assert np.isfinite(jacobian).all()


def test_no_points_to_evaluate(network):
    perceptron = network.to_perceptron()
    value, jacobian = perceptron.value_and_jacobian(np.empty((0, perceptron.num_inputs)))
    assert value.shape == (0, len(perceptron.biases[-1]))
    assert jacobian.shape == (0, len(perceptron.biases[-1]), perceptron.num_inputs)
