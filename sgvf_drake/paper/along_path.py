"""Measures of a field along a path: which way it runs, how long its parts are, where v leads.

On a closed path that is followed all the way around, the arrows of the field point one way.
Where they change to the other way, two arrows part (a source) or meet (a sink), and nobody
passes: this is the failure that the directional consistency loss is to prevent.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray, plane_grid
from sgvf_drake.experiments.simulation import simulate_agents
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import GuidingField, NormalisedComposition
from sgvf_drake.fields.vectors import component_along, cosine
from sgvf_drake.metrics import SETTLE_DISTANCE
from sgvf_drake.paths import Piece, ReferencePath

SPACING = 0.02
"""Samples along a path are this many U apart, at most."""

SHORTEST = SETTLE_DISTANCE
"""A stretch that runs against its surroundings counts from this many U on.  Shorter ones are
the way in which a corner is cut, by no more than an agent on the path may be off it."""

# Points along each axis of the grid over the box.
GRID_SIZE = 121
# A point is near the path within so many U, and away from it beyond so many.
NEAR, AWAY = 0.1, 1.0
# Distances from the path, on both sides, at which it is asked whether v leads along it, U.
BESIDE = (0.05, 0.1, 0.2, 0.3)
# Agents that go where v points, how far they go, and the step of their simulation, U.
AGENTS = 60
WAY = 3.0
STEP = 0.05
# k_s so small that nothing is left of the score in m = s + v.
NO_SCORE = 1e-12


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
    """

    sources: FloatArray
    sinks: FloatArray


def sample_path(reference: ReferencePath, unit_length: float) -> PathSamples:
    """Returns samples of a path that are `SPACING` U apart, where U is the unit length."""
    points, tangents, steps = [], [], []
    for piece in reference.pieces:
        parts = int(np.ceil(piece.length / (SPACING * unit_length)))
        step = piece.length / parts
        arc: FloatArray = step * np.arange(parts + (not piece.closed), dtype=np.float64)
        points.append(piece.at(arc))
        tangents.append(_tangents(piece, arc, step))
        steps.append(step)
    return PathSamples(
        points=np.concatenate(points),
        tangents=np.concatenate(tangents),
        pieces=np.repeat(np.arange(len(points)), [len(here) for here in points]),
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
    """Returns which way a field, given at n samples as (n, d), runs along each piece.

    Stretches shorter than `SHORTEST` count as their surroundings.
    """
    along = (vectors * samples.tangents).sum(axis=1)
    found = []
    for piece, (step, closed) in enumerate(zip(samples.steps, samples.closed, strict=True)):
        here = samples.pieces == piece
        shortest = int(np.ceil(SHORTEST * unit_length / step))
        forward = _without_short_stretches(along[here] >= 0, bool(closed), shortest)
        turns = _turns(forward, bool(closed))
        points = samples.points[here]
        # Index -1 is the last sample: on a closed piece, the one before the first.
        places = (points[turns - 1] + points[turns]) / 2
        found.append(PieceDirection(places[forward[turns]], places[~forward[turns]]))
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


def _turns(forward: BoolArray, closed: bool) -> IntArray:
    """Returns the samples that run the other way than the one before, in order."""
    before = np.roll(forward, 1)
    if not closed:
        before[0] = forward[0]
    return np.flatnonzero(forward != before)


def direction_row(pieces: Sequence[PieceDirection]) -> Row:
    """Sums up which way a field runs along the pieces of a path.

    Returns:
        sources: their number on a piece, the mean over pieces; conflicted: the share of
        pieces that have any source or sink.
    """
    return {
        "sources": float(np.mean([len(piece.sources) for piece in pieces])),
        "conflicted": float(np.mean([len(p.sources) + len(p.sinks) > 0 for p in pieces])),
    }


def lengths_row(field: GuidingField, reference: ReferencePath) -> Row:
    """Measures how long v and m of a planar field are, on a grid over the box.

    Returns:
        v_box_max: the longest v; m_error: the root mean square of |m| - 1; fading: mean |v|
        at the points of the grid that are `NEAR` the path, over that at those `AWAY` from it;
        leads_away: the share of the latter at which v is longer than s.
    """
    _, _, x = plane_grid(field.cloud.box, GRID_SIZE)
    s, v = field.components(x)
    length = np.linalg.norm(v, axis=1)
    leads = length > np.linalg.norm(s, axis=1)
    error = np.linalg.norm(s + v, axis=1) - 1
    distance = reference.project(x).distance / field.cloud.unit_length
    near, away = distance < NEAR, distance > AWAY
    return {
        "v_box_max": float(length.max()),
        "m_error": float(np.sqrt((error**2).mean())),
        "fading": float(length[near].mean() / length[away].mean()),
        "leads_away": float(leads[away].mean()),
    }


def drift_row(field: GuidingField, reference: ReferencePath, samples: PathSamples) -> Row:
    """Measures whether v leads along the path or off it.

    Returns:
        beside_cosine: mean |cos(s, v)| at distances `BESIDE` from the path; outward: the
        mean component of v / |v| away from the path there; drift_u: the mean distance from
        the path, U, of agents that went `WAY` where v points, from the path on.
    """
    unit = field.cloud.unit_length
    x, away = _beside(samples, unit)
    s, v = field.components(x)
    along_v = replace(field, composition=NormalisedComposition(NO_SCORE))
    chosen = np.linspace(0, len(samples.points), AGENTS, endpoint=False).astype(int)
    _, positions, _ = simulate_agents(
        along_v, samples.points[chosen], unit, way=WAY, step=STEP, log_period=STEP
    )
    return {
        "beside_cosine": float(np.abs(cosine(s, v)).mean()),
        # Along v, whose length it is divided by.
        "outward": float(component_along(v, away).mean()),
        "drift_u": float(reference.project(positions[-1]).distance.mean()) / unit,
    }


def _beside(samples: PathSamples, unit: float) -> tuple[FloatArray, FloatArray]:
    """Returns points on both sides of a planar path, and unit vectors away from it."""
    normals = samples.tangents[:, ::-1] * [1.0, -1.0]
    away = np.concatenate([side * normals for side in (-1, 1) for _ in BESIDE])
    distances = np.tile(np.repeat(BESIDE, len(normals)), 2)[:, None]
    return np.tile(samples.points, (2 * len(BESIDE), 1)) + distances * unit * away, away
