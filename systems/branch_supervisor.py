"""A supervisor between guidance and controller: changes branches, and keeps a flight safe."""

from collections.abc import Sequence
from functools import partial
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector_, LeafSystem_

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import Field, SteerableField
from sgvf_drake.paths.itinerary import Itinerary
from systems.branches import Branch, BranchAlong, CheckBranches, CheckedBox, CheckTour
from systems.guidance import CheckFlown, DeclareCommandPorts
from systems.quadrotor import QuadrotorParameters
from systems.scalars import (
    CheckFinite,
    CheckFiniteParameter,
    CheckNonNegativeParameter,
    CheckPositiveParameter,
    ToFloat,
    ToList,
    ToVector,
    template,
)
from systems.sensing import DEFAULT_SAMPLE_PERIOD
from systems.supervision import (
    ARC,
    BRANCH,
    EDGE,
    HOLD_POSITION,
    MODE,
    ON_TOUR,
    CalcCommands,
    Memory,
    Order,
    Seen,
    Settings,
    Supervision,
)

DEFAULT_HOLD_AFTER = 0.15
"""s; an estimator bridges a loss of 0.1 s."""

DEFAULT_LAND_AFTER = 1.0
"""s; a position that was predicted for longer is off by decimetres."""

ACCELERATION_SHARE = 0.4
"""Share of the greatest horizontal acceleration that a path may demand: the rest is for
errors, for the altitude and for torques."""


@template
def BranchSupervisor_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Flies from branch to branch of a path, and stops, slows down or lands in need.

        .. pydrake_system::

            name: BranchSupervisor
            input_ports:
            - position
            - velocity
            - velocity_command
            - acceleration_feedforward
            - speed
            - measurement_age
            output_ports:
            - velocity_command
            - acceleration_feedforward
            - mode
            - branch

        The inputs are what `GuidanceSystem` sees and what it commands: `position` (3) in m,
        `velocity` (3) in m/s, `velocity_command` (3) in m/s and `acceleration_feedforward` (3)
        in m/s^2 in W, and `speed` (1) in m/s.  `measurement_age` (1) is how old the last
        measurement is, in s; not connected, it is always fresh.

        The outputs `velocity_command` and `acceleration_feedforward` take the place of
        guidance's.  `mode` (1) is a `Mode` and `branch` (1) the number of the branch that is
        followed or flown to; both are for logs.

        A branch of a directed field has an itinerary on its network, and then there are more
        ports.  The output `intended_direction` (d), of no unit, is for guidance: about a node
        it is the direction of the exit, between nodes that of the edge, and zero at the end of
        an open itinerary, where the vehicle stops.  The output `edge` (1) is the number of the
        edge in use, from 1, negative if it is travelled backwards, and `arc` (1) the arc length
        in m on the itinerary, which laps count on.

        The place on the itinerary is found anew by the input `heading` (d), guidance's, when
        the vehicle comes to a branch, and by the position from then on.  Another itinerary is
        commanded by `SetRoute`, the next turn alone by the input `next_edge` (1): where the
        edge of that number can follow at the next node it does, and then the vehicle comes
        back to its itinerary the shortest way.  0, and not connected, commands nothing.

        Every `period` the supervisor decides on its mode:

        - FOLLOW hands guidance through.  Where the path demands more acceleration than
          `ACCELERATION_SHARE` of what the thrust allows, it lowers the speed until it does
          not.
        - TRANSFER flies a `Transfer` to a branch, and hands over to guidance at its end.
          It starts when another branch is wanted, at the place of the present branch that
          makes it short (see `DepartureDelay`); and at once when the vehicle is outside the
          box, nearer to another branch than to its own, or may fly again after HOLD.
        - HOLD stops smoothly and stays there: by command, at the end of an open itinerary, or
          while the measurement is older than `hold_after`.
        - LAND stops, descends to the landing height and stays there for good: when the
          measurement is older than `land_after`.

        In the last three the command is a reference motion, which moves at each sample, and
        a correction ``POSITION_GAIN (p_ref - p)``, smoothly limited to `MAX_CORRECTION`.
        With a field of dimension 2 the vertical command stays guidance's, but for LAND.

        The numeric parameter (index `parameter_index`) holds the `Settings`: the wanted
        branch, the laps on each branch of the tour, and the two ages in s; see `SetBranch`,
        `SetLaps`, `SetHoldAfter` and `SetLandAfter`.  They are read at each sample.  While
        the wanted branch is `ON_TOUR`, the tour rules: the next branch is wanted after the
        laps on this one, or at the end of an open one; the last is followed for good.  A
        tour that was interrupted by another wanted branch goes on where it was.

        The abstract parameter (index `route_index`) holds the last route that was commanded:
        a tuple of one `Order`, or an empty one.

        The discrete state is the supervisor's `Memory`.  The commands are direct
        feed-through.  Under AutoDiffXd they have the derivatives for a given memory; what
        the supervisor decides and plans has none.

        Args:
            field: The guiding field, of dimension 2 or 3, in metres.
            branches: The branches of its path; see `MakeBranches`.
            tour: Numbers of the branches in the order in which they are flown.
            laps: On each closed branch of the tour but the last, positive.
            parameters: The vehicle; by default the paper's.
            box: Lower and upper corner (d,) of where the field holds, in m: outside, the
                vehicle flies to its branch instead.  None: everywhere.
            landing_height: z in m.
            period: Of the decisions and of the reference, in s: that of the measurements.

        Raises:
            ConfigurationError: if an argument or a parameter cannot be used.
            NonFiniteValueError: on evaluation, where an input is not finite.
        """

        def _construct(
            self,
            field: Field,
            branches: Sequence[Branch],
            tour: Sequence[int] = (0,),
            laps: float = 1.0,
            parameters: QuadrotorParameters | None = None,
            box: tuple[ArrayLike, ArrayLike] | None = None,
            landing_height: float = 0.0,
            period: float = DEFAULT_SAMPLE_PERIOD,
        ) -> None:
            CheckFlown(field)
            corners = CheckedBox(box, field.dim)
            CheckBranches(branches, field.dim, corners)
            CheckTour(tour, len(branches))
            CheckPositiveParameter("laps", laps)
            CheckFiniteParameter("landing_height", landing_height)
            CheckPositiveParameter("period", period)
            self._dim, self._num_branches = field.dim, len(branches)
            vehicle = parameters or QuadrotorParameters()
            self._supervision = Supervision(
                field,
                branches,
                tour,
                ACCELERATION_SHARE * vehicle.max_horizontal_acceleration,
                corners,
                landing_height,
                period,
            )
            self._inputs = [
                self.DeclareVectorInputPort(name, size)
                for name, size in (
                    ("position", 3),
                    ("velocity", 3),
                    ("velocity_command", 3),
                    ("acceleration_feedforward", 3),
                    ("speed", 1),
                    ("measurement_age", 1),
                )
            ]
            self._heading: Any = None
            if isinstance(field, SteerableField):
                self._heading = self.DeclareVectorInputPort("heading", field.dim)
                self._next_edge = self.DeclareVectorInputPort("next_edge", 1)
            self.route_index = self.DeclareAbstractParameter(Value[object](()))
            self.parameter_index = self.DeclareNumericParameter(
                BasicVector_[T]([ON_TOUR, laps, DEFAULT_HOLD_AFTER, DEFAULT_LAND_AFTER])
            )
            start = Memory.AtStart(tour[0], field.dim).ToVector()
            self._memory_index = self.DeclareDiscreteState(BasicVector_[T](start.tolist()))
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._Update)
            self._DeclareOutputs()

        def _DeclareOutputs(self) -> None:
            memory = self.discrete_state_ticket(self._memory_index)
            tickets = (self.input_port_ticket(port.get_index()) for port in self._inputs[:4])
            DeclareCommandPorts(self, T, self._CalcCommands, {memory, *tickets})
            entries = {"mode": MODE, "branch": BRANCH}
            if self._heading is not None:
                self.DeclareVectorOutputPort(
                    "intended_direction", self._dim, self._CopyDirection, {memory}
                )
                entries |= {"edge": EDGE, "arc": ARC}
            for name, entry in entries.items():
                self.DeclareVectorOutputPort(name, 1, partial(self._CopyEntry, entry), {memory})

        @property
        def num_branches(self) -> int:
            """The number of branches."""
            return self._num_branches

        @property
        def num_edges(self) -> int:
            """The number of edges of the network of a directed field; 0 without one."""
            if self._heading is None:
                return 0
            field: Any = self._supervision.field
            return len(field.network.edges)

        def GetBranch(self, context: Any) -> int:
            """Returns the wanted branch: a number, `HOLD_POSITION` or `ON_TOUR`."""
            return int(self._Settings(context).branch)

        def SetBranch(self, context: Any, branch: int) -> None:
            """Sets the wanted branch, which is flown to from the next sample on.

            Args:
                context: This system's own.
                branch: The number of a branch, `HOLD_POSITION` or `ON_TOUR`.
            """
            self._SetParameter(context, 0, self._CheckedBranch(branch))

        def GetRoute(self, context: Any) -> Itinerary | None:
            """Returns the route that was commanded last; None if none was."""
            order = self._Order(context)
            course = None if order is None else order.route.course
            return None if course is None else course.itinerary

        def _Order(self, context: Any) -> Order | None:
            # In a tuple, since the newest Drake holds no None.
            orders = context.get_abstract_parameter(self.route_index).get_value()
            return orders[0] if orders else None

        def SetRoute(self, context: Any, route: Itinerary | str) -> None:
            """Commands a route in place of the itinerary of its branch, which is wanted then.

            A vehicle on one of its edges flies it from there on, and one on another edge of
            its piece comes to its start the shortest way.

            Args:
                context: This system's own.
                route: An itinerary on the network of the field; or its edges, as "1,2,-3".

            Raises:
                ConfigurationError: If the field is no directed one, if an edge does not
                    exist, cannot be travelled, or does not follow the one before it, or if no
                    branch is on its piece.
            """
            if self._heading is None:
                raise ConfigurationError("the field is no directed one; it has no routes")
            field: Any = self._supervision.field
            branch = BranchAlong(field, route)
            number = self._BranchOfPiece(branch)
            before = self._Order(context)
            count = 1 if before is None else before.number + 1
            parameter = context.get_mutable_abstract_parameter(self.route_index)
            parameter.SetFrom(Value[object]((Order(count, number, branch),)))
            self.SetBranch(context, number)

        def _BranchOfPiece(self, route: Branch) -> int:
            """Returns the number of the branch on the piece of a route."""
            piece = _PieceOf(route)
            for number, branch in enumerate(self._supervision.branches):
                if branch.course is not None and _PieceOf(branch) == piece:
                    return number
            raise ConfigurationError(f"no branch is on piece {piece + 1}, where the route is")

        def GetLaps(self, context: Any) -> float:
            """Returns the laps on each branch of the tour."""
            return self._Settings(context).laps

        def SetLaps(self, context: Any, laps: float) -> None:
            """Sets the laps on each branch of the tour; this system's own Context is wanted."""
            CheckPositiveParameter("laps", laps)
            self._SetParameter(context, 1, laps)

        def GetHoldAfter(self, context: Any) -> float:
            """Returns the age of a measurement in s beyond which the vehicle stops."""
            return self._Settings(context).hold_after

        def SetHoldAfter(self, context: Any, age: float) -> None:
            """Sets that age in s; this system's own Context is wanted."""
            CheckPositiveParameter("hold_after", age)
            self._SetParameter(context, 2, age)

        def GetLandAfter(self, context: Any) -> float:
            """Returns the age of a measurement in s beyond which the vehicle lands."""
            return self._Settings(context).land_after

        def SetLandAfter(self, context: Any, age: float) -> None:
            """Sets that age in s; this system's own Context is wanted."""
            CheckPositiveParameter("land_after", age)
            self._SetParameter(context, 3, age)

        def _Settings(self, context: Any) -> Settings:
            parameters = context.get_numeric_parameter(self.parameter_index)
            return Settings(*ToList(parameters.CopyToVector()))

        def _SetParameter(self, context: Any, index: int, value: float) -> None:
            parameters = context.get_mutable_numeric_parameter(self.parameter_index)
            parameters.SetAtIndex(index, T(value))

        def _CheckedBranch(self, branch: float) -> float:
            numbers = (ON_TOUR, HOLD_POSITION, *range(self._num_branches))
            if branch not in numbers:
                raise ConfigurationError(f"branch must be one of {numbers}, got {branch}")
            return float(branch)

        def _Update(self, context: Any, values: Any) -> None:
            settings = self._Settings(context)
            self._CheckedBranch(settings.branch)
            for name, value in settings._asdict().items():
                if name != "branch":
                    CheckPositiveParameter(name, value)
            vector = values.get_mutable_vector(self._memory_index)
            memory = Memory.FromVector(np.array(ToList(self._Vector(context))))
            self._supervision.Step(settings, self._See(context), memory)
            vector.SetFromVector(ToVector(T, memory.ToVector().tolist()))

        def _See(self, context: Any) -> Seen:
            position, velocity, velocity_command, acceleration, speed, age = (
                self._EvalFinite(context, port) for port in self._inputs
            )
            CheckNonNegativeParameter("speed", speed[0])
            return Seen(
                ToFloat(context.get_time()),
                position,
                velocity,
                velocity_command,
                acceleration,
                float(speed[0]),
                float(age[0]),
                *self._SeeCommands(context),
            )

        def _SeeCommands(self, context: Any) -> tuple[FloatArray | None, int, Order | None]:
            """Returns the heading, the next edge and the order."""
            order = self._Order(context)
            if self._heading is None:
                return None, 0, order
            heading = None
            if self._heading.HasValue(context):
                heading = self._EvalFinite(context, self._heading)
            if not self._next_edge.HasValue(context):
                return heading, 0, order
            number = float(self._EvalFinite(context, self._next_edge)[0])
            count = self.num_edges
            if number not in range(-count, count + 1):
                raise ConfigurationError(
                    f"next_edge must be the number of one of the {count} edges, got {number:g}"
                )
            return heading, int(number), order

        def _EvalFinite(self, context: Any, port: Any) -> FloatArray:
            if port is self._inputs[-1] and not port.HasValue(context):
                return np.zeros(1)  # The measurement is always fresh.
            values = ToList(port.Eval(context))
            CheckFinite(self, context, port, values)
            return np.array(values)

        def _CalcCommands(self, context: Any) -> Any:
            motion = (port.Eval(context) for port in self._inputs[:4])
            commands = CalcCommands(self._Vector(context), self._dim, *motion)
            if not math.isfinite(ToFloat(sum(commands))):
                self._See(context)
            return commands

        def _CopyEntry(self, entry: int, context: Any, output: Any) -> None:
            output.SetAtIndex(0, self._Vector(context)[entry])

        def _CopyDirection(self, context: Any, output: Any) -> None:
            output.SetFromVector(self._Vector(context)[-self._dim :])

        def _Vector(self, context: Any) -> Any:
            return context.get_discrete_state(self._memory_index).CopyToVector()

    return Impl


BranchSupervisor = BranchSupervisor_[None]


def _PieceOf(branch: Branch) -> int:
    """Returns the piece of the network on which the branch of a course is."""
    assert branch.course is not None
    itinerary = branch.course.itinerary
    return itinerary.network.edges[abs(itinerary.edges[0]) - 1].piece
