"""How well agents followed a path: reach, laps, ends, stalls, leaving, cross-track error.

Everything is measured in units U of the path (half-extent / 4), against a reference: the
true path, or what was found in the cloud where nothing else is known.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.paths import ReferencePath

REACH_DISTANCE = 0.1
"""Reached: within this many U of the path, once."""

SETTLE_DISTANCE = 0.3
"""Settled: within this many U for the last lap.  Also how near a waypoint is passed."""

STALL_WINDOW = 8.0
"""Stalled: judged over the time in which an agent at full speed covers this many U."""

STALL_SPAN = 0.5
"""Stalled: the positions in that time span less than this many U."""

END_DISTANCE = 0.1
"""Ended: within this many U of the terminal end.  As near as reaching the path means."""

REST_WINDOW = 2.0
"""Ended: at rest over the time in which an agent at full speed covers this many U.  Less than
`STALL_WINDOW`, so that an agent that arrives late in its run can still have ended."""

REST_SPAN = 0.05
"""Ended: the positions in that time span less than this many U, half of `END_DISTANCE`.  An
agent that runs through the end covers 40 times as much."""

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
        lapped: Settled, and went all the way around its piece, which is closed.
        ended: Followed its open piece from where it entered to the terminal end, and came
            to rest there; False in a run shorter than `REST_WINDOW`.
        stalled: Hardly moved in the end without having ended; False in a run shorter than
            `STALL_WINDOW`.
        left: Was outside `LEAVE_BOXES` boxes.
        rms: Root mean square of the cross-track error over the last lap, or from the first
            reach to the arrival of an agent that ended, in the user's unit of length; NaN
            where not settled.
        maximum: Largest cross-track error over the same time; NaN where not settled.
        laps: Arc length gained since the agent came to stay near its piece, in lengths of
            it; negative against the direction of the reference's arc length.
        piece: The piece of the reference nearest to the last position.
        open: Whether that piece is open.
        samples: Number of time samples in that time; 0 where not settled.
    """

    reached: BoolArray
    settled: BoolArray
    lapped: BoolArray
    ended: BoolArray
    stalled: BoolArray
    left: BoolArray
    rms: FloatArray
    maximum: FloatArray
    laps: FloatArray
    piece: IntArray
    open: BoolArray
    samples: IntArray

    @property
    def followed(self) -> BoolArray:
        """Who did what the field is for: a lap, or the way to the end."""
        return np.asarray(self.lapped | self.ended)

    @property
    def aim(self) -> str:
        """What that is on the pieces on which the agents are in the end, in words."""
        if self.open.all():
            return "come to rest at the end"
        return "complete a lap" + (" or come to rest at the end" if self.open.any() else "")

    def summary(self) -> dict[str, float | None]:
        """Returns the fractions of agents, and the errors over the settled ones.

        The lap fraction is over the agents on closed pieces in the end, the end fraction
        over those on open pieces, each None when there are none; the other fractions are
        over all agents.  The root mean square is over all time samples of the settled
        agents' last laps and ways to the end; both errors are None when no agent settled.
        """
        rms = maximum = None
        if self.settled.any():
            samples = self.samples[self.settled]
            squares = self.rms[self.settled] ** 2 * samples
            rms = float(np.sqrt(squares.sum() / samples.sum()))
            maximum = float(self.maximum[self.settled].max())
        return {
            "reach_fraction": float(self.reached.mean()),
            "lap_fraction": _fraction(self.lapped[~self.open]),
            "end_fraction": _fraction(self.ended[self.open]),
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
    reference: ReferencePath,
    speed: float = 1.0,
    ends: ArrayLike | None = None,
) -> FollowMetrics:
    """Measures how agents follow a path.

    An agent's tail is the longest end of its run in which it stays within
    `SETTLE_DISTANCE` of one piece without a `JUMP` to another strand of it; L is the
    length of that piece.

    - The last lap is the shortest end of the run in which the arc length gained in the tail
      is at least L, either way around.  A closed piece is lapped then.
    - Without that gain, the last lap is the last L / speed of time; the agent has settled if
      its tail covers it.
    - An open piece has a terminal end, at which its agents come to rest.  An agent has ended
      (and settled) there if it is at rest within `END_DISTANCE` of it and its tail holds all
      of the run since the agent first came within `REACH_DISTANCE` of the path, so that it
      skipped nothing.  Its errors are those of the tail from that reach to its arrival, the
      sample since which it has been within `END_DISTANCE`.

    Between two samples an agent must move less than half a piece.

    Args:
        times: (T,) increasing, T >= 2.
        positions: (T, n, d), in the user's unit of length.
        unit_length: U, in the same unit.
        box: lower and upper corner (d,).
        reference: the path.
        speed: the agents' speed, in that unit over the unit of `times`.
        ends: (E, d) where the field comes to rest.  Of the two end vertices of an open piece
            the one that is nearer to any of them is terminal; without any, the last one.

    Raises:
        ConfigurationError: if shapes do not match, times do not increase, or the unit of
            length or the speed is not positive.
        NonFiniteValueError: if a position or an end is not finite.
    """
    times, positions = _check(times, positions, unit_length, reference, speed)
    terminal = _terminal_ends(reference, _check_ends(ends, reference))
    tails = _tails(positions, unit_length, reference)
    settled, lapped, begin = _last_laps(times, positions, unit_length, reference, speed, tails)
    near_end, reach, arrival = _arrivals(positions, unit_length, terminal, tails)
    second = unit_length / speed
    ended = near_end & spans_less(
        times, positions, REST_WINDOW * second, REST_SPAN * unit_length
    )
    begin = np.where(ended, reach, begin)
    until = np.where(ended, arrival, len(times) - 1)
    settled |= ended
    rms, maximum, samples = _errors(tails.distance, settled, begin, until)
    lower, upper = (np.asarray(corner, dtype=np.float64) for corner in box)
    outside = np.abs(positions - (lower + upper) / 2) > LEAVE_BOXES * (upper - lower) / 2
    return FollowMetrics(
        reached=np.any(tails.distance <= REACH_DISTANCE * unit_length, axis=0),
        settled=settled,
        lapped=lapped,
        ended=ended,
        stalled=~ended
        & spans_less(times, positions, STALL_WINDOW * second, STALL_SPAN * unit_length),
        left=np.asarray(outside.any(axis=(0, 2))),
        rms=rms,
        maximum=maximum,
        laps=tails.laps,
        piece=tails.piece,
        open=~reference.closed[tails.piece],
        samples=samples,
    )


def default_duration(reference: ReferencePath, unit_length: float, speed: float = 1.0) -> float:
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


def least_separation(positions: ArrayLike) -> FloatArray:
    """Returns the distance (T,) between those two of n agents that are nearest to each other.

    Args:
        positions: (T, n, d), of two agents or more.

    Raises:
        ConfigurationError: if the shape is wrong.
        NonFiniteValueError: if a position is not finite.
    """
    x = np.asarray(positions, dtype=np.float64)
    if x.ndim != 3 or x.shape[1] < 2:
        raise ConfigurationError(f"positions must be (T, n, d) with n >= 2, not {x.shape}")
    if not np.isfinite(x).all():
        raise NonFiniteValueError("a position is not finite")
    one, other = np.triu_indices(x.shape[1], 1)
    distances = np.linalg.norm(x[:, one] - x[:, other], axis=2)
    return np.asarray(distances.min(axis=1))


def _check(
    times: ArrayLike,
    positions: ArrayLike,
    unit_length: float,
    reference: ReferencePath,
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


def _check_ends(ends: ArrayLike | None, reference: ReferencePath) -> FloatArray:
    """Returns the ends as (E, d), E = 0 where none are given."""
    e = np.asarray([] if ends is None else ends, dtype=np.float64)
    if e.size == 0:
        return np.empty((0, reference.dim))
    if e.ndim != 2 or e.shape[1] != reference.dim:
        raise ConfigurationError(f"ends must be (E, {reference.dim}), not {e.shape}")
    bad = np.flatnonzero(~np.isfinite(e).all(axis=1))
    if len(bad):
        raise NonFiniteValueError(f"end {bad[0]} of the field is not finite")
    return e


def _terminal_ends(reference: ReferencePath, ends: FloatArray) -> FloatArray:
    """Returns the terminal end of each piece (P, d); infinite where it has none."""
    terminal = np.full((len(reference.lengths), reference.dim), np.inf)
    for piece in np.flatnonzero(~reference.closed):
        first, last = reference.first_and_last(int(piece))
        to_first, to_last = (
            np.linalg.norm(ends - vertex, axis=1).min(initial=np.inf)
            for vertex in (first, last)
        )
        terminal[piece] = first if to_first < to_last else last
    return terminal


@dataclass(frozen=True, eq=False)
class _Tails:
    """The ends of the runs, in which agents stay near one piece."""

    distance: FloatArray  # (T, n) to the reference.
    piece: IntArray  # (n,) nearest to the last position.
    length: FloatArray  # (n,) of that piece, L.
    first: IntArray  # (n,) the sample at which the tail begins; T where there is none.
    gain: FloatArray  # (T, n) arc length gained from each sample to the end, in the tail.

    @property
    def laps(self) -> FloatArray:
        last = len(self.gain) - 1
        gain = np.take_along_axis(self.gain, np.minimum(self.first, last)[None], axis=0)[0]
        return np.asarray(gain / self.length)


def _tails(positions: FloatArray, unit_length: float, reference: ReferencePath) -> _Tails:
    steps, agents, dim = positions.shape
    projection = reference.project(positions.reshape(-1, dim))
    distance = projection.distance.reshape(steps, agents)
    pieces = projection.piece.reshape(steps, agents)
    piece = pieces[-1]
    length = reference.lengths[piece]
    step = np.diff(projection.arc.reshape(steps, agents), axis=0)
    period = np.where(reference.closed[piece], length, np.inf)
    # An infinite period leaves the steps on open pieces as they are.
    step -= np.round(step / period) * np.where(np.isfinite(period), period, 0.0)
    moved = np.linalg.norm(np.diff(positions, axis=0), axis=2)
    away = (distance > SETTLE_DISTANCE * unit_length) | (pieces != piece)
    away[:-1] |= np.abs(step) > moved + JUMP * unit_length
    first = since_last(away)
    gain = np.zeros((steps, agents))
    gain[:-1] = np.cumsum(step[::-1], axis=0)[::-1]
    return _Tails(distance, piece, length, first, gain)


def _last_laps(
    times: FloatArray,
    positions: FloatArray,
    unit_length: float,
    reference: ReferencePath,
    speed: float,
    tails: _Tails,
) -> tuple[BoolArray, BoolArray, IntArray]:
    """Returns settled (n,), lapped (n,), and the first sample of each last lap (n,)."""
    begin = _window_start(times, tails.length / speed)
    settled = (begin >= 0) & (tails.first <= begin)
    sample = np.arange(len(times))[:, None]
    whole = np.abs(tails.gain) >= (1 - ROUNDING) * tails.length
    whole &= sample >= tails.first
    passed_all = np.any(whole, axis=0)
    by_gain = len(times) - 1 - np.argmax(whole[::-1], axis=0)
    begin = np.where(passed_all, by_gain, begin)
    return settled | passed_all, passed_all & reference.closed[tails.piece], begin


def _arrivals(
    positions: FloatArray, unit_length: float, terminal: FloatArray, tails: _Tails
) -> tuple[BoolArray, IntArray, IntArray]:
    """Returns who followed its piece to its terminal end (n,), and the way there.

    The way is given by its first and its last sample (n,): the first reach of the path, and
    the sample since which the agent has been at the end.
    """
    from_end = np.linalg.norm(positions - terminal[tails.piece], axis=2)
    arrival = since_last(np.asarray(from_end > END_DISTANCE * unit_length))
    # The end is on the path, so who arrived has reached the path, and no later.
    reach = np.argmax(tails.distance <= REACH_DISTANCE * unit_length, axis=0)
    return (arrival < len(positions)) & (tails.first <= reach), reach, arrival


def since_last(condition: BoolArray) -> IntArray:
    """Returns the sample (n,) after the last one at which a condition (T, n) held."""
    after = len(condition) - np.argmax(condition[::-1], axis=0)
    return np.where(condition.any(axis=0), after, 0)


def _window_start(times: FloatArray, duration: ArrayLike) -> IntArray:
    """Returns the last sample from which a duration (n,) is left; -1 where there is none."""
    latest = times[-1] - (1 - ROUNDING) * np.asarray(duration)
    return np.asarray(np.searchsorted(times, latest, side="right") - 1)


def _errors(
    distance: FloatArray, settled: BoolArray, begin: IntArray, until: IntArray
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Returns root mean square, maximum and number of samples (n,), both ends included."""
    sample = np.arange(len(distance))[:, None]
    inside = settled & (sample >= begin) & (sample <= until)
    samples = inside.sum(axis=0)
    squares = np.sum(distance**2, axis=0, where=inside)
    rms = np.sqrt(squares / np.maximum(samples, 1))
    maximum = np.max(distance, axis=0, where=inside, initial=0.0)
    return np.where(settled, rms, np.nan), np.where(settled, maximum, np.nan), samples


def spans_less(
    times: FloatArray, positions: FloatArray, window: float, span: float
) -> BoolArray:
    """Returns who (n,) spans less than `span` over the last `window` of time.

    Nobody does in a run that is shorter.

    Args:
        times: (T,) increasing.
        positions: (T, n, d).
        window: In the unit of the times.
        span: In the unit of the positions.
    """
    start = int(_window_start(times, window))
    if start < 0:
        return np.zeros(positions.shape[1], dtype=bool)
    extent = np.ptp(positions[start:], axis=0)
    return np.asarray(np.linalg.norm(extent, axis=1) < span)


def _fraction(condition: BoolArray) -> float | None:
    return float(condition.mean()) if len(condition) else None
