"""Learning the tangent field on top of a fixed score (paper, Algorithm 2)."""

from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity

from sgvf_drake.learning.score_matching import (
    BOX_HALF_SIZE,
    Function,
    Losses,
    NoiseSchedule,
)

# Standard deviation of the noise that makes a neighbour of x, normalised units.
NEIGHBOUR_NOISE = 0.1
PAPER_NEIGHBOURS = 5
ROBUST_NEIGHBOURS = 2
# Share of a robust batch that is uniform in the box.
BOX_SHARE = 0.4
# Below this norm a vector has no direction to speak of; keeps the cosines differentiable.
EPSILON = 1e-8

Terms = dict[str, Callable[[], Tensor]]


def paper_tangent_loss(
    network: Function,
    score: Function,
    points: Tensor,
    schedule: NoiseSchedule,
    gain: float,
    batch_size: int,
    weights: Mapping[str, float],
) -> Losses:
    """Algorithm 2 to the letter: unit length, orthogonality, directional consistency.

    x is drawn from the conditional path of Algorithm 1.

    Args:
        network: The tangent network.
        score: The raw score at t = 1, (n, d) -> (n, d).
        points: The waypoints, (N, d).
        schedule: The noise of the conditional path.
        gain: k_s of the normalised score.
        batch_size: Samples of a step.
        weights: lambda_1 to lambda_3 by the name of the loss; 0 removes it.
    """

    def losses() -> dict[str, Tensor]:
        z = points[torch.randint(len(points), (batch_size,))]
        x = z + schedule(torch.rand(batch_size, 1)) * torch.randn_like(z)
        s = normalized_score(score(x), gain)
        v, neighbours = _with_neighbours(network, x, PAPER_NEIGHBOURS, NEIGHBOUR_NOISE)
        terms: Terms = {
            "unit": lambda: unit_length_loss(s, v),
            "orthogonality": lambda: orthogonality_loss(s, v),
            "direction": lambda: directional_consistency_loss(v, neighbours),
        }
        return _weighted(terms, weights)

    return losses


def robust_tangent_loss(
    network: Function,
    score: Function,
    points: Tensor,
    hint: Tensor,
    sigma: float,
    batch_size: int,
    weights: Mapping[str, float],
) -> Losses:
    """Orthogonality, directional consistency and agreement with the orientation hint.

    Unit length of m needs no loss: the robust composition has it built in.  That of N has
    one, so that its direction is well defined.

    Args:
        network: The tangent network.
        score: The raw score at t = 1, (n, d) -> (n, d).
        points: The waypoints, (N, d).
        hint: The orientation hint at the waypoints, (N, d); zero rows are left out.
        sigma: The noise level of the score; neighbours are no farther.
        batch_size: Samples of a step.
        weights: Of each loss by its name; 0 removes it.
    """
    in_box = round(BOX_SHARE * batch_size)
    noise = min(NEIGHBOUR_NOISE, sigma)
    oriented = torch.nonzero(hint.square().sum(dim=1) > 0).squeeze(1)

    def losses() -> dict[str, Tensor]:
        chosen = oriented[torch.randint(len(oriented), (batch_size - in_box,))]
        near = points[chosen] + noise * torch.randn(len(chosen), points.shape[1])
        box = BOX_HALF_SIZE * (2 * torch.rand(in_box, points.shape[1]) - 1)
        x = torch.cat([near, box])
        v, neighbours = _with_neighbours(network, x, ROBUST_NEIGHBOURS, noise)
        terms: Terms = {
            "unit": lambda: unit_length_loss(torch.zeros_like(v), v),
            "orthogonality": lambda: orthogonality_loss(score(x), v),
            "direction": lambda: directional_consistency_loss(v, neighbours),
            "hint": lambda: orientation_loss(network(points[chosen]), hint[chosen]),
        }
        return _weighted(terms, weights)

    return losses


def _weighted(terms: Terms, weights: Mapping[str, float]) -> dict[str, Tensor]:
    """Returns the losses of a weight that is not zero, times it; no other is computed."""
    return {name: weights[name] * loss() for name, loss in terms.items() if weights[name] > 0}


def _with_neighbours(
    network: Function, x: Tensor, count: int, noise: float
) -> tuple[Tensor, Tensor]:
    """Returns the tangent at x, (n, d), and at `count` noisy copies, (count, n, d)."""
    copies = x + noise * torch.randn(count, *x.shape)
    v = network(torch.cat([x[None], copies]).flatten(0, 1))
    v = v.reshape(count + 1, *x.shape)
    return v[0], v[1:]


def unit_length_loss(s: Tensor, v: Tensor) -> Tensor:
    """L_unit = E (|s + v| - 1)^2, with s the normalised score; (n, d) each."""
    return ((s + v).norm(dim=1) - 1).square().mean()


def orthogonality_loss(s: Tensor, v: Tensor) -> Tensor:
    """L_orth = E cos^2 of the angle between score and tangent; (n, d) each."""
    return cosine_similarity(s, v, dim=1, eps=EPSILON).square().mean()


def directional_consistency_loss(v: Tensor, neighbours: Tensor) -> Tensor:
    """L_dir = E [1 - mean_k cos(v(x), v(x'_k))].

    Args:
        v: The tangent at x, (n, d).
        neighbours: The tangent at k neighbours of each x, (k, n, d).
    """
    cosines = cosine_similarity(v.expand_as(neighbours), neighbours, dim=2, eps=EPSILON)
    return 1 - cosines.mean()


def orientation_loss(v: Tensor, hint: Tensor) -> Tensor:
    """1 - E cos of the angle between tangent and orientation hint; (n, d) each."""
    return 1 - cosine_similarity(v, hint, dim=1, eps=EPSILON).mean()


def normalized_score(S: Tensor, gain: float) -> Tensor:
    """S = tanh(k_s |S|) S / |S|, (n, d) (paper, Section III-B)."""
    norm = S.norm(dim=1, keepdim=True).clamp_min(EPSILON)
    return torch.tanh(gain * norm) * S / norm
