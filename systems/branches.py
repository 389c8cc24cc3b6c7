"""The branches of a path, and short motions in time from one to another without a jump.

A motion here is a quintic in time, the least degree that takes a position, a velocity and an
acceleration at both ends.  It is held as the six control points of a Bezier curve (Bernstein
form; G. Farin, Curves and Surfaces for CAGD): plain numbers in metres, which bound the curve.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.typing import ArrayLike

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import Field, NetworkField, SteerableField
from sgvf_drake.paths import ReferencePath
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.planning import covering
from systems.courses import Course
from systems.guidance import FieldForSpeed

POINTS_OF_EXTENT = 80
"""Points of a branch in a length as long as the path is wide: a tenth of a U apart.  A
supervisor looks for the nearest whenever it acts, so they are not all vertices of a line."""

MAX_DEPARTURES = 20
"""Places on a branch from which a departure is tried, and entries that are tried for each."""

BRAKING_SHARE = 0.3
"""Share of the greatest acceleration that brakes ahead of a turn; the turn takes the rest."""

ENTRY_SHARE = 0.1
"""Share of an open branch, from its start, in which a vehicle enters it from elsewhere."""

NUM_CONTROL_POINTS = 6

SPEED_RANGE = (0.6, 1.3)
"""Least and greatest speed of a transfer over the commanded one: neither stops nor rushes."""

TURN_RATE = 1.0
"""1/s; a transfer weighs time against acceleration, and an acceleration of TURN_RATE times the
speed costs as much as the time does.  So it turns gently: over about a second at any speed."""

SHORTEST_TRANSFER = 1.4
"""s; nearly three periods of the attitude bandwidth of the default controller.  At 3 m/s and
more, shorter ones let propellers stand still; at 0.45 m/s it makes no difference."""

STOPPING_TIME = 1.5
"""s; the deceleration of a stop is speed / second at its peak, unless that is too much."""

_DETOURS = np.geomspace(0.8, 3.0, 24)
"""Lengths of transfers that are tried, at the commanded speed, over the distance flown."""

_SAMPLES = np.linspace(0.0, 1.0, 21)
"""Where speed and acceleration are looked at, in shares of the duration."""


class Motion(NamedTuple):
    """Where something is and how it moves, (d,) each, or (n, d) for n of them.

    Attributes:
        position: The position in m.
        velocity: The velocity in m/s.
        acceleration: The acceleration in m/s^2.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


class Transfer(NamedTuple):
    """A motion from one point to another.

    Attributes:
        control_points: The control points, (6, d) in m.
        duration: The duration in s.
        cost: What was minimised, in s; at least the duration.
        violation: By how much it breaks the limits that it was planned for, relative to
            them; 0 if it keeps all of them.
        entry: Which of the entries it leads to.
    """

    control_points: FloatArray
    duration: float
    cost: float
    violation: float
    entry: int = 0

    def Eval(self, time: float) -> Motion:
        """Returns the motion (d,) at a time in s since its start; it rests on both sides."""
        share = min(max(time / self.duration, 0.0), 1.0)
        motion = _Evaluate(self.control_points, np.array(self.duration), _Bases([share]))
        return Motion(*(values[0] for values in motion))


@dataclass(frozen=True, eq=False)
class Branch:
    """One piece of a path, or an itinerary on a network.

    Attributes:
        points: Waypoints on it, (n, d) in m, in the order of travel; equally far apart on a
            course.
        length: In m.
        closed: Whether it is a loop, which may be entered anywhere and flown for ever.
        course: Where it leads on the network of a directed field; None: the field alone
            tells.
    """

    points: FloatArray
    length: float
    closed: bool
    course: Course | None = None

    @classmethod
    def Along(cls, course: Course) -> "Branch":
        """Returns the branch of a course."""
        itinerary = course.itinerary
        extent = 8.0 * itinerary.network.unit_length
        points = itinerary.line.sample(_NumPoints(itinerary.length, extent))
        return cls(points, itinerary.length, itinerary.closed, course)

    def __deepcopy__(self, memo: Any) -> "Branch":
        """Returns itself: nothing of it ever changes."""
        return self

    @cached_property
    def _arcs(self) -> FloatArray:
        """The arc lengths of the waypoints of a course."""
        return np.linspace(0.0, self.length, len(self.points), endpoint=not self.closed)

    @cached_property
    def _headings(self) -> tuple[FloatArray, FloatArray]:
        """The headings at the waypoints of a course, and how they turn."""
        assert self.course is not None
        return self.course.Headings(self._arcs)

    def Nearest(self, position: FloatArray) -> tuple[int, float]:
        """Returns the waypoint nearest to a position (d,), and its distance in m."""
        offset = self.points - position
        squares = np.einsum("ij,ij->i", offset, offset)
        nearest = int(squares.argmin())
        return nearest, math.sqrt(squares[nearest])

    def WaypointAt(self, arc: float) -> int:
        """Returns the waypoint nearest to an arc length in m of a course; laps count on."""
        nearest = round(arc / float(self._arcs[1]))
        count = len(self.points)
        return nearest % count if self.closed else min(max(nearest, 0), count - 1)

    def ArcOf(self, waypoint: int) -> float:
        """Returns the arc length in m of a waypoint of a course."""
        return float(self._arcs[waypoint])

    def Entrances(self, anywhere: bool = False) -> IntArray:
        """Returns the waypoints where a vehicle may enter.

        Args:
            anywhere: Whether an open branch may be entered elsewhere than at its start.
        """
        count = len(self.points)
        if not (self.closed or anywhere):
            count = max(1, round(ENTRY_SHARE * count))
        return np.arange(count)

    def Ahead(self, waypoint: int, reach: float = math.inf) -> IntArray:
        """Returns the waypoints from one on, up to a reach in m; around a loop once."""
        count = len(self.points)
        stop = waypoint + count if self.closed else count
        if reach < math.inf:
            stop = min(stop, waypoint + 1 + math.ceil(reach / self.length * count))
        return np.arange(waypoint, stop) % count

    def MotionAt(
        self, field: Field, speed: float, waypoints: IntArray | slice = slice(None)
    ) -> Motion:
        """Returns the motion (n, d) of vehicles that follow the field exactly at waypoints.

        Args:
            field: The guiding field, in metres; taken as it is flown, see `FieldForSpeed`.
            speed: In m/s.
            waypoints: Their numbers (n,); all by default.
        """
        points, flown = self.points[waypoints], FieldForSpeed(field, speed)
        if self.course is None:
            m, J = flown.value_and_jacobian(points)
            rate = np.einsum("nij,nj->ni", J, m)
        else:
            assert isinstance(flown, SteerableField)
            headings, turns = (values[waypoints] for values in self._headings)
            states = np.concatenate([points, headings], axis=1)
            F, J = flown.with_memory().value_and_jacobian(states)
            d = points.shape[1]
            m, moves = F[:, :d], np.concatenate([F[:, :d], turns], axis=1)
            rate = np.einsum("nij,nj->ni", J[:, :d], moves)
        return Motion(points, speed * m, speed**2 * rate)


def MakeBranches(field: Field, path: ReferencePath | None = None) -> tuple[Branch, ...]:
    """Returns the branches of a path to which a vehicle can be sent.

    They are the pieces of the path, in its order.  Of a directed field they are the pieces of
    its own network, each with an itinerary over all of its edges; see `BranchAlong`.

    Args:
        field: The guiding field, in metres; it tells the direction of travel.
        path: The path, in m; that of a learned field is `field.path`, as by default.
    """
    if isinstance(field, SteerableField):
        steered = cast(NetworkField, field)
        pieces = range(steered.network.num_pieces)
        return tuple(BranchAlong(steered, covering(steered.network, k)) for k in pieces)
    path = cast(Any, field).path if path is None else path
    extent = np.ptp(np.concatenate([piece.vertices for piece in path.pieces]), axis=0).max()
    branches = []
    for piece in path.pieces:
        points = piece.sample(_NumPoints(piece.length, extent))
        steps = np.diff(points, axis=0)
        if float(np.sum(field(points[:-1]) * steps)) < 0.0:
            points = points[::-1]
        branches.append(Branch(points, piece.length, piece.closed))
    return tuple(branches)


def BranchAlong(field: NetworkField, itinerary: Itinerary | str) -> Branch:
    """Returns the branch of a directed field that leads along an itinerary on its network.

    Args:
        field: The guiding field, in metres.
        itinerary: On `field.network`; or its edges, as "1,2,-3".

    Raises:
        ConfigurationError: If an edge does not exist, or does not follow the one before it.
    """
    if isinstance(itinerary, str):
        itinerary = Itinerary.parse(itinerary, field.network)
    return Branch.Along(Course.Of(field, itinerary))


def _NumPoints(length: float, extent: float) -> int:
    return 2 + round(POINTS_OF_EXTENT * length / extent)


def SpeedLimits(
    field: Field, branch: Branch, speed: float, max_acceleration: float
) -> FloatArray:
    """Returns the speeds (n,) in m/s at which a vehicle can pass the waypoints of a branch.

    At each, the acceleration of `Branch.MotionAt` is kept; and before a turn the speed falls no
    faster than `BRAKING_SHARE` of the acceleration allows (the backward pass of
    time-optimal path parametrisation).  Nowhere is the result above the commanded speed, which
    is positive, in m/s; the acceleration is in m/s^2.
    """
    demand = np.linalg.norm(branch.MotionAt(field, speed).acceleration, axis=1)
    limits = speed * np.sqrt(np.minimum(1.0, max_acceleration / np.maximum(demand, 1e-9)))
    steps = np.linalg.norm(np.roll(branch.points, -1, axis=0) - branch.points, axis=1)
    gains = 2.0 * BRAKING_SHARE * max_acceleration * steps
    last = len(limits) - 1
    # Twice around a loop: the turn may lie behind its first waypoint.
    backward = [*range(last, -1, -1)] * 2 if branch.closed else range(last - 1, -1, -1)
    for i in backward:
        ahead = limits[(i + 1) % len(limits)]
        limits[i] = min(limits[i], math.sqrt(ahead**2 + gains[i]))
    return limits


def DepartureDelay(
    field: Field,
    branch: Branch,
    target: Branch,
    waypoint: int,
    speed: float,
    max_acceleration: float,
) -> float:
    """Returns how long in s a vehicle best goes on along its branch before a transfer.

    A transfer that starts where the branch leads away from its target is long.  The delay
    is the one at which the transfer ends soonest and is gentle, waiting included; it is less
    than a lap.

    Args:
        field: The guiding field, in metres.
        branch: Where the vehicle is.
        target: Where it is to go.
        waypoint: The waypoint of the branch that it is at.
        speed: In m/s, positive.
        max_acceleration: In m/s^2; see `PlanTransfer`.
    """
    ahead = branch.Ahead(waypoint)
    steps = np.linalg.norm(np.diff(branch.points[ahead], axis=0), axis=1)
    delays = np.concatenate(([0.0], np.cumsum(steps))) / speed
    stride = -(-len(ahead) // MAX_DEPARTURES)
    ahead, delays = ahead[::stride], delays[::stride]
    departures = branch.MotionAt(field, speed, ahead)
    entrances = target.Entrances()
    stride = -(-len(entrances) // MAX_DEPARTURES)
    entries = target.MotionAt(field, speed, entrances[::stride])
    plans = [
        PlanTransfer(Motion(*start), entries, speed, max_acceleration)
        for start in zip(*departures, strict=True)
    ]
    violations = np.array([plan.violation for plan in plans])
    costs = delays + [plan.cost for plan in plans]
    return float(delays[np.argmin(np.where(violations == violations.min(), costs, np.inf))])


def PlanTransfer(
    start: Motion, entries: Motion, speed: float, max_acceleration: float
) -> Transfer:
    """Returns the best motion from a start to one of several entries.

    Among all entries and durations of a grid that keep the limits, it is the one with the
    least integral of 1 + (|a| / (TURN_RATE speed))^2 over time: a compromise of short and
    gentle.  The speed has to stay within `SPEED_RANGE` of the commanded one.  In the first
    half it may be as far outside as at the start, so that a vehicle can start from rest.

    Where nothing keeps all limits, the result is what breaks them least.

    Args:
        start: The motion at the start, (d,).
        entries: The motions at the entries, (n, d).
        speed: The commanded speed in m/s, positive.
        max_acceleration: In m/s^2.
    """
    distance = np.linalg.norm(entries.position - start.position, axis=1)
    durations = np.maximum(_DETOURS[:, None] * distance / speed, SHORTEST_TRANSFER)
    points = _ControlPoints(start, entries, durations)
    _, velocity, acceleration = _Evaluate(points, durations, _Bases(_SAMPLES))
    speeds = np.linalg.norm(velocity, axis=-1)
    accelerations = np.linalg.norm(acceleration, axis=-1)
    violation = np.maximum(
        _SpeedViolation(speeds, float(np.linalg.norm(start.velocity)), speed),
        np.maximum(accelerations / max_acceleration - 1.0, 0.0).max(axis=-1),
    )
    effort = np.mean((accelerations / (TURN_RATE * speed)) ** 2, axis=-1)
    cost = np.where(violation == violation.min(), durations * (1.0 + effort), np.inf)
    best = np.unravel_index(np.argmin(cost), cost.shape)
    return Transfer(
        points[best],
        float(durations[best]),
        float(cost[best]),
        float(violation[best]),
        int(best[1]),
    )


def PlanStop(
    start: Motion, max_acceleration: float, goal: FloatArray | None = None
) -> Transfer:
    """Returns a motion that brings a vehicle to rest.

    The speed falls as a cubic, which fixes where it stops.  From a start without
    acceleration, the deceleration is greatest in the middle: 1.5 |v| / duration.

    Args:
        start: The motion at the start, (d,).
        max_acceleration: In m/s^2, that this greatest deceleration has to keep.
        goal: Where it comes to rest, (d,) in m; None: where the cubic ends.
    """
    p, v, a = start
    T = max(STOPPING_TIME, 1.5 * float(np.linalg.norm(v)) / max_acceleration)
    end = p + v * T / 2.0 + a * T**2 / 12.0
    rest = Motion(end if goal is None else goal, np.zeros_like(v), np.zeros_like(a))
    return Transfer(_ControlPoints(start, rest, np.array(T)), T, cost=T, violation=0.0)


def _ControlPoints(start: Motion, end: Motion, duration: FloatArray) -> FloatArray:
    """Returns the control points (..., 6, d) of motions of durations (...)."""
    T = duration[..., None]
    p0, v0, a0 = start
    p1, v1, a1 = end
    shape = np.broadcast_shapes(p0.shape, p1.shape, (*T.shape[:-1], p0.shape[-1]))
    points = (
        p0,
        p0 + v0 * T / 5.0,
        p0 + v0 * T * 2.0 / 5.0 + a0 * T**2 / 20.0,
        p1 - v1 * T * 2.0 / 5.0 + a1 * T**2 / 20.0,
        p1 - v1 * T / 5.0,
        p1,
    )
    return np.stack([np.broadcast_to(point, shape) for point in points], axis=-2)


def _Bases(shares: Sequence[float] | FloatArray) -> tuple[FloatArray, ...]:
    """Returns the Bernstein polynomials of degrees 5, 4 and 3, (k, 6), (k, 5) and (k, 4)."""
    t = np.asarray(shares, dtype=np.float64)[:, None]
    bases = []
    for degree in (5, 4, 3):
        i = np.arange(degree + 1)
        binomials = np.array([math.comb(degree, int(j)) for j in i])
        bases.append(binomials * t**i * (1.0 - t) ** (degree - i))
    return tuple(bases)


def _Evaluate(
    points: FloatArray, duration: FloatArray, bases: tuple[FloatArray, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns position, velocity and acceleration (..., k, d) of motions (..., 6, d)."""
    T = duration[..., None, None]
    first = np.diff(points, axis=-2)
    second = np.diff(first, axis=-2)
    return (
        bases[0] @ points,
        bases[1] @ first * (5.0 / T),
        bases[2] @ second * (20.0 / T**2),
    )


def _SpeedViolation(speeds: FloatArray, start_speed: float, speed: float) -> FloatArray:
    """Returns how far speeds (..., k) leave the range that is allowed, over the speed."""
    least, greatest = SPEED_RANGE[0] * speed, SPEED_RANGE[1] * speed
    early = _SAMPLES < 0.5
    lower = np.where(early, min(least, start_speed), least)
    upper = np.where(early, max(greatest, start_speed), greatest)
    outside = np.maximum(lower - speeds, speeds - upper).max(axis=-1)
    # Rounding is no violation.
    return np.maximum(outside / speed - 1e-9, 0.0)


def CheckBranches(
    branches: Sequence[Branch], dim: int, box: tuple[FloatArray, FloatArray] | None
) -> None:
    """Raises ConfigurationError unless a vehicle can be sent to each branch, inside the box."""
    if not branches:
        raise ConfigurationError("a supervisor needs at least one branch")
    for number, branch in enumerate(branches):
        points, length = branch.points, branch.length
        shape = np.shape(points)
        if len(shape) != 2 or shape[1] != dim or not shape[0]:
            problem = f"must have points (n, {dim}), got {shape}"
        elif not np.isfinite(points).all():
            problem = "has a point that is not finite"
        elif not (np.isfinite(length) and length > 0.0):
            problem = f"must have a positive length, got {length}"
        elif box is not None and not ((points >= box[0]) & (points <= box[1])).all():
            problem = "is not inside the box"
        else:
            continue
        raise ConfigurationError(f"branch {number} {problem}")


def CheckedBox(
    box: tuple[ArrayLike, ArrayLike] | None, dim: int
) -> tuple[FloatArray, FloatArray] | None:
    """Returns the corners of a box as arrays.

    Raises:
        ConfigurationError: if they are not two, (d,) each, the lower one first.
    """
    if box is None:
        return None
    lower, upper = (np.asarray(corner, dtype=np.float64) for corner in box)
    if lower.shape != (dim,) or upper.shape != (dim,) or not (lower < upper).all():
        raise ConfigurationError(
            f"box must be a lower and an upper corner ({dim},), got {lower} and {upper}"
        )
    return lower, upper


def CheckTour(tour: Sequence[int], num_branches: int) -> None:
    """Raises ConfigurationError unless there is a tour, of branches that exist."""
    if not len(tour) or any(stop not in range(num_branches) for stop in tour):
        raise ConfigurationError(
            f"tour must hold numbers of the {num_branches} branches, got {list(tour)}"
        )
