"""Whether waypoints on both sides of a line scatter, or lie in rows along it.

A scale that is wider than the distance of two strands merges them, and those of a whole
coverage, into one line.  Scatter about a line has no direction: of the waypoints next to
another, a third lies within 30 degrees of the line.  On strands the next waypoint lies along
the line, as long as the strands are not much nearer to each other than their waypoints.

All lengths are in units of the cloud (U).
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import FloatArray
from sgvf_drake.paths.reference import Piece, Projection

WIDE = 0.9
"""Scatter in mean steps along a line from which on rows are told: that of two strands .9 of
their spacing apart."""

NEXT, WITHIN = 2, 0.5
"""The nearest waypoints whose directions are looked at: on a strand, both neighbours; then all
within this share of the scatter, which has no direction there, but rows have that are farther
apart than they scatter."""

MOST_LOOKED_AT, MOST_NEIGHBOURS = 1_000, 500
"""Waypoints and neighbours of each that are looked at, to bound time and memory."""

ALONG = np.cos(np.radians(30.0))
"""Cosine of the angle to the line within which a third of all directions in the plane lie."""

SHARE_ALONG = 0.48
"""Of waypoints that scatter, fewer neighbours lie along the line: up to .44 of 200 waypoints on
strips of several widths; of strands one spacing apart, .5 and more."""

SMALL = 1e-3
"""Relative: half of the step along a line that tells its direction, and what distances may
differ by that are the same."""


def lie_in_rows(
    lines: Sequence[Piece], points: FloatArray, foot: Projection, near: float
) -> bool:
    """Whether waypoints about lines lie in rows along them.

    Args:
        lines: What was found.
        points: The waypoints, (N, d).
        foot: The nearest points of the lines to them.
        near: Those farther from every line are strays.
    """
    own = foot.distance < near
    step = sum(line.length for line in lines) / len(points)
    scatter = np.sqrt((foot.distance[own] ** 2).mean()) if own.any() else 0.0
    if scatter < WIDE * step:
        return False
    tangent = np.empty_like(points)
    for number, line in enumerate(lines):
        on = foot.piece == number
        ends = [
            line.at(np.clip(foot.arc[on] + half, 0, line.length))
            for half in (-SMALL * line.length, SMALL * line.length)
        ]
        tangent[on] = ends[1] - ends[0]
    distinct, first = np.unique(points, axis=0, return_index=True)
    first = first[own[first]]
    first = first[:: 1 + len(first) // MOST_LOOKED_AT]
    distance, nearest = cKDTree(distinct).query(
        points[first], k=min(1 + MOST_NEIGHBOURS, len(distinct))
    )
    away = distinct[nearest[:, 1:]] - points[first, None]
    along = np.abs((away * tangent[first, None]).sum(axis=2))
    size = np.linalg.norm(away, axis=2) * np.linalg.norm(tangent[first], axis=1)[:, None]
    # On a lattice, several are as near as the second one.
    second = (1 + SMALL) * distance[:, [min(NEXT, distance.shape[1] - 1)]]
    for reach in (second, np.maximum(second, WITHIN * scatter)):
        counted = distance[:, 1:] <= reach
        share = ((along > ALONG * size) & counted).sum(axis=1) / counted.sum(axis=1)
        if share.mean() > SHARE_ALONG:
            return True
    return False
