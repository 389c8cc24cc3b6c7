"""The number of loops of a planar cloud, by the persistence of its alpha complex.

Discs that grow around the waypoints leave holes, which appear and are filled: by duality with
the triangles of the Delaunay triangulation, which merge as the discs shrink (Edelsbrunner and
Harer, Computational Topology, 2010, ch. V and VII).  Holes that last long are loops of the
path.  This is a second opinion on the topology that shares nothing with the ridge.
"""

import networkx as nx
import numpy as np
from scipy.spatial import Delaunay

from sgvf_drake.arrays import FloatArray, IntArray

LEAST_RATIO = 2.5
"""A hole that is a loop of the path lasts until the discs are this many times larger."""

MOST_LOOPS = 30


def hole_persistence(points: FloatArray) -> FloatArray:
    """Returns death over birth of the holes between growing discs, the largest first.

    Args:
        points: (N, 2), distinct, not all on a line.

    Raises:
        scipy.spatial.QhullError: If the points lie on a line.
    """
    triangles = Delaunay(points)
    corners = points[triangles.simplices]
    radius = np.append(_circumradius(corners), np.inf)
    outside = len(corners)
    birth, first, second = _shared_edges(points, triangles, radius)
    death = dict(enumerate(radius))
    merged = nx.utils.UnionFind(range(outside + 1))
    ratios = []
    for k in np.argsort(-birth, kind="stable"):
        a, b = merged[int(first[k])], merged[int(second[k])]
        if a == b:
            continue
        longer, shorter = (a, b) if death[a] >= death[b] else (b, a)
        ratios.append(death[shorter] / max(birth[k], 1e-12))
        merged.union(longer, shorter)
        death[merged[longer]] = death[longer]
    return np.sort(ratios)[::-1]


def count_loops(points: FloatArray) -> int:
    """Returns the number of loops of a planar cloud (N, 2): those above the widest gap."""
    ratios = np.log(np.maximum(hole_persistence(points)[:MOST_LOOPS], 1.0))
    ratios = np.append(ratios, 0.0)
    if ratios[0] < np.log(LEAST_RATIO):
        return 0
    return int(np.argmax(-np.diff(ratios))) + 1


def _circumradius(corners: FloatArray) -> FloatArray:
    """The radius of the circle through the corners of each triangle, (T, 3, 2) -> (T,)."""
    a, b, c = (
        np.linalg.norm(corners[:, i] - corners[:, j], axis=1) for i, j in ((1, 2), (0, 2), (0, 1))
    )
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = np.abs(u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]) / 2
    return np.asarray(a * b * c / np.maximum(4 * area, 1e-12))


def _shared_edges(
    points: FloatArray, triangles: Delaunay, radius: FloatArray
) -> tuple[FloatArray, IntArray, IntArray]:
    """Returns the radius at which discs cover each edge, and the triangles on its two sides.

    The outside of the hull counts as one more triangle, of infinite radius.
    """
    simplices = triangles.simplices
    outside = len(simplices)
    own = np.arange(outside)
    births, firsts, seconds = [], [], []
    for corner in range(3):
        i, j = simplices[:, corner - 2], simplices[:, corner - 1]
        other = triangles.neighbors[:, corner]
        other = np.where(other < 0, outside, other)
        # The corner of the other triangle that is not on the edge; at the hull, the own one.
        beyond = np.append(simplices, [[0, 0, 0]], axis=0)[other].sum(axis=1) - i - j
        beyond = np.where(other == outside, simplices[:, corner], beyond)
        middle, half = (points[i] + points[j]) / 2, np.linalg.norm(points[i] - points[j], axis=1) / 2
        empty = np.ones(outside, bool)
        for opposite in (simplices[:, corner], beyond):
            empty &= np.linalg.norm(points[opposite] - middle, axis=1) >= half - 1e-12
        birth = np.where(empty, half, np.minimum(radius[own], radius[other]))
        once = own < other
        births.append(birth[once])
        firsts.append(own[once])
        seconds.append(other[once])
    return np.concatenate(births), np.concatenate(firsts), np.concatenate(seconds)
