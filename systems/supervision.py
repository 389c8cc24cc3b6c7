"""The rules of a branch supervisor: what it sees and remembers, decides and commands."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property, lru_cache
import math
from typing import Any, NamedTuple

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.fields.base import Field
from sgvf_drake.paths.itinerary import successors
from sgvf_drake.paths.planning import connection
from systems.branches import (
    NUM_CONTROL_POINTS,
    STOPPING_TIME,
    Branch,
    DepartureDelay,
    Motion,
    PlanStop,
    PlanTransfer,
    SpeedLimits,
    Transfer,
)
from systems.courses import Course, Detour, Spot
from systems.scalars import Scalar, Sqrt, ToFloat

ON_TOUR = -2
"""The wanted branch: the one that the tour says."""

HOLD_POSITION = -1
"""The wanted branch: none, stop here."""

POSITION_GAIN = 2.0
"""From position error to velocity, 1/s, while a reference is flown; see `ALTITUDE_GAIN`."""

MAX_CORRECTION = 1.0
"""m/s; the greatest velocity for the sake of a position error."""

MAX_LIMITS = 32
"""Branches times speeds whose limits are kept."""

BLEND_TIME = 0.3
"""s, at the end of a transfer, over which guidance takes over: about 1 / velocity gain."""

MISMATCH = 0.3
"""Difference of actual and commanded velocity over the speed, beyond which a motion is planned
from the actual one.  Below it, going on from the command makes no step in it."""

ASTRAY_RATIO = 3.0
"""A vehicle is astray if another branch is nearer than its own by this factor, ..."""

ON_BRANCH_SHARE = 0.05
"""... and its own is farther than this share of its length: of a circle, 0.3 of its radius."""

RECOVERED_SHARE = 0.5
"""A measurement is back when its age is below this share of what made the vehicle hold."""

REST_SHARE = 0.1
"""An open branch is at its end where the field asks for less than this share of the speed."""

RETURN_REACH = 2.0
"""A vehicle comes back to its course not farther than this many U ahead of where it left it."""

SCALE_TIME = 0.1
"""s, in which the speed follows what the path allows."""

LEAST_SCALE = 1e-3
"""The scale at which a vehicle starts from rest."""

SPEED_UP_SHARE = 0.1
"""The speed rises at this share of the greatest acceleration, from rest and after turns."""

LANDING_RATE = 0.3
"""m/s."""

LANDING_ACCELERATION = 0.5
"""m/s^2, with which a descent begins."""

LANDING_GAIN = 1.0
"""1/s, from height to rate of descent near the ground."""


class Mode(IntEnum):
    """What a supervisor does."""

    FOLLOW = 0
    TRANSFER = 1
    HOLD = 2
    LAND = 3


class Settings(NamedTuple):
    """What a user may change in flight."""

    branch: float  # Number of the wanted branch, or `HOLD_POSITION`, or `ON_TOUR`.
    laps: float  # To be flown on each branch of the tour.
    hold_after: float  # Age of a measurement in s beyond which the vehicle stops.
    land_after: float  # Age of a measurement in s beyond which it lands.


class Seen(NamedTuple):
    """The inputs at one sample, in the units of the ports."""

    time: float  # In s.
    position: FloatArray  # p_WB, (3,).
    velocity: FloatArray  # v_WB, (3,).
    velocity_command: FloatArray  # Of guidance, (3,).
    acceleration_feedforward: FloatArray  # Of guidance, (3,).
    speed: float  # Commanded.
    age: float  # Of the measurement.
    heading: FloatArray | None = None  # Of guidance, (d,), with a directed field.
    next_edge: int = 0  # That is commanded; 0: none.
    order: "Order | None" = None  # The last route that was commanded.


@dataclass(frozen=True, eq=False)
class Order:
    """A route that is commanded in place of the course of a branch."""

    number: int  # Of the order; each has another.
    branch: int  # Number of the branch.
    route: Branch  # In its place.

    def __deepcopy__(self, memo: Any) -> "Order":
        """Returns itself: nothing of it ever changes."""
        return self


_REFERENCE, _PLACES, _VECTORS = slice(4, 13), slice(13, 28), slice(28, None)
"""Where the reference, what stands between, and the control points and the intended direction
are in the vector."""

MODE, BRANCH, EDGE, ARC = 0, _PLACES.start, _PLACES.start + 8, _PLACES.start + 9
"""Where the mode, the branch, the edge and the arc length are in the vector."""


@dataclass
class Memory:
    """What a supervisor remembers from one sample to the next, and as which vector."""

    mode: float  # A `Mode`.
    weight: float  # Of guidance in the outputs, in [0, 1]; the rest is the reference's.
    scale: float  # On the speed of guidance, in (0, 1].
    scale_rate: float  # Its rate in 1/s.
    position: FloatArray  # Of the reference (3,) in m.
    velocity: FloatArray  # Of the reference (3,) in m/s.
    acceleration: FloatArray  # Of the reference (3,) in m/s^2.
    branch: float  # Number of the branch that is followed or flown to.
    stop: float  # Place in the tour.
    flown: float  # Distance in m along the branch.
    target: float  # Branch that a departure is planned to; `ON_TOUR`: none.
    departure: float  # Time in s of that departure.
    start: float  # Time in s at which the planned motion started.
    duration: float  # Of the planned motion in s.
    speed: float  # The commanded speed at the last sample in m/s, -1 before the first.
    edge: float  # Number of the edge in use of a network; 0: none.
    arc: float  # Arc length in m on the course or the detour, which laps count on.
    section: float  # The section of it; see `Spot`.
    order: float  # Number of the order that was taken up; 0: none.
    first: float  # Edge on which the present detour begins; 0: there is none.
    second: float  # Edge that was commanded to follow it; 0: none.
    rejoin: float  # Where in the edges of the course the detour ends; -1: it ends elsewhere.
    control_points: FloatArray  # Of the planned motion, (6, d) in m.
    direction: FloatArray  # The intended one, (d,); zero without a directed field.

    @classmethod
    def AtStart(cls, branch: int, dim: int) -> "Memory":
        """Returns the memory of a supervisor that has not seen anything."""
        start = cls.FromVector(np.zeros(_VECTORS.start + (NUM_CONTROL_POINTS + 1) * dim))
        start.weight, start.scale, start.duration = 1.0, 1.0, 1.0
        start.branch, start.target, start.speed = float(branch), float(ON_TOUR), -1.0
        return start

    @classmethod
    def FromVector(cls, values: FloatArray) -> "Memory":
        """Reads what `ToVector` has written."""
        reference = values[_REFERENCE].reshape(3, 3).copy()
        vectors = values[_VECTORS].reshape(NUM_CONTROL_POINTS + 1, -1).copy()
        before, places = values[: _REFERENCE.start].tolist(), values[_PLACES].tolist()
        attributes: list[Any] = [*before, *reference, *places, vectors[:-1], vectors[-1]]
        return cls(*attributes)

    def ToVector(self) -> FloatArray:
        """Returns all of it, in the order of the attributes, as one vector."""
        return np.concatenate([np.ravel(value) for value in vars(self).values()])


@dataclass(frozen=True)
class Supervision:
    """The rules by which a supervisor changes its memory at each sample."""

    field: Field  # In metres.
    branches: Sequence[Branch]  # Of its path.
    tour: Sequence[int]  # Numbers of the branches in the order in which they are flown.
    max_acceleration: float  # That the thrust is trusted with, in m/s^2.
    box: tuple[FloatArray, FloatArray] | None  # Corners (d,) of where the field holds, in m.
    landing_height: float  # z in m.
    period: float  # Of the samples in s.

    @property
    def _dim(self) -> int:
        return self.field.dim

    @cached_property
    def _Limits(self) -> Callable[[Branch, float], FloatArray]:
        """The speeds (n,) in m/s at which each waypoint of a branch can be passed."""

        @lru_cache(MAX_LIMITS)
        def limits(branch: Branch, speed: float) -> FloatArray:
            return SpeedLimits(self.field, branch, speed, self.max_acceleration)

        return limits

    def Step(self, settings: Settings, seen: Seen, memory: Memory) -> None:
        """Changes the memory at a sample: first the mode, then the reference."""
        if memory.speed < 0.0:
            self._Start(settings, seen, memory)
        elif seen.speed > memory.speed:
            # A speed that is raised is taken up from the one that was flown.
            memory.scale *= max(memory.speed / seen.speed, LEAST_SCALE)
        memory.speed = seen.speed
        self._TakeUpOrder(seen, memory)
        if memory.mode == Mode.FOLLOW:
            self._MoveOn(seen, memory)
        nearest, distance = self._InUse(memory, seen).Nearest(seen.position[: self._dim])
        self._Decide(settings, seen, memory, distance)
        if memory.mode == Mode.FOLLOW:
            self._CountDistance(seen, memory, distance)
            self._AdaptScale(seen, memory, nearest)
        else:
            memory.scale_rate = 0.0
            self._MoveReference(seen, memory)

    def _Start(self, settings: Settings, seen: Seen, memory: Memory) -> None:
        """Takes up the wanted branch and the speed that the vehicle has."""
        memory.branch = max(float(self._Wanted(settings, memory)), 0.0)
        memory.order = 0.0 if seen.order is None else float(seen.order.number)
        course = self._Course(memory, seen)
        if course is not None:
            start = course.Start(seen.position[: self._dim], seen.heading)
            self._PlaceAt(course, start, memory)
        speed = math.hypot(*seen.velocity[: self._dim])
        memory.scale = min(max(speed / max(seen.speed, 1e-9), LEAST_SCALE), 1.0)

    def _Decide(self, settings: Settings, seen: Seen, memory: Memory, distance: float) -> None:
        if memory.mode == Mode.LAND:
            return
        if memory.mode == Mode.FOLLOW:
            self._AdvanceTour(settings, seen, memory)
        if seen.age > settings.land_after:
            self._Land(seen, memory)
        elif self._MustHold(settings, seen, memory):
            if memory.mode != Mode.HOLD:
                self._Stop(seen, memory)
        else:
            self._Fly(settings, seen, memory, distance)

    def _MustHold(self, settings: Settings, seen: Seen, memory: Memory) -> bool:
        share = RECOVERED_SHARE if memory.mode == Mode.HOLD else 1.0
        return (
            settings.branch == HOLD_POSITION
            or seen.age > share * settings.hold_after
            or (self._Wanted(settings, memory) == memory.branch and self._IsAtEnd(seen, memory))
        )

    def _Fly(self, settings: Settings, seen: Seen, memory: Memory, distance: float) -> None:
        """Decides what to do with a vehicle that may fly."""
        wanted = self._Wanted(settings, memory)
        # Where guidance stands still, there is no speed to fly elsewhere with.
        may_leave = seen.speed > 0.0
        if memory.mode == Mode.HOLD or (
            memory.mode == Mode.FOLLOW and self._IsAstray(seen, memory, distance)
        ):
            if may_leave:
                self._FlyTo(wanted, seen, memory)
        elif wanted != memory.branch and may_leave:
            if memory.mode == Mode.TRANSFER or self._IsTimeToDepart(wanted, seen, memory):
                self._FlyTo(wanted, seen, memory)
        else:
            memory.target = ON_TOUR
            if memory.mode == Mode.TRANSFER and seen.time >= memory.start + memory.duration:
                memory.mode, memory.weight = Mode.FOLLOW, 1.0

    def _Wanted(self, settings: Settings, memory: Memory) -> int:
        """Returns the number of the wanted branch, or `HOLD_POSITION`."""
        if settings.branch == ON_TOUR:
            return self.tour[int(memory.stop)]
        return int(settings.branch)

    def _AdvanceTour(self, settings: Settings, seen: Seen, memory: Memory) -> None:
        if settings.branch != ON_TOUR or memory.stop >= len(self.tour) - 1:
            return
        if memory.branch != self.tour[int(memory.stop)]:
            return  # Still on the way back from a branch that was wanted by command.
        branch = self._Branch(memory, seen)
        asked = math.hypot(*seen.velocity_command[: self._dim])
        at_end = not branch.closed and asked < REST_SHARE * seen.speed
        if branch.course is not None:
            at_end = self._IsAtEnd(seen, memory)
        laps = settings.laps if branch.closed else 1.0
        if memory.flown >= laps * branch.length or (at_end and memory.flown > 0.0):
            memory.stop += 1.0
            memory.flown = 0.0

    def _IsTimeToDepart(self, wanted: int, seen: Seen, memory: Memory) -> bool:
        if memory.target != wanted:
            branch, target = self._InUse(memory, seen), self._BranchOf(wanted, memory, seen)
            memory.target = wanted
            memory.departure = seen.time + DepartureDelay(
                self.field,
                branch,
                target,
                self._Waypoint(seen, memory),
                self._SpeedFor(target, seen.speed),
                self.max_acceleration,
            )
        # Half a period: times are sums of periods, and round.
        return seen.time > memory.departure - 0.5 * self.period

    def _IsAstray(self, seen: Seen, memory: Memory, distance: float) -> bool:
        """Whether the field is not to be trusted, or leads to another branch."""
        p = seen.position[: self._dim]
        if self.box is not None and ((p < self.box[0]) | (p > self.box[1])).any():
            return True
        return distance > ON_BRANCH_SHARE * self._InUse(memory, seen).length and any(
            ASTRAY_RATIO * branch.Nearest(p)[1] < distance
            for number, branch in enumerate(self.branches)
            if number != memory.branch
        )

    def _FlyTo(self, wanted: int, seen: Seen, memory: Memory) -> None:
        is_return = wanted == memory.branch
        branch = (
            self._InUse(memory, seen) if is_return else self._BranchOf(wanted, memory, seen)
        )
        speed = self._SpeedFor(branch, seen.speed)
        if is_return and branch.course is not None and memory.edge != 0.0:
            # What lies farther ahead is not to be left out.
            reach = RETURN_REACH * branch.course.itinerary.network.unit_length
            entrances = branch.Ahead(branch.WaypointAt(memory.arc), reach)
        else:
            entrances = branch.Entrances(anywhere=is_return and branch.course is None)
        entries = branch.MotionAt(self.field, speed, entrances)
        start = self._Motion(seen, memory)
        plan = PlanTransfer(start, entries, speed, self.max_acceleration)
        self._Begin(Mode.TRANSFER, plan, seen, memory)
        memory.scale = speed / seen.speed
        if not is_return:
            memory.branch, memory.flown, memory.first = float(wanted), 0.0, 0.0
        if branch.course is not None:
            arc = branch.ArcOf(int(entrances[plan.entry]))
            self._PlaceAt(branch.course, branch.course.At(arc), memory)

    def _Stop(self, seen: Seen, memory: Memory) -> None:
        goal = None
        if self._IsAtEnd(seen, memory):
            goal = self._InUse(memory, seen).points[-1]
        plan = PlanStop(self._Motion(seen, memory), self.max_acceleration, goal)
        self._Begin(Mode.HOLD, plan, seen, memory)

    def _Land(self, seen: Seen, memory: Memory) -> None:
        memory.velocity[2] = (
            seen.velocity_command[2]
            if self._dim == 2
            else self._Motion(seen, memory).velocity[2]
        )
        memory.position[2] = seen.position[2]
        if memory.mode != Mode.HOLD:
            self._Stop(seen, memory)
        memory.mode = Mode.LAND

    def _Begin(self, mode: Mode, plan: Transfer, seen: Seen, memory: Memory) -> None:
        memory.mode, memory.weight, memory.target = mode, 0.0, ON_TOUR
        memory.start, memory.duration = seen.time, plan.duration
        memory.control_points = plan.control_points

    def _Motion(self, seen: Seen, memory: Memory) -> Motion:
        """Returns where a planned motion begins: with the velocity that is commanded now."""
        d, w = self._dim, memory.weight
        guided = seen.velocity_command * memory.scale
        acceleration = seen.acceleration_feedforward * memory.scale
        v = (w * guided + (1.0 - w) * memory.velocity)[:d]
        a = (w * acceleration + (1.0 - w) * memory.acceleration)[:d]
        if math.dist(v, seen.velocity[:d]) > MISMATCH * seen.speed:
            v, a = seen.velocity[:d], np.zeros(d)
        return Motion(seen.position[:d], v, a)

    def _MoveReference(self, seen: Seen, memory: Memory) -> None:
        d = self._dim
        plan = Transfer(memory.control_points, memory.duration, 0.0, 0.0)
        motion = plan.Eval(seen.time - memory.start)
        if memory.mode == Mode.LAND:
            self._Descend(memory)
            d = 2
        memory.position[:d], memory.velocity[:d], memory.acceleration[:d] = (
            values[:d] for values in motion
        )
        if memory.mode == Mode.TRANSFER:
            left = memory.start + memory.duration - seen.time
            share = min(max(1.0 - left / BLEND_TIME, 0.0), 1.0)
            memory.weight = share * share * (3.0 - 2.0 * share)

    def _Descend(self, memory: Memory) -> None:
        """Moves the reference down, faster and faster, then steadily, then slowly to ground."""
        height = memory.position[2] - self.landing_height
        faster = memory.velocity[2] - LANDING_ACCELERATION * self.period
        memory.velocity[2] = max(faster, -LANDING_RATE, -LANDING_GAIN * height)
        memory.acceleration[2] = 0.0
        memory.position[2] += memory.velocity[2] * self.period

    def _CountDistance(self, seen: Seen, memory: Memory, distance: float) -> None:
        """Adds what was flown along the field, while the vehicle is on its branch."""
        branch = self._Branch(memory, seen)
        if branch.course is not None or distance > ON_BRANCH_SHARE * branch.length:
            return
        command = seen.velocity_command[: self._dim]
        along = float(command @ seen.velocity[: self._dim])
        memory.flown += along / max(math.hypot(*command), 1e-9) * self.period

    def _AdaptScale(self, seen: Seen, memory: Memory, nearest: int) -> None:
        """Moves the speed to what the thrust allows at a waypoint, and slowly up.

        That is known from the path alone: what the vehicle's own motion demands would
        rise with each oscillation across the path, and the speed with it.
        """
        if seen.speed == 0.0:
            return
        branch = self._InUse(memory, seen)
        if branch.course is not None:
            nearest = branch.WaypointAt(memory.arc)
        target = self._Limits(branch, seen.speed)[nearest] / seen.speed
        if self._Ends(branch, memory):
            left = max(branch.length - memory.arc, 0.0)
            target = min(target, math.sqrt(2.0 * left / (STOPPING_TIME * seen.speed)))
        fastest = self.max_acceleration / seen.speed
        rate = (target - memory.scale) / SCALE_TIME
        memory.scale_rate = float(min(max(rate, -fastest), SPEED_UP_SHARE * fastest))
        memory.scale += memory.scale_rate * self.period

    def _SpeedFor(self, branch: Branch, speed: float) -> float:
        """Returns the speed in m/s at which a branch can be flown to and entered.

        All of a branch can be followed at it; of a course, which may turn round, some of it.
        """
        limits = self._Limits(branch, speed)
        return float(limits.min() if branch.course is None else limits.max())

    def _BranchOf(self, number: int, memory: Memory, seen: Seen) -> Branch:
        """Returns a branch; the route that was taken up in its place, if there is one."""
        order = seen.order
        if order is not None and order.number == memory.order and order.branch == number:
            return order.route
        return self.branches[number]

    def _Branch(self, memory: Memory, seen: Seen) -> Branch:
        """Returns the branch that is followed or flown to."""
        return self._BranchOf(int(memory.branch), memory, seen)

    def _Course(self, memory: Memory, seen: Seen) -> Course | None:
        return self._Branch(memory, seen).course

    def _InUse(self, memory: Memory, seen: Seen) -> Branch:
        """Returns that branch, or the detour on the way to it."""
        branch = self._Branch(memory, seen)
        if branch.course is None or memory.first == 0.0:
            return branch
        numbers = int(memory.first), int(memory.second), int(memory.rejoin)
        return DetourBranch(branch.course, *numbers)

    def _Waypoint(self, seen: Seen, memory: Memory) -> int:
        """Returns the waypoint where a vehicle is that follows a branch."""
        branch = self._InUse(memory, seen)
        if branch.course is not None:
            return branch.WaypointAt(memory.arc)
        return branch.Nearest(seen.position[: self._dim])[0]

    def _TakeUpOrder(self, seen: Seen, memory: Memory) -> None:
        """Begins the route that was commanded, from the edge in use, the shortest way."""
        order = seen.order
        if order is None or order.number == memory.order:
            return
        if memory.mode == Mode.TRANSFER and seen.speed == 0.0:
            return  # There is no speed to fly elsewhere with.
        memory.order = float(order.number)
        if order.branch != memory.branch:
            return
        course, edge = order.route.course, int(memory.edge)
        assert course is not None
        memory.flown = memory.first = memory.second = memory.rejoin = 0.0
        if memory.mode == Mode.TRANSFER:
            # It is not there yet: the transfer is planned anew.
            memory.edge = 0.0
            self._FlyTo(order.branch, seen, memory)
            return
        index = 0
        if edge in course.edges:
            index = course.edges.index(edge)
        else:
            memory.first = float(edge)
            course = Detour(course, edge, 0, 0)
        self._PlaceAt(course, course.OnEdge(index, seen.position[: self._dim]), memory)

    def _MoveOn(self, seen: Seen, memory: Memory) -> None:
        """Looks where a vehicle is on its course, and leaves it or a detour where it is to."""
        branch, position = self._InUse(memory, seen), seen.position[: self._dim]
        course = branch.course
        if course is None:
            return
        spot = course.Advance(Spot(int(memory.section), memory.arc), position)
        if memory.first == 0.0:
            memory.flown += spot.arc - memory.arc
        self._PlaceAt(course, spot, memory)
        index = course.Index(spot)
        if memory.first != 0.0 and memory.rejoin >= 0.0 and index + 1 == len(course.edges):
            memory.first, index = 0.0, int(memory.rejoin)
            course = self._Branch(memory, seen).course
            assert course is not None
            self._PlaceAt(course, course.OnEdge(index, position), memory)
        if seen.next_edge not in (0, course.Following(index)):
            self._Turn(course, index, seen, memory)

    def _Turn(self, course: Course, index: int, seen: Seen, memory: Memory) -> None:
        """Goes over the commanded edge next, if it can follow, and then back to the course."""
        itinerary, number = course.itinerary, course.edges[index]
        if seen.next_edge not in successors(itinerary.network)[number]:
            return
        if itinerary.nodes[index] is None:
            return  # It ends before the node.
        own = self._Course(memory, seen)
        assert own is not None
        count, after = len(own.edges), index + 1
        if memory.first != 0.0:
            after = int(memory.rejoin) if memory.rejoin >= 0.0 else count
        left = [
            k % count for k in range(after, after + count if own.itinerary.closed else count)
        ]
        way = connection(itinerary.network, seen.next_edge, [own.edges[k] for k in left])
        memory.first, memory.second = float(number), float(seen.next_edge)
        # Where nothing of the course is left to come to, the commanded edge is the last.
        memory.rejoin = next((float(k) for k in left if own.edges[k] in way[-1:]), -1.0)
        detour = self._InUse(memory, seen).course
        assert detour is not None
        self._PlaceAt(detour, detour.OnEdge(0, seen.position[: self._dim]), memory)

    def _PlaceAt(self, course: Course, spot: Spot, memory: Memory) -> None:
        memory.section, memory.arc = float(spot.section), spot.arc
        memory.edge = float(course.edges[course.Index(spot)])
        memory.direction = course.Direction(spot)

    def _Ends(self, branch: Branch, memory: Memory) -> bool:
        """Whether a vehicle is to come to rest at the end of what is in use of a network."""
        leads_on = memory.first != 0.0 and memory.rejoin >= 0.0
        return branch.course is not None and not (branch.closed or leads_on)

    def _IsAtEnd(self, seen: Seen, memory: Memory) -> bool:
        """Whether a vehicle is where it is to come to rest."""
        branch = self._InUse(memory, seen)
        if branch.course is None or not self._Ends(branch, memory):
            return False
        return branch.course.IsCompleted(Spot(int(memory.section), memory.arc))


@lru_cache(MAX_LIMITS)
def DetourBranch(course: Course, first: int, second: int, rejoin: int) -> Branch:
    """Returns the branch of a `Detour`."""
    return Branch.Along(Detour(course, first, second, rejoin))


def CalcCommands(
    memory: np.ndarray,
    dim: int,
    position: np.ndarray,
    velocity: np.ndarray,
    velocity_command: np.ndarray,
    acceleration: np.ndarray,
) -> list[Scalar]:
    """Returns the commands (6,): a mean of guidance's and of the reference's.

    Args:
        memory: `Memory` as a vector.
        dim: Number of axes, the first ones, that are the supervisor's; all for a landing.
        position: The vehicle's (3,).
        velocity: The vehicle's (3,).
        velocity_command: Guidance's (3,).
        acceleration: Guidance's feed-forward (3,).
    """
    _, w, scale, scale_rate = memory[: _REFERENCE.start].tolist()
    p_ref, v_ref, a_ref = memory[_REFERENCE].reshape(3, 3).tolist()
    position, velocity = position.tolist(), velocity.tolist()
    v, a = velocity_command.tolist(), acceleration.tolist()
    guided = range(3 if ToFloat(memory[MODE]) == Mode.LAND else dim)
    errors = [p_ref[i] - position[i] for i in guided]
    stretch = sum((e * e for e in errors), 0.0) * (POSITION_GAIN / MAX_CORRECTION) ** 2
    gain = POSITION_GAIN / Sqrt(1.0 + stretch)
    for i in guided:
        v_flown = v_ref[i] + gain * errors[i]
        a_flown = a_ref[i] + gain * (v_ref[i] - velocity[i])
        a[i] = w * (scale * a[i] + scale_rate * v[i]) + (1.0 - w) * a_flown
        v[i] = w * scale * v[i] + (1.0 - w) * v_flown
    return [*v, *a]
