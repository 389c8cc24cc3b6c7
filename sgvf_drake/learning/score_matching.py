"""Learning the score of the cloud by denoising score matching (paper, Algorithm 1)."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

# Noise at t = 0: about the half-extent of the normalised cloud, so that p_0 forgets it.
SIGMA_MAX = 3.0
# Norm of q = sigma S at which `compress` bends from linear to constant.
COMPRESSION_RADIUS = 3.0
# Shares of a robust batch: at t = 1 instead of uniform t, and uniform in the box instead of
# around a waypoint.
DATA_END_SHARE = 0.75
BOX_SHARE = 0.3
# Half-size of the box of the normalised cloud, 1.25 half-extents of 4.
BOX_HALF_SIZE = 5.0

Losses = Callable[[], dict[str, Tensor]]
Function = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class NoiseSchedule:
    """sigma(t) = sigma_max^(1 - t) sigma_min^t: geometric, t = 1 is the data end.

    The paper writes its SDE with growing noise (Section II-B) but evaluates the score of
    the data at t = 1; time runs the second way here.

    Attributes:
        sigma_min: Noise level at t = 1, normalised units.
        sigma_max: Noise level at t = 0.
    """

    sigma_min: float
    sigma_max: float = SIGMA_MAX

    def __call__(self, t: Tensor) -> Tensor:
        """Returns sigma(t), elementwise."""
        ratio = torch.tensor(self.sigma_min / self.sigma_max, dtype=t.dtype)
        return self.sigma_max * ratio**t


def mixture_score(x: Tensor, sigma: Tensor | float, points: Tensor) -> Tensor:
    """Returns the exact score (sum_i w_i x_i - x) / sigma^2 of the noised waypoints.

    It is the conditional mean of Algorithm 1's target -eps / sigma over all waypoints that
    may have led to x, so it has the same minimiser without that target's noise.

    Args:
        x: Positions, (n, d).
        sigma: Noise levels, (n, 1) or one number.
        points: The waypoints, (N, d).
    """
    squares = torch.cdist(x, points, compute_mode="donot_use_mm_for_euclid_dist") ** 2
    weights = torch.softmax(-0.5 * squares / sigma**2, dim=1)
    return (weights @ points - x) / sigma**2


def compress(q: Tensor) -> Tensor:
    """Returns rho(q) = q / sqrt(1 + |q|^2/9): bounded where the score is huge, smooth."""
    return q / torch.sqrt(1 + q.square().sum(dim=1, keepdim=True) / COMPRESSION_RADIUS**2)


def paper_score_loss(
    network: Function,
    points: Tensor,
    schedule: NoiseSchedule,
    batch_size: int,
    exact: bool = False,
) -> Losses:
    """Algorithm 1 to the letter: the network's output is S, its target -eps / sigma(t).

    Args:
        network: The score network of (x, t).
        points: The waypoints, (N, d).
        schedule: The noise of the perturbation.
        batch_size: Samples of a step.
        exact: Whether the target is the conditional mean of that one instead.
    """

    def losses() -> dict[str, Tensor]:
        z = points[torch.randint(len(points), (batch_size,))]
        t = torch.rand(batch_size, 1)
        noise = torch.randn_like(z)
        sigma = schedule(t)
        x = z + sigma * noise
        target = mixture_score(x, sigma, points) if exact else -noise / sigma
        output = network(torch.cat([x, t], dim=1))
        return {"score": (output - target).square().sum(dim=1).mean()}

    return losses


def robust_score_loss(
    network: Function, points: Tensor, schedule: NoiseSchedule, batch_size: int
) -> Losses:
    """Matches compress(q) with the exact q = sigma S, around the path and in the box."""
    at_end = round(DATA_END_SHARE * batch_size)
    in_box = round(BOX_SHARE * batch_size)

    def losses() -> dict[str, Tensor]:
        t = torch.rand(batch_size, 1)
        x = points[torch.randint(len(points), (batch_size,))]
        x = x + schedule(t) * torch.randn_like(x)
        # Where x lies and when it is asked are drawn apart: t = 1 sees the whole box too.
        box = torch.randperm(batch_size)[:in_box]
        x[box] = BOX_HALF_SIZE * (2 * torch.rand(in_box, x.shape[1]) - 1)
        t[torch.randperm(batch_size)[:at_end]] = 1.0
        sigma = schedule(t)
        target = sigma * mixture_score(x, sigma, points)
        output = network(torch.cat([x, t], dim=1))
        error = compress(output) - compress(target)
        return {"score": error.square().sum(dim=1).mean()}

    return losses


def noisy_score_loss(
    network: Function, points: Tensor, schedule: NoiseSchedule, batch_size: int
) -> Losses:
    """Matches q with Algorithm 1's target, sigma (-eps / sigma) = -eps, at the robust times.

    All samples are drawn by the perturbation, each by the noise of its own time: the
    conditional mean of -eps is the exact q there, while one in the box has no waypoint that
    it came from.  Nothing is compressed: -eps is of order one, and the mean of a compressed
    target would not be the compressed mean.
    """
    at_end = round(DATA_END_SHARE * batch_size)

    def losses() -> dict[str, Tensor]:
        t = torch.rand(batch_size, 1)
        t[torch.randperm(batch_size)[:at_end]] = 1.0
        z = points[torch.randint(len(points), (batch_size,))]
        noise = torch.randn_like(z)
        output = network(torch.cat([z + schedule(t) * noise, t], dim=1))
        return {"score": (output + noise).square().sum(dim=1).mean()}

    return losses
