"""Speeds of several vehicles on one closed path, until the gaps between them are as asked."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import BasicVector_, DiagramBuilder, EventStatus, LeafSystem_

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.exceptions import ConfigurationError
from systems.branches import Branch
from systems.guidance import GuidanceSystem
from systems.guidance_loop import GuidanceLoop
from systems.scalars import (
    CheckFiniteAgents,
    CheckFiniteParameter,
    CheckPositiveParameter,
    ToList,
    ToVector,
    template,
)

DEFAULT_SPACING_GAIN = 0.25
"""1/s.  With it, the fastest change of gaps, 4 gain, is slower than the default controller
changes a speed."""

MEAN_SHARE, SLOWEST_SHARE = 0.75, 0.5
"""Mean and least speed over the greatest, where only that is known."""

DEFAULT_SPACING_PERIOD = 0.1
"""s; short beside the time 1 / (4 gain) in which gaps change fastest."""

REACH_SHARE = 0.05
"""Share of its length that a vehicle may be off the path, and still counts as on it."""

OFF_PATH = -1.0
"""The arc and the gap of a vehicle that is not on the path."""

ROUNDING = 1e-12
"""Distances that differ by less than this part of the length are equal."""


class Pace(NamedTuple):
    """How fast vehicles go, and how fast they change their gaps.

    Attributes:
        speed: At which all go, m/s, once the gaps are as asked.
        slowest: The least speed, m/s, less than that, and not negative.
        fastest: The greatest speed, m/s, more than that.
        gain: From metres of a gap to a speed, 1/s.
    """

    speed: float
    slowest: float
    fastest: float
    gain: float = DEFAULT_SPACING_GAIN

    @classmethod
    def UpTo(cls, fastest: float) -> "Pace":
        """Returns the pace of vehicles that fly at most as fast as this, in m/s."""
        return cls(MEAN_SHARE * fastest, SLOWEST_SHARE * fastest, fastest)


@template
def SpacingController_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Sets the speeds of n vehicles on one closed path until their gaps are as asked.

        .. pydrake_system::

            name: SpacingController
            input_ports:
            - position_0
            - position_1
            output_ports:
            - speed_0
            - speed_1
            - arcs
            - gaps

        These are the ports for two vehicles; more have more of them.  `position_i` (3) is p_WB
        of vehicle i in m, and `speed_i` (1) in m/s is for the input `speed` of its guidance.
        `arcs` (n) in m tells where on the path each is, and `gaps` (n) in m how far the next
        vehicle on it is ahead, along the path; they sum to its length.

        With the gap g_i ahead of vehicle i, which is to be the share w_i of the length, and
        the vehicle i - 1 behind it, the speed is

            v_i = clip(v + k (r_i - r_(i-1)), slowest, fastest),  r_i = g_i / (n w_i).

        This is consensus on a ring: each vehicle weighs the gaps on its two sides, as in
        coordinated path following (Yao et al., arXiv:2103.12372), here by arc length.  It
        converges from everywhere: V = sum g_i^2 / (2 n w_i) has the rate -sum x_i v_i
        with x_i = r_i - r_(i-1).  The x_i sum to zero, and v_i - v has the sign of x_i, so
        the rate is -sum x_i (v_i - v) <= 0, and zero only where all r_i are equal, which is
        where V is least.  And the least r_i never shrinks, since the vehicle ahead of it is
        at least as fast as v, and the one behind at most as fast: nobody overtakes, and of gaps
        that are to be equal the least never gets less.  Small errors of equal gaps die out at
        the rates k (2 - 2 cos(2 pi j / n)), j = 1..n-1.  All this is for vehicles that fly at
        the speeds they are given.

        Gaps are along the path.  Where a path crosses itself, vehicles on both strands may
        meet; see `sgvf_drake.metrics.least_separation`.

        The discrete state holds the arc lengths (n) and the speeds (n), and is updated every
        `period`.  A vehicle is looked for from its last arc length on to `reach` ahead, so it
        stays on its strand where the path crosses itself.  Where it is farther than
        `reach` from that part of the path, it is looked for on the whole.  Where it is farther
        from that too, it is not on the path: its arc and its gap are `OFF_PATH`, it is given
        the speed v, and the others count without it, their shares enlarged in proportion.

        The numeric parameters are the `Pace` (index `pace_index`) and the shares (n)
        (`shares_index`); see `SetPace` and `SetShares`.  They are read at each update.  The
        outputs depend on the state alone, and have no derivatives.

        Args:
            branch: The closed path in m, in the direction of travel; see `MakeBranches`.
            num_vehicles: n, at least 2.
            pace: The speeds and the gain.
            shares: The parts of the length that the gaps ahead of the vehicles are to be,
                (n,), positive, in any unit; None: all are equal.
            reach: A distance in m; by default `REACH_SHARE` of the length.
            period: The time between updates, s, in which a vehicle moves less than `reach`.

        Raises:
            ConfigurationError: if an argument or a parameter cannot be used.
            NonFiniteValueError: on an update, where a position is not finite.
        """

        def _construct(
            self,
            branch: Branch,
            num_vehicles: int,
            pace: Pace,
            shares: ArrayLike | None = None,
            reach: float | None = None,
            period: float = DEFAULT_SPACING_PERIOD,
        ) -> None:
            if not branch.closed:
                raise ConfigurationError("only vehicles on a closed path can be spaced")
            if num_vehicles < 2:
                raise ConfigurationError(
                    f"spacing needs at least 2 vehicles, got {num_vehicles}"
                )
            n = self._count = num_vehicles
            self._line = _ClosedLine(branch.points)
            self._reach = REACH_SHARE * self._line.length if reach is None else reach
            CheckPositiveParameter("reach", self._reach)
            CheckPositiveParameter("period", period)
            self._period = period
            self._positions = [
                self.DeclareVectorInputPort(f"position_{i}", 3) for i in range(n)
            ]
            self._CheckPace(pace)
            self.pace_index = self.DeclareNumericParameter(BasicVector_[T](pace))
            first = _CheckedShares(np.ones(n) if shares is None else shares, n)
            self.shares_index = self.DeclareNumericParameter(BasicVector_[T](first))
            start = [OFF_PATH] * n + [pace.speed] * n
            self._index = self.DeclareDiscreteState(BasicVector_[T](start))
            self.DeclareInitializationDiscreteUpdateEvent(self._Start)
            self.DeclarePeriodicDiscreteUpdateEvent(period, period, self._Advance)
            state = {self.discrete_state_ticket(self._index)}
            for i in range(n):
                copy = partial(self._CopySpeed, i)
                self.DeclareVectorOutputPort(f"speed_{i}", 1, copy, state)
            self.DeclareVectorOutputPort("arcs", n, self._CopyArcs, state)
            self.DeclareVectorOutputPort("gaps", n, self._CalcGaps, state)

        @property
        def num_vehicles(self) -> int:
            """The number of vehicles n."""
            return self._count

        @property
        def length(self) -> float:
            """The length of the path in m."""
            return self._line.length

        def GetPace(self, context: Any) -> Pace:
            """Returns the speeds and the gain; this system's own Context is wanted."""
            parameters = context.get_numeric_parameter(self.pace_index)
            return Pace(*ToList(parameters.CopyToVector()))

        def SetPace(self, context: Any, pace: Pace) -> None:
            """Sets the speeds and the gain; this system's own Context is wanted."""
            self._CheckPace(pace)
            parameters = context.get_mutable_numeric_parameter(self.pace_index)
            parameters.SetFromVector(ToVector(T, pace))

        def GetShares(self, context: Any) -> tuple[float, ...]:
            """Returns the n shares, which sum to 1; this system's own Context is wanted."""
            parameters = context.get_numeric_parameter(self.shares_index)
            return tuple(ToList(parameters.CopyToVector()))

        def SetShares(self, context: Any, shares: ArrayLike) -> None:
            """Sets the shares (n,), in any unit; this system's own Context is wanted."""
            parameters = context.get_mutable_numeric_parameter(self.shares_index)
            values = _CheckedShares(shares, self._count).tolist()
            parameters.SetFromVector(ToVector(T, values))

        def _CheckPace(self, pace: Pace) -> None:
            for name, value in pace._asdict().items():
                CheckFiniteParameter(name, value)
            if not 0.0 <= pace.slowest < pace.speed < pace.fastest:
                raise ConfigurationError(f"need 0 <= slowest < speed < fastest, got {pace}")
            if pace.fastest * self._period >= self._reach:
                raise ConfigurationError(
                    f"at {pace.fastest} m/s a vehicle moves farther in a period of "
                    f"{self._period} s than the reach of {self._reach:.4g} m"
                )
            CheckPositiveParameter("gain", pace.gain)

        def _Start(self, context: Any, values: Any) -> EventStatus:
            return self._Update(context, values, np.full(self._count, OFF_PATH))

        def _Advance(self, context: Any, values: Any) -> EventStatus:
            return self._Update(context, values, self._Arcs(context))

        def _Update(self, context: Any, values: Any, arcs: FloatArray) -> EventStatus:
            positions = np.array([ToList(port.Eval(context)) for port in self._positions])
            CheckFiniteAgents(self, context, "the position", positions)
            arcs = self._line.Track(positions, arcs, self._reach)
            pace = self.GetPace(context)
            self._CheckPace(pace)
            shares = _CheckedShares(self.GetShares(context), self._count)
            speeds = _Speeds(*_Gaps(arcs, self.length), shares, pace)
            state = ToVector(T, [*arcs.tolist(), *speeds.tolist()])
            values.get_mutable_vector(self._index).SetFromVector(state)
            return EventStatus.Succeeded()

        def _Arcs(self, context: Any) -> FloatArray:
            state = ToList(context.get_discrete_state(self._index).CopyToVector())
            return np.array(state[: self._count])

        def _CopySpeed(self, vehicle: int, context: Any, output: Any) -> None:
            state = context.get_discrete_state(self._index)
            output.SetAtIndex(0, state.GetAtIndex(self._count + vehicle))

        def _CopyArcs(self, context: Any, output: Any) -> None:
            output.SetFromVector(ToVector(T, self._Arcs(context).tolist()))

        def _CalcGaps(self, context: Any, output: Any) -> None:
            order, gaps = _Gaps(self._Arcs(context), self.length)
            of_vehicles = np.full(self._count, OFF_PATH)
            of_vehicles[order] = gaps
            output.SetFromVector(ToVector(T, of_vehicles.tolist()))

    return Impl


SpacingController = SpacingController_[None]


def AddSpacing(
    builder: DiagramBuilder,
    loops: Sequence[GuidanceLoop],
    branch: Branch,
    shares: ArrayLike | None = None,
    *,
    pace: Pace | None = None,
    reach: float | None = None,
    period: float = DEFAULT_SPACING_PERIOD,
    name: str = "spacing",
) -> Any:
    """Keeps vehicles on one closed path apart, by their speeds.

    Adds a `SpacingController` and connects it with the loops, from `AddGuidance`, that follow
    a field of this path.

    Args:
        builder: Is changed; the loops are in it.
        loops: The loops of the vehicles, whose speeds are free.
        branch: The closed path in m, in the direction of travel; see `MakeBranches`.
        shares: As in `SpacingController`.
        pace: As in `SpacingController`, at most as fast as each guidance; by default that
            `UpTo` the speed of the slowest guidance.
        reach: As in `SpacingController`.
        period: As in `SpacingController`.
        name: The name of the system in the builder.

    Returns:
        The system.

    Raises:
        ConfigurationError: if an argument cannot be used; then nothing was added.
    """
    if builder.HasSubsystemNamed(name):
        raise ConfigurationError(
            f"the diagram has a system {name!r} already: choose another `name`"
        )
    for i, loop in enumerate(loops):
        _CheckLoop(builder, loop)
        if any(loop is other for other in loops[:i]):
            raise ConfigurationError(f"the loop {loop.get_name()!r} is given twice")
    most = min((_SpeedOf(loop) for loop in loops), default=np.inf)
    if pace is None:
        CheckPositiveParameter("the speed of the slowest guidance", most)
        pace = Pace.UpTo(most)
    if pace.fastest > most:
        raise ConfigurationError(
            f"the pace is up to {pace.fastest} m/s, but a guidance follows its field at {most} "
            "m/s at most"
        )
    spacing = SpacingController(branch, len(loops), pace, shares, reach, period)
    builder.AddNamedSystem(name, spacing)
    for i, loop in enumerate(loops):
        builder.Connect(loop.GetOutputPort("position"), spacing.GetInputPort(f"position_{i}"))
        builder.Connect(spacing.GetOutputPort(f"speed_{i}"), loop.GetInputPort("speed"))
    return spacing


def _CheckLoop(builder: DiagramBuilder, loop: GuidanceLoop) -> None:
    """Raises ConfigurationError unless the speed of a loop can be set by a system."""
    if not any(system is loop for system in builder.GetSystems()):
        raise ConfigurationError(f"the loop {loop.get_name()!r} is not in the builder")
    if not loop.HasInputPort("speed"):
        raise ConfigurationError(
            f"the guidance of {loop.get_name()!r} has no input port 'speed'"
        )
    if builder.IsConnectedOrExported(loop.GetInputPort("speed")):
        raise ConfigurationError(f"the speed of {loop.get_name()!r} is set already")


def _SpeedOf(loop: GuidanceLoop) -> float:
    """Returns the greatest speed in m/s of a loop's guidance; infinite if it has no bound."""
    guidance = loop.guidance
    if not isinstance(guidance, GuidanceSystem):
        return np.inf
    return float(guidance.GetSpeed(guidance.CreateDefaultContext()))


class _ClosedLine:
    """A closed polyline on which vehicles are looked for.

    Attributes:
        length: The length in m.
    """

    def __init__(self, points: FloatArray) -> None:
        self._starts = points
        self._steps = np.roll(points, -1, axis=0) - points
        self._lengths = np.linalg.norm(self._steps, axis=1)
        # Between points that coincide any place will do.
        self._squares = np.maximum(self._lengths**2, np.finfo(np.float64).tiny)
        self._arcs = np.cumsum(self._lengths) - self._lengths
        self.length = float(self._lengths.sum())

    def Track(self, positions: FloatArray, arcs: FloatArray, reach: float) -> FloatArray:
        """Returns the arc lengths (n,) of vehicles at positions (n, 3), from their last ones.

        A vehicle that is not within `reach` of the path is `OFF_PATH`; others are looked for
        from where they were on, up to that far ahead.
        """
        places = positions[:, : self._starts.shape[1]]
        ahead = np.arange(1 + np.searchsorted(self._arcs, reach))
        found = np.full(len(places), OFF_PATH)
        known = np.flatnonzero(arcs >= 0.0)
        here = np.searchsorted(self._arcs, arcs[known], side="right") - 1
        found[known] = self._Nearest(places[known], here[:, None] + ahead, reach)
        lost = np.flatnonzero(found < 0.0)
        if len(lost):
            everywhere = np.tile(np.arange(len(self._arcs)), (len(lost), 1))
            found[lost] = self._Nearest(places[lost], everywhere, reach)
        return found

    def _Nearest(self, places: FloatArray, segments: IntArray, reach: float) -> FloatArray:
        """Returns the arc lengths (n,) nearest to places (n, d) on segments (n, k) of each."""
        segments = segments % len(self._arcs)
        starts, steps = self._starts[segments], self._steps[segments]
        along = np.einsum("nkd,nkd->nk", places[:, None] - starts, steps)
        along = np.clip(along / self._squares[segments], 0.0, 1.0)
        away = np.linalg.norm(places[:, None] - starts - along[..., None] * steps, axis=2)
        # The first of equals: before a dead end, the way in, and not the way back over it.
        nearest = away.min(axis=1, keepdims=True) + ROUNDING * self.length
        best = (away <= nearest).argmax(axis=1)
        rows = np.arange(len(places))
        segment = segments[rows, best]
        arcs = self._arcs[segment] + along[rows, best] * self._lengths[segment]
        return np.where(away[rows, best] <= reach, arcs % self.length, OFF_PATH)


def _Gaps(arcs: FloatArray, length: float) -> tuple[IntArray, FloatArray]:
    """Returns the vehicles (m,) on the path in their order, and the gap (m,) ahead of each."""
    on = np.flatnonzero(arcs >= 0.0)
    order = on[np.argsort(arcs[on], kind="stable")]
    return order, np.diff(arcs[order], append=arcs[order[:1]] + length)


def _Speeds(order: IntArray, gaps: FloatArray, shares: FloatArray, pace: Pace) -> FloatArray:
    """Returns the speeds (n,), from the vehicles (m,) on the path and their gaps (m,)."""
    speeds = np.full(len(shares), pace.speed)
    shares = shares[order]
    stretched = gaps * shares.sum() / (len(order) * shares)
    change = pace.gain * (stretched - np.roll(stretched, 1))
    speeds[order] = np.clip(pace.speed + change, pace.slowest, pace.fastest)
    return speeds


def _CheckedShares(shares: ArrayLike, count: int) -> FloatArray:
    """Returns the shares (n,), which sum to 1."""
    values = np.asarray(shares, dtype=np.float64)
    if values.shape != (count,) or not (np.isfinite(values).all() and (values > 0.0).all()):
        raise ConfigurationError(
            f"need {count} shares that are finite and positive, got {values.tolist()}"
        )
    return np.asarray(values / values.sum())
