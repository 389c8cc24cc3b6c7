"""Cuts an itinerary into sections, each with one intended direction and a guard at its end.

On a network a field follows an edge in the direction of an intended direction g.  For a
constant g that is a field without memory, and T.g of the line's tangent T keeps its sign over
less than 90 degrees of bend.  So an itinerary is a finite automaton.
"""

from dataclasses import dataclass, replace
import itertools
import math

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths.itinerary import Itinerary

KAPPA = 4.0
"""How sharply a field of edges that are travelled either way tells those along g."""

BEND = math.radians(45)
"""The tangent is not farther from the intended direction, between nodes."""

TURN = math.radians(40)
"""A node is turned at if the line bends there by more; else it is passed straight on, as the
crossings of a network are."""

EXIT = 3.5
"""The direction behind a node is that of the chord over this many sigma."""

MARGIN = 0.88
"""The exit is intended from this share of the distance at which it takes over."""

END = 1.5
"""An end, and a target, is reached this many sigma before it: agents rest before an end."""

STEP = 0.25
"""Bends are looked at this many sigma apart, on chords of one sigma."""


@dataclass(frozen=True, eq=False)
class Section:
    """A part of an itinerary with one intended direction, on one edge.

    Attributes:
        begin: The arc length at which it begins.
        end: The arc length of its guard, where the next section begins.
        direction: (d,) the intended direction, a unit vector.
        edge: The number of its edge, negative if reversed.
        node: The node that it leads into; None if it ends on the edge.
        turns: Whether it is part of a turn: from some way before a node at which the line
            turns by more than 40 degrees to some way behind it.
    """

    begin: float
    end: float
    direction: FloatArray
    edge: int
    node: int | None
    turns: bool


@dataclass(frozen=True)
class Passage:
    """How a node is passed, in the unit of the network.

    Attributes:
        direction: That of the exit.
        turns: Whether it is turned at.
        lead: How far before the node the exit is the intended direction.
        out: How far behind it.
    """

    direction: FloatArray
    turns: bool
    lead: float
    out: float


@dataclass(frozen=True)
class Bend:
    """How far before a sharp bend, or a node, the direction behind it is the intended one.

    Attributes:
        sigma: The scale of the field, in the unit of the network.
        kappa: That of the field.
        lag: As of `sections`.
    """

    sigma: float
    kappa: float
    lag: float

    def lead(self, straight: float) -> float:
        """Returns the distance for a turn of this cosine.

        The lag is part of it, but less the more the exit leads back: there, an agent whose
        heading has turned too early is led back along the edge that it came by.
        """
        lag = self.lag * min(1.0, 1.0 + straight)
        return MARGIN * _takeover(straight, self.kappa) * self.sigma + lag


def sections(
    itinerary: Itinerary, sigma: float, kappa: float = KAPPA, lag: float | None = None
) -> tuple[Section, ...]:
    """Cuts an itinerary into sections.

    About a node g is the direction of the exit.  Between nodes it is that of the chords of
    bends.  The last guard of an open itinerary lies before its end, as where agents turn round.

    Args:
        itinerary: The itinerary.
        sigma: The scale of the field, in the unit of the itinerary.
        kappa: That of the field.
        lag: The distance after which an agent's heading has followed g; sigma by default, for
            a heading that is remembered as long, and 0 where g itself is the heading.

    Raises:
        ConfigurationError: If sigma or kappa is not positive, or the lag negative.
    """
    lag = sigma if lag is None else lag
    if not 0 <= lag < math.inf:
        raise ConfigurationError(f"the lag must be finite and not negative, not {lag}")
    for name, value in (("sigma", sigma), ("kappa", kappa)):
        if not 0 < value < math.inf:
            raise ConfigurationError(f"{name} must be positive and finite, not {value}")
    ends = np.append(itinerary.starts[1:], itinerary.length)
    bend = Bend(sigma, kappa, lag)
    passages = [passage(itinerary, k, bend) for k in range(len(ends))]
    found: list[Section] = []
    for k, (begin, end) in enumerate(zip(itinerary.starts, ends, strict=True)):
        before = passages[k - 1] if k or itinerary.closed else None
        found += _on_edge(itinerary, k, (float(begin), float(end)), before, passages[k], bend)
    if not itinerary.closed:
        found = _stopped(found, max(itinerary.length - END * sigma, itinerary.length / 2))
    return tuple(found)


def is_end(itinerary: Itinerary, node: int | None) -> bool:
    """Whether a node is an end of a path, where agents come to rest."""
    return node is not None and itinerary.network.nodes[node].degree == 1


def _on_edge(
    itinerary: Itinerary,
    k: int,
    span: tuple[float, float],
    before: Passage | None,
    after: Passage | None,
    bend: Bend,
) -> list[Section]:
    """The sections of an edge: behind one node, between the two, and before the other."""
    sigma = bend.sigma
    begin, end = span
    out, lead = (before.out if before else 0.0), (after.lead if after else 0.0)
    # A short edge is shared by its two nodes.
    scale = min(1.0, (end - begin) / (out + lead)) if out + lead else 1.0
    left, right = begin + scale * out, end - scale * lead
    edge, node = itinerary.edges[k], itinerary.nodes[k]
    found = []
    if before is not None:
        found.append(Section(begin, left, before.direction, edge, None, before.turns))
    if right - left > 1e-9 * sigma:
        for chord, a, b in between_nodes(itinerary, (left, right), span, bend):
            found.append(Section(a, b, chord, edge, node if b == end else None, False))
    if after is not None:
        found.append(Section(right, end, after.direction, edge, node, after.turns))
    return found


def between_nodes(
    itinerary: Itinerary, zone: tuple[float, float], edge: tuple[float, float], bend: Bend
) -> list[tuple[FloatArray, float, float]]:
    """Cuts a part of an edge where it bends.

    Args:
        itinerary: The itinerary.
        zone: The arc lengths at which the part begins and ends.
        edge: Those of the edge.
        bend: How far ahead of sharp bends it is cut.

    Returns:
        The intended direction (d,) of each section, and where that begins and ends.
    """
    cuts = _cut_bends(itinerary, zone, edge, bend.sigma)
    chords = [_chord(itinerary, a, b) for a, b in itertools.pairwise(cuts)]
    guards = itertools.pairwise(_led(itinerary, cuts, edge, bend))
    return [(chord, *guard) for chord, guard in zip(chords, guards, strict=True)]


def passage(itinerary: Itinerary, k: int, bend: Bend) -> Passage | None:
    """Returns how the node behind the `k`-th edge is passed; None: no edge follows."""
    sigma = bend.sigma
    node, last = itinerary.nodes[k], k + 1 == len(itinerary.edges)
    if node is None or (last and not itinerary.closed):
        return None
    ends = np.append(itinerary.starts, itinerary.length)
    at, lengths = ends[k + 1], np.diff(ends)
    out = min(EXIT * sigma, lengths[(k + 1) % len(lengths)])
    into = _chord(itinerary, at - min(EXIT * sigma, lengths[k]), at)
    # A closed itinerary goes on at 0.
    exit_at = 0.0 if last else at
    direction = _chord(itinerary, exit_at, exit_at + out)
    straight = float(into @ direction)
    turns = straight < math.cos(TURN)
    lead = END * sigma if is_end(itinerary, node) else bend.lead(straight)
    return Passage(direction, turns, lead, EXIT * sigma)


def _takeover(straight: float, kappa: float) -> float:
    """How far before a node its exit attracts more than the edge that is travelled, in sigma.

    The weight of a strand is exp(-r^2 / 2) cosh(kappa T.g) at a distance of r sigma, with g
    along the exit.  Where the exit leads back at an acute angle, it is near, and the edge that
    is travelled is itself along g, the other way.

    Args:
        straight: The cosine of the turn.
        kappa: That of the field.
    """
    back = min(max(-straight, 0.0), 1 - 1e-6)
    gain = _log_cosh(kappa) - _log_cosh(kappa * back)
    return math.sqrt(2 * gain / (1 - back**2))


def _log_cosh(x: float) -> float:
    return abs(x) + math.log1p(math.exp(-2 * abs(x))) - math.log(2)


def _cut_bends(
    itinerary: Itinerary, zone: tuple[float, float], edge: tuple[float, float], sigma: float
) -> list[float]:
    """Halves a part of an edge until no tangent is farther than `BEND` from its chord."""
    s = np.linspace(*zone, math.ceil((zone[1] - zone[0]) / (STEP * sigma)) + 1)
    lower, upper = s - sigma / 2, s + sigma / 2
    if itinerary.nodes[0] is None and itinerary.closed:
        lower, upper = lower % itinerary.length, upper % itinerary.length
    else:
        lower, upper = np.maximum(lower, edge[0]), np.minimum(upper, edge[1])
    tangents = _units(itinerary.line.at(upper) - itinerary.line.at(lower))
    cosines = np.clip((tangents[1:] * tangents[:-1]).sum(axis=1), -1, 1)
    turned = np.concatenate([[0.0], np.cumsum(np.arccos(cosines))])
    points = itinerary.line.at(s)

    def halved(first: int, last: int) -> list[int]:
        """The ends of the parts between two samples; halves turn equally."""
        chord = _units(points[[last]] - points[[first]])[0]
        if last - first < 2 or (tangents[first : last + 1] @ chord).min() >= math.cos(BEND):
            return [last]
        half = int(np.searchsorted(turned, (turned[first] + turned[last]) / 2))
        half = min(max(half, first + 1), last - 1)
        return halved(first, half) + halved(half, last)

    return [zone[0], *s[halved(0, len(s) - 1)[:-1]].tolist(), zone[1]]


def _led(
    itinerary: Itinerary, cuts: list[float], edge: tuple[float, float], bend: Bend
) -> list[float]:
    """The guards at the cuts of an edge: ahead of those at corners, as before a node."""
    guards = cuts[:1]
    for cut in cuts[1:-1]:
        into = _chord(itinerary, max(cut - EXIT * bend.sigma, edge[0]), cut)
        out = _chord(itinerary, cut, min(cut + EXIT * bend.sigma, edge[1]))
        straight = float(into @ out)
        lead = bend.lead(straight) if straight < math.cos(TURN) else 0.0
        # Half of the way from the guard before is left for the direction there.
        guards.append(max(cut - lead, (guards[-1] + cut) / 2))
    return [*guards, cuts[-1]]


def _chord(itinerary: Itinerary, begin: float, end: float) -> FloatArray:
    """The direction from one arc length to another."""
    first, last = itinerary.line.at(np.array([begin, end]))
    return _units((last - first)[None])[0]


def _units(steps: FloatArray) -> FloatArray:
    """Steps (n, d) as unit vectors; those of no length stay."""
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    return steps / np.where(length > 0, length, 1.0)


def _stopped(found: list[Section], guard: float) -> list[Section]:
    """The sections up to a last guard, behind which nothing is left to be done."""
    kept = [section for section in found if section.begin < guard]
    kept[-1] = replace(kept[-1], end=guard, node=found[-1].node)
    return kept
