"""Sparse clouds, and even ones: the shortest tours through the waypoints themselves.

Below the spacing of its waypoints a density falls apart, so the ridge of a sparse cloud is seen
at scales that round its tips and merge its strands.  But the shortest tour through the samples
of a curve visits them in their order, where they are dense enough for its bends and for the
distance of its strands (Giesen, Symposium on Computational Geometry, 1999).

Here there may be several tours, and no step costs more than a gap: the steps that would are
where paths end.  As long as it saves length, two steps are exchanged for two others (2-opt),
which turns a part of a tour round, parts a tour in two, or joins two.  Where an exchange that
changes the paths would cost little, the tours do not decide what the paths are: so it is at
junctions, at crossings, and between strands as near to each other as their waypoints.  Evenly
spaced waypoints whose tours do decide need no ridge either, however dense they are.

All lengths are in units of the cloud (U).
"""

from dataclasses import dataclass
import math

import networkx as nx
import numpy as np
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import cdist

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.paths.assembly import Graph, Strand
from sgvf_drake.paths.geometry import SPARSE
from sgvf_drake.paths.reference import Piece, ReferencePath
from sgvf_drake.paths.skeleton import FEWEST_WAYPOINTS

MOST_WAYPOINTS = 400
"""So many waypoints farther apart than `SPARSE` fill an area rather than lie on paths."""

STEP_PERCENTILE = 90.0
"""Nine in ten edges of the minimum spanning tree are no longer than the step of the waypoints:
the spacing of even ones, 2.3 mean spacings of random ones."""

EVEN = 1.3
"""Waypoints are evenly spaced if their step is at most so many times the median one."""

GAP = 3.0
"""Paths end where the next waypoint is more than this many steps away; one of 40 random gaps is
so long with a chance of 4 %."""

DOUBT = (
    "the waypoints are too sparse to tell these paths from others; more waypoints would "
    "decide, or a scale to look at (sigma)"
)

MARGIN = 1.0
"""Paths that would be shorter than this many steps more may be right too."""

MEETING = 0.6
"""Where strands meet, other paths cost less than this: where two cross at right angles, at most
2 - sqrt 2 of their steps."""

ASIDE, SHARE_NEAR = 0.5, 0.9
"""A ridge that follows its waypoints has this share of them nearer than so many steps."""

SMALLEST_PART = 8
"""A part of a tour with fewer waypoints may be turned round by noise, and makes no loop."""

FEWEST_OF_LOOP = 4
"""Fewer waypoints are no loop: they are open at their longest step."""

ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class PathsByTours:
    """The paths through sparse waypoints, or through few and even ones.

    Attributes:
        points: The waypoints, (n, d), each once.
        graph: Loops and open paths, whose vertices are the waypoints in their order.
        step: How far apart neighbours are.
        gap: How far apart they are at most.
        margin: How much longer the next best paths are.
        is_sparse: Whether the waypoints are too far apart for a ridge; else they are even.
    """

    points: FloatArray
    graph: Graph
    step: float
    gap: float
    margin: float
    is_sparse: bool

    @property
    def apart(self) -> bool:
        """Whether strands keep apart, as far as these paths can tell."""
        return self.margin >= MEETING * self.step

    @property
    def sure(self) -> bool:
        """Whether no other paths are nearly as short."""
        return self.margin >= MARGIN * self.step

    def meet_in(self, ridge: Graph) -> bool:
        """Whether strands meet in a ridge, which these paths cannot show.

        It runs along the waypoints: at a coarse scale, strands are merged and seem to meet.
        """
        lines = (
            Piece(strand.path[strand.ends is None :], strand.ends is None)
            for strand in ridge.strands.values()
        )
        aside = ReferencePath(tuple(lines)).project(self.points).distance
        near = np.quantile(aside, SHARE_NEAR) < ASIDE * self.step
        return bool(near and (ridge.signature.junctions or ridge.signature.crossings))


def find_tours(points: FloatArray) -> PathsByTours | None:
    """Finds the shortest paths through waypoints (N, d) that are sparse, or few and even.

    None where they are neither.
    """
    points = np.unique(points, axis=0)
    if not 2 <= len(points) <= MOST_WAYPOINTS:
        return None
    distance = cdist(points, points)
    tree = minimum_spanning_tree(distance).data
    step = float(np.percentile(tree, STEP_PERCENTILE))
    if tree.mean() <= SPARSE and step > EVEN * np.median(tree):
        return None
    gap = GAP * step
    # The best exchange may lead astray: at tips without gaps, at ends without the tips.
    greedy = [_greedy_tour(distance)]
    starts = greedy, Tours(greedy, distance, math.inf).shortened().cycles
    tours = min(
        (Tours(start, distance, gap).shortened() for start in starts), key=lambda t: t.cost
    )
    is_sparse = bool(tree.mean() > SPARSE)
    return PathsByTours(points, _graph(points, tours), step, gap, tours.margin(), is_sparse)


class Tours:
    """Closed tours through points, and what it saves to exchange two of their steps."""

    def __init__(self, cycles: list[IntArray], distance: FloatArray, gap: float) -> None:
        """Computes what every exchange saves.

        Args:
            cycles: The points of each tour in order.
            distance: (n, n) of the points.
            gap: What a step costs at most.
        """
        self.cycles = cycles
        self._distance, self._gap = distance, gap
        cost = np.minimum(distance, gap)
        # There is a gap on both sides of a point by itself.
        np.fill_diagonal(cost, gap)
        # Steps a -> b; an exchange joins a to a and b to b, or each a to the other b.
        a = np.concatenate(cycles)
        b = np.concatenate([np.roll(cycle, -1) for cycle in cycles])
        sizes = np.array([len(cycle) for cycle in cycles])
        self._cycle = np.repeat(np.arange(len(cycles)), sizes)
        self._steps, self._is_gap = distance[a, b], cost[a, b] >= gap
        self.cost = float(cost[a, b].sum())
        before = cost[a, b][:, None] + cost[a, b]
        across = cost[np.ix_(a, b)]
        self._turned = before - cost[np.ix_(a, a)] - cost[np.ix_(b, b)]
        self._crossed = before - across - across.T
        for saved in (self._turned, self._crossed):
            np.fill_diagonal(saved, -np.inf)
        # Two steps of one tour part it in two.  A small part is no loop, but may have ends.
        place = np.arange(len(a))
        same = self._cycle == self._cycle[:, None]
        later = place > place[:, None]
        inner = np.abs(place - place[:, None])
        outer = sizes[self._cycle] - inner
        fits = (inner >= SMALLEST_PART) | (np.where(later, across.T, across) >= gap)
        fits &= (outer >= SMALLEST_PART) | (np.where(later, across, across.T) >= gap)
        self._crossed[same & ~fits] = -np.inf
        self._matters = ~same | (np.minimum(inner, outer) >= SMALLEST_PART)

    def shortened(self) -> "Tours":
        """Makes the best exchange until none saves anything."""
        tours = self
        while (saved := np.maximum(tours._turned, tours._crossed)).max() > ROUNDING:
            i, j = np.unravel_index(int(saved.argmax()), saved.shape)
            tours = tours._exchanged(int(min(i, j)), int(max(i, j)))
        return tours

    def _exchanged(self, i: int, j: int) -> "Tours":
        """Exchanges steps i < j in the better of both ways."""
        turns = self._turned[i, j] >= self._crossed[i, j]
        own = {int(self._cycle[i]), int(self._cycle[j])}
        rest = [cycle for k, cycle in enumerate(self.cycles) if k not in own]
        one, two = self._after(i), self._after(j)
        if len(own) == 1:
            one, two = one[: j - i], one[j - i :]
        joined = [np.concatenate([one, two[::-1] if turns else two])]
        parts = [one, two] if len(own) == 1 and not turns else joined
        return Tours([*rest, *parts], self._distance, self._gap)

    def _after(self, step: int) -> IntArray:
        """The tour that a step belongs to, beginning where the step ends."""
        k = int(self._cycle[step])
        return np.roll(self.cycles[k], int(np.argmax(self._cycle == k)) - step - 1)

    def margin(self) -> float:
        """How much longer the next best paths are."""
        # Where both steps are gaps, an exchange changes no path.
        changes = self._matters & ~(self._is_gap & self._is_gap[:, None])
        exchanged = -np.maximum(self._turned, self._crossed)[changes]
        widths = np.abs(self._steps - self._gap)[self._steps > 0]
        # A short loop may be an open path, there and back, which would cost a gap instead.
        tours = [self._cycle == k for k in range(len(self.cycles))]
        loops = [tour for tour in tours if not self._is_gap[tour].any()]
        opened = [self._steps[loop].sum() / 2 - self._gap for loop in loops]
        return float(min(math.inf, *exchanged, *widths, *opened))

    def paths(self) -> list[tuple[IntArray, bool]]:
        """The points of each path in order, and whether it is closed."""
        found = []
        for k, cycle in enumerate(self.cycles):
            gaps = np.flatnonzero(self._is_gap[self._cycle == k])
            if len(gaps) == 0 and len(cycle) < FEWEST_OF_LOOP:
                gaps = np.array([np.argmax(self._steps[self._cycle == k])])
            if len(gaps) == 0:
                found.append((cycle, True))
                continue
            # It begins behind its last gap.
            parts = np.split(np.roll(cycle, -1 - gaps[-1]), (gaps - gaps[-1])[:-1])
            found += [(part, False) for part in parts]
        return found


def _greedy_tour(distance: FloatArray) -> IntArray:
    """Joins points to a path through all of them, the nearest first, each to two at most."""
    count = len(distance)
    path = nx.empty_graph(count)
    joined = nx.utils.UnionFind(range(count))
    i, j = np.triu_indices(count, k=1)
    for k in np.argsort(distance[i, j], kind="stable").tolist():
        a, b = int(i[k]), int(j[k])
        if path.degree(a) < 2 and path.degree(b) < 2 and joined[a] != joined[b]:
            joined.union(a, b)
            path.add_edge(a, b)
    start = next(node for node, degree in path.degree() if degree == 1)
    return np.array(list(nx.dfs_preorder_nodes(path, start)))


def _graph(points: FloatArray, tours: Tours) -> Graph:
    """The paths as a graph; those of few waypoints are strays."""
    graph = Graph({}, {})
    for order, closed in tours.paths():
        line, ends = points[order], None
        if len(line) < min(FEWEST_WAYPOINTS, len(points)):
            continue
        if closed:
            line = np.vstack([line, line[:1]])
        else:
            ends = [len(graph.places), len(graph.places) + 1]
            graph.places |= {ends[0]: line[0], ends[1]: line[-1]}
            # They end at waypoints, as those that were cut.
            graph.exact_ends |= {*ends}
        graph.strands[len(graph.strands)] = Strand(line, ends)
    return graph
