"""From a skeleton to a graph of nodes and edges: junctions, crossings, ends, and routes.

A crossing of two strands at an acute angle is no point of the ridge: the strands merge on
their way and part again, which makes two branches.  So near branches become one node, and the
arms of a node are paired: where all go straight through, it is a crossing.

All lengths are in units of the cloud (U).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
import math

import networkx as nx
import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.paths.polyline import aim, arc_lengths
from sgvf_drake.paths.skeleton import Skeleton

CONTRACTION = 3.0
"""Branches within this many sigma of each other along the ridge are one node."""

LONGEST_OVERLAP = 9.0
"""Two strands that cross at 20 degrees or more share the ridge for so many sigma at most."""

STRAIGHT_TURN = 40.0
"""Arms that turn by less than this, in degrees, go straight through a node."""

CLEAR_TURN, CLEAR_MARGIN = 60.0, 15.0
"""Arms that turn by less than this do too where the next pairing turns by so much more."""

ARM_NEAR, ARM_FAR = 2.0, 5.0
"""The part of an arm, in sigma from its node, that shows where it goes."""

MOST_ARMS = 8
"""Nodes with more arms are no crossings: there are 105 pairings of eight."""

Arm = tuple[int, int]
"""An edge, and which of its ends: 0 for its start, 1 for its end."""

Pairing = list[tuple[Arm, Arm]]
"""Arms that are joined, two at a time."""


@dataclass(eq=False)
class Strand:
    """An edge while the graph is built.

    Attributes:
        path: Polyline from its start to its end, (n, d); of a plain loop the first point is
            also the last.
        ends: The nodes at both ends; None for a plain loop, which has no node.
    """

    path: FloatArray
    ends: list[int] | None

    @property
    def length(self) -> float:
        """Its length."""
        return float(arc_lengths(self.path)[-1])


@dataclass(eq=False)
class Graph:
    """Nodes and strands.

    Attributes:
        places: The place of each node, (d,).
        strands: What joins them.
        through: For each arm that goes straight through a crossing, the arm it goes on with.
        exact_ends: Ends that are where a path was cut, not where its ridge ends.
    """

    places: dict[int, FloatArray]
    strands: dict[int, Strand]
    through: dict[Arm, Arm] = field(default_factory=dict)
    exact_ends: set[int] = field(default_factory=set)

    def arms(self, node: int) -> list[Arm]:
        """The arms of a node."""
        return [
            (k, side)
            for k, strand in self.strands.items()
            for side in (0, 1)
            if strand.ends is not None and strand.ends[side] == node
        ]

    def all_arms(self) -> dict[int, list[Arm]]:
        """The arms of every node."""
        arms: dict[int, list[Arm]] = {node: [] for node in self.places}
        for k, strand in self.strands.items():
            for side, node in enumerate(strand.ends or ()):
                arms[node].append((k, side))
        return arms

    def outward(self, arm: Arm) -> FloatArray:
        """The polyline of an arm from its node on, (n, d)."""
        path = self.strands[arm[0]].path
        return path if arm[1] == 0 else path[::-1]

    def join(self, a: int, b: int, via: FloatArray | None = None) -> None:
        """Joins two ends of paths by a line through points (n, d); they are nodes no more."""
        line = [self.places[a], *([] if via is None else via), self.places[b]]
        self.strands[1 + max(self.strands)] = Strand(np.array(line), [a, b])
        self.dissolve()

    def dissolve(self) -> None:
        """Joins the two strands of nodes that have two arms only."""
        for node in list(self.places):
            arms = self.arms(node)
            if len(arms) != 2:
                continue
            (k, side), (m, other) = arms
            if k == m:
                path = self.strands[k].path
                self.strands[k] = Strand(np.vstack([path, path[:1]]), None)
            else:
                path = np.vstack([self.outward(arms[0])[::-1], self.outward(arms[1])])
                far = (k, 1 - side), (m, 1 - other)
                self.strands[k] = Strand(path, [self.node(arm) for arm in far])
                del self.strands[m]
                self._rename_arms({far[0]: (k, 0), far[1]: (k, 1)})
            del self.places[node]

    def cut(self, k: int, before: FloatArray, after: FloatArray) -> None:
        """Cuts a strand between two places along it, (d,) each, which become ends."""
        strand = self.strands.pop(k)
        first, second = 1 + max(self.places, default=-1), 2 + max(self.places, default=-1)
        self.places |= {first: before, second: after}
        self.exact_ends |= {first, second}
        i, j = (int(np.linalg.norm(strand.path - p, axis=1).argmin()) for p in (before, after))
        if strand.ends is None:
            loop = strand.path[:-1]
            kept = np.roll(loop, -j, axis=0)[1 : (i - j - 1) % len(loop) + 1]
            self.strands[k] = Strand(np.vstack([after, kept, before]), [second, first])
            return
        start, end = strand.ends
        other = 1 + max([k, *self.strands])
        self.strands[k] = Strand(np.vstack([strand.path[:i], before]), [start, first])
        self.strands[other] = Strand(np.vstack([after, strand.path[j + 1 :]]), [second, end])
        self._rename_arms({(k, 1): (other, 1)})

    def _rename_arms(self, names: Mapping[Arm, Arm]) -> None:
        """Keeps what goes through crossings where strands were cut or joined."""
        self.through = {names.get(a, a): names.get(b, b) for a, b in self.through.items()}

    @property
    def signature(self) -> "Signature":
        """What scales vote about."""
        graph = nx.MultiGraph()
        graph.add_nodes_from(self.places)
        joined = [strand.ends for strand in self.strands.values() if strand.ends is not None]
        graph.add_edges_from(joined)
        loops = len(self.strands) - len(joined)
        parts = nx.number_connected_components(graph)
        crossed = {self.node(arm) for arm in self.through}
        degrees: dict[bool, list[int]] = {False: [], True: []}
        for node, degree in graph.degree():
            degrees[node in crossed].append(degree)
        return Signature(
            pieces=parts + loops,
            cycles=len(joined) - len(self.places) + parts + loops,
            ends=degrees[False].count(1),
            junctions=tuple(sorted(degree for degree in degrees[False] if degree > 1)),
            crossings=tuple(sorted(degrees[True])),
        )

    def node(self, arm: Arm) -> int:
        """The node that an arm belongs to."""
        ends = self.strands[arm[0]].ends
        assert ends is not None
        return ends[arm[1]]


@dataclass(frozen=True, order=True)
class Signature:
    """The topology of a graph: its pieces, cycles and ends, and the arms of its nodes."""

    pieces: int
    cycles: int
    ends: int
    junctions: tuple[int, ...]
    crossings: tuple[int, ...]

    def __str__(self) -> str:
        counts = {
            "piece": self.pieces,
            "loop": self.cycles,
            "end": self.ends,
            "junction": len(self.junctions),
            "crossing": len(self.crossings),
        }
        return ", ".join(f"{n} {name}" + "s" * (n > 1) for name, n in counts.items() if n)

    @property
    def complexity(self) -> int:
        """What noise adds: ends and junctions, those with an odd number of arms above all."""
        return self.ends + sum(1 + degree % 2 for degree in self.junctions)


def assemble(skeleton: Skeleton, sigma: float) -> Graph:
    """Builds the graph of a skeleton whose scale is `sigma`."""
    graph = _contracted(skeleton, sigma)
    _merge_overlaps(graph, sigma)
    graph.dissolve()
    _pair_arms(graph, sigma)
    return graph


def _contracted(skeleton: Skeleton, sigma: float) -> Graph:
    """Makes one node of branches that are near each other, and strands of what joins nodes."""
    node_of = _nodes(skeleton, CONTRACTION * sigma)
    members: dict[int, list[int]] = {}
    for i, node in node_of.items():
        members.setdefault(node, []).append(i)
    graph = Graph({n: skeleton.points[group].mean(axis=0) for n, group in members.items()}, {})
    walked: set[tuple[int, int]] = set()
    done = set(node_of)
    for i, node in node_of.items():
        for j in skeleton.links[i]:
            if (i, j) in walked:
                continue
            path = skeleton.walk(i, j)
            walked |= {(i, j), (path[-1], path[-2])}
            done.update(path)
            ends = [node, node_of[path[-1]]]
            # What leads from a node back to it within its own size is part of it.
            inside = ends[0] == ends[1] and skeleton.length(path) <= 1.7 * CONTRACTION * sigma
            if not inside:
                graph.strands[len(graph.strands)] = Strand(skeleton.points[path], ends)
    for i in skeleton.links:
        if i not in done:
            loop = skeleton.walk(i, next(iter(skeleton.links[i])))
            done.update(loop)
            graph.strands[len(graph.strands)] = Strand(skeleton.points[loop], None)
    return graph


def _nodes(skeleton: Skeleton, reach: float) -> dict[int, int]:
    """The node of every branch and tip: branches that a short walk joins are one."""
    branches = [i for i in skeleton.links if skeleton.degree(i) >= 3]
    near = nx.Graph()
    near.add_nodes_from(branches)
    for i in branches:
        for j in skeleton.links[i]:
            path = skeleton.walk(i, j, reach=reach)
            if skeleton.degree(path[-1]) >= 3 and skeleton.length(path) <= reach:
                near.add_edge(i, path[-1])
    near.add_nodes_from(skeleton.tips())
    groups = nx.connected_components(near)
    return {i: node for node, group in enumerate(groups) for i in group}


def _merge_overlaps(graph: Graph, sigma: float) -> None:
    """Makes a crossing of two triple nodes whose outer arms go straight through the link."""
    merged = True
    while merged:
        merged = False
        for k, both in links_of_two(graph):
            if graph.strands[k].length > LONGEST_OVERLAP * sigma:
                break
            if min(worst_turn(graph, pairing, sigma) for pairing in both) < STRAIGHT_TURN:
                _contract(graph, k)
                merged = True
                break


def links_of_two(graph: Graph) -> Iterator[tuple[int, list[Pairing]]]:
    """The links of two triple nodes, the shortest first, and how their other arms pair."""
    arms = graph.all_arms()
    for k, link in sorted(graph.strands.items(), key=lambda item: item[1].length):
        if link.ends is None or link.ends[0] == link.ends[1]:
            continue
        outer = [[arm for arm in arms[node] if arm[0] != k] for node in link.ends]
        if [len(side) for side in outer] == [2, 2]:
            (a, b), (c, d) = outer
            yield k, [[(a, c), (b, d)], [(a, d), (b, c)]]


def _contract(graph: Graph, link: int) -> None:
    """Makes one node of the two that a strand joins."""
    ends = graph.strands.pop(link).ends
    assert ends is not None
    kept, gone = ends
    graph.places[kept] = (graph.places[kept] + graph.places.pop(gone)) / 2
    for strand in graph.strands.values():
        if strand.ends is not None:
            strand.ends = [kept if node == gone else node for node in strand.ends]


def _pair_arms(graph: Graph, sigma: float) -> None:
    """Finds the crossings: nodes with an even number of arms that all go straight through."""
    for arms in graph.all_arms().values():
        if len(arms) % 2 or not 4 <= len(arms) <= MOST_ARMS:
            continue
        ranked = sorted(
            ((worst_turn(graph, pairing, sigma), pairing) for pairing in pairings(arms)),
            key=lambda item: item[0],
        )
        worst, best = ranked[0]
        clear = worst < CLEAR_TURN and ranked[1][0] > worst + CLEAR_MARGIN
        if worst < STRAIGHT_TURN or clear:
            for a, b in best:
                graph.through[a], graph.through[b] = b, a


def pairings(arms: Sequence[Arm]) -> Iterator[Pairing]:
    """All ways to pair arms, an even number of them."""
    if not arms:
        yield []
        return
    first, *rest = arms
    for k, other in enumerate(rest):
        for pairs in pairings(rest[:k] + rest[k + 1 :]):
            yield [(first, other), *pairs]


def worst_turn(graph: Graph, pairing: Pairing, sigma: float) -> float:
    """By how many degrees the arms of a pairing turn at most."""
    return max(_turn(graph, a, b, sigma) for a, b in pairing)


def _turn(graph: Graph, a: Arm, b: Arm, sigma: float) -> float:
    """By how many degrees a strand turns that comes along arm `a` and goes on along `b`.

    It turns twice: from its arm to the line between the two arms, and from this to the other
    arm.  So two parallel streets that end at a third, on both sides and one step apart, are
    not one that crosses it.
    """
    (place_a, out_a), (place_b, out_b) = (
        aim(graph.outward(arm), ARM_NEAR * sigma, ARM_FAR * sigma) for arm in (a, b)
    )
    between = place_b - place_a
    return _angle(-out_a, between) + _angle(between, out_b)


def _angle(a: FloatArray, b: FloatArray) -> float:
    cosine = float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300)
    return math.degrees(math.acos(min(1.0, max(-1.0, cosine))))
