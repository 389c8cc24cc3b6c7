"""The first look at a directed field: is every edge followed, and every turn made?"""

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from scipy.integrate import solve_ivp

from sgvf_drake.arrays import BoolArray
from sgvf_drake.fields import DirectedField, FloatArray
from sgvf_drake.learning.self_check import (
    AROUND,
    LENGTHS,
    PASS_DISTANCE,
    WAY_IN,
    Fault,
    PieceCheck,
    SelfCheck,
)
from sgvf_drake.passages import straight_on
from sgvf_drake.paths import ReferencePath
from sgvf_drake.paths.itinerary import Itinerary, successors
from sgvf_drake.paths.navigator import Navigator

STARTS_AROUND = 4
"""Starts around each edge, headed by chance, which have to come to a path."""

STEP = 0.5
"""The way between two looks at where a robot is on its itinerary, in noise levels."""

TOLERANCE = 1e-3
"""The tolerance of the integration, in U."""


@dataclass(frozen=True, eq=False)
class _Run:
    """An edge and one that can follow it: from the middle of the one to that of the other.

    The first and the last edge of a path are driven whole.  A run that is not steered goes
    where its heading leads.
    """

    piece: int
    navigator: Navigator
    begin: float
    end: float
    steered: bool


def check_directed(field: DirectedField) -> SelfCheck:
    """Drives over every edge and through every turn, and in from around every edge.

    Crossings are driven straight over twice: steered, and as a robot without a route does.
    """
    network = field.network
    runs = _runs(field)
    missed = _drive(field, runs)
    strayed = _come_in(field)
    checks = []
    for piece in range(network.num_pieces):
        edges = [edge for edge in network.edges if edge.piece == piece]
        own = [
            ("skip" if run.steered else "turn", place)
            for run, place in zip(runs, missed, strict=True)
            if run.piece == piece
        ]
        own += [("leave", place) for number, place in strayed if number == piece]
        faults = [Fault(kind, tuple(p.tolist())) for kind, p in own if p is not None]
        checks.append(
            PieceCheck(
                length=sum(edge.length for edge in edges),
                closed=network.kind(piece) == "closed path",
                starts=len(own),
                completed=len(own) - len(faults),
                faults=tuple(faults),
            )
        )
    return SelfCheck(tuple(checks))


def _runs(field: DirectedField) -> list[_Run]:
    network, sigma = field.network, field.memory_length
    following = successors(network)
    entered = Counter(after for numbers in following.values() for after in numbers)
    ahead = straight_on(network)
    runs = []
    for number, numbers in following.items():
        for edges in [[number, after] for after in numbers] or [[number]]:
            itinerary = Itinerary.along(edges, network, closed=False)
            ends = np.append(itinerary.starts, itinerary.length)
            begin = ends[1] / 2 if entered[number] else 0.0
            end = ends[-2:].mean() if following[edges[-1]] else ends[-1]
            navigator = Navigator(itinerary, sigma, step=STEP * sigma)
            piece = network.edges[abs(number) - 1].piece
            run = _Run(piece, navigator, float(begin), float(end), steered=True)
            runs.append(run)
            if edges[1:] == [ahead.get(number)]:
                runs.append(replace(run, steered=False))
    return runs


def _drive(field: DirectedField, runs: list[_Run]) -> list[FloatArray | None]:
    """Where each run ended that did not come to its end; None for the others."""
    step = STEP * field.memory_length
    lines = [run.navigator.itinerary.line for run in runs]
    begins = np.array([run.begin for run in runs])
    x = np.concatenate([line.at(s) for line, s in zip(lines, begins[:, None], strict=True)])
    states = [run.navigator.at(s) for run, s in zip(runs, begins[:, None], strict=True)]
    h = np.concatenate(
        [run.navigator.direction(s) for run, s in zip(runs, states, strict=True)]
    )
    way_in = WAY_IN * field.cloud.unit_length
    left = np.array([LENGTHS * (run.end - run.begin) for run in runs]) + way_in
    running = np.arange(len(runs))
    steered = np.array([run.steered for run in runs])
    arrived = np.zeros(len(runs), bool)
    while len(running):
        target = np.concatenate([runs[k].navigator.direction(states[k]) for k in running])
        target[~steered[running]] = np.nan
        x[running], h[running] = _moved(field, x[running], h[running], target, step)
        for k in running:
            states[k] = runs[k].navigator.advance(states[k], x[k : k + 1])
            arrived[k] = (
                states[k].arc[0] >= runs[k].end or runs[k].navigator.completed(states[k])[0]
            )
        left[running] -= step
        running = running[~arrived[running] & (left[running] > 0)]
    arrived &= _on_last_edge(field, runs, x)
    return [None if done else place for done, place in zip(arrived, x, strict=True)]


def _on_last_edge(field: DirectedField, runs: list[_Run], x: FloatArray) -> BoolArray:
    """Whether no edge is nearer than the last one of a run, by more than a noise level."""
    network = field.network
    last = [network.edges[abs(run.navigator.itinerary.edges[-1]) - 1].line for run in runs]
    own = [
        ReferencePath((line,)).project(place[None]).distance[0]
        for line, place in zip(last, x, strict=True)
    ]
    return np.array(own) <= network.path.project(x).distance + field.memory_length


def _come_in(field: DirectedField) -> list[tuple[int, FloatArray | None]]:
    """The piece of each start around the edges, and where it ended, if off all paths."""
    rng = np.random.default_rng(0)
    unit = field.cloud.unit_length
    edges = field.network.edges
    beside = np.concatenate([edge.line.sample(STARTS_AROUND + 1)[1:] for edge in edges])
    away, heading = rng.normal(size=(2, *beside.shape))
    x = beside + AROUND * unit * away / np.linalg.norm(away, axis=1, keepdims=True)
    h = heading / np.linalg.norm(heading, axis=1, keepdims=True)
    x, h = _moved(field, x, h, np.full(x.shape, np.nan), WAY_IN * unit)
    off = field.network.path.project(x).distance > max(PASS_DISTANCE, field.sigma) * unit
    pieces = np.repeat([edge.piece for edge in edges], len(beside) // len(edges))
    return [
        (int(piece), place if is_off else None)
        for piece, place, is_off in zip(pieces, x, off, strict=True)
    ]


def _moved(
    field: DirectedField, x: FloatArray, h: FloatArray, target: FloatArray, way: float
) -> tuple[FloatArray, FloatArray]:
    """Places and headings some way on; headings turn to a target, or where it is NaN ahead."""
    motion, steered = field.with_memory(), np.isfinite(target)

    def derivative(_: float, y: FloatArray) -> FloatArray:
        y = y.reshape(len(x), -1)
        F = motion(y)
        turn = (target - y[:, field.dim :]) / motion.memory_length
        F[:, field.dim :][steered] = turn[steered]
        return F.ravel()

    y = np.concatenate([x, h], axis=1)
    tolerance = TOLERANCE * np.repeat([field.cloud.unit_length, 1.0], field.dim)
    solution = solve_ivp(
        derivative,
        (0, way),
        y.ravel(),
        method="RK23",
        rtol=TOLERANCE,
        atol=np.tile(tolerance, len(x)),
    )
    x, h = np.split(solution.y[:, -1].reshape(y.shape), 2, axis=1)
    return x, h
