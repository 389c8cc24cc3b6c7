"""The losses of the tangent field (paper, Section III-B, Algorithm 2) and the hint."""

import torch
from torch import Tensor
from torch.nn.functional import cosine_similarity

# Below this norm a vector has no direction to speak of; keeps the cosines differentiable.
EPSILON = 1e-8


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
