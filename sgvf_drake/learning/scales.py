"""What the cloud says about its own scales: spacing, noise, and the noise level to learn at."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree
from scipy.stats import chi2

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
# Waypoints in a run whose scatter about a parabola is noise: few, so that sparse waypoints
# on a bend still count as one.
RUN = 5
# Waypoints farther apart than this (in U) cannot tell noise from corners: runs of them hold
# little else.  Their noise is taken to be at most this share of the spacing.
SPARSE = 0.3
NOISE_PER_SPACING = 0.15


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
    def fine_sigma(self) -> float:
        """The noise level that the path asks for: below its gaps."""
        return min(SIGMA_DEFAULT, SIGMA_PER_GAP * self.gap)

    @property
    def coarse_sigma(self) -> float:
        """The noise level that the waypoints ask for: above their spacing and noise."""
        wanted = max(SIGMA_PER_SPACING * self.spacing, SIGMA_PER_NOISE * self.noise)
        return min(wanted, SIGMA_CEILING)


def cloud_scales(points: FloatArray, pieces: Sequence[TracedPiece]) -> CloudScales:
    """Measures the scales of a normalised cloud, (N, d)."""
    length = sum(piece.length for piece in pieces)
    # Copies of a waypoint are no nearer to the next one.
    spacing = length / len(np.unique(points, axis=0))
    noise = _noise(points, pieces)
    if spacing > SPARSE:
        noise = min(noise, NOISE_PER_SPACING * spacing)
    return CloudScales(spacing, noise, _gap(points, pieces))


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


def _noise(points: FloatArray, pieces: Sequence[TracedPiece]) -> float:
    """Median residual of parabolas through runs of waypoints along their piece.

    Parabolas, so that the bend of the path does not count as noise; along the piece, so that
    other strands do not; the median, so that corners do not.
    """
    residuals = [_residuals(points[piece.order], piece.closed) for piece in pieces]
    squares = np.concatenate(residuals)
    # A residual has as many degrees of freedom as the run has spare waypoints, across.
    freedom = (RUN - 3) * (points.shape[1] - 1)
    return float(np.sqrt(np.median(squares) / chi2.median(freedom))) if len(squares) else 0.0


def _residuals(chain: FloatArray, closed: bool) -> FloatArray:
    """Sums of squared residuals across the path, one for each run of `RUN` waypoints."""
    if len(chain) < RUN:
        return np.empty(0)
    if closed:
        chain = np.concatenate([chain, chain[: RUN - 1]])
    runs = np.swapaxes(sliding_window_view(chain, RUN, axis=0), 1, 2)
    local = runs - runs.mean(axis=1, keepdims=True)
    _, _, axes = np.linalg.svd(local, full_matrices=False)
    rotated = local @ np.swapaxes(axes, 1, 2)
    along, across = rotated[:, :, :1], rotated[:, :, 1:]
    scale = np.abs(along).max(axis=1, keepdims=True)
    u = np.divide(along, scale, out=np.zeros_like(along), where=scale > 0)
    design = np.concatenate([np.ones_like(u), u, u**2], axis=2)
    fit = design @ (np.linalg.pinv(design) @ across)
    return np.asarray(((across - fit) ** 2).sum(axis=(1, 2)))
