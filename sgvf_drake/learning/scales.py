"""What the cloud says about its own scales: spacing, noise, and the noise level to learn at."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.fields import FloatArray
from sgvf_drake.paths import TracedPiece

# The finest level that the default network resolves, and the coarsest that still leaves a
# path in a cloud of half-extent 4.
SIGMA_FLOOR = 0.1
SIGMA_CEILING = 1.0
# Below half the spacing the mixture falls apart into single waypoints, where robots stop.
SIGMA_PER_SPACING = 0.65
SIGMA_PER_NOISE = 3.0
# Neighbours in the local fit that estimates the noise.
FIT_NEIGHBOURS = 8


@dataclass(frozen=True)
class CloudScales:
    """Scales of a normalised cloud (half-extent 4).

    Attributes:
        spacing: Mean distance between neighbouring waypoints along the path.
        noise: Estimated standard deviation of the waypoints across the path.
    """

    spacing: float
    noise: float

    @property
    def sigma_min(self) -> float:
        """The noise level to learn at: above spacing and noise, within the network's reach."""
        wanted = max(
            SIGMA_FLOOR, SIGMA_PER_SPACING * self.spacing, SIGMA_PER_NOISE * self.noise
        )
        return min(wanted, SIGMA_CEILING)


def cloud_scales(points: FloatArray, pieces: Sequence[TracedPiece]) -> CloudScales:
    """Measures the scales of a normalised cloud, (N, d)."""
    length = sum(piece.length for piece in pieces)
    return CloudScales(length / len(points), _noise(points))


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
