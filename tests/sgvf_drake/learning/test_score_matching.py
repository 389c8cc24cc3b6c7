import numpy as np
import pytest
import torch

from sgvf_drake.fields import GaussianMixture
from sgvf_drake.learning.schedule import NoiseSchedule
from sgvf_drake.learning.score_matching import (
    BOX_HALF_SIZE,
    COMPRESSION_RADIUS,
    DATA_END_SHARE,
    compress,
    mixture_score,
    noisy_score_loss,
    paper_score_loss,
    robust_score_loss,
)
from sgvf_drake.paths import make_shape

BATCH = 256


@pytest.fixture
def seeded():
    """Leaves torch's global generator as it was."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(8)
        yield


@pytest.fixture
def points():
    return torch.as_tensor(make_shape("star", num_points=60)[0].points.copy()).float()


def test_compression_is_bounded_and_the_identity_at_zero():
    direction = torch.tensor([0.6, -0.8], dtype=torch.float64)
    size = torch.tensor([0.0, 1e-3, 1.0, 3.0, 1e3, 1e9], dtype=torch.float64)
    squeezed = compress(size[:, None] * direction)
    expected = size / torch.sqrt(1 + size**2 / COMPRESSION_RADIUS**2)
    torch.testing.assert_close(squeezed, expected[:, None] * direction)
    assert squeezed.norm(dim=1).max() <= COMPRESSION_RADIUS * (1 + 1e-15)
    slope = torch.autograd.functional.jacobian(
        lambda q: compress(q[None])[0], torch.zeros(2, dtype=torch.float64)
    )
    torch.testing.assert_close(slope, torch.eye(2, dtype=torch.float64))


def test_compression_does_not_reorder():
    size = torch.logspace(-3, 3, 100, dtype=torch.float64)
    squeezed = compress(torch.stack([size, torch.zeros_like(size)], dim=1))[:, 0]
    assert (squeezed.diff() > 0).all()


@pytest.mark.parametrize("dim", [2, 3])
def test_mixture_score_is_that_of_the_fields(dim):
    rng = np.random.default_rng(0)
    waypoints, x = rng.uniform(-4, 4, (70, dim)), rng.uniform(-5, 5, (50, dim))
    for sigma in (0.1, 0.7, 3.0):
        expected = GaussianMixture(waypoints, sigma).score(x)
        double = mixture_score(torch.as_tensor(x), sigma, torch.as_tensor(waypoints))
        np.testing.assert_allclose(double, expected, rtol=1e-9, atol=1e-10 / sigma)
    sigmas = rng.uniform(0.1, 3, (50, 1))
    each = [
        GaussianMixture(waypoints, s).score(row[None])[0]
        for s, row in zip(sigmas[:, 0], x, strict=True)
    ]
    together = mixture_score(*map(torch.as_tensor, (x, sigmas, waypoints)))
    np.testing.assert_allclose(together, each, rtol=1e-9, atol=1e-9)


def test_mixture_score_in_single_precision_is_good_enough_to_train_on(points):
    sigma = 0.1
    x = points + sigma * torch.randn(points.shape, generator=torch.Generator().manual_seed(1))
    expected = GaussianMixture(points.double().numpy(), sigma).score(x.double().numpy())
    single = mixture_score(x, sigma, points)
    assert single.dtype == torch.float32
    # Distances squared over 2 sigma^2 reach a few thousand where weights vanish, and a few
    # units where they count; sigma S is of order one.
    np.testing.assert_allclose(sigma * single, sigma * expected, atol=1e-4)


def conditional_mean_residuals(seed, score_sigma, sigma=0.4, n=200_000):
    """Standard scores of E[target - S(x)] in 16 bins of x and 2 coordinates.

    Where S is the conditional mean of Algorithm 1's target, each is N(0, 1).
    """
    rng = np.random.default_rng(seed)
    waypoints = np.array([[0.0, 0.0], [1.0, 0.2], [1.3, 0.9], [-0.5, 0.7], [0.1, 0.1]])
    noise = rng.standard_normal((n, 2))
    x = waypoints[rng.integers(5, size=n)] + sigma * noise
    target = -noise / sigma
    model = mixture_score(torch.as_tensor(x), score_sigma, torch.as_tensor(waypoints)).numpy()
    residual = target - model
    bins = [np.searchsorted(np.quantile(axis, [0.25, 0.5, 0.75]), axis) for axis in x.T]
    label = 4 * bins[0] + bins[1]
    scores = [
        residual[label == k].mean(axis=0)
        / (residual[label == k].std(axis=0) / np.sqrt((label == k).sum()))
        for k in range(16)
    ]
    return np.abs(scores)


@pytest.mark.parametrize("seed", range(3))
def test_the_exact_target_is_the_conditional_mean_of_the_papers(seed):
    """So least squares on either has the same minimiser."""
    # 32 normal numbers exceed 4.5 with a chance of 2e-4.
    assert conditional_mean_residuals(seed, score_sigma=0.4).max() < 4.5


def test_the_conditional_mean_test_can_tell():
    assert conditional_mean_residuals(0, score_sigma=0.41).max() > 6


@pytest.mark.usefixtures("seeded")
def test_the_robust_loss_vanishes_at_the_exact_score(points):
    schedule = NoiseSchedule(0.1)

    def exact(inputs):
        x, t = inputs[:, :2], inputs[:, 2:]
        return schedule(t) * mixture_score(x, schedule(t), points)

    loss = robust_score_loss(exact, points, schedule, BATCH)
    # Rounding in single precision, squared.
    assert all(loss()["score"] < 1e-10 for _ in range(5))
    wrong = robust_score_loss(lambda z: 1.1 * exact(z), points, schedule, BATCH)
    assert wrong()["score"] > 1e-3


@pytest.mark.usefixtures("seeded")
def test_the_papers_loss_is_least_at_the_exact_score(points):
    """On the same draws; what is left is the variance of the target itself."""
    schedule = NoiseSchedule(0.5)

    def exact(inputs):
        return mixture_score(inputs[:, :2], schedule(inputs[:, 2:]), points)

    values = []
    for factor in (0.8, 1.0, 1.2):
        torch.manual_seed(2)
        network = lambda z, factor=factor: factor * exact(z)  # noqa: E731
        loss = paper_score_loss(network, points, schedule, 20_000)
        values.append(loss()["score"].item())
    assert values[1] < min(values[0], values[2])
    assert values[1] > 0.1


@pytest.mark.usefixtures("seeded")
def test_a_robust_batch_sees_the_data_end_the_box_and_the_surroundings(points):
    batches = []

    def recorder(inputs):
        batches.append(inputs)
        return inputs[:, :2]

    loss = robust_score_loss(recorder, points, NoiseSchedule(0.1), BATCH)
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


@pytest.mark.usefixtures("seeded")
def test_algorithm_1_perturbs_a_waypoint_by_the_noise_of_its_time(points):
    def recorder(inputs):
        recorder.seen = inputs
        return torch.zeros(len(inputs), 2)

    schedule = NoiseSchedule(0.1)
    value = paper_score_loss(recorder, points[:1], schedule, 20_000)()["score"]
    x, sigma = recorder.seen[:, :2], schedule(recorder.seen[:, 2:])
    noise = (x - points[0]) / sigma
    # The standard error of a standard deviation is 1 / sqrt(2 n) = .004.
    assert noise.std() == pytest.approx(1, abs=0.016)
    torch.testing.assert_close(value, (noise / sigma).square().sum(dim=1).mean())


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
    """The largest of 32 standard scores of E[target - mean], over bins of x and t."""
    residual = (target - mean).double()
    x, t = inputs[:, :2], inputs[:, 2]
    label = 4 * (x[:, 0] > x[:, 0].median()).long() + 2 * (x[:, 1] > x[:, 1].median())
    label += t > t.median()
    groups = [residual[label == k] for k in range(8) if (label == k).sum() > 1]
    return max(
        (group.mean(dim=0) / group.std(dim=0) * len(group) ** 0.5).abs().max().item()
        for group in groups
    )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("make_loss", [noisy_score_loss, paper_score_loss])
def test_the_noisy_targets_have_the_exact_ones_as_their_mean(make_loss, seed):
    """That of the robust recipe is the score times sigma, that of the paper's the score."""
    points = torch.tensor([[0.0, 0.0], [1.0, 0.2], [1.3, 0.9], [-0.5, 0.7], [0.1, 0.1]])
    schedule = NoiseSchedule(0.4)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        inputs, target = batch_and_target(make_loss, points, schedule, 100_000)
    sigma = schedule(inputs[:, 2:])
    factor = sigma if make_loss is noisy_score_loss else 1.0
    mean = factor * mixture_score(inputs[:, :2], sigma, points)
    assert (target - mean).abs().mean() > 0.1
    # At most 16 normal numbers exceed 4.5 with a chance of 1e-4.
    assert largest_residual(inputs, target, mean) < 4.5
    wrong = factor * mixture_score(inputs[:, :2], 1.1 * sigma, points)
    assert largest_residual(inputs, target, wrong) > 6


@pytest.mark.usefixtures("seeded")
def test_the_papers_draws_with_the_exact_target(points):
    schedule = NoiseSchedule(0.1)
    options = {"n": 500, "exact": True}
    torch.manual_seed(3)
    inputs, target = batch_and_target(paper_score_loss, points, schedule, **options)
    sigma = schedule(inputs[:, 2:])
    torch.testing.assert_close(target, mixture_score(inputs[:, :2], sigma, points))
    torch.manual_seed(3)
    noisy_inputs, _ = batch_and_target(paper_score_loss, points, schedule, 500)
    torch.testing.assert_close(noisy_inputs, inputs, rtol=0, atol=0)


@pytest.mark.usefixtures("seeded")
def test_a_noisy_batch_is_perturbed_by_the_noise_of_its_own_time(points):
    schedule = NoiseSchedule(0.1)
    inputs, target = batch_and_target(noisy_score_loss, points[:1], schedule, 20_000)
    x, t = inputs[:, :2], inputs[:, 2:]
    assert (t == 1).sum() == round(DATA_END_SHARE * 20_000)
    # x is the waypoint less sigma times the target -eps, in single precision.
    torch.testing.assert_close(x, points[0] - schedule(t) * target, rtol=0, atol=1e-4)
    at_end = (x - points[0])[t[:, 0] == 1]
    # The standard error of a standard deviation is sigma / sqrt(2 n) = 6e-4.
    assert at_end.std() == pytest.approx(0.1, abs=2.4e-3)
