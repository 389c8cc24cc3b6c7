import numpy as np
import pytest
import torch

from sgvf_drake.learning.networks import POSITION_SCALE, Network

POINTS = np.random.default_rng(0).uniform(-5, 5, (50, 2))


@pytest.fixture
def seeded():
    """Leaves torch's global generator as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(6)
        yield


def evaluated(network, z):
    with torch.no_grad():
        return network(torch.as_tensor(z, dtype=torch.float32)).double().numpy()


@pytest.mark.usefixtures("seeded")
@pytest.mark.parametrize("has_time", [False, True])
def test_without_frequencies_the_first_layer_sees_the_scaled_inputs(has_time):
    inputs = 2 + has_time
    network = Network(inputs, (16, 8), 2, 0, 2.0, has_time=has_time, scaled=True)
    assert network.layers[0].in_features == inputs
    plain = Network(inputs, (16, 8), 2)
    plain.layers.load_state_dict(network.layers.state_dict())
    t = np.random.default_rng(1).uniform(0, 1, (50, int(has_time)))
    scaled = np.hstack([POINTS / POSITION_SCALE, 2 * t - 1])
    # Single precision, on outputs of order one.
    z = np.hstack([POINTS, t])
    np.testing.assert_allclose(evaluated(network, z), evaluated(plain, scaled), atol=1e-6)
    perceptron = network.to_perceptron()
    assert perceptron.features is None
    assert perceptron.weights[0].shape == (16, inputs)
    np.testing.assert_allclose(perceptron(z), evaluated(network, z), atol=1e-5)


@pytest.mark.usefixtures("seeded")
def test_features_are_scaled_in_any_case():
    """So the recipes may ask for scaled inputs whatever the number of frequencies."""
    torch.manual_seed(1)
    network = Network(2, (8,), 2, 5)
    torch.manual_seed(1)
    scaled = Network(2, (8,), 2, 5, scaled=True)
    np.testing.assert_array_equal(evaluated(scaled, POINTS), evaluated(network, POINTS))


@pytest.mark.parametrize("num_frequencies", [0, 6])
@pytest.mark.parametrize("hidden", [(), (9,), (64, 64, 64)])
def test_the_network_of_a_perceptron_is_the_same_function(
    make_perceptron, hidden, num_frequencies
):
    perceptron = make_perceptron(np.random.default_rng(3), 2, hidden, 2, num_frequencies)
    expected = perceptron(POINTS)
    found = evaluated(Network.from_perceptron(perceptron), POINTS)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.usefixtures("seeded")
@pytest.mark.parametrize("num_frequencies", [0, 6])
def test_there_and_back_nothing_is_lost(num_frequencies):
    network = Network(3, (9, 7), 2, num_frequencies, 2.0, has_time=True)
    state = torch.get_rng_state()
    again = Network.from_perceptron(network.to_perceptron())
    assert torch.equal(torch.get_rng_state(), state)
    z = np.hstack([POINTS, np.ones((50, 1))])
    np.testing.assert_array_equal(evaluated(again, z), evaluated(network, z))
