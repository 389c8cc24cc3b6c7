"""The networks that are trained, there and back to NumPy, and the loop that trains them."""

from itertools import pairwise, product

import numpy as np
import pytest
import torch
from torch import nn

from sgvf_drake.learning.networks import POSITION_SCALE, Network
from sgvf_drake.learning.optimization import RECORD_EVERY, Optimization, optimize

POINTS = np.random.default_rng(0).uniform(-5, 5, (50, 2))


@pytest.fixture(autouse=True)
def seeded():
    """Leaves torch's global generator as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(6)
        yield


def evaluated(network, z):
    with torch.no_grad():
        return network(torch.as_tensor(z, dtype=torch.float32)).double().numpy()


def test_without_frequencies_the_first_layer_sees_the_scaled_inputs():
    for has_time in (False, True):
        inputs = 2 + has_time
        network = Network(inputs, (16, 8), 2, 0, 2.0, has_time=has_time, scaled=True)
        assert network.layers[0].in_features == inputs
        plain = Network(inputs, (16, 8), 2)
        plain.layers.load_state_dict(network.layers.state_dict())
        t = np.random.default_rng(1).uniform(0, 1, (50, int(has_time)))
        z, scaled = np.hstack([POINTS, t]), np.hstack([POINTS / POSITION_SCALE, 2 * t - 1])
        # Single precision, on outputs of order one.
        np.testing.assert_allclose(evaluated(network, z), evaluated(plain, scaled), atol=1e-6)
        perceptron = network.to_perceptron()
        assert perceptron.features is None
        assert perceptron.weights[0].shape == (16, inputs)
        np.testing.assert_allclose(perceptron(z), evaluated(network, z), atol=1e-5)
    # Features are scaled in any case: recipes may ask for it whatever their number.
    twins = []
    for options in ({}, {"scaled": True}):
        torch.manual_seed(1)
        twins.append(evaluated(Network(2, (8,), 2, 5, **options), POINTS))
    np.testing.assert_array_equal(*twins)


def test_there_and_back_it_is_the_same_function(make_perceptron):
    for hidden, num_frequencies in product([(), (9,), (64, 64, 64)], [0, 6]):
        perceptron = make_perceptron(np.random.default_rng(3), 2, hidden, 2, num_frequencies)
        expected = perceptron(POINTS)
        found = evaluated(Network.from_perceptron(perceptron), POINTS)
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
        network = Network(3, hidden, 2, num_frequencies, 2.0, has_time=True)
        state = torch.get_rng_state()
        again = Network.from_perceptron(network.to_perceptron())
        assert torch.equal(torch.get_rng_state(), state)
        z = np.hstack([POINTS, np.ones((50, 1))])
        np.testing.assert_array_equal(evaluated(again, z), evaluated(network, z))


# The loop.


class Parabola(nn.Module):
    """Two parameters and two loss terms, least at (3, -1)."""

    def __init__(self):
        super().__init__()
        self.p = nn.Parameter(torch.zeros(2))

    def losses(self):
        return {"near": (self.p[0] - 3) ** 2, "far": (self.p[1] + 1) ** 2}


def test_history_and_minimum():
    model = Parabola()
    settings = Optimization(iterations=234, learning_rate=0.1, warmup=10, cosine=True)
    history = optimize(model, model.losses, settings, "score")
    assert list(history.columns) == ["stage", "iteration", "near", "far", "total"]
    assert (history["stage"] == "score").all()
    assert history["iteration"].tolist() == [*range(0, 234, RECORD_EVERY), 233]
    # Recorded before the step: the first record is that of the start.
    assert history.loc[0, ["near", "far", "total"]].tolist() == [9, 1, 10]
    sums = history["near"] + history["far"]
    assert history["total"].to_numpy() == pytest.approx(sums.to_numpy(), rel=1e-6)
    torch.testing.assert_close(model.p.detach(), torch.tensor([3.0, -1.0]), atol=1e-2, rtol=0)


def test_progress_is_told_up_to_the_end():
    for iterations in (1, 10, 11, 25):
        told = []
        model, steps = Parabola(), Optimization(iterations, 0.1)
        tell = lambda *call, told=told: told.append(call)  # noqa: E731
        history = optimize(model, model.losses, steps, "tangent", tell)
        assert told[0] == ("tangent", 1, iterations)
        assert told[-1] == ("tangent", iterations, iterations)
        done = [call[1] for call in told]
        assert done == sorted(set(done))
        assert len(history) == len(told)


def test_the_learning_rate_warms_up_and_falls_along_a_half_cosine():
    settings = Optimization(iterations=1000, learning_rate=1.0, warmup=50, cosine=True)
    factors = [settings.factor(step) for step in range(1001)]
    known = {0: 1 / 50, 24: 0.5, 49: 1, 50: 1, 525: 0.5, 1000: 0}
    for step, factor in known.items():
        assert factors[step] == pytest.approx(factor, abs=1e-15)
    assert all(a < b for a, b in pairwise(factors[:50]))
    assert all(a > b for a, b in pairwise(factors[50:]))
    constant = Optimization(iterations=10, learning_rate=1.0)
    assert [constant.factor(step) for step in range(10)] == [1.0] * 10
    # The first step of Adam is the learning rate times the factor.
    for warmup, factor in ((0, 1.0), (4, 0.25)):
        model = Parabola()
        optimize(model, model.losses, Optimization(1, 0.1, warmup=warmup), "score")
        expected = factor * torch.tensor([0.1, -0.1])
        torch.testing.assert_close(model.p.detach(), expected, rtol=1e-5, atol=0)
    # Fewer iterations than the warmup are no error.
    settings = Optimization(iterations=3, learning_rate=0.1, warmup=50, cosine=True)
    assert len(optimize(model, model.losses, settings, "score")) == 2
