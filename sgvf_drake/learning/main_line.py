"""One line through a piece: in order, with cut corners put back and strays left out.

The longest path of a piece's tree is nearly that line.  But the tree cuts an acute corner and
leaves its tip aside, runs to strays that lie near, zigzags between the sides of a narrow part
where waypoints are sparse, and joins sparse pieces that come near each other.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.fields import FloatArray
from sgvf_drake.learning.scales import SPARSE
from sgvf_drake.paths import TracedPiece
from sgvf_drake.paths.polyline import signed_area

# A piece of fewer waypoints is a stray one.
STRAY_PIECE = 5
# A waypoint farther than this from the main line of its piece (in steps of the line) is not
# beside it by noise: it is a corner that the tree has cut, a stray, or part of a branch.
ASIDE = 0.7
# It is a stray if visiting it is a detour of more than this many steps, and it stands alone:
# its nearest neighbour is this many times farther than that of nine waypoints in ten.  A
# longer detour makes strays of several waypoints too.
DETOUR = 1.5
ALONE = 1.3
LONGEST_DETOUR = 4.0
# A branch reaches farther from the line than this (in U); no one line runs through it.
BRANCH = 1.25
# Two loops have at least so many waypoints each, and save at least this share of a step.
SMALLEST_LOOP = 8
PARTING_GAIN = 0.5
# A tour is not shortened for less than this, and waypoints closer than this coincide.
ROUNDING = 1e-9
# The step of a line: nine of ten of its steps are no longer.
STEP_PERCENTILE = 90


@dataclass(frozen=True, eq=False)
class MainLine:
    """The main line of a piece: its longest path with cut corners put back.

    Attributes:
        points: (K, d) in order; a closed line does not repeat its first point.
        strays: Waypoints of the piece that are not near the line and not on the way.
        has_branches: Whether too many are left aside for one line to be the piece.
    """

    points: FloatArray
    strays: int
    has_branches: bool


def main_line(points: FloatArray, piece: TracedPiece, noise: float) -> MainLine:
    """Finds the main line of a piece.

    Args:
        points: The waypoints, (N, d), normalised units.
        piece: The piece.
        noise: Standard deviation of the waypoints across the path.
    """
    line, members = points[piece.order], points[piece.indices]
    if len(line) < STRAY_PIECE:
        return MainLine(line, 0, has_branches=False)
    step = float(np.percentile(steps_of(line), STEP_PERCENTILE))
    neighbour = cKDTree(np.unique(members, axis=0)).query(members, k=2)[0][:, 1]
    alone = neighbour > ALONE * np.percentile(neighbour, STEP_PERCENTILE)
    distance = cKDTree(line).query(members)[0]
    sparse = piece.closed and is_sparse(line)
    aside = np.flatnonzero(distance > (0 if sparse else max(ASIDE * step, 3 * noise)))
    if not sparse and distance[aside[~alone[aside]]].max(initial=0.0) > BRANCH:
        return MainLine(line, 0, has_branches=True)
    strays = 0
    # The nearest first: a corner of several waypoints is put back from its foot to its tip.
    for member in aside[np.argsort(distance[aside])]:
        if np.linalg.norm(line - members[member], axis=1).min() <= ROUNDING:
            continue  # one that coincides with it is there already
        detours = _detours(line, members[member], piece.closed)
        if detours.min() > (DETOUR if alone[member] else LONGEST_DETOUR) * step:
            strays += 1
        else:
            line = np.insert(line, int(detours.argmin()) + 1, members[member], axis=0)
    if piece.closed:
        line = untangled(line)
    lonely = cKDTree(members[alone]).query(line)[0] == 0 if alone.any() else False
    stray = lonely & (_detour_of_each(line, piece.closed) > DETOUR * step)
    return MainLine(line[~stray], strays + int(stray.sum()), has_branches=False)


def untangled(loop: FloatArray) -> FloatArray:
    """Returns a loop shortened by reversing parts of it (2-opt) until none helps.

    Through sparse waypoints the tree zigzags between the two sides of a narrow part, as it
    does where an acute tip has few on one side.  The shortest tour does not: it runs around
    any curve that is sampled well enough (Giesen 1999).  The direction of travel is kept.
    """
    count = len(loop)
    distance = np.linalg.norm(loop[:, None] - loop[None], axis=2)
    order = np.arange(count)
    improved = True
    while improved:
        improved = False
        for i in range(count - 1):
            # Edges (i, i + 1) and (j, j + 1) become (i, j) and (i + 1, j + 1).
            j = np.arange(i + 1, count)
            a, b, c, d = order[i], order[i + 1], order[j], order[(j + 1) % count]
            gain = distance[a, b] + distance[c, d] - distance[a, c] - distance[b, d]
            best = int(gain.argmax())
            if gain[best] > ROUNDING:
                order[i + 1 : j[best] + 1] = order[i + 1 : j[best] + 1][::-1].copy()
                improved = True
    tour = loop[order]
    turned = loop.shape[1] == 2 and signed_area(tour) * signed_area(loop) < 0
    return tour[::-1] if turned else tour


def parted(loop: FloatArray) -> list[FloatArray]:
    """Splits a sparse loop in two where two loops are clearly shorter, as two pieces are.

    The tree of two sparse pieces joins them where they come near; a tour of both then
    crosses twice, and closing each half by itself is shorter.
    """
    step = float(np.percentile(steps_of(loop), STEP_PERCENTILE))
    if not is_sparse(loop) or len(loop) < 2 * SMALLEST_LOOP:
        return [loop]
    after = np.roll(loop, -1, axis=0)
    across = np.linalg.norm(loop[:, None] - after[None], axis=2)
    edges = np.diag(across)
    gain = edges[:, None] + edges[None] - across - across.T
    i, j = np.indices(gain.shape)
    fits = (j - i >= SMALLEST_LOOP) & (j - i <= len(loop) - SMALLEST_LOOP)
    best = int(np.where(fits, gain, -np.inf).argmax())
    first, last = np.unravel_index(best, gain.shape)
    if gain[first, last] <= PARTING_GAIN * step:
        return [loop]
    inner = loop[first + 1 : last + 1]
    outer = np.concatenate([loop[: first + 1], loop[last + 1 :]])
    # Each closed piece of the plane runs counter-clockwise; see `TracedPiece`.
    parts = sorted([inner, outer], key=len, reverse=True)
    return [
        part[::-1] if loop.shape[1] == 2 and signed_area(part) < 0 else part for part in parts
    ]


def is_sparse(line: FloatArray) -> bool:
    """Whether the waypoints of a line are too far apart to tell noise from corners."""
    return float(steps_of(line).mean()) > SPARSE


def steps_of(line: FloatArray) -> FloatArray:
    """Returns the distances between neighbours of a line, (K, d) -> (K - 1,)."""
    return np.asarray(np.linalg.norm(np.diff(line, axis=0), axis=1))


def _detours(line: FloatArray, point: FloatArray, closed: bool) -> FloatArray:
    """Length added by visiting a point between each two neighbours of a line."""
    after = np.roll(line, -1, axis=0) if closed else line[1:]
    before = line if closed else line[:-1]
    return np.asarray(
        np.linalg.norm(before - point, axis=1)
        + np.linalg.norm(after - point, axis=1)
        - np.linalg.norm(after - before, axis=1)
    )


def _detour_of_each(line: FloatArray, closed: bool) -> FloatArray:
    """Length that each point of a line adds to it; zero at the ends of an open one."""
    before, after = np.roll(line, 1, axis=0), np.roll(line, -1, axis=0)
    detour = (
        np.linalg.norm(line - before, axis=1)
        + np.linalg.norm(line - after, axis=1)
        - np.linalg.norm(after - before, axis=1)
    )
    if not closed:
        detour[[0, -1]] = 0.0
    return np.asarray(detour)
