"""The SE(3) controller as a system: from a velocity command to propeller forces."""

from typing import Any

from pydrake.systems.framework import BasicVector_, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from systems.mixing import CalcPropellerForces
from systems.quadrotor import NUM_PROPELLERS, STATE_SIZE, QuadrotorParameters
from systems.scalars import (
    SCALARS,
    CheckFinite,
    CheckFiniteParameter,
    CheckPositiveParameter,
    MathOf,
    Scalar,
    ToList,
    ToVector,
)
from systems.se3_law import CalcThrustAndTorque, Gains

DEFAULT_GAINS = Gains(
    velocity_gain=3.0, attitude_bandwidth=12.0, damping_ratio=0.7, heading=0.0
)
"""Measured on a circle of 1 m.  A delay of 30 ms in the state is borne at 12 rad/s and diverges
at 18 (at 15 with a damping ratio of 1); a velocity gain above a quarter of the bandwidth, or a
damping ratio of 1, makes the turn-in at 4 m/s oscillate."""


@TemplateSystem.define("Se3Controller_", T_list=SCALARS)  # type: ignore[untyped-decorator, no-untyped-call]
def Se3Controller_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Flies a quadrotor at a commanded velocity by geometric control on SE(3).

        .. pydrake_system::

            name: Se3Controller
            input_ports:
            - state
            - velocity_command
            - acceleration_feedforward
            output_ports:
            - propeller_force

        `state` (12) is QuadrotorPlant's: position p_WB in m, roll-pitch-yaw in rad,
        velocity v_WB in m/s and the rates of roll-pitch-yaw in rad/s; z is up.

        `velocity_command` (3) in m/s and `acceleration_feedforward` (3) in m/s^2 are in W.

        `propeller_force` (4) is QuadrotorPlant's input: forces in N over the plant's
        force constant kF, which is 1 by default.  Each force is in
        [0, `QuadrotorParameters.max_propeller_force`].

        The law is that of Lee, Leok and McClamroch 2010 (see `systems.se3_law`), with a
        velocity command in place of a trajectory and the heading held fixed.  The one
        numeric parameter (index `parameter_index`) holds the `Gains`; see `SetGains`.  The
        output is direct feed-through.

        Args:
            parameters: The vehicle that is flown; by default the paper's.
            gains: The gains; by default `DEFAULT_GAINS`.

        Raises:
            ConfigurationError: if a gain cannot be used.
            NonFiniteValueError: on evaluation, where an input is not finite.
        """

        def _construct(
            self,
            parameters: QuadrotorParameters | None = None,
            gains: Gains = DEFAULT_GAINS,
            converter: Any = None,
        ) -> None:
            LeafSystem_[T].__init__(self, converter=converter)
            _CheckGains(gains)
            self._arguments: dict[str, Any] = {"parameters": parameters, "gains": gains}
            self._parameters = parameters or QuadrotorParameters()
            self._math = MathOf(T)
            self._state = self.DeclareVectorInputPort("state", STATE_SIZE)
            self._velocity_command = self.DeclareVectorInputPort("velocity_command", 3)
            self._acceleration_feedforward = self.DeclareVectorInputPort(
                "acceleration_feedforward", 3
            )
            self.parameter_index = self.DeclareNumericParameter(BasicVector_[T](list(gains)))
            self._propeller_force = self.DeclareVectorOutputPort(
                "propeller_force",
                NUM_PROPELLERS,
                self._CalcPropellerForce,
                {self.all_input_ports_ticket(), self.all_parameters_ticket()},
            )

        def _construct_copy(self, other: Any, converter: Any = None) -> None:
            Impl._construct(self, **other._arguments, converter=converter)

        @property
        def parameters(self) -> QuadrotorParameters:
            """The vehicle that is flown."""
            return self._parameters

        def GetGains(self, context: Any) -> Gains:
            """Returns the gains."""
            return Gains(
                *context.get_numeric_parameter(self.parameter_index).CopyToVector().tolist()
            )

        def SetGains(self, context: Any, gains: Gains) -> None:
            """Sets the gains; this system's own Context is wanted.

            To change one: ``SetGains(context, GetGains(context)._replace(heading=0.5))``.
            """
            _CheckGains(gains)
            context.get_mutable_numeric_parameter(self.parameter_index).SetFromVector(
                ToVector(T, gains)
            )

        def _CalcPropellerForce(self, context: Any, output: Any) -> None:
            state = self._Read(context, self._state)
            velocity_command = self._Read(context, self._velocity_command)
            acceleration = self._Read(context, self._acceleration_feedforward)
            gains = self.GetGains(context)
            thrust, torque = CalcThrustAndTorque(
                self._math, self._parameters, gains, state, velocity_command, acceleration
            )
            k = self._parameters.force_constant
            forces = CalcPropellerForces(self._parameters, thrust, torque)
            output.SetFromVector(ToVector(T, [force / k for force in forces]))

        def _Read(self, context: Any, port: Any) -> list[Scalar]:
            value = port.Eval(context)
            CheckFinite(self, context, port, ToList(value))
            return value.tolist()

    return Impl


Se3Controller = Se3Controller_[None]


def _CheckGains(gains: Gains) -> None:
    for name in ("velocity_gain", "attitude_bandwidth", "damping_ratio"):
        CheckPositiveParameter(name, getattr(gains, name))
    CheckFiniteParameter("heading", gains.heading)
