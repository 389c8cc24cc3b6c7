"""The ridge as a graph: points joined along the path, its short leaves cut, its gaps bridged.

All lengths are in units of the cloud (U); the scale `sigma` is the one of the ridge.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
import heapq
import itertools
import math

import networkx as nx
import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial import cKDTree

from sgvf_drake.arrays import FloatArray
from sgvf_drake.paths.polyline import aim, arc_lengths

LINK = 1.1
"""Ridge points up to this many sigma apart are neighbours: three times their distance."""

SHORTEST_LOOP = 9.0
"""Loops shorter than this many sigma are not seen at this scale: a circle of diameter
3 sigma, whose two sides merge."""

LEAF = 2.5
"""Leaves shorter than this many sigma are spurs of noise."""

ACUTE = 100.0
"""A leaf between two arms that meet at less than this angle, in degrees, may be their tip."""

TIP_ALIGNMENT = 0.7
"""A tip points away from its arms to within 45 degrees."""

LEAST_LENGTH, FEWEST_WAYPOINTS = 5.0, 5
"""A piece has at least this length in sigma and this many waypoints; less are strays."""


WALK_OFFSET = 100.0
"""Arc length left between two walks when they are laid out one after the other, in U."""

LONGEST_TREE_EDGE = 1.5
"""Longer edges of the tree of ridge points lead from piece to piece, in U."""

STRAIGHT, BENT = 0.75, 0.3
"""Cosine between a tip's direction and its bridge: within 41 degrees first, then within 73."""

SIDEWAYS = 0.8
"""The same where a tip is joined to the side of a strand."""

WIDEST_TIP_GAP, WIDEST_SIDE_GAP = 1.8, 0.8
"""Gaps wider than this, in U, are gaps of the path, however few its waypoints are."""

BRIDGING_ROUNDS = 6
"""Rounds of bridges at most: one may be what another starts from."""


class Skeleton:
    """Points and the links between them.

    Attributes:
        points: (n, d); those without an entry in `links` are no longer part of it.
        links: For each point its neighbours, and the distance to each.
        reach: The widest gap between two tips that was bridged, had there been one.
    """

    reach: float = 0.0

    def __init__(self, points: FloatArray) -> None:
        self.points = points
        self.links: dict[int, dict[int, float]] = {i: {} for i in range(len(points))}

    def join(self, i: int, j: int) -> None:
        """Links two points."""
        length = float(np.linalg.norm(self.points[i] - self.points[j]))
        self.links[i][j] = self.links[j][i] = length

    def drop(self, i: int) -> None:
        """Takes a point out."""
        for j in self.links.pop(i):
            del self.links[j][i]

    def degree(self, i: int) -> int:
        """The number of neighbours of a point."""
        return len(self.links[i])

    def tips(self) -> list[int]:
        """The points with one neighbour."""
        return [i for i, links in self.links.items() if len(links) == 1]

    def walk(self, first: int, second: int, reach: float = math.inf) -> list[int]:
        """Goes from one point through its neighbour up to a branch, a tip, or back.

        Ends early where the walk is longer than `reach`.
        """
        path = [first, second]
        length = self.links[first][second]
        while len(self.links[path[-1]]) == 2 and path[-1] != first and length <= reach:
            a, b = self.links[path[-1]]
            onward = b if a == path[-2] else a
            length += self.links[path[-1]][onward]
            path.append(onward)
        return path

    def length(self, path: Iterable[int]) -> float:
        """The length of a walk."""
        return sum(self.links[a][b] for a, b in itertools.pairwise(path))

    def direction(self, path: list[int], near: float, far: float) -> FloatArray:
        """The unit vector between two arc lengths of a walk, (d,)."""
        _, step = aim(self.points[path], near, far)
        return step / max(float(np.linalg.norm(step)), 1e-12)

    def is_near(self, start: int, target: int, reach: float) -> bool:
        """Whether a walk shorter than `reach` leads from one point to another (Dijkstra)."""
        best, queue = {start: 0.0}, [(0.0, start)]
        while queue:
            length, i = heapq.heappop(queue)
            if i == target:
                return True
            if length > best[i]:
                continue
            for j, step in self.links[i].items():
                if length + step < min(reach, best.get(j, math.inf)):
                    best[j] = length + step
                    heapq.heappush(queue, (best[j], j))
        return False

    def pieces(self) -> Iterator[set[int]]:
        """The connected parts."""
        return nx.connected_components(nx.Graph(self.links))


@dataclass(frozen=True)
class Sampling:
    """How the waypoints lie along the ridge.

    Attributes:
        count: The number of waypoints.
        rate: Waypoints per unit of length.
        unevenness: Coefficient of variation of the gaps between them: 0 for even ones, 1 for
            those at random.
    """

    count: float
    rate: float
    unevenness: float

    @property
    def longest_gap(self) -> float:
        """A gap that sampling leaves in one cloud of 50 (e^-4), in units of length.

        The longest of n random gaps has the distribution exp(-n exp(-gap / mean)).
        """
        return (1 + self.unevenness * (math.log(self.count) + 4)) / self.rate

    @property
    def long_gap(self) -> float:
        """A gap as long as one in 50 random ones, beside which a path ends at another."""
        return (1 + 4 * self.unevenness) / self.rate


def grow_skeleton(
    ridge: FloatArray, points: FloatArray, weights: FloatArray, sigma: float
) -> Skeleton:
    """Joins ridge points to the graph of the path.

    Args:
        ridge: The ridge points, (n, d).
        points: The waypoints, (N, d).
        weights: How many waypoints each stands for, (N,).
        sigma: The scale of the ridge.
    """
    skeleton = _spanner(ridge, sigma)
    prune(skeleton, sigma)
    if skeleton.links:
        _bridge_gaps(skeleton, sampling_along(skeleton, points, weights), sigma)
        prune(skeleton, sigma)
        _drop_specks(skeleton, points, weights, sigma)
    return skeleton


def _spanner(points: FloatArray, sigma: float) -> Skeleton:
    """Joins near points, the nearest first, unless that closes a short loop."""
    skeleton = Skeleton(points)
    pairs = cKDTree(points).query_pairs(LINK * sigma, output_type="ndarray")
    distances = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    joined = nx.utils.UnionFind(range(len(points)))
    for k in np.lexsort((pairs[:, 1], pairs[:, 0], distances)):
        i, j = map(int, pairs[k])
        separate = joined[i] != joined[j]
        if separate or not skeleton.is_near(i, j, SHORTEST_LOOP * sigma - distances[k]):
            joined.union(i, j)
            skeleton.join(i, j)
    return skeleton


def prune(skeleton: Skeleton, sigma: float) -> None:
    """Cuts short leaves, the shortest first, until none is left; acute tips become corners."""
    pruned = True
    while pruned:
        pruned = False
        leaves = []
        for tip in skeleton.tips():
            path = skeleton.walk(tip, next(iter(skeleton.links[tip])), reach=14 * sigma)
            if skeleton.degree(path[-1]) >= 3:
                leaves.append((skeleton.length(path), path))
        for length, path in sorted(leaves):
            if _is_still_leaf(skeleton, path) and _prune_leaf(skeleton, path, length, sigma):
                pruned = True


def _is_still_leaf(skeleton: Skeleton, path: list[int]) -> bool:
    return (
        all(i in skeleton.links for i in path)
        and skeleton.degree(path[0]) == 1
        and all(skeleton.degree(i) == 2 for i in path[1:-1])
        and skeleton.degree(path[-1]) >= 3
    )


def _prune_leaf(skeleton: Skeleton, path: list[int], length: float, sigma: float) -> bool:
    """Cuts a leaf if it is short, or leads the path through it if it is an acute tip."""
    tip, before, branch = path[0], path[-2], path[-1]
    others = [i for i in skeleton.links[branch] if i != before]
    reach = _tip_length(skeleton, path, others, sigma)
    if length >= max(LEAF * sigma, reach):
        return False
    if reach > 0 and length > 0.5 * sigma:
        for i in path[1:]:
            skeleton.drop(i)
        for i in others:
            skeleton.join(i, tip)
    else:
        for i in path[:-1]:
            skeleton.drop(i)
    return True


def _tip_length(skeleton: Skeleton, path: list[int], others: list[int], sigma: float) -> float:
    """How long a leaf may be that is the tip of two arms; zero where it is none.

    The ridges of two arms at an angle phi merge where they are 2 sin(phi / 2) sigma apart.
    """
    if len(others) != 2:
        return 0.0
    arms = [
        skeleton.direction(skeleton.walk(path[-1], i, reach=12 * sigma), sigma, 4 * sigma)
        for i in others
    ]
    angle = math.acos(float(np.clip(arms[0] @ arms[1], -1, 1)))
    away = -(arms[0] + arms[1])
    leaf = skeleton.direction(path[::-1], 0, 4 * sigma)
    aligned = away @ leaf > TIP_ALIGNMENT * np.linalg.norm(away)
    if angle >= math.radians(ACUTE) or not aligned:
        return 0.0
    return (1.6 / max(math.sin(angle / 2), 0.1) + 1) * sigma


def sampling_along(skeleton: Skeleton, points: FloatArray, weights: FloatArray) -> Sampling:
    """Measures how the waypoints (N, d) lie along a skeleton."""
    ids = np.array(list(skeleton.links))
    _, nearest = cKDTree(skeleton.points[ids]).query(points)
    arc, tangent = _unrolled(skeleton)
    foot = ids[nearest]
    known = np.isfinite(arc[foot])
    foot = foot[known]
    along = arc[foot] + ((points[known] - skeleton.points[foot]) * tangent[foot]).sum(axis=1)
    gaps = np.diff(np.sort(along))
    # Gaps between walks are not gaps of the path.
    gaps = gaps[gaps < WALK_OFFSET / 2]
    uneven = float(np.std(gaps)) / max(float(np.mean(gaps)), 1e-9) if len(gaps) > 4 else 1.0
    count = float(weights.sum())
    rate = count / max(_tree_length(skeleton.points[ids]), 1e-6)
    return Sampling(count, rate, min(1.0, uneven))


def _unrolled(skeleton: Skeleton) -> tuple[FloatArray, FloatArray]:
    """Lays all walks out along one line: arc length (n,) and tangent (n, d) of each point."""
    arc = np.full(len(skeleton.points), np.nan)
    tangent = np.zeros_like(skeleton.points)
    offset = 0.0
    walked: set[tuple[int, int]] = set()
    branches = [i for i in skeleton.links if skeleton.degree(i) != 2]
    for i in itertools.chain(branches, skeleton.links):
        for j in skeleton.links[i]:
            if (i, j) in walked:
                continue
            path = skeleton.walk(i, j)
            for a, b in itertools.pairwise(path):
                walked |= {(a, b), (b, a)}
            places = skeleton.points[path]
            lengths = arc_lengths(places)
            steps = np.gradient(places, axis=0)
            steps /= np.maximum(np.linalg.norm(steps, axis=1, keepdims=True), 1e-12)
            for k, s, t in zip(path, lengths, steps, strict=True):
                if np.isnan(arc[k]):
                    arc[k], tangent[k] = offset + s, t
            offset += lengths[-1] + WALK_OFFSET
    return arc, tangent


def _tree_length(points: FloatArray) -> float:
    """Length of the minimum spanning tree of points, without its long edges: gaps count."""
    neighbours = min(12, len(points) - 1)
    if neighbours < 1:
        return 0.0
    distance, other = cKDTree(points).query(points, k=neighbours + 1)
    row = np.repeat(np.arange(len(points)), neighbours)
    graph = coo_array(
        (distance[:, 1:].ravel() + 1e-12, (row, other[:, 1:].ravel())), shape=(len(points),) * 2
    )
    edges = minimum_spanning_tree(graph.tocsr()).data
    return float(edges[edges < LONGEST_TREE_EDGE].sum())


def _bridge_gaps(skeleton: Skeleton, sampling: Sampling, sigma: float) -> None:
    """Joins tips to tips and to strands across the gaps that the sampling leaves."""
    to_tip = min(1.5 * sigma + sampling.longest_gap, max(WIDEST_TIP_GAP, 4 * sigma))
    skeleton.reach = to_tip
    to_side = min(2.5 * sigma + sampling.long_gap, max(WIDEST_SIDE_GAP, 4 * sigma))
    for alignment, part in ((STRAIGHT, 1.0), (BENT, 0.8)):
        for _ in range(BRIDGING_ROUNDS):
            if not _bridge_once(skeleton, sigma, alignment, part * to_tip, to_side):
                break


def _bridge_once(
    skeleton: Skeleton, sigma: float, alignment: float, to_tip: float, to_side: float
) -> bool:
    """Builds the bridges that cost least, at most one a tip; returns whether there was one.

    A tip waits whose best bridge leads to one that has just got another: that may have become a
    strand, and the next best bridge lead to its far end.
    """
    headings = {i: _heading(skeleton, i, sigma) for i in _loose(skeleton)}
    bridges = []
    for tip, other in _near(skeleton, headings, headings, to_tip):
        cost = _tip_cost(skeleton, tip, other, headings, alignment, sigma)
        if math.isfinite(cost):
            bridges.append((cost, tip, other))
    sides = [i for i in skeleton.links if i not in headings]
    for tip, other in _near(skeleton, headings, sides, to_side):
        cost = _side_cost(skeleton, tip, other, headings[tip], sigma)
        if math.isfinite(cost):
            bridges.append((cost, tip, other))
    joined: set[int] = set()
    waiting: set[int] = set()
    for _, *both in sorted(bridges):
        tips = set(both) & headings.keys()
        if tips & joined:
            waiting |= tips - joined
        elif not tips & waiting:
            skeleton.join(*both)
            joined |= tips
    return bool(joined)


def _near(
    skeleton: Skeleton, tips: Iterable[int], others: Iterable[int], reach: float
) -> Iterator[tuple[int, int]]:
    """The pairs of a tip and another point within reach that no link joins."""
    tips, others = np.array(list(tips), dtype=int), np.array(list(others), dtype=int)
    if len(tips) == 0 or len(others) == 0:
        return
    near = cKDTree(skeleton.points[others]).query_ball_point(skeleton.points[tips], reach)
    for tip, found in zip(tips.tolist(), near, strict=True):
        for other in others[found].tolist():
            if other != tip and other not in skeleton.links[tip]:
                yield tip, other


def _loose(skeleton: Skeleton) -> list[int]:
    """Tips, and points without any neighbour."""
    return [i for i, links in skeleton.links.items() if len(links) <= 1]


def _heading(skeleton: Skeleton, tip: int, sigma: float) -> FloatArray | None:
    """The unit vector out of a tip; None where its strand is too short to tell."""
    if not skeleton.links[tip]:
        return None
    path = skeleton.walk(tip, next(iter(skeleton.links[tip])), reach=5 * sigma)
    if skeleton.length(path) < 1.5 * sigma:
        return None
    return -skeleton.direction(path, 0, 4 * sigma)


def _tip_cost(
    skeleton: Skeleton,
    tip: int,
    other: int,
    headings: dict[int, FloatArray | None],
    alignment: float,
    sigma: float,
) -> float:
    """The length of a bridge between tips, more where it bends; infinite if it may not be."""
    length, direction = _step(skeleton, tip, other)
    ahead, there = _alignment(headings[tip], direction), _alignment(headings[other], -direction)
    least = min(0.5, alignment) if length < 3 * sigma else alignment
    if min(ahead, there) < least or _same_way(headings[tip], headings[other], alignment):
        return math.inf
    if _closes_short_loop(skeleton, tip, other, length, sigma):
        return math.inf
    return length * (1 + 2 * (2 - ahead - there))


def _side_cost(
    skeleton: Skeleton, tip: int, other: int, heading: FloatArray | None, sigma: float
) -> float:
    """The same for a bridge from a tip to the side of a strand."""
    length, direction = _step(skeleton, tip, other)
    ahead = _alignment(heading, direction)
    if heading is None or ahead < SIDEWAYS:
        return math.inf
    if _closes_short_loop(skeleton, tip, other, length, sigma):
        return math.inf
    return 1.5 * length * (1 + 2 * (1 - ahead))


def _step(skeleton: Skeleton, tip: int, other: int) -> tuple[float, FloatArray]:
    """The distance of two points, and the unit vector from one to the other."""
    step = skeleton.points[other] - skeleton.points[tip]
    length = math.sqrt(step @ step)
    return length, step / max(length, 1e-12)


def _closes_short_loop(
    skeleton: Skeleton, tip: int, other: int, length: float, sigma: float
) -> bool:
    return skeleton.is_near(tip, other, max(SHORTEST_LOOP * sigma, 5 * length))


def _alignment(heading: FloatArray | None, direction: FloatArray) -> float:
    return 1.0 if heading is None else float(heading @ direction)


def _same_way(a: FloatArray | None, b: FloatArray | None, alignment: float) -> bool:
    """Whether two tips do not face each other."""
    if a is None or b is None:
        return False
    return float(a @ b) > (-0.2 if alignment > 0.5 else 0.3)


def _drop_specks(
    skeleton: Skeleton, points: FloatArray, weights: FloatArray, sigma: float
) -> None:
    """Drops pieces that are short, or have few waypoints."""
    ids = np.array(list(skeleton.links))
    _, nearest = cKDTree(skeleton.points[ids]).query(points)
    own = dict(zip(ids.tolist(), np.bincount(nearest, weights, len(ids)), strict=True))
    for piece in list(skeleton.pieces()):
        length = sum(sum(skeleton.links[i].values()) for i in piece) / 2
        if length < LEAST_LENGTH * sigma or sum(own[i] for i in piece) < FEWEST_WAYPOINTS:
            for i in piece:
                skeleton.drop(i)
