"""Plans itineraries: the shortest one to a point, and one over every edge."""

from collections import defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
import itertools

import networkx as nx
import numpy as np
from numpy.typing import ArrayLike

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths.itinerary import Itinerary, between, oriented_line, successors
from sgvf_drake.paths.network import PathNetwork
from sgvf_drake.paths.polyline import aim
from sgvf_drake.paths.reference import ReferencePath

NEGLIGIBLE = 1e-9
"""Shorter parts of edges, in U, are not travelled."""

ARM = 3.0
"""The direction of an arm is that of its chord over this many sigma of its network."""

Arm = tuple[int, int]
"""An edge, from 0, and its side: 0 for its start, 1 for its end."""

Half = tuple[int, int, int]
"""An edge, from 0, which time it is travelled, and its side."""


def shortest(
    network: PathNetwork,
    start: ArrayLike,
    target: ArrayLike,
    heading: ArrayLike | None = None,
) -> Itinerary:
    """Returns the shortest itinerary from one point to another, between their nearest points.

    It turns round at ends only, and travels one-way paths forwards.

    Args:
        network: The network.
        start: (d,) where it starts.
        target: (d,) where it ends.
        heading: (d,) which way it starts on an edge that is travelled either way; by default
            the shorter way.

    Raises:
        ConfigurationError: If a point cannot be used, or the target cannot be reached.
    """
    begin, end = _foot(network, start), _foot(network, target)
    graph = _states(network, begin, end)
    if heading is not None:
        graph.remove_nodes_from([("from", _against(network, begin, heading))])
    try:
        states = nx.dijkstra_path(graph, "start", "target")[1:-1]
    except nx.NetworkXNoPath:
        raise ConfigurationError(_why_unreachable(network, start, target)) from None
    numbers = [number for _, number in states]
    lines = [oriented_line(network, number) for number in numbers]
    lengths = [network.edges[abs(number) - 1].length for number in numbers]
    cuts = [[0.0, length] for length in lengths]
    cuts[0][0] = _along(network, numbers[0], begin)
    cuts[-1][1] = _along(network, numbers[-1], end)
    least = NEGLIGIBLE * network.unit_length
    kept = [k for k, (a, b) in enumerate(cuts) if b - a > least]
    if not kept:
        raise ConfigurationError(f"{_named(target)} is where the itinerary starts")
    return Itinerary.of_lines(
        network,
        [numbers[k] for k in kept],
        [between(lines[k], *cuts[k]) for k in kept],
        closed=False,
        # Where it stops at a node, the rest of the edge is not travelled.
        stops=lengths[kept[-1]] - cuts[kept[-1]][1] > least,
    )


def connection(network: PathNetwork, start: int, targets: Iterable[int]) -> list[int]:
    """Returns the edges from one to the nearest of others, both included, the shortest way.

    Args:
        network: The network.
        start: The number of the first edge, negative if it is travelled backwards.
        targets: Those of the edges of which it leads to one.

    Returns:
        The numbers of the edges; none if no target can be reached.
    """
    graph = nx.DiGraph()
    for number, after in successors(network).items():
        graph.add_weighted_edges_from(
            (number, k, network.edges[abs(number) - 1].length) for k in after
        )
    if start not in graph:
        return []
    lengths, ways = nx.single_source_dijkstra(graph, start)
    reached = [target for target in targets if target in lengths]
    return ways[min(reached, key=lengths.__getitem__)] if reached else []


def covering(network: PathNetwork, piece: int = 0, start: ArrayLike | None = None) -> Itinerary:
    """Returns a shortest itinerary over every edge of a piece, back to its start.

    A one-way path is travelled along its route.  On a network the Chinese postman's tour is
    taken that goes as straight as possible over nodes; it turns round at ends only.

    Args:
        network: The network.
        piece: The piece, from 0.
        start: (d,) a point on the edge that comes first; by default that of least number.
            An open one-way path starts where it does.

    Raises:
        ConfigurationError: If there is no such piece, or the point cannot be used.
    """
    if not 0 <= piece < network.num_pieces:
        raise ConfigurationError(
            f"there is no piece {piece + 1} (there are 1 to {network.num_pieces})"
        )
    own = [k for k, edge in enumerate(network.edges) if edge.piece == piece]
    first = own[0] if start is None else _foot(network, start, own)[0]
    if not network.is_one_way(piece):
        return Itinerary.along(_Tour(network, own).numbers(first), network, closed=True)
    route = next(route for route in network.routes if route.piece == piece)
    turn = route.edges.index(first) if route.closed else 0
    numbers = [edge + 1 for edge in route.edges[turn:] + route.edges[:turn]]
    return Itinerary.along(numbers, network, closed=route.closed)


def _foot(
    network: PathNetwork, point: ArrayLike, edges: list[int] | None = None
) -> tuple[int, float]:
    """The edge, from 0, and the arc length on it, nearest to a point."""
    x = _checked(network, point, "point")
    own = list(range(len(network.edges))) if edges is None else edges
    found = ReferencePath(tuple(network.edges[k].line for k in own)).project(x[None])
    return own[int(found.piece[0])], float(found.arc[0])


def _against(network: PathNetwork, foot: tuple[int, float], heading: ArrayLike) -> int:
    """The edge of a foot travelled against a heading; 0, which is none, if it is one-way."""
    edge, arc = foot
    if network.is_one_way(network.edges[edge].piece):
        return 0
    around = np.clip([arc - network.sigma, arc + network.sigma], 0, network.edges[edge].length)
    before, after = network.edges[edge].line.at(around)
    h = _checked(network, heading, "heading")
    return -(edge + 1) if h @ (after - before) > 0 else edge + 1


def _checked(network: PathNetwork, point: ArrayLike, name: str) -> FloatArray:
    x = np.asarray(point, dtype=np.float64)
    if x.shape != (network.dim,) or not np.isfinite(x).all():
        raise ConfigurationError(f"{_named(point)} is no {name} in {network.dim} dimensions")
    return x


def _along(network: PathNetwork, number: int, foot: tuple[int, float]) -> float:
    """The arc length of a foot on its edge, in the direction of travel."""
    edge, arc = foot
    return arc if number > 0 else network.edges[edge].length - arc


def _states(
    network: PathNetwork, begin: tuple[int, float], end: tuple[int, float]
) -> nx.DiGraph:
    """States of travel, joined by the length that leads from one to the next.

    They are ("from", number) from the first foot on, ("whole", number) from the start of an
    edge on, and those two places.
    """
    following = successors(network)
    graph = nx.DiGraph()
    graph.add_nodes_from(["start", "target"])
    last = [number for number in following if abs(number) == end[0] + 1]
    for number, after in following.items():
        length = network.edges[abs(number) - 1].length
        whole = ("whole", number)
        graph.add_edges_from((whole, ("whole", k), {"weight": length}) for k in after)
        if number in last:
            graph.add_edge(whole, "target", weight=_along(network, number, end))
        if abs(number) != begin[0] + 1:
            continue
        first, passed = ("from", number), _along(network, number, begin)
        graph.add_edge("start", first, weight=0.0)
        graph.add_edges_from((first, ("whole", k), {"weight": length - passed}) for k in after)
        ahead = _along(network, number, end) - passed
        if number in last and ahead >= 0:
            graph.add_edge(first, "target", weight=ahead)
    return graph


def _named(point: ArrayLike) -> str:
    return f"({', '.join(f'{x:.6g}' for x in np.ravel(point))})"


def _why_unreachable(network: PathNetwork, start: ArrayLike, target: ArrayLike) -> str:
    pieces = [network.edges[_foot(network, point)[0]].piece for point in (start, target)]
    reason = (
        "their path is one-way"
        if pieces[0] == pieces[1]
        else f"they are on pieces {pieces[0] + 1} and {pieces[1] + 1}"
    )
    return f"{_named(target)} cannot be reached from {_named(start)}: {reason}"


@dataclass
class _Tour:
    """The Chinese postman's tour of edges that are travelled either way.

    At every node the arms are paired, an edge that is travelled twice having two arms there.
    Pairs make circuits; these are joined by exchanging partners, until one is left.

    Attributes:
        network: The network.
        edges: The edges of a connected piece, from 0.
        partners: The arm through which each arm is left, after joining.
    """

    network: PathNetwork
    edges: list[int]
    partners: dict[Half, Half] = field(init=False)

    def __post_init__(self) -> None:
        self._outwards = {
            (k, side): self._outward(k, side) for k in self.edges for side in (0, 1)
        }
        twice = _travelled_twice(self.network, self.edges)
        at_nodes: dict[int, list[Half]] = defaultdict(list)
        for k in self.edges:
            for time, side in itertools.product(range(1 + (k in twice)), (0, 1)):
                nodes = self.network.edges[k].nodes
                assert nodes is not None
                at_nodes[nodes[side]].append((k, time, side))
        self.partners = {}
        for halves in at_nodes.values():
            self._pair(halves)
        self._join(list(at_nodes.values()))

    def numbers(self, first: int) -> list[int]:
        """Returns the tour as edges from 1, beginning with an edge travelled forwards."""
        half: Half = (first, 0, 0)
        found: list[int] = []
        while not found or half != (first, 0, 0):
            edge, time, side = half
            found.append(edge + 1 if side == 0 else -edge - 1)
            half = self.partners[edge, time, 1 - side]
        return found

    def _outward(self, edge: int, side: int) -> FloatArray:
        """The direction of an arm away from its node."""
        line = oriented_line(self.network, edge + 1 if side == 0 else -edge - 1)
        _, step = aim(line, 0.0, ARM * self.network.sigma)
        return step / max(float(np.linalg.norm(step)), np.finfo(np.float64).tiny)

    def _bend(self, one: Half, other: Half) -> float:
        """From 0 straight on to 2; more than other bends can save, if it turns round."""
        arms = (one[0], one[2]), (other[0], other[2])
        if arms[0] == arms[1]:
            return 2.0 + 2.0 * len(self._outwards)
        return 1.0 + float(self._outwards[arms[0]] @ self._outwards[arms[1]])

    def _pair(self, halves: list[Half]) -> None:
        graph = nx.Graph()
        graph.add_weighted_edges_from(
            (one, other, self._bend(one, other))
            for one, other in itertools.combinations(halves, 2)
        )
        for one, other in nx.min_weight_matching(graph):
            self.partners |= {one: other, other: one}

    def _join(self, nodes: list[list[Half]]) -> None:
        """Exchanges partners of two circuits, where it bends the least, until one is left.

        Where neither pair turns round, one of the two exchanges does not either.
        """
        while True:
            circuit = self._circuits()
            swaps = [
                swap
                for halves in nodes
                for swap in self._swaps(halves)
                if circuit[swap[1][:2]] != circuit[swap[2][:2]]
            ]
            if not swaps:
                return
            _, one, other = min(swaps)
            for a, b in ((one, other), (self.partners[one], self.partners[other])):
                self.partners |= {a: b, b: a}

    def _circuits(self) -> dict[tuple[int, int], int]:
        """The circuit of every time that an edge is travelled."""
        graph = nx.Graph((one[:2], other[:2]) for one, other in self.partners.items())
        return {
            time: number
            for number, times in enumerate(nx.connected_components(graph))
            for time in times
        }

    def _swaps(self, halves: list[Half]) -> Iterator[tuple[float, Half, Half]]:
        """What bends more if two arms are paired, and their partners; and the two arms."""
        for one, other in itertools.combinations(halves, 2):
            a, b = self.partners[one], self.partners[other]
            before = self._bend(one, a) + self._bend(other, b)
            yield self._bend(one, other) + self._bend(a, b) - before, one, other


def _travelled_twice(network: PathNetwork, edges: list[int]) -> set[int]:
    """The edges on the shortest paths that pair the nodes with an odd number of arms."""
    graph = nx.MultiGraph()
    for k in edges:
        graph.add_edge(*(network.edges[k].nodes or ()), key=k, weight=network.edges[k].length)
    odd = [node for node, degree in graph.degree if degree % 2]
    ways = {node: nx.single_source_dijkstra(graph, node) for node in odd}
    pairs = nx.Graph()
    pairs.add_weighted_edges_from(
        (one, other, ways[one][0][other]) for one, other in itertools.combinations(odd, 2)
    )
    twice: set[int] = set()
    for one, other in nx.min_weight_matching(pairs):
        for a, b in itertools.pairwise(ways[one][1][other]):
            # Of parallel edges the shortest.  No edge is on two of the paths: without it they
            # would pair their ends in less.
            twice.add(min(graph[a][b], key=lambda k: network.edges[k].length))
    return twice
