"""What the cloud says about its own scales: spacing, noise, and the noise level to learn at."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.fields import FloatArray
from sgvf_drake.paths import TracedPiece

# The level to learn at where nothing asks for another, and the coarsest that still leaves a
# path in a cloud of half-extent 4.
SIGMA_DEFAULT = 0.1
SIGMA_CEILING = 1.0
# Below half the spacing the mixture falls apart into single waypoints, where robots stop.
SIGMA_PER_SPACING = 0.65
SIGMA_PER_NOISE = 3.0
# From two noise levels apart, the ridges of neighbouring strands are two; from four, a robot
# on one does not feel the other.
SIGMA_PER_GAP = 0.25
# Strands are neighbours, and not the two sides of a corner, if the way from one to the other
# along the path is longer than this in U, and this many times longer than across.
STRAND_SEPARATION = 1.0
STRAND_RATIO = 5.0
# Only gaps that would ask for less than the default matter.
WIDEST_GAP = SIGMA_DEFAULT / SIGMA_PER_GAP
# Waypoints that are enough to find the gaps; of more, an even selection is taken.
GAP_WAYPOINTS = 4_000
# Neighbours in the local fit that estimates the noise.
FIT_NEIGHBOURS = 8


@dataclass(frozen=True)
class CloudScales:
    """Scales of a normalised cloud (half-extent 4).

    Attributes:
        spacing: Mean distance between neighbouring waypoints along the path.
        noise: Estimated standard deviation of the waypoints across the path.
        gap: Smallest distance between neighbouring strands; `WIDEST_GAP` where it is more.
    """

    spacing: float
    noise: float
    gap: float

    @property
    def sigma_min(self) -> float:
        """The noise level to learn at: below the gaps, above spacing and noise."""
        fine = min(SIGMA_DEFAULT, SIGMA_PER_GAP * self.gap)
        coarse = max(SIGMA_PER_SPACING * self.spacing, SIGMA_PER_NOISE * self.noise)
        return min(max(fine, coarse), SIGMA_CEILING)


def cloud_scales(points: FloatArray, pieces: Sequence[TracedPiece]) -> CloudScales:
    """Measures the scales of a normalised cloud, (N, d)."""
    length = sum(piece.length for piece in pieces)
    return CloudScales(length / len(points), _noise(points), _gap(points, pieces))


def _gap(points: FloatArray, pieces: Sequence[TracedPiece]) -> float:
    step = max(1, len(points) // GAP_WAYPOINTS)
    chains = [piece.order[::step] for piece in pieces]
    chain = np.concatenate(chains)
    number = np.repeat(np.arange(len(pieces)), [len(c) for c in chains])
    arc = np.zeros(len(points))
    for piece in pieces:
        arc[piece.indices] = piece.arc
    length = np.array([piece.length if piece.closed else np.inf for piece in pieces])
    first, second = cKDTree(points[chain]).query_pairs(WIDEST_GAP, output_type="ndarray").T
    across = np.linalg.norm(points[chain[first]] - points[chain[second]], axis=1)
    along = np.abs(arc[chain[first]] - arc[chain[second]])
    along = np.minimum(along, length[number[first]] - along)
    along[number[first] != number[second]] = np.inf
    strands = along > np.maximum(STRAND_SEPARATION, STRAND_RATIO * across)
    return float(across[strands].min(initial=WIDEST_GAP))


def _noise(points: FloatArray) -> float:
    """Median residual of a parabola through the neighbours of each waypoint.

    A parabola, so that the bend of the path does not count as noise; the median, so that
    corners do not.
    """
    count = min(FIT_NEIGHBOURS, len(points))
    if count <= 4:
        return 0.0
    _, neighbours = cKDTree(points).query(points, k=count)
    local = points[neighbours] - points[neighbours].mean(axis=1, keepdims=True)
    _, _, axes = np.linalg.svd(local, full_matrices=False)
    along = np.einsum("nki,ni->nk", local, axes[:, 0])
    across = np.einsum("nki,ni->nk", local, axes[:, 1])
    scale = np.abs(along).max(axis=1, keepdims=True)
    u = np.divide(along, scale, out=np.zeros_like(along), where=scale > 0)
    design = np.stack([np.ones_like(u), u, u**2], axis=2)
    coefficients = np.linalg.pinv(design) @ across[:, :, None]
    fit = (design @ coefficients)[:, :, 0]
    residuals = ((across - fit) ** 2).sum(axis=1) / (count - 3)
    return float(np.sqrt(np.median(residuals)))
