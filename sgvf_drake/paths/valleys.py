"""Whether a line runs between two strands, where a coarse scale has merged them.

Such a line is a ridge at its own scale and a valley of the density: the waypoints lie on both
sides of it and none in the middle.  Those of one path that scatter do lie in the middle too.
"""

import numpy as np
from scipy.ndimage import uniform_filter1d

from sgvf_drake.arrays import FloatArray
from sgvf_drake.paths.assembly import CONTRACTION, Graph
from sgvf_drake.paths.geometry import chains, rough_line
from sgvf_drake.paths.reference import Piece, ReferencePath

NEIGHBOURHOOD = 41
"""Waypoints whose distances from the line tell how far they are from it around a place."""

MIDDLE, MIDDLE_SHARE = 0.5, 0.29
"""Of points that are spread evenly across a line, this share lies nearer to it than half of
their RMS distance; of a Gaussian spread more do."""

CHANCE = 1e-2
"""That so many waypoints in turn are not in the middle by accident."""

FEWEST_CHANGES = 0.25
"""Share of waypoints whose next one is on the other side: half of them between two strands,
none where the line only cuts a bend."""

TOLD_APART = 2.0
"""Strands are farther apart than this many of their own spacings; nearer ones are scatter."""


def runs_in_valley(graph: Graph, points: FloatArray, sigma: float) -> bool:
    """Whether a line of a graph runs between two strands.

    Args:
        graph: What was found at a scale.
        points: The waypoints, (N, d).
        sigma: The scale.
    """
    path = ReferencePath(tuple(rough_line(graph, chain, sigma)[0] for chain in chains(graph)))
    foot = path.project(points)
    near = foot.distance < CONTRACTION * sigma
    for number, line in enumerate(path.pieces):
        own = np.flatnonzero(near & (foot.piece == number))
        own = own[np.argsort(foot.arc[own], kind="stable")]
        if len(own) and _has_empty_middle(line, foot.arc[own], points[own]):
            return True
    return False


def _has_empty_middle(line: Piece, arc: FloatArray, points: FloatArray) -> bool:
    """Whether waypoints (n, d), in the order of their arc lengths, leave a stretch empty."""
    offset = points - line.at(arc)
    mode = "wrap" if line.closed else "nearest"
    squares = (offset**2).sum(axis=1)
    around = uniform_filter1d(squares, min(NEIGHBOURHOOD, len(arc)), mode=mode)
    middle = squares < MIDDLE**2 * around
    borders = np.flatnonzero(np.concatenate([[True], middle, [True]]))
    longest = np.log(CHANCE / (MIDDLE_SHARE * len(arc))) / np.log(1 - MIDDLE_SHARE)
    for first, last in zip(borders[:-1], borders[1:] - 1, strict=True):
        if last - first <= longest:
            continue
        run = offset[first:last]
        changes = ((run[1:] * run[:-1]).sum(axis=1) < 0).mean()
        # Each of the strands has half of the waypoints.
        spacing = 2 * (arc[last - 1] - arc[first]) / (last - first - 1)
        apart = 2 * np.sqrt(squares[first:last].mean())
        if changes > FEWEST_CHANGES and apart > TOLD_APART * spacing:
            return True
    return False
