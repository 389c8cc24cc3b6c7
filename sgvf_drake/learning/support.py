"""The points that are learned from: the waypoints, cleaned where they need it.

Most clouds are learned as they are.  Where waypoints are too many, stray, sparse, noisy or
uneven for the noise level that the path asks for, they are thinned, left out, or replaced
by points evenly spaced on a smoothing spline through their piece, so that a robot finds the
same density everywhere.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import warnings

import numpy as np
from scipy.interpolate import make_splprep
from scipy.spatial import cKDTree

from sgvf_drake.fields import FloatArray
from sgvf_drake.learning.main_line import STRAY_PIECE, is_sparse, main_line, parted, steps_of
from sgvf_drake.learning.scales import CloudScales, cloud_scales
from sgvf_drake.paths import TracedPiece, trace_pieces, with_ends

# More waypoints than this are thinned to one a cell; a cell with less than this share of the
# median count holds strays.
MAX_POINTS = 2_000
STRAY_SHARE = 0.1
FIRST_CELL = 0.01
# A waypoint is stray if its nearest neighbour is this many times farther than that of nine
# waypoints in ten, and this many times farther than that of its own neighbours (their
# median): in a sparse stretch of a path they are far from each other too.
STRAY_DISTANCE = 3.0
STRAY_RATIO = 2.0
# Learned as it is: a cloud whose own noise level is at most this many times the one that its
# path asks for, and whose gaps along the path are at most this many of it.
CLEAN_LEVEL = 1.25
CLEAN_GAP = 2.5
# Points on the spline, in noise levels.
SPLINE_SPACING = 0.5


@dataclass(frozen=True, eq=False)
class Support:
    """What is learned from, in normalised units.

    Attributes:
        points: (M, d).
        pieces: Their spanning tree, in the direction of travel.
        sigma: The noise level to learn at.
        scales: Of the waypoints that were kept.
        dropped: Number of waypoints that were left out as strays.
        resampled: Whether the points are those of a spline instead of waypoints.
    """

    points: FloatArray
    pieces: tuple[TracedPiece, ...]
    sigma: float
    scales: CloudScales
    dropped: int
    resampled: bool


def find_support(
    waypoints: FloatArray, sigma: float | None = None, closed: bool | None = None
) -> Support:
    """Cleans a normalised cloud where it needs it.

    Args:
        waypoints: (N, d).
        sigma: The noise level, if it is given; None: it follows from the cloud.
        closed: Whether all pieces are closed, or all open; None: what their tree says.
    """
    thinned = _thin(waypoints)
    points = _without_strays(thinned)
    pieces = trace_pieces(points)
    if closed is not None:
        pieces = tuple(with_ends(piece, points, closed) for piece in pieces)
    scales = cloud_scales(points, pieces)
    fine = sigma or scales.fine_sigma
    lines = [main_line(points, piece, scales.noise) for piece in pieces]
    strays = len(thinned) - len(points) + sum(line.strays for line in lines)
    if any(line.has_branches for line in lines) or (
        strays == 0
        # Where a path ends, its density has to fall as that of an even one does.
        and all(piece.closed for piece in pieces)
        and _is_clean([line.points for line in lines], scales, fine)
    ):
        level = sigma or max(fine, scales.coarse_sigma)
        return Support(points, pieces, level, scales, strays, resampled=False)
    parts = [
        (part, piece.closed)
        for line, piece in zip(lines, pieces, strict=True)
        for part in (parted(line.points) if piece.closed else [line.points])
    ]
    chains = [_spline(part, closed, scales.noise, fine) for part, closed in parts]
    traced = _chained(chains, [closed for _, closed in parts])
    return Support(np.concatenate(chains), traced, fine, scales, strays, resampled=True)


def _thin(points: FloatArray) -> FloatArray:
    """Returns the mean waypoint of each cell of the finest grid that is coarse enough."""
    if len(points) <= MAX_POINTS:
        return points
    cell = FIRST_CELL
    while True:
        cells, member, counts = np.unique(
            np.floor(points / cell), axis=0, return_inverse=True, return_counts=True
        )
        if len(cells) <= MAX_POINTS:
            break
        cell *= np.sqrt(2)
    means = np.zeros_like(cells)
    np.add.at(means, member.reshape(-1), points)
    means /= counts[:, None]
    return means[counts >= STRAY_SHARE * np.median(counts)]


def _without_strays(points: FloatArray) -> FloatArray:
    distinct, of_point = np.unique(points, axis=0, return_inverse=True)
    if len(distinct) <= STRAY_PIECE:
        return points
    distances, neighbours = cKDTree(distinct).query(distinct, k=STRAY_PIECE)
    nearest = distances[:, 1]
    typical = np.percentile(nearest[of_point.reshape(-1)], 90)
    around = np.median(nearest[neighbours[:, 1:]], axis=1)
    stray = (nearest > STRAY_DISTANCE * typical) & (nearest > STRAY_RATIO * around)
    kept = points[~stray[of_point.reshape(-1)]]
    pieces = [piece for piece in trace_pieces(kept) if len(piece.indices) >= STRAY_PIECE]
    if not pieces:
        return points
    return kept[np.sort(np.concatenate([piece.indices for piece in pieces]))]


def _is_clean(lines: Sequence[FloatArray], scales: CloudScales, fine: float) -> bool:
    widest = max(float(steps_of(line).max(initial=0.0)) for line in lines)
    return scales.coarse_sigma <= CLEAN_LEVEL * fine and widest <= CLEAN_GAP * fine


def _spline(line: FloatArray, closed: bool, noise: float, sigma: float) -> FloatArray:
    """Returns points evenly spaced on a smoothing spline through a line, (K, d)."""
    if closed:
        line = np.concatenate([line, line[:1]])
    # Sparse waypoints say nothing between them: a line through them keeps their corners.
    sparse = is_sparse(line)
    degree = 1 if sparse else min(3, len(line) - 1)
    # What noise across the path leaves as the sum of squared residuals.
    budget = 0.0 if sparse else len(line) * (line.shape[1] - 1) * noise**2
    bc = "periodic" if closed else None
    with warnings.catch_warnings():
        # Where the budget is not met to the last digit, what it returns is good enough.
        warnings.simplefilter("ignore", RuntimeWarning)
        spline, _ = make_splprep(line.T, k=degree, s=budget, bc_type=bc)
    fine = spline(np.linspace(0, 1, 20 * len(line))).T
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(fine, axis=0), axis=1))])
    count = max(STRAY_PIECE, round(arc[-1] / (SPLINE_SPACING * sigma)))
    at = np.linspace(0, arc[-1], count, endpoint=not closed)
    return np.column_stack([np.interp(at, arc, column) for column in fine.T])


def _chained(chains: Sequence[FloatArray], closed: Sequence[bool]) -> tuple[TracedPiece, ...]:
    """Returns the pieces of points that are already in order."""
    traced = []
    start = 0
    for chain, loop in zip(chains, closed, strict=True):
        indices = np.arange(start, start + len(chain))
        arc = np.concatenate([[0], np.cumsum(steps_of(chain))])
        closing = float(np.linalg.norm(chain[0] - chain[-1])) if loop else 0.0
        edges = np.column_stack([indices[:-1], indices[1:]])
        traced.append(TracedPiece(indices, arc, indices, edges, loop, float(arc[-1]) + closing))
        start += len(chain)
    return tuple(traced)
