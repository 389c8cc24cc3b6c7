"""Which way a field runs along a path: where it turns around, into sources and sinks.

On a closed path that is followed all the way around, the arrows of the field point one way.
Where they change to the other way, two arrows part (a source) or meet (a sink), and nobody
passes: this is the failure that the directional consistency loss is to prevent.
"""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.metrics import SETTLE_DISTANCE
from sgvf_drake.paths import Piece, ReferencePath

STEP = 0.02
"""Samples along a path are this many U apart, at most."""

SHORTEST = SETTLE_DISTANCE
"""A stretch that runs against its surroundings counts from this many U on.  Shorter ones are
the way in which a corner is cut, by no more than an agent on the path may be off it."""


@dataclass(frozen=True, eq=False)
class PathSamples:
    """Points on a path at equal steps of arc length, and which way it runs there.

    Attributes:
        points: (n, d), piece by piece.
        tangents: (n, d) unit vectors along increasing arc length; at a corner, between those
            of its sides.
        pieces: (n,) the piece of each.
        steps: (P,) arc length between neighbours on each piece.
        closed: (P,) whether each piece is closed.
    """

    points: FloatArray
    tangents: FloatArray
    pieces: IntArray
    steps: FloatArray
    closed: BoolArray


@dataclass(frozen=True, eq=False)
class PieceDirection:
    """Which way a field runs along one piece.

    Attributes:
        sources: (k, d) where the arrows part.
        sinks: (l, d) where they meet.
        against: Share of the length on which they point against the longer part of it.
    """

    sources: FloatArray
    sinks: FloatArray
    against: float

    @property
    def has_conflict(self) -> bool:
        """Whether the piece is not run through one way."""
        return len(self.sources) + len(self.sinks) > 0


def sample_path(reference: ReferencePath, unit_length: float) -> PathSamples:
    """Returns samples of a path `STEP` U apart.

    Args:
        reference: The path.
        unit_length: U.
    """
    points, tangents, counts, steps = [], [], [], []
    for piece in reference.pieces:
        parts = int(np.ceil(piece.length / (STEP * unit_length)))
        step = piece.length / parts
        arc: FloatArray = step * np.arange(parts + (not piece.closed), dtype=np.float64)
        points.append(piece.at(arc))
        tangents.append(_tangents(piece, arc, step))
        counts.append(len(arc))
        steps.append(step)
    return PathSamples(
        points=np.concatenate(points),
        tangents=np.concatenate(tangents),
        pieces=np.repeat(np.arange(len(counts)), counts),
        steps=np.array(steps),
        closed=reference.closed,
    )


def _tangents(piece: Piece, arc: FloatArray, step: float) -> FloatArray:
    """Returns the directions of chords of one step about points of a piece."""

    def at(arc: FloatArray) -> FloatArray:
        inside = arc % piece.length if piece.closed else np.clip(arc, 0, piece.length)
        return piece.at(np.asarray(inside, dtype=np.float64))

    chords = at(arc + step / 2) - at(arc - step / 2)
    return chords / np.linalg.norm(chords, axis=1, keepdims=True)


def directions(
    samples: PathSamples, vectors: FloatArray, unit_length: float
) -> list[PieceDirection]:
    """Returns which way a field runs along each piece.

    Stretches shorter than `SHORTEST` count as their surroundings.

    Args:
        samples: The path.
        vectors: (n, d) the field at the samples.
        unit_length: U.
    """
    along = (vectors * samples.tangents).sum(axis=1)
    found = []
    for piece, (step, closed) in enumerate(zip(samples.steps, samples.closed, strict=True)):
        here = samples.pieces == piece
        shortest = int(np.ceil(SHORTEST * unit_length / step))
        forward = _without_short_stretches(along[here] >= 0, bool(closed), shortest)
        found.append(_direction(samples.points[here], forward, bool(closed)))
    return found


def _without_short_stretches(forward: BoolArray, closed: bool, shortest: int) -> BoolArray:
    """Turns stretches of fewer samples than `shortest` around, the shortest first."""
    forward = forward.copy()
    while True:
        starts = _turns(forward, closed)
        if not len(starts):
            return forward
        if closed:
            ends = np.append(starts[1:], starts[0] + len(forward))
        else:
            starts, ends = np.append(0, starts), np.append(starts, len(forward))
        shortest_one = int(np.argmin(ends - starts))
        if ends[shortest_one] - starts[shortest_one] >= shortest:
            return forward
        stretch = np.arange(starts[shortest_one], ends[shortest_one]) % len(forward)
        forward[stretch] = ~forward[stretch]


def _direction(points: FloatArray, forward: BoolArray, closed: bool) -> PieceDirection:
    turns = _turns(forward, closed)
    # Index -1 is the last sample: on a closed piece, the one before the first.
    places = (points[turns - 1] + points[turns]) / 2
    share = float(forward.mean())
    return PieceDirection(
        sources=places[forward[turns]],
        sinks=places[~forward[turns]],
        against=min(share, 1 - share),
    )


def _turns(forward: BoolArray, closed: bool) -> IntArray:
    """Returns the samples that run the other way than the one before, in order."""
    before = np.roll(forward, 1)
    if not closed:
        before[0] = forward[0]
    return np.flatnonzero(forward != before)
