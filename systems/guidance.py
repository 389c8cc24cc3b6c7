"""From the vehicle's state to a velocity command, by the guiding vector field."""

import operator
from typing import Any

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import BasicVector_, LeafSystem_, ValueProducer
from pydrake.systems.scalar_conversion import TemplateSystem

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import AdjustableField, Field
from systems.quadrotor import STATE_SIZE
from systems.scalars import (
    SCALARS,
    CheckFinite,
    CheckFiniteParameter,
    CheckSpeed,
    EvalField,
    Scalar,
    ToList,
    ToVector,
)

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
"""1/s; how fast a flown field may ask a vehicle to turn toward the path.  A third of the
attitude bandwidth of the default controller: beyond about 8 the flight oscillates across the
path, below it costs nothing measurable."""

VELOCITY_OFFSET = 6
"""Where v_WB starts in the state."""


def FieldForSpeed(
    field: Field, speed: float, max_approach_rate: float = MAX_APPROACH_RATE
) -> Field:
    """Returns the field, made wide enough for a vehicle at a speed.

    Beside the path, a field asks a vehicle to turn at the rate speed / approach_length.
    Where that is more than the rate allowed, the approach length grows; fields that cannot
    be adjusted, or need not be, are returned as they are.

    Args:
        field: The field, in metres.
        speed: In m/s.
        max_approach_rate: In 1/s, well below the bandwidth of the vehicle's attitude.
    """
    if not isinstance(field, AdjustableField):
        return field
    needed = speed / max_approach_rate
    return field.with_approach_length(needed) if needed > field.approach_length else field


@TemplateSystem.define("GuidanceSystem_", T_list=SCALARS)  # type: ignore[untyped-decorator, no-untyped-call]
def GuidanceSystem_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Commands the velocity that follows a guiding vector field.

        .. pydrake_system::

            name: GuidanceSystem
            input_ports:
            - state
            output_ports:
            - velocity_command
            - acceleration_feedforward

        `state` (12) is QuadrotorPlant's: position p_WB in m, roll-pitch-yaw in rad,
        velocity v_WB in m/s and the rates of roll-pitch-yaw in rad/s; z is up.

        `velocity_command` (3) is speed m(p_WB) in m/s, in W, with m of the paper's
        equation 3.

        `acceleration_feedforward` (3) is the rate of that command in m/s^2 while the
        vehicle moves with its own velocity: speed J(p_WB) v_WB, where J is the field's
        Jacobian.  It is what makes a vehicle turn with the path instead of after it.

        A field of dimension 2 guides x and y, and the altitude is held by a velocity
        command ``ALTITUDE_GAIN (altitude - z)``, limited to `MAX_CLIMB_RATE`.  A field of
        dimension 3 guides all three, and the altitude is not used.

        The one numeric parameter (index `parameter_index`) holds (speed in m/s, altitude
        in m); see `SetSpeed` and `SetAltitude`.  Both outputs are direct feed-through, and
        both share one cached evaluation of the field.

        A learned field may ask for quicker turns than the vehicle can fly; `AddGuidance`
        passes it through `FieldForSpeed` first, and so should a diagram composed by hand.

        Args:
            field: The guiding field, of dimension 2 or 3, in metres.
            speed: In m/s, at which the field is followed.
            altitude: In m; only for a field of dimension 2.
            feedforward: False makes `acceleration_feedforward` zero, to show what it is
                for.

        Raises:
            ConfigurationError: if an argument cannot be used.
            NonFiniteValueError: on evaluation, where the state or the field is not finite.
        """

        def _construct(
            self,
            field: Field,
            speed: float = DEFAULT_SPEED,
            altitude: float = DEFAULT_ALTITUDE,
            feedforward: bool = True,
            converter: Any = None,
        ) -> None:
            LeafSystem_[T].__init__(self, converter=converter)
            if field.dim not in (2, 3):
                raise ConfigurationError(
                    f"a vehicle needs a field of dimension 2 or 3, got {field.dim}"
                )
            CheckSpeed(speed)
            CheckFiniteParameter("altitude", altitude)
            self._arguments: dict[str, Any] = {
                "field": field,
                "speed": speed,
                "altitude": altitude,
                "feedforward": feedforward,
            }
            self._field = field
            self._feedforward = feedforward
            self._state = self.DeclareVectorInputPort("state", STATE_SIZE)
            self.parameter_index = self.DeclareNumericParameter(
                BasicVector_[T]([speed, altitude])
            )
            # The field's value and Jacobian, flattened.  It does not depend on the
            # parameters, and a Value of anything but a BasicVector aborts when fields are
            # evaluated in batches.
            size = field.dim + field.dim**2
            self._value_and_jacobian = self.DeclareCacheEntry(
                "field value and Jacobian",
                ValueProducer(
                    allocate=lambda: Value[BasicVector_[T]](BasicVector_[T](size)),
                    calc=self._CalcField,
                ),
                {self.input_port_ticket(self._state.get_index())},
            )
            # Named one by one: the default takes in the time, and then the controller would
            # be evaluated in every stage of the integrator instead of once in a sample.
            sources = {
                self.input_port_ticket(self._state.get_index()),
                self._value_and_jacobian.ticket(),
                self.all_parameters_ticket(),
            }
            self._velocity_command = self.DeclareVectorOutputPort(
                "velocity_command", 3, self._CalcVelocityCommand, sources
            )
            self._acceleration_feedforward = self.DeclareVectorOutputPort(
                "acceleration_feedforward", 3, self._CalcAccelerationFeedforward, sources
            )

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(self, **other._arguments, converter=converter)

        @property
        def field(self) -> Field:
            """The field that is followed."""
            return self._field

        def GetSpeed(self, context: Any) -> Scalar:
            """Returns the speed in m/s."""
            return self._Parameters(context).GetAtIndex(0)

        def SetSpeed(self, context: Any, speed: Scalar) -> None:
            """Sets the speed in m/s; this system's own Context is wanted."""
            CheckSpeed(speed)
            context.get_mutable_numeric_parameter(self.parameter_index).SetAtIndex(0, speed)

        def GetAltitude(self, context: Any) -> Scalar:
            """Returns the altitude in m."""
            return self._Parameters(context).GetAtIndex(1)

        def SetAltitude(self, context: Any, altitude: Scalar) -> None:
            """Sets the altitude in m; this system's own Context is wanted."""
            CheckFiniteParameter("altitude", altitude)
            context.get_mutable_numeric_parameter(self.parameter_index).SetAtIndex(1, altitude)

        def _Parameters(self, context: Any) -> Any:
            return context.get_numeric_parameter(self.parameter_index)

        def _CalcField(self, context: Any, value: Any) -> None:
            state = self._state.Eval(context)
            CheckFinite(self, context, self._state, ToList(state))
            m, J = EvalField(self._field, state[: self._field.dim])
            result = np.concatenate((m, J.ravel()))
            CheckFinite(self, context, "the field's value or Jacobian", ToList(result))
            value.get_mutable_value().SetFromVector(result)

        def _Inputs(self, context: Any) -> tuple[list[Scalar], list[Scalar], Scalar, Scalar]:
            """Returns the field's value and Jacobian, the state, the speed, the altitude."""
            # The field is evaluated first: that is where the state is checked.
            field = self._value_and_jacobian.Eval(context).CopyToVector().tolist()
            speed, altitude = self._Parameters(context).CopyToVector().tolist()
            return field, self._state.Eval(context).tolist(), speed, altitude

        def _CalcVelocityCommand(self, context: Any, output: Any) -> None:
            field, state, speed, altitude = self._Inputs(context)
            dim = self._field.dim
            command = [speed * m_i for m_i in field[:dim]]
            if dim == 2:
                climb = ALTITUDE_GAIN * (altitude - state[2])
                command.append(min(max(climb, -MAX_CLIMB_RATE), MAX_CLIMB_RATE))
            output.SetFromVector(ToVector(T, command))

        def _CalcAccelerationFeedforward(self, context: Any, output: Any) -> None:
            if not self._feedforward:
                output.SetZero()
                return
            field, state, speed, altitude = self._Inputs(context)
            dim = self._field.dim
            v_WB = state[VELOCITY_OFFSET : VELOCITY_OFFSET + 3]
            acceleration = []
            for row in range(dim, dim + dim * dim, dim):
                J_v = sum(map(operator.mul, field[row : row + dim], v_WB))
                acceleration.append(speed * J_v)
            if dim == 2:
                climb = ALTITUDE_GAIN * (altitude - state[2])
                # The rate of the limited command is zero at its limit.
                limited = abs(climb) > MAX_CLIMB_RATE
                acceleration.append(0.0 if limited else -ALTITUDE_GAIN * v_WB[2])
            output.SetFromVector(ToVector(T, acceleration))

    return Impl


GuidanceSystem = GuidanceSystem_[None]
