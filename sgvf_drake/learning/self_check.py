"""The first look at a trained field: can its path be followed, and if not, what is wrong?"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial import cKDTree

from sgvf_drake.fields import FloatArray, GuidingField
from sgvf_drake.paths import Piece, ReferencePath

# Starts on each closed piece, evenly spread, which have to complete it; and starts around
# each piece, this many U beside it, which have to come to a path and not stop.
STARTS = 4
STARTS_AROUND = 8
AROUND = 0.8
# A run has time for this many lengths of its piece, and this many U for the way in.
LENGTHS = 1.5
WAY_IN = 3.0
# |m| below this on the path is a stall, and gets no more time.
SLOWEST = 0.1
# A place counts as passed within this many U, or one noise level where that is more: wide
# enough for a tip that is cut, too narrow for a strand that is skipped.
PASS_DISTANCE = 0.5
# At rest: the last part of a run (in U of time at full speed) spans less than this.
REST_TIME = 2.0
REST_SPAN = 0.15
# Rest is right within this many U of an end.
END_DISTANCE = 0.1
# A stretch of the path on which the field runs against the rest of it is a fault from this
# length on (in U); shorter ones are the way a corner is turned.
SPLIT_LENGTH = 0.5
# Places on a piece that are looked at, in one U of its length, and the fewest of them.
PLACES_PER_UNIT, FEWEST_PLACES = 10, 16
# Samples of a run in one U, and the tolerance of its integration in U.
SAMPLES_PER_UNIT = 10
TOLERANCE = 1e-3


@dataclass(frozen=True)
class Fault:
    """Something that keeps a robot from following a piece.

    Attributes:
        kind: `stall` (it stops where the path goes on), `split` (a stretch of the path runs
            against the rest, between a source and a sink), `skip` (a part of the piece is
            not visited), `turn` (without a route it turns off where a path goes straight over
            a crossing) or `leave` (it does not come to a path, or leaves it).
        point: Where, (d,) in the user's unit.
    """

    kind: str
    point: tuple[float, ...]

    def __str__(self) -> str:
        place = ", ".join(f"{coordinate:.3g}" for coordinate in self.point)
        return f"{self.kind} at ({place})"


@dataclass(frozen=True)
class PieceCheck:
    """What following one piece showed.

    Attributes:
        length: Length of the piece in the user's unit.
        closed: Whether it is closed.
        starts: Number of runs, on the piece and around it.
        completed: Runs on the piece that passed all of it, and runs around it that came to
            a path and went on.
        faults: What was found wrong, one of a kind and place.
    """

    length: float
    closed: bool
    starts: int
    completed: int
    faults: tuple[Fault, ...]


@dataclass(frozen=True)
class SelfCheck:
    """Whether every piece could be followed.

    Attributes:
        pieces: One entry a piece, the longest first.
    """

    pieces: tuple[PieceCheck, ...]

    @property
    def passed(self) -> bool:
        """Whether no piece has a fault."""
        return not any(piece.faults for piece in self.pieces)

    @property
    def message(self) -> str:
        """One line that says what was found."""
        if self.passed:
            return f"{len(self.pieces)} of {len(self.pieces)} pieces followed to the end"
        return "; ".join(
            f"piece {number} (length {piece.length:.3g}): "
            f"{piece.completed} of {piece.starts} runs completed, "
            + ", ".join(map(str, piece.faults))
            for number, piece in enumerate(self.pieces, start=1)
            if piece.faults
        )

    def to_json(self) -> dict[str, Any]:
        """Returns the check as plain JSON values."""
        return {"passed": self.passed, "message": self.message, **asdict(self)}


def check_field(field: GuidingField, path: ReferencePath | None = None) -> SelfCheck:
    """Follows the field from every piece of its path and from around it.

    Args:
        field: The field.
        path: The path, normalised units; None: that of the field's network.
    """
    if path is None:
        cloud, lines = field.cloud, field.network.path.pieces
        path = ReferencePath(
            tuple(Piece(cloud.normalize(line.vertices), line.closed) for line in lines)
        )
    checker = _Checker(field, path)
    return SelfCheck(tuple(checker.check(piece) for piece in path.pieces))


class _Checker:
    """One field and its path, in normalised units."""

    def __init__(self, field: GuidingField, path: ReferencePath) -> None:
        self._field = field
        self._path = path
        self._ends = field.cloud.normalize(field.ends)
        self._reach = max(PASS_DISTANCE, field.sigma)

    def check(self, piece: Piece) -> PieceCheck:
        on, around = self._starts(piece)
        slowness = float((1 / np.maximum(self._speeds(piece), SLOWEST)).mean())
        duration = (LENGTHS * piece.length + WAY_IN) * slowness
        runs = _follow(self._field, np.concatenate([on, around]), duration)
        found = [
            self._fault(runs[:, run], piece if run < len(on) else None, slowness)
            for run in range(runs.shape[1])
        ]
        faults = [fault for fault in found if fault is not None] + self._splits(piece)
        return PieceCheck(
            length=piece.length * self._field.cloud.unit_length,
            closed=piece.closed,
            starts=len(found),
            completed=sum(fault is None for fault in found),
            faults=self._distinct(faults),
        )

    def _starts(self, piece: Piece) -> tuple[FloatArray, FloatArray]:
        """Returns starts on the piece and around it; an open one is entered at its start."""
        count = STARTS if piece.closed else 1
        on = self._evenly(piece, count)
        beside = self._evenly(piece, STARTS_AROUND)
        # All around, by a fixed sequence: no chance in what is found.
        directions = np.random.default_rng(0).normal(size=beside.shape)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return on, beside + AROUND * directions

    def _evenly(self, piece: Piece, count: int) -> FloatArray:
        return piece.at(np.linspace(0, piece.length, count, endpoint=False))

    def _places(self, piece: Piece) -> FloatArray:
        return piece.sample(max(FEWEST_PLACES, round(PLACES_PER_UNIT * piece.length)))

    def _speeds(self, piece: Piece) -> FloatArray:
        places = self._field.cloud.denormalize(self._places(piece))
        return np.asarray(np.linalg.norm(self._field(places), axis=1))

    def _fault(self, run: FloatArray, piece: Piece | None, slowness: float) -> Fault | None:
        """What is wrong with a run (T, d) that is to complete a piece, or None."""
        last = run[-1]
        resting = run[-round(REST_TIME * slowness * SAMPLES_PER_UNIT) :]
        if (
            not np.isfinite(run).all()
            or self._path.project(last[None]).distance[0] > self._reach
        ):
            return self._at("leave", last)
        at_rest = np.linalg.norm(np.ptp(resting, axis=0)) < REST_SPAN
        if (
            at_rest
            and np.linalg.norm(self._ends - last, axis=1).min(initial=np.inf) > END_DISTANCE
        ):
            return self._at("stall", last)
        if piece is None:
            return None
        places = self._places(piece)
        missed = cKDTree(run).query(places)[0]
        if missed.max() > self._reach:
            return self._at("skip", places[missed.argmax()])
        return None

    def _splits(self, piece: Piece) -> list[Fault]:
        """Stretches on which the field runs against most of the piece, by their middles."""
        line = self._places(piece)
        chords = np.roll(line, -1, axis=0) - np.roll(line, 1, axis=0)
        m = self._field(self._field.cloud.denormalize(line))
        along = np.sign((m * chords).sum(axis=1))
        if not piece.closed:
            along[[0, -1]] = along[[1, -2]]
        against = along * (1 if along.sum() >= 0 else -1) < 0
        if piece.closed:
            # A stretch through the first place is one.
            first = int(np.argmin(against))
            line, against = (np.roll(values, -first, axis=0) for values in (line, against))
        steps = np.linalg.norm(np.diff(line, axis=0, append=line[-1:]), axis=1)
        stretches = np.split(np.arange(len(line)), np.flatnonzero(np.diff(against)) + 1)
        return [
            self._at("split", line[stretch[len(stretch) // 2]])
            for stretch in stretches
            if against[stretch[0]] and steps[stretch].sum() > SPLIT_LENGTH
        ]

    def _at(self, kind: str, point: FloatArray) -> Fault:
        return Fault(kind, tuple(self._field.cloud.denormalize(point).tolist()))

    def _distinct(self, faults: Sequence[Fault]) -> tuple[Fault, ...]:
        """One fault for each kind and place; runs that end together found the same one."""
        kept: list[Fault] = []
        for fault in faults:
            near = self._reach * self._field.cloud.unit_length
            if not any(
                fault.kind == other.kind
                and np.linalg.norm(np.subtract(fault.point, other.point)) < near
                for other in kept
            ):
                kept.append(fault)
        return tuple(kept)


def _follow(field: GuidingField, starts: FloatArray, duration: float) -> FloatArray:
    """Integrates the field in normalised units; returns (T, n, d)."""
    cloud = field.cloud

    def derivative(_: float, state: FloatArray) -> FloatArray:
        return field(cloud.denormalize(state.reshape(starts.shape))).ravel()

    times = np.linspace(0, duration, 2 + int(SAMPLES_PER_UNIT * duration))
    solution = solve_ivp(
        derivative,
        (0, duration),
        starts.ravel(),
        t_eval=times,
        rtol=TOLERANCE,
        atol=TOLERANCE,
    )
    return solution.y.T.reshape(-1, *starts.shape)
