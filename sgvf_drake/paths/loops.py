"""The number of loops of a planar cloud, by the persistence of its alpha complex.

Discs that grow around the waypoints leave holes, which appear and are filled: by duality with
the triangles of the Delaunay triangulation, which merge as the discs shrink (Edelsbrunner and
Harer, Computational Topology, 2010, ch. V and VII).  Holes that last long are loops of the
path.  This is a second opinion on the topology that shares nothing with the ridge.
"""

from dataclasses import dataclass

import networkx as nx
import numpy as np
from scipy.spatial import Delaunay

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray

LEAST_RATIO, OF_POINTS, GROWTH = 1.7, 200, 0.2
"""A hole that is a loop of the path lasts until the discs are this many times larger.

Noise leaves holes that last longer the more points there are: with 100 to 1,000 points on 18
networks, the longest of them 1.55 for 200 points and 2.4 for 1,000, and those of loops 1.8 and
4.6 at least, if the points lie at random; as the number of points to the power of a fifth.
"""


@dataclass(frozen=True, eq=False)
class Holes:
    """The holes between growing discs around planar points.

    Attributes:
        birth: (H,) radius of the discs when each hole is closed off.
        death: (H,) radius when it is filled: that of the largest circle inside.
        count: The number of points.
    """

    birth: FloatArray
    death: FloatArray
    count: int

    def loops(self, sigma: float, reach: float) -> int:
        """The number of loops of the path that can be seen at a scale.

        They are wider than the scale, and closed by then: discs of radius sigma meet across
        what its kernel cannot tell apart.  So the throat of a bay closes a loop at a coarse
        scale, and none at a fine one.

        Args:
            sigma: The scale.
            reach: The widest gap in a path that is closed at this scale.
        """
        return int(np.sum(self._closed(sigma, reach) & (self.death >= sigma)))

    def has_between(self, scatter: float, sigma: float, reach: float) -> bool:
        """Whether loops are too narrow to be seen at a scale, but wider than scatter leaves."""
        hidden = (self.death > scatter) & (self.death < sigma)
        return bool(np.any(self._closed(sigma, reach) & hidden))

    def _closed(self, sigma: float, reach: float) -> BoolArray:
        """Which holes are loops that are closed at a scale, (H,)."""
        lasting = LEAST_RATIO * max(1.0, self.count / OF_POINTS) ** GROWTH
        closed = self.birth <= max(sigma, reach / 2)
        return np.asarray(closed & (self.death >= lasting * self.birth))


def find_holes(points: FloatArray) -> Holes:
    """Finds the holes of planar points (N, 2), distinct and not all on a line.

    Raises:
        scipy.spatial.QhullError: If the points lie on a line.
    """
    triangles = Delaunay(points)
    radius = np.append(_circumradius(points[triangles.simplices]), np.inf)
    covered, first, second = _shared_edges(points, triangles, radius)
    death = dict(enumerate(radius.tolist()))
    merged = nx.utils.UnionFind(range(len(radius)))
    births, deaths = [], []
    # As the discs shrink, triangles are uncovered, and merge over the edges that are.
    for k in np.argsort(-covered, kind="stable"):
        a, b = merged[int(first[k])], merged[int(second[k])]
        if a == b:
            continue
        longer, shorter = (a, b) if death[a] >= death[b] else (b, a)
        births.append(covered[k])
        deaths.append(death[shorter])
        lasts = death[longer]
        merged.union(longer, shorter)
        death[merged[longer]] = lasts
    return Holes(np.array(births), np.array(deaths), len(points))


def _circumradius(corners: FloatArray) -> FloatArray:
    """The radius of the circle through the corners of each triangle, (T, 3, 2) -> (T,)."""
    a, b, c = (
        np.linalg.norm(corners[:, i] - corners[:, j], axis=1)
        for i, j in ((1, 2), (0, 2), (0, 1))
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
        middle, half = (
            (points[i] + points[j]) / 2,
            np.linalg.norm(points[i] - points[j], axis=1) / 2,
        )
        empty = np.ones(outside, bool)
        for opposite in (simplices[:, corner], beyond):
            empty &= np.linalg.norm(points[opposite] - middle, axis=1) >= half - 1e-12
        birth = np.where(empty, half, np.minimum(radius[own], radius[other]))
        once = own < other
        births.append(birth[once])
        firsts.append(own[once])
        seconds.append(other[once])
    return np.concatenate(births), np.concatenate(firsts), np.concatenate(seconds)
