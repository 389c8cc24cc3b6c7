"""The losses of the score: least at the exact score, on the draws that they promise."""

import numpy as np
import pytest
import torch

from sgvf_drake.fields import GaussianMixture, ScoreNetwork
from sgvf_drake.learning.score_matching import (
    BOX_HALF_SIZE,
    COMPRESSION_RADIUS,
    DATA_END_SHARE,
    SIGMA_MAX,
    NoiseSchedule,
    compress,
    mixture_score,
    noisy_score_loss,
    paper_score_loss,
    robust_score_loss,
)
from sgvf_drake.learning.score_stage import frozen_score
from sgvf_drake.paths import make_shape

BATCH = 256
SCHEDULE = NoiseSchedule(0.1)
FEW = torch.tensor([[0.0, 0.0], [1.0, 0.2], [1.3, 0.9], [-0.5, 0.7], [0.1, 0.1]])


@pytest.fixture(autouse=True)
def seeded():
    """Leaves torch's global generator as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(8)
        yield


@pytest.fixture(scope="module")
def points():
    return torch.as_tensor(make_shape("star", num_points=60)[0].points.copy()).float()


def test_the_noise_falls_by_equal_factors_from_forgetting_the_cloud_to_the_data():
    t = torch.linspace(0, 1, 11, dtype=torch.float64)
    for sigma_max in (SIGMA_MAX, 2.0):
        sigma = NoiseSchedule(0.05, sigma_max)(t)
        assert sigma[[0, -1]].tolist() == pytest.approx([sigma_max, 0.05], rel=1e-14)
        ratios = torch.full((10,), (0.05 / sigma_max) ** 0.1).double()
        torch.testing.assert_close(sigma[1:] / sigma[:-1], ratios)
    assert SIGMA_MAX == 3.0
    sigma = SCHEDULE(torch.rand(5, 1))
    assert (sigma.shape, sigma.dtype) == ((5, 1), torch.float32)


def test_compression_is_bounded_and_the_identity_at_zero():
    direction = torch.tensor([0.6, -0.8], dtype=torch.float64)
    size = torch.logspace(-3, 9, 100, dtype=torch.float64)
    squeezed = compress(size[:, None] * direction)
    expected = size / torch.sqrt(1 + size**2 / COMPRESSION_RADIUS**2)
    torch.testing.assert_close(squeezed, expected[:, None] * direction)
    assert squeezed.norm(dim=1).max() <= COMPRESSION_RADIUS * (1 + 1e-15)
    assert (squeezed.norm(dim=1)[:60].diff() > 0).all()
    zero = torch.zeros(2, dtype=torch.float64)
    slope = torch.autograd.functional.jacobian(lambda q: compress(q[None])[0], zero)
    torch.testing.assert_close(slope, torch.eye(2, dtype=torch.float64))


def test_mixture_score_is_that_of_the_fields(points):
    for dim in (2, 3):
        rng = np.random.default_rng(0)
        waypoints, x = rng.uniform(-4, 4, (70, dim)), rng.uniform(-5, 5, (50, dim))
        sigmas = rng.uniform(0.1, 3, (50, 1))
        for sigma in (0.1, 0.7, 3.0, sigmas):
            each = np.broadcast_to(sigma, (50, 1))[:, 0]
            expected = [
                GaussianMixture(waypoints, s).score(row[None])[0]
                for s, row in zip(each, x, strict=True)
            ]
            tensor = torch.as_tensor(sigma) if np.ndim(sigma) else sigma
            found = mixture_score(torch.as_tensor(x), tensor, torch.as_tensor(waypoints))
            np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)
    # In single precision it is good enough to train on: distances squared over 2 sigma^2 reach
    # a few thousand where weights vanish, and a few units where they count.
    x = points + 0.1 * torch.randn(points.shape)
    expected = GaussianMixture(points.double().numpy(), 0.1).score(x.double().numpy())
    single = mixture_score(x, 0.1, points)
    assert single.dtype == torch.float32
    np.testing.assert_allclose(0.1 * single, 0.1 * expected, atol=1e-4)


def exact_score(schedule, points, factor=1.0, scaled=False):
    """The exact score of (x, t), times sigma where it is to be q."""

    def network(inputs):
        sigma = schedule(inputs[:, 2:])
        S = mixture_score(inputs[:, :2], sigma, points)
        return factor * (sigma * S if scaled else S)

    return network


def test_the_losses_are_least_at_the_exact_score(points):
    loss = robust_score_loss(exact_score(SCHEDULE, points, scaled=True), points, SCHEDULE, 256)
    # Rounding in single precision, squared.
    assert all(loss()["score"] < 1e-10 for _ in range(5))
    wrong = exact_score(SCHEDULE, points, 1.1, scaled=True)
    assert robust_score_loss(wrong, points, SCHEDULE, BATCH)()["score"] > 1e-3
    # Of the paper's, what is left is the variance of the target itself; on the same draws.
    schedule = NoiseSchedule(0.5)
    values = []
    for factor in (0.8, 1.0, 1.2):
        torch.manual_seed(2)
        network = exact_score(schedule, points, factor)
        values.append(paper_score_loss(network, points, schedule, 20_000)()["score"].item())
    assert values[1] < min(values[0], values[2])
    assert values[1] > 0.1


def batch_and_target(make_loss, points, schedule, n, **options):
    """Inputs of a batch, and the target that the loss compares the outputs with.

    Read off the gradient of a mean of squares at zero: -2 / n times the target.
    """
    seen = []

    def network(inputs):
        seen.extend([inputs, torch.zeros(n, 2, requires_grad=True)])
        return seen[1]

    make_loss(network, points, schedule, n, **options)()["score"].backward()
    inputs, output = seen
    return inputs, -output.grad * n / 2


def largest_residual(inputs, target, mean):
    """The largest of 16 standard scores of E[target - mean], over bins of x and t."""
    residual = (target - mean).double()
    x, t = inputs[:, :2], inputs[:, 2]
    label = 4 * (x[:, 0] > x[:, 0].median()).long() + 2 * (x[:, 1] > x[:, 1].median())
    label += t > t.median()
    groups = [residual[label == k] for k in range(8) if (label == k).sum() > 1]
    return max(
        (group.mean(dim=0) / group.std(dim=0) * len(group) ** 0.5).abs().max().item()
        for group in groups
    )


@pytest.mark.parametrize("make_loss", [noisy_score_loss, paper_score_loss])
def test_the_noisy_targets_have_the_exact_ones_as_their_mean(make_loss):
    """So least squares on either has the same minimiser; that of the robust recipe is q."""
    schedule = NoiseSchedule(0.4)
    for seed in range(3):
        torch.manual_seed(seed)
        inputs, target = batch_and_target(make_loss, FEW, schedule, 100_000)
        sigma = schedule(inputs[:, 2:])
        factor = sigma if make_loss is noisy_score_loss else 1.0
        mean = factor * mixture_score(inputs[:, :2], sigma, FEW)
        assert (target - mean).abs().mean() > 0.1
        # At most 16 normal numbers exceed 4.5 with a chance of 1e-4.
        assert largest_residual(inputs, target, mean) < 4.5
        # The test can tell.
        wrong = factor * mixture_score(inputs[:, :2], 1.1 * sigma, FEW)
        assert largest_residual(inputs, target, wrong) > 6


def test_a_robust_batch_sees_the_data_end_the_box_and_the_surroundings(points):
    batches = []

    def recorder(inputs):
        batches.append(inputs)
        return inputs[:, :2]

    loss = robust_score_loss(recorder, points, SCHEDULE, BATCH)
    for _ in range(20):
        loss()
    assert all(batch.shape == (BATCH, 3) for batch in batches)
    assert all((batch[:, 2] == 1).sum() == round(DATA_END_SHARE * BATCH) for batch in batches)
    seen = torch.cat(batches)
    assert seen[:, 2].min() >= 0
    at_end = seen[seen[:, 2] == 1][:, :2]
    near = torch.cdist(at_end, points).min(dim=1).values < 0.3
    # At t = 1 70 % of the draws are around waypoints, and about half of these near them,
    # since they are spread by the noise of another t, so at least 35 %; and the box leaves at
    # least 15 % far away.
    assert near.float().mean() > 0.35
    assert (~near).float().mean() > 0.15
    assert (at_end.abs() > 0.9 * BOX_HALF_SIZE).any(dim=1).float().mean() > 0.02


def test_algorithm_1_perturbs_a_waypoint_by_the_noise_of_its_time(points):
    inputs, target = batch_and_target(paper_score_loss, points[:1], SCHEDULE, 20_000)
    sigma = SCHEDULE(inputs[:, 2:])
    noise = (inputs[:, :2] - points[0]) / sigma
    # The standard error of a standard deviation is 1 / sqrt(2 n) = .004.
    assert noise.std() == pytest.approx(1, abs=0.016)
    torch.testing.assert_close(target, -noise / sigma, rtol=1e-3, atol=1e-4)
    # With the exact target, the draws are the same.
    torch.manual_seed(3)
    inputs, target = batch_and_target(paper_score_loss, points, SCHEDULE, 500, exact=True)
    exact = mixture_score(inputs[:, :2], SCHEDULE(inputs[:, 2:]), points)
    torch.testing.assert_close(target, exact)
    torch.manual_seed(3)
    noisy_inputs, _ = batch_and_target(paper_score_loss, points, SCHEDULE, 500)
    torch.testing.assert_close(noisy_inputs, inputs, rtol=0, atol=0)


def test_a_noisy_batch_is_perturbed_by_the_noise_of_its_own_time(points):
    inputs, target = batch_and_target(noisy_score_loss, points[:1], SCHEDULE, 20_000)
    x, t = inputs[:, :2], inputs[:, 2:]
    assert (t == 1).sum() == round(DATA_END_SHARE * 20_000)
    # x is the waypoint less sigma times the target -eps, in single precision.
    torch.testing.assert_close(x, points[0] - SCHEDULE(t) * target, rtol=0, atol=1e-4)
    at_end = (x - points[0])[t[:, 0] == 1]
    # The standard error of a standard deviation is sigma / sqrt(2 n) = 6e-4.
    assert at_end.std() == pytest.approx(0.1, abs=2.4e-3)


def test_the_score_that_a_tangent_is_learned_on_is_that_of_the_model(make_perceptron):
    """Of outputs that are sigma S, as those of the robust recipe, too."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-4, 4, (50, 2))
    for scale in (1.0, 0.3):
        model = ScoreNetwork(make_perceptron(rng, 3, (8, 8), 2), scale)
        found = frozen_score(model)(torch.as_tensor(x).float())
        np.testing.assert_allclose(found, model.score(x), rtol=1e-4, atol=1e-5)
