"""How well agents followed a path: reach, laps, stalls, leaving, and cross-track error.

Everything is measured in units U of the path (half-extent / 4), against a reference: the
true path, or the spanning tree of the cloud where nothing else is known.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.paths.reference import Reference

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
BoolArray = NDArray[np.bool_]

REACH_DISTANCE = 0.1
"""Reached: within this many U of the path, once."""

SETTLE_DISTANCE = 0.3
"""Settled: within this many U for the last lap.  Also how near a waypoint is passed."""

STALL_WINDOW = 8.0
"""Stalled: judged over the time in which an agent at full speed covers this many U."""

STALL_SPAN = 0.5
"""Stalled: the positions in that time span less than this many U."""

LEAVE_BOXES = 1.5
"""Left: outside the box enlarged about its centre by this factor."""

DURATION_LAPS = 1.5
"""A run has time for this many laps of the longest piece,"""

DURATION_UNITS = 15.0
"""and for a way in of this many U: three half-sizes of the box."""

JUMP = 1.0
"""The nearest point of the path may run ahead of the agent by this many U in one sample, as
where a corner is cut.  More is a jump to another strand, and what lies between is not
counted as followed."""

ROUNDING = 1e-6
"""A lap counts when this part of it is missing: a trajectory is sampled and rounded."""


@dataclass(frozen=True, eq=False)
class FollowMetrics:
    """What `follow_metrics` found, one value for each of n agents.

    Attributes:
        reached: Came within `REACH_DISTANCE`.
        settled: Stayed within `SETTLE_DISTANCE` of one piece over the last lap.
        lapped: Settled, and went all the way around (along) its piece.
        stalled: Hardly moved in the end; False in a run shorter than `STALL_WINDOW`.
        left: Was outside `LEAVE_BOXES` boxes.
        rms: Root mean square of the cross-track error over the last lap, in the user's
            unit of length; NaN where not settled.
        maximum: Largest cross-track error over the last lap; NaN where not settled.
        laps: Arc length gained since the agent came to stay near its piece, in lengths of
            it; negative against the direction of the reference's arc length.
        piece: The piece of the reference nearest to the last position.
        samples: Number of time samples in the last lap; 0 where not settled.
    """

    reached: BoolArray
    settled: BoolArray
    lapped: BoolArray
    stalled: BoolArray
    left: BoolArray
    rms: FloatArray
    maximum: FloatArray
    laps: FloatArray
    piece: IntArray
    samples: IntArray

    def summary(self) -> dict[str, float | None]:
        """Returns the fractions of agents, and the errors over the settled ones.

        The root mean square is over all time samples of the settled agents' last laps;
        both errors are None when no agent settled.
        """
        rms = maximum = None
        if self.settled.any():
            samples = self.samples[self.settled]
            squares = self.rms[self.settled] ** 2 * samples
            rms = float(np.sqrt(squares.sum() / samples.sum()))
            maximum = float(self.maximum[self.settled].max())
        return {
            "reach_fraction": float(self.reached.mean()),
            "lap_fraction": float(self.lapped.mean()),
            "stall_fraction": float(self.stalled.mean()),
            "leave_fraction": float(self.left.mean()),
            "cross_track_rms": rms,
            "cross_track_max": maximum,
        }


def follow_metrics(
    times: ArrayLike,
    positions: ArrayLike,
    unit_length: float,
    box: tuple[ArrayLike, ArrayLike],
    reference: Reference,
    speed: float = 1.0,
) -> FollowMetrics:
    """Measures how agents follow a path.

    An agent's tail is the longest end of its run in which it stays within
    `SETTLE_DISTANCE` of one piece without a `JUMP` to another strand of it; L is the
    length of that piece.

    - With a true path, a lap is done when the arc length gained in the tail is at least L,
      either way around, and the last lap is the shortest end of the run with that gain.
    - With the tree of a cloud, a lap is done when every waypoint of the piece was passed
      within `SETTLE_DISTANCE` in the tail.
    - Without a lap, or with the tree, the last lap is the last L / speed of time; the agent
      has settled if its tail covers it.

    Between two samples an agent must move less than half a piece.  A piece without length
    (an isolated waypoint of a cloud) is nothing to settle on.

    Args:
        times: (T,) increasing, T >= 2.
        positions: (T, n, d), in the user's unit of length.
        unit_length: U, in the same unit.
        box: lower and upper corner (d,).
        reference: a `ReferencePath`, or `tree_reference(cloud)`.
        speed: the agents' speed, in that unit over the unit of `times`.

    Raises:
        ConfigurationError: if shapes do not match, times do not increase, or the unit of
            length or the speed is not positive.
        NonFiniteValueError: if a position is not finite.
    """
    times, positions = _check(times, positions, unit_length, reference, speed)
    tails = _tails(positions, unit_length, reference)
    settled, lapped, begin = _last_laps(times, positions, unit_length, reference, speed, tails)
    rms, maximum, samples = _errors(tails.distance, settled, begin)
    lower, upper = (np.asarray(corner, dtype=np.float64) for corner in box)
    outside = np.abs(positions - (lower + upper) / 2) > LEAVE_BOXES * (upper - lower) / 2
    return FollowMetrics(
        reached=_any(tails.distance <= REACH_DISTANCE * unit_length),
        settled=settled,
        lapped=lapped,
        stalled=_stalled(times, positions, unit_length, speed),
        left=np.asarray(outside.any(axis=(0, 2))),
        rms=rms,
        maximum=maximum,
        laps=tails.laps,
        piece=tails.piece,
        samples=samples,
    )


def default_duration(reference: Reference, unit_length: float, speed: float = 1.0) -> float:
    """Returns the time to run, 1.5 longest pieces + 15 U at the given speed."""
    return (DURATION_LAPS * reference.longest + DURATION_UNITS * unit_length) / speed


def grid_starts(box: tuple[ArrayLike, ArrayLike], n: int, dim: int) -> FloatArray:
    """Returns `n` start points (n, dim) on a grid over the box, its borders included.

    The grid has the smallest k with k^dim >= n points along each axis; if that is more
    than n in all, n of them are taken in even steps.  A single point is the centre.

    Raises:
        ConfigurationError: if n < 1 or the box is not of this dimension.
    """
    lower, upper = (np.asarray(corner, dtype=np.float64) for corner in box)
    if n < 1:
        raise ConfigurationError(f"the number of starts must be at least 1, not {n}")
    if lower.shape != (dim,) or upper.shape != (dim,):
        raise ConfigurationError(f"the box has corners {lower.shape}; need ({dim},)")
    if n == 1:
        return ((lower + upper) / 2)[None, :]
    k = 2
    while k**dim < n:
        k += 1
    axes = [np.linspace(low, high, k) for low, high in zip(lower, upper, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, dim)
    return grid[np.arange(n) * (len(grid) - 1) // (n - 1)]


def _check(
    times: ArrayLike,
    positions: ArrayLike,
    unit_length: float,
    reference: Reference,
    speed: float,
) -> tuple[FloatArray, FloatArray]:
    t = np.asarray(times, dtype=np.float64)
    p = np.asarray(positions, dtype=np.float64)
    if t.ndim != 1 or len(t) < 2 or not np.all(np.diff(t) > 0):
        raise ConfigurationError("times must be at least 2 increasing values (T,)")
    if p.ndim != 3 or len(p) != len(t) or p.shape[1] < 1 or p.shape[2] != reference.dim:
        raise ConfigurationError(
            f"positions must be ({len(t)}, n, {reference.dim}), not {p.shape}"
        )
    for name, value in (("unit_length", unit_length), ("speed", speed)):
        if not (0 < value < np.inf):
            raise ConfigurationError(f"{name} must be positive and finite, not {value}")
    bad = np.argwhere(~np.isfinite(p).all(axis=2))
    if len(bad):
        raise NonFiniteValueError(
            f"the position of agent {bad[0, 1]} is not finite at time {t[bad[0, 0]]:g}"
        )
    return t, p


@dataclass(frozen=True, eq=False)
class _Tails:
    """The ends of the runs, in which agents stay near one piece.

    Attributes:
        distance: (T, n) distance to the reference.
        piece: (n,) the piece nearest to the last position.
        length: (n,) its length L.
        first: (n,) the sample at which the tail begins; T where there is none.
        gain: (T, n) arc length gained from each sample to the end; valid in the tail.
    """

    distance: FloatArray
    piece: IntArray
    length: FloatArray
    first: IntArray
    gain: FloatArray

    @property
    def laps(self) -> FloatArray:
        last = len(self.gain) - 1
        gain = np.take_along_axis(self.gain, np.minimum(self.first, last)[None], axis=0)[0]
        return np.where(self.length > 0, gain / np.where(self.length > 0, self.length, 1), 0.0)


def _tails(positions: FloatArray, unit_length: float, reference: Reference) -> _Tails:
    steps, agents, dim = positions.shape
    projection = reference.project(positions.reshape(-1, dim))
    distance = projection.distance.reshape(steps, agents)
    pieces = projection.piece.reshape(steps, agents)
    piece = pieces[-1]
    length = reference.lengths[piece]
    step = np.diff(projection.arc.reshape(steps, agents), axis=0)
    period = np.where(reference.closed[piece] & (length > 0), length, np.inf)
    # An infinite period leaves the steps on open pieces as they are.
    step -= np.round(step / period) * np.where(np.isfinite(period), period, 0.0)
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=2)
    away = (distance > SETTLE_DISTANCE * unit_length) | (pieces != piece)
    away[:-1] |= np.abs(step) > moved + JUMP * unit_length
    first = np.where(away.any(axis=0), steps - np.argmax(away[::-1], axis=0), 0)
    gain = np.zeros((steps, agents))
    gain[:-1] = np.cumsum(step[::-1], axis=0)[::-1]
    return _Tails(distance, piece, length, first, gain)


def _last_laps(
    times: FloatArray,
    positions: FloatArray,
    unit_length: float,
    reference: Reference,
    speed: float,
    tails: _Tails,
) -> tuple[BoolArray, BoolArray, IntArray]:
    """Returns settled (n,), lapped (n,), and the first sample of each last lap (n,)."""
    begin = _window_start(times, tails.length / speed)
    settled = (begin >= 0) & (tails.first <= begin) & (tails.length > 0)
    if reference.waypoints is not None:
        lapped = settled.copy()
        for agent in np.flatnonzero(settled):
            tail = positions[tails.first[agent] :, agent]
            waypoints = reference.waypoints[tails.piece[agent]]
            passed = cKDTree(tail).query(waypoints)[0] <= SETTLE_DISTANCE * unit_length
            lapped[agent] = passed.all()
        return settled, lapped, begin
    sample = np.arange(len(times))[:, None]
    whole = np.abs(tails.gain) >= (1 - ROUNDING) * tails.length
    whole &= (sample >= tails.first) & (tails.length > 0)
    lapped = _any(whole)
    by_gain = len(times) - 1 - np.argmax(whole[::-1], axis=0)
    return settled | lapped, lapped, np.where(lapped, by_gain, begin)


def _any(condition: BoolArray) -> BoolArray:
    """Returns whether a condition (T, n) held at any time, (n,)."""
    return np.asarray(condition.any(axis=0))


def _window_start(times: FloatArray, duration: ArrayLike) -> IntArray:
    """Returns the last sample from which a duration (n,) is left; -1 where there is none."""
    latest = times[-1] - (1 - ROUNDING) * np.asarray(duration)
    return np.asarray(np.searchsorted(times, latest, side="right") - 1)


def _errors(
    distance: FloatArray, settled: BoolArray, begin: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Returns root mean square, maximum and number of samples (n,) of the last laps."""
    inside = settled & (np.arange(len(distance))[:, None] >= begin)
    samples = inside.sum(axis=0)
    squares = np.sum(distance**2, axis=0, where=inside)
    rms = np.sqrt(squares / np.maximum(samples, 1))
    maximum = np.max(distance, axis=0, where=inside, initial=0.0)
    return np.where(settled, rms, np.nan), np.where(settled, maximum, np.nan), samples


def _stalled(
    times: FloatArray, positions: FloatArray, unit_length: float, speed: float
) -> BoolArray:
    start = int(_window_start(times, STALL_WINDOW * unit_length / speed))
    if start < 0:
        return np.zeros(positions.shape[1], dtype=bool)
    span = np.ptp(positions[start:], axis=0)
    return np.asarray(np.linalg.norm(span, axis=1) < STALL_SPAN * unit_length)
