"""From the vehicle's state to a velocity command, by the guiding vector field."""

from collections.abc import Callable, Sequence
from functools import lru_cache, partial
import math
from typing import Any, NamedTuple

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector_, LeafSystem_, ValueProducer

from sgvf_drake.compiling import digest, kernel
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import ParametricField
from sgvf_drake.fields.base import (
    AdjustableField,
    CompilableField,
    Field,
    SteerableField,
)
from sgvf_drake.fields.compiled import CompiledField, CompiledMotion
from systems import scalars
from systems.scalars import (
    CheckConstant,
    CheckFinite,
    CheckFiniteParameter,
    CheckNonNegativeParameter,
    CheckPositiveParameter,
    EvalField,
    MakeMoving,
    Scalar,
    Tanh,
    ToFloat,
    ToList,
    ToVector,
    compilable,
    template,
)
from systems.se3_law import NUM_DERIVATIVES

DEFAULT_SPEED = 0.45
"""m/s; a calm indoor pace.  The paper does not give the speed of its flights."""

DEFAULT_ALTITUDE = 1.0
"""m."""

ALTITUDE_GAIN = 2.0
"""From altitude error to climb rate, 1/s.  With the controller's velocity gain k_v the poles
of the altitude are -ALTITUDE_GAIN and -k_v."""

MAX_CLIMB_RATE = 1.0
"""m/s, up and down."""

MAX_APPROACH_RATE = 4.0
"""1/s; how fast a flown field may ask a quadrotor to turn toward the path.  A third of the
attitude bandwidth of the default controller: beyond about 8 the flight oscillates across the
path, below it costs nothing measurable."""

LENGTH_ROUNDING = 1e-9
"""A heading may be longer than 1 by this, for rounding."""

DIFFERENCE_TIME = 0.001
"""s; the derivatives of a command are of differences between where the vehicle was, is and will
be, this long before and after.  They are then as exact as (speed times this / approach length)
squared, and rounding does not show."""

WIDENED_FIELDS = 8
"""Fields of other approach lengths that a system keeps, one for each speed in use."""


def FieldForSpeed(
    field: Field, speed: float, max_approach_rate: float = MAX_APPROACH_RATE
) -> Field:
    """Returns the field as a vehicle flies it at a speed: made wide enough to be followed.

    Beside the path, a field asks a vehicle to turn at the rate speed / approach_length.
    Where that is more than the vehicle can, the approach length grows; fields that
    cannot be adjusted, or need not be, are returned as they are.

    Args:
        field: The field, in metres.
        speed: In m/s.
        max_approach_rate: What the vehicle can, in 1/s; by default a quadrotor.
    """
    if not isinstance(field, AdjustableField):
        return field
    needed = _ApproachLength(field, speed, max_approach_rate)
    return field.with_approach_length(needed) if needed > field.approach_length else field


def CheckFlown(field: Field | SteerableField) -> None:
    """Raises ConfigurationError, with the reason, on a field that no vehicle can follow."""
    if isinstance(field, ParametricField):
        raise ConfigurationError(
            "a parametric field is no field of places: its last coordinate is the parameter of "
            "the curve, which a vehicle would take for an altitude"
        )
    if field.dim not in (2, 3):
        raise ConfigurationError(
            f"a vehicle needs a field of dimension 2 or 3, got {field.dim}"
        )


def HasCompiledForm(field: Field | SteerableField) -> bool:
    """Tells whether compiled code can evaluate a field, or the motion of a directed one."""
    followed = field.with_memory() if isinstance(field, SteerableField) else field
    return isinstance(followed, CompilableField)


def _ApproachLength(field: Field, speed: Scalar, max_approach_rate: float) -> float:
    """Returns the approach length in m at which a vehicle follows a field, 0 if it has none."""
    if not isinstance(field, AdjustableField):
        return 0.0
    return max(field.approach_length, ToFloat(speed) / max_approach_rate)


@template
def GuidanceSystem_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Commands the velocity that follows a guiding vector field.

        .. pydrake_system::

            name: GuidanceSystem
            input_ports:
            - position
            - velocity
            - speed
            output_ports:
            - velocity_command
            - acceleration_feedforward
            - speed
            - command_derivatives

        `position` (3) is p_WB in m and `velocity` (3) is v_WB in m/s; z is up.

        `velocity_command` (3) is speed m(p_WB) in m/s, in W, with m of the paper's
        equation 3.

        `acceleration_feedforward` (3) is the rate of that command in m/s^2 while the
        vehicle moves with its own velocity: speed J(p_WB) v_WB, where J is the field's
        Jacobian.  It is what makes a vehicle turn with the path instead of after it.

        The output `speed` (1) in m/s is the parameter of that name or, where the input `speed`
        (1) is connected, the lesser of the two: the approach length is for the parameter, so a
        faster vehicle could not follow.  The feed-forward takes this speed as constant.

        `command_derivatives` (24) in W are those of `systems.se3_law.NUM_DERIVATIVES`, by
        differences over `DIFFERENCE_TIME`; they cost two more evaluations of the field, where
        they are asked for.  A directed field has no such port.

        A directed field m(x, g) is followed with g = h, a heading that is remembered in the
        continuous state (d), of no unit and of length at most 1.  It turns to a further input,
        `intended_direction` (d), or, where that is zero or not connected, to the tangent of
        the strand that is followed: the vehicle then goes straight on.  It does so over the
        distance `memory_length` of the field.  A further output, `heading` (d), is that
        state; a vehicle whose heading is zero follows no network, so see `SetHeading`.  The
        rate of the heading is part of the feed-forward.

        A field of dimension 2 guides x and y, and the altitude is held by a velocity
        command ``ALTITUDE_GAIN (altitude - z)``, smoothly limited to `MAX_CLIMB_RATE` by a
        hyperbolic tangent.  A field of dimension 3 guides all three, and the altitude is
        not used.

        The one numeric parameter (index `parameter_index`) holds (speed in m/s, altitude
        in m, approach length in m); see `SetSpeed`, `SetAltitude` and `SetApproachLength`.
        The approach length is that of the field, or what the vehicle can turn at its speed
        if that is more (see `FieldForSpeed`), and 0 for a field that has none.

        The two commands are direct feed-through, and share one cached evaluation of the
        field.

        Args:
            field: The guiding field, of dimension 2 or 3, in metres; perhaps a directed one.
            speed: In m/s, at which the field is followed.
            altitude: In m; only for a field of dimension 2.
            feedforward: False makes `acceleration_feedforward` zero, to show what it is
                for.
            max_approach_rate: How fast the field may ask the vehicle to turn toward the path,
                in 1/s; by default that of a quadrotor.

        Raises:
            ConfigurationError: if an argument or a parameter cannot be used, or a
                derivative by the approach length is asked for.
            NonFiniteValueError: on evaluation, where an input or the field is not finite.
        """

        def _construct(
            self,
            field: Field,
            speed: float = DEFAULT_SPEED,
            altitude: float = DEFAULT_ALTITUDE,
            feedforward: bool = True,
            max_approach_rate: float = MAX_APPROACH_RATE,
        ) -> None:
            self._position = self.DeclareVectorInputPort("position", 3)
            self._velocity = self.DeclareVectorInputPort("velocity", 3)
            motion = {
                self.input_port_ticket(port.get_index())
                for port in (self._position, self._velocity)
            }
            self._DeclareGuidance(
                motion, field, speed, altitude, feedforward, max_approach_rate
            )

        def _DeclareGuidance(
            self,
            motion: set[Any],
            field: Field,
            speed: float,
            altitude: float,
            feedforward: bool,
            max_approach_rate: float,
        ) -> None:
            """Declares all but the ports of the motion, of which these are the tickets."""
            CheckFlown(field)
            CheckNonNegativeParameter("speed", speed)
            CheckPositiveParameter("max_approach_rate", max_approach_rate)
            CheckFiniteParameter("altitude", altitude)
            self._field, self._max_approach_rate = field, max_approach_rate
            self._is_adjustable = isinstance(field, AdjustableField)
            self._Flown = lru_cache(WIDENED_FIELDS)(partial(_Fly, field, T))
            self._feedforward = feedforward
            self._Calc = _CalcCommandsCompiled if T is float else _CalcCommandsInPython
            self.parameter_index = self.DeclareNumericParameter(
                BasicVector_[T](
                    [speed, altitude, _ApproachLength(field, speed, max_approach_rate)]
                )
            )
            parameters = self.all_parameters_ticket()
            sources = {parameters, *motion}
            self._intended: Any = None
            if isinstance(field, SteerableField):
                sources |= self._DeclareHeading(field, sources)
            else:
                self._m_and_J = self._DeclareVector(
                    "m_and_J", field.dim + field.dim**2, self._CalcField, sources
                )
            self._asked = self.DeclareVectorInputPort("speed", 1)
            asked = self.input_port_ticket(self._asked.get_index())
            DeclareCommandPorts(self, T, self._CalcCommands, {*sources, asked})
            self.DeclareVectorOutputPort("speed", 1, self._CalcSpeed, {parameters, asked})
            if self._intended is None:
                self.DeclareVectorOutputPort(
                    "command_derivatives",
                    NUM_DERIVATIVES,
                    self._CalcDerivatives,
                    {*sources, asked},
                )

        def _DeclareHeading(self, field: SteerableField, sources: set[Any]) -> set[Any]:
            """Declares what a directed field needs; returns what the commands depend on too."""
            motion, heading = field.with_memory(), self.xc_ticket()
            self._memory_length = motion.memory_length
            self._intended = self.DeclareVectorInputPort("intended_direction", field.dim)
            self.DeclareContinuousState(field.dim)
            MakeMoving(self)
            self.DeclareVectorOutputPort("heading", field.dim, self._CopyHeading, {heading})
            # Shared by the commands and the rate of the heading, which are both asked for in
            # every stage of the integrator.
            size = motion.dim + motion.dim**2
            self._motion = self._DeclareVector(
                "motion", size, self._CalcMotion, {*sources, heading}
            )
            return {heading, self.input_port_ticket(self._intended.get_index())}

        def _DeclareVector(
            self, name: str, size: int, calc: Callable[[Any, Any], None], sources: set[Any]
        ) -> Any:
            """Declares what is computed once for all that need it."""
            return self.DeclareCacheEntry(
                name,
                ValueProducer(
                    allocate=lambda: Value[BasicVector_[T]](BasicVector_[T](size)), calc=calc
                ),
                sources,
            )

        @property
        def field(self) -> Field:
            """The field that was given; `GetFlownField` returns the one that is followed."""
            return self._field

        def GetFlownField(self, context: Any) -> Field:
            """Returns the field with the approach length of the Context."""
            return self._Flown(*self._ReadParameters(context)[2:]).field

        def GetSpeed(self, context: Any) -> Scalar:
            """Returns the speed in m/s; where the input `speed` is connected, the most."""
            return self._Parameters(context).GetAtIndex(0)

        def SetSpeed(self, context: Any, speed: Scalar) -> None:
            """Sets the speed in m/s, and the approach length that goes with it.

            This system's own Context is wanted.  A derivative by the speed is the one at
            this approach length, which has none.
            """
            CheckNonNegativeParameter("speed", speed)
            parameters = context.get_mutable_numeric_parameter(self.parameter_index)
            parameters.SetAtIndex(0, speed)
            length = _ApproachLength(self._field, speed, self._max_approach_rate)
            parameters.SetAtIndex(2, T(length))

        def GetAltitude(self, context: Any) -> Scalar:
            """Returns the altitude in m."""
            return self._Parameters(context).GetAtIndex(1)

        def SetAltitude(self, context: Any, altitude: Scalar) -> None:
            """Sets the altitude in m; this system's own Context is wanted."""
            CheckFiniteParameter("altitude", altitude)
            context.get_mutable_numeric_parameter(self.parameter_index).SetAtIndex(1, altitude)

        def GetApproachLength(self, context: Any) -> Scalar:
            """Returns the distance in m over which the flown field turns to the path."""
            return self._Parameters(context).GetAtIndex(2)

        def SetApproachLength(self, context: Any, length: float) -> None:
            """Sets the approach length in m; this system's own Context is wanted.

            Raises:
                ConfigurationError: if it is not positive, or the field has none.
            """
            if not self._is_adjustable:
                raise ConfigurationError("the field has no approach length to set")
            CheckPositiveParameter("approach_length", length)
            context.get_mutable_numeric_parameter(self.parameter_index).SetAtIndex(2, T(length))

        def GetHeading(self, context: Any) -> np.ndarray:
            """Returns the heading (d,) of a directed field; this system's own Context."""
            return context.get_continuous_state_vector().CopyToVector()

        def SetHeading(self, context: Any, heading: Any) -> None:
            """Sets the heading (d,) of a directed field; this system's own Context is wanted.

            Raises:
                ConfigurationError: if the field has none, or it is not finite or too long.
            """
            values = np.asarray(heading, dtype=np.float64)
            if self._intended is None:
                raise ConfigurationError("the field is no directed one; it has no heading")
            if values.shape != (self._field.dim,) or not (
                np.linalg.norm(values) <= 1.0 + LENGTH_ROUNDING
            ):
                raise ConfigurationError(
                    f"a heading is a vector ({self._field.dim},) of length at most 1, got "
                    f"{values.tolist()}"
                )
            context.SetContinuousState(ToVector(T, values.tolist()))

        def _CalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
            """Turns the heading."""
            turn = self._Turn(context, self._EvalMotion(context))
            speed = self._FlownSpeed(context, self.GetSpeed(context))
            derivatives.get_mutable_vector().SetFromVector(speed * turn)

        def _EvalDirected(self, context: Any) -> tuple[np.ndarray, np.ndarray]:
            """Returns m and J by rows, (d + d^2,), and dm by the turn of the heading, (d,)."""
            d = self._field.dim
            motion = self._EvalMotion(context)
            J = motion[2 * d : 2 * d + 2 * d * d].reshape(d, 2 * d)
            field = np.concatenate((motion[:d], J[:, :d].ravel()))
            return field, J[:, d:] @ self._Turn(context, motion)

        def _EvalMotion(self, context: Any) -> np.ndarray:
            """Returns F of place and heading, and its Jacobian by rows, (2d + 4d^2,)."""
            return self._motion.Eval(context).CopyToVector()

        def _EvalVehicle(self, context: Any) -> tuple[np.ndarray, np.ndarray]:
            """Returns p_WB and v_WB, (3,) each."""
            return self._position.Eval(context), self._velocity.Eval(context)

        def _CheckVehicle(self, context: Any) -> None:
            for port in (self._position, self._velocity):
                CheckFinite(self, context, port, ToList(port.Eval(context)))

        def _CalcField(self, context: Any, m_and_J: Any) -> None:
            place = self._EvalVehicle(context)[0][: self._field.dim]
            flown = self._Flown(*self._ReadParameters(context)[2:])
            m_and_J.get_mutable_value().SetFromVector(flown.evaluate(place))

        def _CalcMotion(self, context: Any, motion: Any) -> None:
            place = self._EvalVehicle(context)[0][: self._field.dim]
            flown = self._Flown(*self._ReadParameters(context)[2:])
            values = flown.evaluate(np.concatenate((place, self.GetHeading(context))))
            motion.get_mutable_value().SetFromVector(values)

        def _Turn(self, context: Any, motion: np.ndarray) -> np.ndarray:
            """Returns by how much the heading turns, (d,) per metre."""
            d = self._field.dim
            if self._intended.HasValue(context):
                intended = self._intended.Eval(context)
                CheckFinite(self, context, self._intended, ToList(intended))
                if any(ToList(intended)):
                    return (intended - self.GetHeading(context)) / self._memory_length
            return motion[d : 2 * d]

        def _ReadParameters(self, context: Any) -> list[Scalar]:
            """Returns speed, altitude and, as a plain float, approach length."""
            parameters = self._Parameters(context).CopyToVector().tolist()
            if T is not float:
                parameters[2] = CheckConstant("approach_length", parameters[2])
            return parameters

        def _Parameters(self, context: Any) -> Any:
            return context.get_numeric_parameter(self.parameter_index)

        def _CalcCommands(self, context: Any) -> np.ndarray:
            position, velocity = self._EvalVehicle(context)
            speed, altitude, _ = self._ReadParameters(context)
            CheckNonNegativeParameter("speed", speed)
            speed = self._FlownSpeed(context, speed)
            if self._intended is None:
                field = self._m_and_J.Eval(context).CopyToVector()
                commands = self._Calc(field, position, velocity, speed, altitude)
            else:
                field, turning = self._EvalDirected(context)
                commands = self._Calc(field, position, velocity, speed, altitude)
                # The heading turns at the commanded speed, whatever the vehicle's own.
                commands[3 : 3 + len(turning)] += speed * speed * turning
            # Looked at afterwards: what is not finite has made all commands so.
            if not math.isfinite(ToFloat(commands[0])):
                self._CheckVehicle(context)
                CheckFinite(self, context, "the field's value or Jacobian", ToList(field))
                CheckFinite(self, context, "the command", ToList(commands))
            if not self._feedforward:
                commands[3:] = T(0.0)
            return commands

        def _CalcDerivatives(self, context: Any, output: Any) -> None:
            p, v = self._EvalVehicle(context)
            speed, altitude, approach_length = self._ReadParameters(context)
            speed = self._FlownSpeed(context, speed)
            flown, d = self._Flown(approach_length), self._field.dim
            way = DIFFERENCE_TIME * v
            fields = (
                flown.evaluate(p[:d] - way[:d]),
                self._m_and_J.Eval(context).CopyToVector(),
                flown.evaluate(p[:d] + way[:d]),
            )
            commands = [
                CalcCommandAt(field, place, speed, altitude)
                for field, place in zip(fields, (p - way, p, p + way), strict=True)
            ]
            derivatives = CalcDerivatives(commands, v)
            if not all(map(math.isfinite, ToList(derivatives))):
                self._CheckVehicle(context)
                CheckFinite(self, context, "a derivative of the command", ToList(derivatives))
            output.SetFromVector(derivatives)

        def _FlownSpeed(self, context: Any, speed: Scalar) -> Scalar:
            """Returns the speed of the parameter, or that of the input, if it is less."""
            if not self._asked.HasValue(context):
                return speed
            asked = self._asked.Eval(context)[0]
            CheckFinite(self, context, self._asked, [ToFloat(asked)])
            CheckNonNegativeParameter("the speed that is asked for", asked)
            return asked if asked < speed else speed

        def _CopyHeading(self, context: Any, output: Any) -> None:
            output.SetFromVector(self.GetHeading(context))

        def _CalcSpeed(self, context: Any, output: Any) -> None:
            output.SetAtIndex(0, self._FlownSpeed(context, self.GetSpeed(context)))

    return Impl


GuidanceSystem = GuidanceSystem_[None]


def DeclareCommandPorts(
    system: Any, T: type, calc: Callable[[Any], Any], sources: set[Any]
) -> None:
    """Declares the outputs `velocity_command` and `acceleration_feedforward` of a system.

    Args:
        system: Of the scalar type T; is changed.
        T: The scalar type.
        calc: Returns velocity and acceleration (6,) for a Context, once for both ports.
        sources: Tickets of what `calc` depends on.
    """

    def Calc(context: Any, value: Any) -> None:
        value.get_mutable_value().SetFromVector(calc(context))

    # A Value of anything but a BasicVector aborts when fields are evaluated in batches.
    commands = system.DeclareCacheEntry(
        "commands",
        ValueProducer(
            allocate=lambda: Value[BasicVector_[T]](BasicVector_[T](6)),
            calc=Calc,
        ),
        sources,
    )

    def Copy(part: slice, context: Any, output: Any) -> None:
        output.SetFromVector(commands.Eval(context).CopyToVector()[part])

    # The sources are named: the default takes in the time, and then the controller would be
    # evaluated in every stage of the integrator instead of once in a sample.
    sources = sources | {commands.ticket()}
    for name, part in (
        ("velocity_command", slice(0, 3)),
        ("acceleration_feedforward", slice(3, 6)),
    ):
        system.DeclareVectorOutputPort(name, 3, partial(Copy, part), sources)


@compilable
def _CalcCommands(
    field: np.ndarray,
    p_WB: np.ndarray,
    v_WB: np.ndarray,
    speed: Scalar,
    altitude: Scalar,
    commands: np.ndarray,
) -> np.ndarray:
    """Fills in the commands (6,) from m and J by rows, the vehicle's motion, the parameters."""
    dim = 2 if len(field) == 6 else 3
    for i in range(dim):
        row = field[dim + dim * i :]
        J_v = row[0] * v_WB[0] + row[1] * v_WB[1]
        if dim == 3:
            J_v += row[2] * v_WB[2]
        commands[i], commands[3 + i] = field[i], J_v
    CompleteCommands(dim, p_WB, v_WB, speed, altitude, commands)
    return commands


@compilable
def CompleteCommands(
    dim: int,
    p_WB: np.ndarray,
    v_WB: np.ndarray,
    speed: Scalar,
    altitude: Scalar,
    commands: np.ndarray,
) -> None:
    """Turns m and J v of a field, which stand in commands (6,), into velocity and its rate."""
    for i in range(dim):
        commands[i] = speed * commands[i]
        commands[3 + i] = speed * commands[3 + i]
    if dim == 2:
        climb = Tanh(ALTITUDE_GAIN * (altitude - p_WB[2]) / MAX_CLIMB_RATE)
        commands[2] = MAX_CLIMB_RATE * climb
        commands[5] = -ALTITUDE_GAIN * (1.0 - climb * climb) * v_WB[2]


def CalcCommandAt(
    field: np.ndarray, p_WB: np.ndarray, speed: Scalar, altitude: Scalar
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the command U (3,) in m/s at a place, and its derivative DU (3, 3) in 1/s.

    Args:
        field: m and J by rows, (d + d^2,), at the place.
        p_WB: The place (3,) in m.
        speed: In m/s.
        altitude: In m.
    """
    d = 2 if len(field) == 6 else 3
    up = np.array([0.0, 0.0, 1.0])
    commands = _CalcCommands(field, p_WB, up, speed, altitude, np.empty(6, field.dtype))
    # The last column; what else is not of the field is zero, in the field's scalar type.
    DU = np.outer(commands[3:], up)
    DU[:d, :d] = speed * field[d:].reshape(d, d)
    return commands[:3], DU


def CalcDerivatives(
    commands: Sequence[tuple[np.ndarray, np.ndarray]], v_WB: np.ndarray
) -> np.ndarray:
    """Returns the derivatives of a command, (`NUM_DERIVATIVES`,).

    Those along the velocity are second differences, of the command and of DU v: the latter is
    the derivative of the former along the velocity, exactly.

    Args:
        commands: U and DU where the vehicle was, is and will be; see `CalcCommandAt`.
        v_WB: Its velocity (3,) in m/s.
    """
    (U_0, DU_0), (U_1, DU_1), (U_2, DU_2) = commands
    h = DIFFERENCE_TIME
    second = (U_0 - 2.0 * U_1 + U_2) / h**2
    third = (DU_0 - 2.0 * DU_1 + DU_2) @ v_WB / h**2
    D2U_v = (DU_2 - DU_0) / (2.0 * h)
    return np.concatenate([second, third, DU_1.ravel(), D2U_v.ravel()])


def _CalcCommandsInPython(
    field: np.ndarray, p_WB: np.ndarray, v_WB: np.ndarray, speed: Scalar, altitude: Scalar
) -> np.ndarray:
    commands = _CalcCommands(field, p_WB, v_WB, speed, altitude, np.empty(6, object))
    if not all(map(math.isfinite, (*ToList(p_WB), *ToList(v_WB), *ToList(commands)))):
        commands[:] = np.nan
    return commands


def _MakeCompiled(sources: int) -> Any:
    @kernel
    def calc_commands(
        field: np.ndarray, p_WB: np.ndarray, v_WB: np.ndarray, speed: float, altitude: float
    ) -> np.ndarray:
        sources  # noqa: B018 (enclosed to be in the key of the cache; see `digest`)
        commands = _CalcCommands(field, p_WB, v_WB, speed, altitude, np.empty(6))
        # What does not enter a command must not pass as good either.
        usable = np.isfinite(p_WB).all() and np.isfinite(v_WB).all()
        if not (usable and np.isfinite(commands).all()):
            commands[:] = np.nan
        return commands

    return calc_commands


_CalcCommandsCompiled = _MakeCompiled(digest(scalars))
"""The commands (6,), which are NaN where an input cannot be used."""


class _FlownField(NamedTuple):
    """A field of one approach length, and what evaluates it at one point: see `EvalField`.

    A directed field is evaluated as the motion of place and heading.  What compiled code calls
    takes the arguments; there are none where the field has no compiled form.
    """

    field: Field
    evaluate: Callable[[np.ndarray], np.ndarray]
    arguments: tuple[Any, ...] | None = None


def _Fly(field: Field, T: type, approach_length: float) -> _FlownField:
    if isinstance(field, AdjustableField):
        CheckPositiveParameter("approach_length", approach_length)
        if approach_length != field.approach_length:
            field = field.with_approach_length(approach_length)
    followed = field.with_memory() if isinstance(field, SteerableField) else field
    if T is float and isinstance(followed, CompilableField):
        compiled = followed.compiled()
        arguments = None
        if isinstance(compiled, CompiledField | CompiledMotion):
            arguments = compiled.arguments
        return _FlownField(field, compiled.evaluate, arguments)
    return _FlownField(field, partial(EvalField, followed))
