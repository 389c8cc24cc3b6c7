"""The first look at a trained field: can its path be followed from the path itself?"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial import cKDTree

from sgvf_drake.fields import FloatArray, GuidingField
from sgvf_drake.paths import TracedPiece, trace_pieces

# Starts on each closed piece, evenly spread over its waypoints.
STARTS = 4
# A run has time for this many lengths of its piece.
LENGTHS = 1.5
# |m| below this is a stall, and gets no more time.
SLOWEST = 0.1
# A waypoint counts as passed within this many U, or one noise level where that is more.
PASS_DISTANCE = 0.3
# Pieces of fewer waypoints are stray points, not a path.
SMALLEST_PIECE = 3
# Samples of a run in one U, and the tolerance of its integration in U.
SAMPLES_PER_UNIT = 10
TOLERANCE = 1e-3


@dataclass(frozen=True)
class PieceCheck:
    """What following one piece showed.

    Attributes:
        length: Length of the piece in the user's unit.
        starts: Number of runs.
        completed: Runs that passed every waypoint of the piece.
    """

    length: float
    starts: int
    completed: int


@dataclass(frozen=True)
class SelfCheck:
    """Whether every piece could be followed, started on the path.

    Attributes:
        pieces: One entry a piece, the longest first.
    """

    pieces: tuple[PieceCheck, ...]

    @property
    def passed(self) -> bool:
        """Whether there is a piece and every run on every piece completed it."""
        return bool(self.pieces) and all(p.completed == p.starts for p in self.pieces)

    @property
    def message(self) -> str:
        """One line that says what was found."""
        if not self.pieces:
            return f"no piece has {SMALLEST_PIECE} waypoints, so there is nothing to follow"
        if self.passed:
            return f"{len(self.pieces)} of {len(self.pieces)} pieces followed to the end"
        failed = [
            f"piece {number} (length {piece.length:.3g}): "
            f"{piece.completed} of {piece.starts} runs completed it"
            for number, piece in enumerate(self.pieces, start=1)
            if piece.completed < piece.starts
        ]
        return "; ".join(failed)

    def to_json(self) -> dict[str, Any]:
        """Returns the check as plain JSON values."""
        return {"passed": self.passed, "message": self.message, **asdict(self)}


def check_field(field: GuidingField) -> SelfCheck:
    """Follows the field along every piece of its cloud, started on the piece."""
    points = field.cloud.normalize(field.cloud.points)
    pieces = [p for p in trace_pieces(points) if len(p.indices) >= SMALLEST_PIECE]
    return SelfCheck(tuple(_check_piece(field, points, piece) for piece in pieces))


def _check_piece(field: GuidingField, points: FloatArray, piece: TracedPiece) -> PieceCheck:
    first = np.linspace(0, len(piece.order), STARTS, endpoint=False).astype(int)
    starts = points[piece.order[first if piece.closed else [0]]]
    waypoints = points[piece.indices]
    # A field that is slow on its path (the paper's form) is given the time it needs.
    speeds = np.linalg.norm(field(field.cloud.points[piece.indices]), axis=1)
    slowness = float((1 / np.maximum(speeds, SLOWEST)).mean())
    runs = _follow(field, starts, LENGTHS * piece.length * slowness)
    reach = max(PASS_DISTANCE, field.sigma)
    completed = [
        bool((cKDTree(run).query(waypoints)[0] <= reach).all())
        for run in np.swapaxes(runs, 0, 1)
    ]
    return PieceCheck(piece.length * field.cloud.unit_length, len(starts), sum(completed))


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
