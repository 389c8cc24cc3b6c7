"""Itineraries: the edges of a network that are travelled one after the other."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
import itertools

import numpy as np
from numpy.typing import ArrayLike

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths.network import PathNetwork
from sgvf_drake.paths.polyline import arc_lengths, points_at
from sgvf_drake.paths.reference import Piece


@dataclass(frozen=True, eq=False)
class Itinerary:
    """Edges that follow each other, in the unit of their network.

    Attributes:
        network: The network.
        edges: The number of each edge, from 1; negative if it is travelled from its end to
            its start.
        closed: Whether it repeats: its end is its start.
        line: The polyline that it runs along.
        starts: (E,) the arc length on the line at which each edge starts.
        nodes: The node that each edge leads into; None if it ends on the edge.
    """

    network: PathNetwork
    edges: tuple[int, ...]
    closed: bool
    line: Piece
    starts: FloatArray
    nodes: tuple[int | None, ...]

    @classmethod
    def parse(cls, text: str, network: PathNetwork) -> "Itinerary":
        """Reads an itinerary as "1,2,-3"; see `along`.

        Raises:
            ConfigurationError: If that is no list of edges, or they do not follow each other.
        """
        try:
            numbers = [int(number) for number in text.split(",")]
        except ValueError:
            raise ConfigurationError(f"{text!r} is no list of edges, as 1,2,-3 is") from None
        return cls.along(numbers, network)

    @classmethod
    def along(
        cls, numbers: Sequence[int], network: PathNetwork, closed: bool | None = None
    ) -> "Itinerary":
        """Returns the itinerary along whole edges.

        Args:
            numbers: The edges, from 1; negative from their end to their start.
            network: The network.
            closed: Whether it repeats; by default, if the first edge can follow the last.

        Raises:
            ConfigurationError: If an edge does not exist, is travelled against its one-way
                path, or does not follow the edge before it.
        """
        following = successors(network)
        _check(numbers, network, following)
        returns = numbers[0] in following[numbers[-1]]
        if closed and not returns:
            raise ConfigurationError(f"edge {numbers[0]} cannot follow edge {numbers[-1]}")
        lines = [oriented_line(network, number) for number in numbers]
        return cls.of_lines(network, numbers, lines, returns if closed is None else closed)

    @classmethod
    def of_lines(
        cls,
        network: PathNetwork,
        numbers: Sequence[int],
        lines: Sequence[FloatArray],
        closed: bool,
        stops: bool = False,
    ) -> "Itinerary":
        """Joins edges whose polylines may be cut at the start and the end.

        Args:
            network: The network.
            numbers: The edges, from 1, negative from their end to their start.
            lines: What is travelled of each, in the direction of travel.
            closed: Whether the last ends where the first starts.
            stops: Whether the last is cut.
        """
        ends = np.cumsum([arc_lengths(line)[-1] for line in lines])
        vertices = np.concatenate([lines[0], *(line[1:] for line in lines[1:])])
        line = Piece(vertices[:-1] if closed else vertices, closed)
        nodes = [end_node(network, number) for number in numbers]
        if stops:
            nodes[-1] = None
        starts = np.concatenate([[0.0], ends[:-1]])
        return cls(network, tuple(numbers), closed, line, starts, tuple(nodes))

    @property
    def length(self) -> float:
        """Its length, of one lap if it is closed."""
        return self.line.length

    def edge_at(self, arc: ArrayLike) -> IntArray:
        """Returns the place in `edges` (n,) of the edge at arc lengths (n,); laps count on."""
        arc = np.asarray(arc, dtype=np.float64)
        on_lap = arc % self.length if self.closed else arc
        return np.maximum(np.searchsorted(self.starts, on_lap, side="right") - 1, 0)


def successors(network: PathNetwork) -> dict[int, list[int]]:
    """The edges that can follow each edge, for every direction that it can be travelled in.

    A one-way path is travelled forwards along its route.  Elsewhere every other arm of a node
    can follow; only at an end an edge is followed by itself, the other way round.
    """
    following: dict[int, list[int]] = {}
    departures: dict[int, list[int]] = defaultdict(list)
    for route in network.routes:
        if network.is_one_way(route.piece):
            numbers = [edge + 1 for edge in route.edges]
            following |= {number: [after] for number, after in itertools.pairwise(numbers)}
            following[numbers[-1]] = numbers[:1] if route.closed else []
    two_way = [
        sign * (k + 1)
        for k, edge in enumerate(network.edges)
        if not network.is_one_way(edge.piece)
        for sign in (1, -1)
    ]
    for number in two_way:
        departures[_node(end_node(network, -number))].append(number)
    for number in two_way:
        arms = departures[_node(end_node(network, number))]
        following[number] = [after for after in arms if after != -number or len(arms) == 1]
    return following


def end_node(network: PathNetwork, number: int) -> int | None:
    """The node that an edge, negative if reversed, leads into; None for a plain loop."""
    nodes = network.edges[abs(number) - 1].nodes
    return None if nodes is None else nodes[number > 0]


def oriented_line(network: PathNetwork, number: int) -> FloatArray:
    """The polyline (n, d) of a whole edge, in the direction of travel."""
    edge = network.edges[abs(number) - 1]
    vertices = edge.line.vertices
    if edge.nodes is None:
        vertices = np.concatenate([vertices, vertices[:1]])
    return vertices if number > 0 else vertices[::-1]


def between(line: FloatArray, begin: float, end: float) -> FloatArray:
    """The part of a polyline from one arc length to a larger one."""
    arc = arc_lengths(line)
    inner = line[(arc > begin) & (arc < end)]
    first, last = points_at(line, np.array([begin, end]))
    return np.concatenate([[first], inner, [last]])


def _node(node: int | None) -> int:
    """The edges of a two-way piece have nodes."""
    assert node is not None
    return node


def _check(
    numbers: Sequence[int], network: PathNetwork, following: dict[int, list[int]]
) -> None:
    """Refuses edges that cannot be travelled one after the other."""
    if not numbers:
        raise ConfigurationError("an itinerary needs at least one edge")
    for number in numbers:
        if not 1 <= abs(number) <= len(network.edges):
            raise ConfigurationError(
                f"there is no edge {number} (there are 1 to {len(network.edges)})"
            )
        if number not in following:
            raise ConfigurationError(
                f"edge {-number} is one-way and cannot be travelled as {number}"
            )
    for number, after in itertools.pairwise(numbers):
        if after not in following[number]:
            raise ConfigurationError(_why_not(number, after, network))


def _why_not(number: int, after: int, network: PathNetwork) -> str:
    node = end_node(network, number)
    if node is None or node != end_node(network, -after):
        return f"edges {number} and {after} do not meet"
    if after == -number:
        return f"edge {number} cannot turn round at node {node + 1}, which is no end"
    return f"edge {after} does not follow edge {number} on their one-way path"
