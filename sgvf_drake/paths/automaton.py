"""A network as one automaton: each edge and each turn is cut once, for all routes.

`sections` cuts one itinerary, and what it makes of an edge depends, by a little, on the edges
before and behind.  Here every edge is cut by itself, for each direction of travel: from a place
where all turns into it end, to one before which none out of it begins.  So a route is made of
parts that other routes share.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.paths.itinerary import Itinerary, between, oriented_line, successors
from sgvf_drake.paths.network import PathNetwork
from sgvf_drake.paths.polyline import arc_lengths, points_at
from sgvf_drake.paths.sections import END, EXIT, KAPPA, Bend, Passage, between_nodes, passage

BESIDE = 1.0
"""The last guard of an edge lies so many sigma before the first place where a turn begins, and
the first one as many behind the place where, on an itinerary, turns end."""


@dataclass(frozen=True, eq=False)
class EdgeCut:
    """An edge in one direction of travel, with the sections between its nodes.

    Attributes:
        number: That of the edge, from 1; negative if it is travelled from its end to its start.
        line: (M, d) its polyline in the direction of travel, in the unit of the network.
        closed: Whether it is a loop without a node.
        guards: (n + 1,) arc lengths: n sections lie between them.
        directions: (n, d) the intended direction in each section.
        entry: (d,) the intended direction from a turn into this edge on, to its first guard.
    """

    number: int
    line: FloatArray
    closed: bool
    guards: FloatArray
    directions: FloatArray
    entry: FloatArray

    @property
    def last(self) -> FloatArray:
        """The intended direction (d,) before its last guard."""
        return self.directions[-1] if len(self.directions) else self.entry

    def keeping(self, guards: Sequence[int]) -> "EdgeCut":
        """Returns the cut with some of its guards; see `Automaton.keeping`."""
        kept = np.array(guards)
        return replace(self, guards=self.guards[kept], directions=self.directions[kept[1:] - 1])

    def at(self, arc: float) -> FloatArray:
        """Returns the point (d,) at an arc length; before its start is its start, or a lap."""
        arc = arc % arc_lengths(self.line)[-1] if self.closed else max(arc, 0.0)
        return points_at(self.line, np.array([arc]))[0]


@dataclass(frozen=True, eq=False)
class Automaton:
    """All that a robot can do on a network.

    Attributes:
        edges: The cut of each edge that can be travelled, by its number.
        turns: By an edge and one that can follow it, the arc length on the first from which on
            the direction of the exit is intended.
    """

    edges: Mapping[int, EdgeCut]
    turns: Mapping[tuple[int, int], float]

    @classmethod
    def of(cls, network: PathNetwork, sigma: float, kappa: float = KAPPA) -> "Automaton":
        """Cuts a network as `sections` with a lag of zero does.

        Args:
            network: The network.
            sigma: The scale of the field, in the unit of the network.
            kappa: That of the field.
        """
        bend, following = Bend(sigma, kappa, lag=0.0), successors(network)
        edges: dict[int, EdgeCut] = {}
        turns: dict[tuple[int, int], float] = {}
        for number, numbers in following.items():
            if network.edges[abs(number) - 1].nodes is None:
                edges[number], turns[number, number] = _loop(network, number, bend)
                continue
            ways = {after: _way(network, number, after, bend) for after in numbers}
            edges[number], scale = _cut(network, number, ways, bend)
            length = arc_lengths(edges[number].line)[-1]
            turns |= {(number, after): length - scale * way.lead for after, way in ways.items()}
        return cls(edges, turns)

    def keeping(self, guards: Mapping[int, Sequence[int]]) -> "Automaton":
        """Returns the automaton in which some guards of edges are left out.

        Before each guard the direction that was intended there is the intended one, from the
        last guard that is kept on.

        Args:
            guards: The places of the guards that are kept, by the edge, from 0; the first and
                the last among them.
        """
        return Automaton(
            {number: cut.keeping(guards[number]) for number, cut in self.edges.items()},
            self.turns,
        )

    def line_of(self, before: int, after: int | None, index: int | None) -> FloatArray:
        """Returns what is travelled of a section, of a turn, or to an end, (M, d).

        Args:
            before: The edge.
            after: The edge into which it is left by a turn; None: it is followed to its end.
            index: The section; None: what lies behind the last guard.
        """
        cut = self.edges[before]
        begin = cut.guards[-1 if index is None else index]
        end = arc_lengths(cut.line)[-1] if index is None else cut.guards[index + 1]
        line = between(cut.line, begin, end)
        if index is not None or after is None:
            return line
        ahead = self.edges[after]
        # A loop without a node is left into its start.
        rest = between(ahead.line, 0.0, ahead.guards[0]) if ahead.guards[0] else line[:0]
        return np.concatenate([line, rest[1:]])


def _way(network: PathNetwork, number: int, after: int, bend: Bend) -> Passage:
    """Returns how the node between two edges is passed."""
    way = passage(Itinerary.along([number, after], network, closed=False), 0, bend)
    assert way is not None
    return way


def _cut(
    network: PathNetwork, number: int, ways: Mapping[int, Passage], bend: Bend
) -> tuple[EdgeCut, float]:
    """Returns the cut of an edge, and by how much it scales what its nodes take of it."""
    line = oriented_line(network, number)
    length = float(arc_lengths(line)[-1])
    lead = max((way.lead for way in ways.values()), default=END * bend.sigma)
    lead += BESIDE * bend.sigma
    out = (EXIT + BESIDE) * bend.sigma
    scale = min(1.0, length / (out + lead))
    left, right = scale * out, length - scale * lead
    alone = Itinerary.along([number], network, closed=False)
    parts = []
    if right - left > 1e-9 * bend.sigma:
        parts = between_nodes(alone, (left, right), (0.0, length), bend)
    step = points_at(line, np.array([min(EXIT * bend.sigma, length)]))[0] - line[0]
    cut = EdgeCut(
        number,
        line,
        closed=False,
        guards=np.array([left, *(end for _, _, end in parts)]),
        directions=np.array([chord for chord, _, _ in parts]).reshape(-1, network.dim),
        entry=step / np.linalg.norm(step),
    )
    return cut, scale


def _loop(network: PathNetwork, number: int, bend: Bend) -> tuple[EdgeCut, float]:
    """Returns the cut of a loop without a node, and where its last section begins.

    That one leads into the first, as a turn does.
    """
    alone = Itinerary.along([number], network)
    span = (0.0, alone.length)
    *parts, (entry, last, _) = between_nodes(alone, span, span, bend)
    guards = np.array([0.0, *(end for _, _, end in parts)])
    directions = np.array([chord for chord, _, _ in parts])
    line = oriented_line(network, number)
    return EdgeCut(number, line, True, guards, directions, entry), last
