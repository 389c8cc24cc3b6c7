"""Learning the tangent field on top of a fixed score (paper, Algorithm 2)."""

from collections.abc import Callable

import torch
from torch import Tensor

from sgvf_drake.learning.networks import Network
from sgvf_drake.learning.schedule import NoiseSchedule
from sgvf_drake.learning.score_matching import BOX_HALF_SIZE, Losses
from sgvf_drake.learning.tangent_losses import (
    directional_consistency_loss,
    normalized_score,
    orientation_loss,
    orthogonality_loss,
    unit_length_loss,
)

# Standard deviation of the noise that makes a neighbour of x, normalised units.
NEIGHBOUR_NOISE = 0.1
PAPER_NEIGHBOURS = 5
ROBUST_NEIGHBOURS = 2
# Share of a robust batch that is uniform in the box, and its weight of the hint.
BOX_SHARE = 0.4
HINT_WEIGHT = 3.0
# Keeps |N| well above the softening of its direction; small, since near the zeros that the
# topology demands (Poincare-Hopf) it has to give way.
UNIT_WEIGHT = 0.3

Score = Callable[[Tensor], Tensor]


def paper_tangent_loss(
    network: Network,
    score: Score,
    points: Tensor,
    schedule: NoiseSchedule,
    gain: float,
    batch_size: int,
) -> Losses:
    """Algorithm 2 to the letter: unit length, orthogonality, directional consistency.

    x is drawn from the conditional path of Algorithm 1, all weights lambda are one.
    """

    def losses() -> dict[str, Tensor]:
        z = points[torch.randint(len(points), (batch_size,))]
        x = z + schedule(torch.rand(batch_size, 1)) * torch.randn_like(z)
        s = normalized_score(score(x), gain)
        v, neighbours = _with_neighbours(network, x, PAPER_NEIGHBOURS, NEIGHBOUR_NOISE)
        return {
            "unit": unit_length_loss(s, v),
            "orthogonality": orthogonality_loss(s, v),
            "direction": directional_consistency_loss(v, neighbours),
        }

    return losses


def robust_tangent_loss(
    network: Network,
    score: Score,
    points: Tensor,
    hint: Tensor,
    sigma: float,
    batch_size: int,
) -> Losses:
    """Orthogonality, directional consistency and agreement with the orientation hint.

    Unit length needs no loss: the robust composition has it built in.

    Args:
        network: The tangent network.
        score: The raw score at t = 1, (n, d) -> (n, d).
        points: The waypoints, (N, d).
        hint: The orientation hint at the waypoints, (N, d); zero rows are left out.
        sigma: The noise level of the score; neighbours are no farther.
        batch_size: Samples of a step.
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
        return {
            "unit": UNIT_WEIGHT * unit_length_loss(torch.zeros_like(v), v),
            "orthogonality": orthogonality_loss(score(x), v),
            "direction": directional_consistency_loss(v, neighbours),
            "hint": HINT_WEIGHT * orientation_loss(network(points[chosen]), hint[chosen]),
        }

    return losses


def _with_neighbours(
    network: Network, x: Tensor, count: int, noise: float
) -> tuple[Tensor, Tensor]:
    """Returns the tangent at x, (n, d), and at `count` noisy copies, (count, n, d)."""
    copies = x + noise * torch.randn(count, *x.shape)
    v = network(torch.cat([x[None], copies]).flatten(0, 1))
    v = v.unflatten(0, (count + 1, len(x)))
    return v[0], v[1:]
