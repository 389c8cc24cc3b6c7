"""Which edges of a network agents ran along, which way, and what they did at the nodes.

An edge counts as run along when its middle was passed: through a gate across it, as wide as
no other strand is near.  Where an edge turns about at its middle, as at a tip, robots cut it
short, and the gate stands beside.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
import itertools
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import FloatArray
from sgvf_drake.metrics import SETTLE_DISTANCE
from sgvf_drake.paths import PathNetwork, Piece, ReferencePath
from sgvf_drake.paths.itinerary import Itinerary, end_node

SAMPLING = 0.02
"""Distance of the points of an edge at which other strands are looked for, in U."""

TANGENT = 0.05
"""Half the chord that gives the direction at the middle of an edge, in U."""

MIDDLES = (1 / 2, 3 / 8, 5 / 8)
"""Where the gate may stand, in shares of the edge."""

STRAIGHT = 0.9
"""The chord of an edge over its length, as wide as a gate on both sides, where it goes on."""

AWAY = 3.0
"""What is farther along an edge than this many times its distance is another strand."""


class Passage(NamedTuple):
    """The middle of an edge that was passed.

    Attributes:
        sample: The last sample before it.
        edge: The number of the edge, from 1; negative if it was run along backwards.
    """

    sample: int
    edge: int


@dataclass(frozen=True, eq=False)
class _Gate:
    """A disc across an edge at its middle."""

    place: FloatArray
    direction: FloatArray
    radius: float


def passages(positions: FloatArray, network: PathNetwork) -> list[list[Passage]]:
    """Returns the passages of each agent, in time.

    Args:
        positions: (T, n, d), in the unit of the network.
        network: The network.
    """
    found: list[list[Passage]] = [[] for _ in range(positions.shape[1])]
    for number, gate in enumerate(_gates(network), start=1):
        along = (positions - gate.place) @ gate.direction
        before, after = along[:-1], along[1:]
        sample, agent = np.nonzero((before < 0) != (after < 0))
        a, b = before[sample, agent], after[sample, agent]
        share = (a / (a - b))[:, None]
        start, end = positions[sample, agent], positions[sample + 1, agent]
        through = start + share * (end - start)
        near = np.linalg.norm(through - gate.place, axis=1) <= gate.radius
        passed: dict[int, list[Passage]] = defaultdict(list)
        for k in np.flatnonzero(near):
            edge = number if a[k] < 0 else -number
            own = passed[agent[k]]
            if own and not _left(positions[own[-1].sample : sample[k] + 1, agent[k]], gate):
                # To and fro on the spot.
                own.pop()
            else:
                own.append(Passage(int(sample[k]), edge))
        for agent_number, own in passed.items():
            found[agent_number] += own
    return [sorted(own) for own in found]


def straight_on(network: PathNetwork) -> dict[int, int]:
    """The edge straight ahead of each that leads into a crossing, both ways."""
    ahead = {}
    for route in network.routes:
        numbers = [edge + 1 for edge in route.edges]
        pairs = itertools.pairwise(numbers + numbers[:1] if route.closed else numbers)
        for one, other in pairs:
            ahead[one] = other
            ahead[-other] = -one
    return ahead


def straight_fraction(
    passed: Sequence[Sequence[Passage]], network: PathNetwork
) -> float | None:
    """The part of the crossings that were driven straight over; None if none was passed."""
    ahead = straight_on(network)
    crossings = {k for k, node in enumerate(network.nodes) if node.kind == "crossing"}
    done = [
        after.edge == ahead.get(before.edge)
        for own in passed
        for before, after in itertools.pairwise(own)
        if end_node(network, before.edge) in crossings
    ]
    return sum(done) / len(done) if done else None


def turn_fraction(passed: Sequence[Sequence[Passage]], itinerary: Itinerary) -> float | None:
    """The part of the nodes of an itinerary that were left as it says; None if none was passed.

    An agent follows it from the first of its edges on that it runs along.  Where it has that
    edge several times, the agent came to the one from which on it follows best.
    """
    numbers = itinerary.edges
    following = list(itertools.pairwise(numbers + numbers[:1] if itinerary.closed else numbers))
    done: list[bool] = []
    for own in passed:
        edges = [passage.edge for passage in own]
        turns = [_turns(edges, following, first) for first in range(len(following))]
        done += max(turns, key=sum, default=[])
    return sum(done) / len(done) if done else None


def runs_along(passed: Sequence[Passage], itinerary: Itinerary) -> bool:
    """Whether an agent passed the edges of an itinerary in order.

    An open one may begin and end on the way, so that its first and its last edge need not be
    passed.
    """
    wanted = itinerary.edges if itinerary.closed else itinerary.edges[1:-1]
    left = iter(passage.edge for passage in passed)
    return all(any(edge == own for own in left) for edge in wanted)


def errors_in_use(
    positions: FloatArray, passed: Sequence[Passage], network: PathNetwork
) -> FloatArray:
    """Returns the distances (T,) of an agent from the edges that it runs along.

    Between two passages these are the two edges; before the first and after the last one, where
    it is not known which edge the agent is on, the distance is that from the network.

    Args:
        positions: (T, d).
        passed: Its passages.
        network: The network.
    """
    errors = network.path.project(positions).distance
    for before, after in itertools.pairwise(passed):
        samples = slice(before.sample, after.sample + 1)
        lines = [network.edges[abs(e) - 1].line for e in {before.edge, after.edge}]
        distance = ReferencePath(tuple(lines)).project(positions[samples]).distance
        errors[samples] = distance
    return errors


def _left(positions: FloatArray, gate: _Gate) -> bool:
    """Whether an agent (T, d) went away from a gate, farther than it is wide."""
    return bool((np.linalg.norm(positions - gate.place, axis=1) > gate.radius).any())


def _turns(
    edges: Sequence[int], following: Sequence[tuple[int, int]], first: int
) -> list[bool]:
    """Whether edges that an agent ran along were left as an itinerary says, from a place on."""
    done = []
    for edge, after in itertools.pairwise(edges):
        places = [k % len(following) for k in range(first, first + len(following))]
        place = next((k for k in places if following[k][0] == edge), None)
        if place is not None:
            done.append(after == following[place][1])
            first = place + 1
    return done


def _middle(line: Piece, width: float) -> float:
    """The arc length of the gate of an edge: in its middle, if it goes on there."""
    half = min(width, line.length / 4)
    places = [share * line.length for share in MIDDLES]
    for middle in places:
        before, after = line.at(middle + half * np.array([-1.0, 1.0]))
        if np.linalg.norm(after - before) > STRAIGHT * 2 * half:
            return middle
    return places[0]


def _gates(network: PathNetwork) -> list[_Gate]:
    unit = network.unit_length
    arcs = [
        np.linspace(0, edge.length, 2 + round(edge.length / (SAMPLING * unit)))
        for edge in network.edges
    ]
    points = [edge.line.at(arc) for edge, arc in zip(network.edges, arcs, strict=True)]
    tree = cKDTree(np.concatenate(points))
    number = np.repeat(np.arange(len(arcs)), list(map(len, arcs)))
    arc = np.concatenate(arcs)
    gates = []
    for k, edge in enumerate(network.edges):
        middle = _middle(edge.line, SETTLE_DISTANCE * unit)
        reach = min(TANGENT * unit, edge.length / 2)
        ends = edge.line.at(middle + reach * np.array([-1.0, 0.0, 1.0]))
        chord = ends[2] - ends[0]
        near = np.array(tree.query_ball_point(ends[1], 2 * SETTLE_DISTANCE * unit))
        distance = np.linalg.norm(tree.data[near] - ends[1], axis=1)
        own = number[near] == k
        other = ~own | (np.abs(arc[near] - middle) > AWAY * distance + SAMPLING * unit)
        radius = min(SETTLE_DISTANCE * unit, distance[other].min(initial=np.inf) / 2)
        gates.append(_Gate(ends[1], chord / np.linalg.norm(chord), float(radius)))
    return gates
