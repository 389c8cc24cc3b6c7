"""The SE(3) controller as a system: from a velocity command to propeller forces."""

import math
from typing import Any

import numpy as np
from pydrake.systems.framework import BasicVector_, LeafSystem_

from sgvf_drake.compiling import digest, kernel
from sgvf_drake.exceptions import ConfigurationError
from systems import quadrotor, scalars, se3_law
from systems.quadrotor import (
    ATTITUDE,
    NUM_PROPELLERS,
    STATE_SIZE,
    VELOCITY,
    QuadrotorParameters,
    Rotors,
)
from systems.scalars import (
    CheckFinite,
    CheckFiniteParameter,
    CheckNonNegativeParameter,
    CheckPositiveParameter,
    ToFloat,
    ToList,
    ToVector,
    compilable,
    template,
)
from systems.se3_law import (
    NUM_DERIVATIVES,
    Body,
    CalcAcceleration,
    CalcPropellerInput,
    Gains,
)

DEFAULT_GAINS = Gains(
    velocity_gain=3.0, attitude_bandwidth=12.0, damping_ratio=0.7, heading=0.0
)
"""Measured on a circle of 1 m.  A delay of 30 ms in the state is borne at 12 rad/s and diverges
at 18 (at 15 with a damping ratio of 1); a velocity gain above a quarter of the bandwidth, or a
damping ratio of 1, makes the turn-in at 4 m/s oscillate."""

HEADING = Gains._fields.index("heading")
"""Its place among the numeric parameters."""

DISTURBANCE_BANDWIDTH = 6.0
"""rad/s, of the estimate of what disturbs a vehicle: half of that of the attitude that answers.
On a circle of 1 m, with a delay of 30 ms and wind of 3 m/s, it leaves 3 mm of 190 mm."""


# For a type checker, that with which the methods below are mixed.
_AnySystem: Any = object


def Se3Methods(T: type) -> Any:
    """Returns what an `Se3Controller` does, but for its ports of state and commands.

    It is a class outside of Drake, since a system may have only one base that is a system.

    Args:
        T: The scalar type.
    """

    class Methods(_AnySystem):
        _state: Any
        _velocity_command: Any
        _acceleration_feedforward: Any
        _command_derivatives: Any = None

        def _DeclareController(
            self,
            sources: set[Any],
            parameters: QuadrotorParameters | None,
            gains: Gains,
            saturate: bool,
        ) -> None:
            """Declares all but the ports of state and commands, and says what it depends on."""
            _CheckGains(gains)
            self._parameters = parameters or QuadrotorParameters()
            self._saturate = saturate
            self._heading = self.DeclareVectorInputPort("heading", 1)
            self.gains_index = self.DeclareNumericParameter(BasicVector_[T](list(gains)))
            self._undisturbed = ToVector(T, [0.0, 0.0, 0.0])
            self._predicted_velocity: Any = None
            if ToFloat(gains.disturbance_bandwidth) > 0.0:
                self._predicted_velocity = self.DeclareVectorInputPort("predicted_velocity", 3)
            body = [self._parameters.mass, *self._parameters.inertia]
            self.body_index = self.DeclareNumericParameter(BasicVector_[T](body))
            sources = sources | {self.all_parameters_ticket()}
            self._propeller_force = self.DeclareVectorOutputPort(
                "propeller_force", NUM_PROPELLERS, self._CalcPropellerForce, sources
            )
            self._acceleration = self.DeclareVectorOutputPort(
                "acceleration", 3, self._CalcAcceleration, sources
            )

        @property
        def parameters(self) -> QuadrotorParameters:
            """The vehicle that is flown."""
            return self._parameters

        @property
        def arguments(self) -> dict[str, Any]:
            """What it was made with, by name."""
            return dict(self._arguments)

        def GetGains(self, context: Any) -> Gains:
            """Returns the gains."""
            return Gains(
                *context.get_numeric_parameter(self.gains_index).CopyToVector().tolist()
            )

        def SetGains(self, context: Any, gains: Gains) -> None:
            """Sets the gains; this system's own Context is wanted.

            To change one: ``SetGains(context, GetGains(context)._replace(heading=0.5))``.
            """
            _CheckGains(gains)
            if gains.disturbance_bandwidth > 0.0 and self._predicted_velocity is None:
                raise ConfigurationError(
                    "this controller was made without a disturbance_bandwidth, to estimate none"
                )
            context.get_mutable_numeric_parameter(self.gains_index).SetFromVector(
                ToVector(T, gains)
            )

        def GetBody(self, context: Any) -> Body:
            """Returns the mass in kg and the inertia in kg m^2 that are believed."""
            return Body(*context.get_numeric_parameter(self.body_index).CopyToVector().tolist())

        def SetBody(self, context: Any, body: Body) -> None:
            """Sets the mass in kg and the inertia in kg m^2 that are believed.

            This system's own Context is wanted.  The vehicle's own stay what they are: so
            one sees what a wrong belief costs.
            """
            _CheckBody(body)
            context.get_mutable_numeric_parameter(self.body_index).SetFromVector(
                ToVector(T, body)
            )

        def _ReadGains(self, context: Any) -> np.ndarray:
            """Returns the gains (5,) with the heading that is asked for."""
            gains = context.get_numeric_parameter(self.gains_index).CopyToVector()
            if self._heading.HasValue(context):
                gains[HEADING] = self._heading.Eval(context)[0]
            return gains

        def _ReadDerivatives(self, context: Any) -> np.ndarray:
            """Returns the derivatives of the command, or none."""
            port = self._command_derivatives
            if port is None or not port.HasValue(context):
                return self._undisturbed[:0]
            return port.Eval(context)

        def _CalcDisturbance(self, context: Any) -> np.ndarray:
            """Returns what disturbs the vehicle, (3,) in m/s^2 in W."""
            if self._predicted_velocity is None:
                return self._undisturbed
            bandwidth = context.get_numeric_parameter(self.gains_index).GetAtIndex(4)
            predicted = self._predicted_velocity.Eval(context)
            return bandwidth * (self._state.Eval(context)[VELOCITY] - predicted)

        def _CalcPropellerForce(self, context: Any, output: Any) -> None:
            arguments = (
                self._state.Eval(context),
                self._velocity_command.Eval(context),
                self._acceleration_feedforward.Eval(context),
                self._ReadDerivatives(context),
                self._CalcDisturbance(context),
                self._ReadGains(context),
                context.get_numeric_parameter(self.body_index).CopyToVector(),
                self._parameters.rotors,
                self._parameters.gravity,
                self._saturate,
            )
            if T is float:
                # Looked at afterwards: a bad input makes the forces NaN, and checks in Python
                # would cost more than the law.
                forces = _CalcInputCompiled(*arguments)
            else:
                self._CheckInputs(context)
                forces = np.array(CalcPropellerInput(*arguments))
            if not math.isfinite(ToFloat(forces[0])):
                self._CheckInputs(context)
                # The law has no direction for a thrust vector of zero, and overflows far away.
                CheckFinite(self, context, "the propeller force", ToList(forces))
            output.SetFromVector(forces)

        def _CalcAcceleration(self, context: Any, output: Any) -> None:
            forces = self._propeller_force.Eval(context)
            attitude = tuple(self._state.Eval(context)[ATTITUDE].tolist())
            lift = self._parameters.force_constant * forces.sum() / self._parameters.mass
            acceleration = CalcAcceleration(attitude, lift, self._parameters.gravity)
            output.SetFromVector(np.array(acceleration) + self._CalcDisturbance(context))

        def _CheckInputs(self, context: Any) -> None:
            for port in (self._state, self._velocity_command, self._acceleration_feedforward):
                CheckFinite(self, context, port, ToList(port.Eval(context)))
            derivatives = ToList(self._ReadDerivatives(context))
            CheckFinite(self, context, self._command_derivatives, derivatives)
            if self._heading.HasValue(context):
                heading = self._heading.Eval(context)
                CheckFinite(self, context, self._heading, ToList(heading))
            _CheckGains(self.GetGains(context))
            _CheckBody(self.GetBody(context))

    return Methods


@template
def Se3Controller_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(Se3Methods(T), LeafSystem_[T]):  # type: ignore[misc]
        """Flies a quadrotor at a commanded velocity by geometric control on SE(3).

        .. pydrake_system::

            name: Se3Controller
            input_ports:
            - state
            - velocity_command
            - acceleration_feedforward
            - command_derivatives
            - heading
            - predicted_velocity
            output_ports:
            - propeller_force
            - acceleration

        `state` (12) is QuadrotorPlant's, in metres, radians and seconds; z is up.

        `velocity_command` (3) in m/s and `acceleration_feedforward` (3) in m/s^2 are in W.

        `command_derivatives` (24), in W, are those of `systems.se3_law.NUM_DERIVATIVES`; the
        port may stay unconnected.  With them the desired attitude turns exactly as the command
        asks.  Without them it is taken to turn with the path, which leaves errors that grow
        with the speed and with how fast the field turns to the path.

        `heading` (1), the desired yaw in rad, takes the place of that of the gains; it may stay
        unconnected.  A vehicle turns to it from any yaw (see `systems.se3_law.LimitHeading`).

        `propeller_force` (4) is QuadrotorPlant's input: forces in N over the plant's
        force constant kF, which is 1 by default.  Each force is in
        [0, `QuadrotorParameters.max_propeller_force`] if saturated.

        `acceleration` (3) in m/s^2 in W is what these forces give the vehicle at this
        attitude, whatever mass is believed: what an accelerometer would show, for a
        `StateEstimator`.

        With a disturbance bandwidth L the controller makes up for what else accelerates the
        vehicle: wind, or a mass other than is believed.  It then has the input
        `predicted_velocity` z (3) in m/s, which an Integrator makes of `acceleration`:
        z' = a + d with the acceleration a above and the estimate d = L (v - z), so that d
        follows the truth as a low-pass filter of L does (a momentum observer: A. De Luca et
        al., IROS 2006).  The law demands d less, and `acceleration` includes it.  It is
        integral action that does not wind up where the forces are limited.

        The law is that of Lee, Leok and McClamroch 2010 (see `systems.se3_law`), with a
        velocity command in place of a trajectory and the heading taken to be fixed.  The
        numeric parameters are the `Gains` (index `gains_index`, see `SetGains`) and the `Body`,
        the mass and inertia that the controller believes (index `body_index`, see `SetBody`).
        Both outputs are direct feed-through.

        Args:
            parameters: The vehicle that is flown; by default the paper's.
            gains: The gains; by default `DEFAULT_GAINS`.
            saturate: Whether demands and forces are limited to what the vehicle can give.
                False makes the law smooth, for derivatives and trajectory optimisation.

        Raises:
            ConfigurationError: if a gain, the mass or the inertia cannot be used; on
                evaluation too, where they were set in the Context itself.
            NonFiniteValueError: on evaluation, where an input or a force is not finite.
        """

        def _construct(
            self,
            parameters: QuadrotorParameters | None = None,
            gains: Gains = DEFAULT_GAINS,
            saturate: bool = True,
        ) -> None:
            self._state = self.DeclareVectorInputPort("state", STATE_SIZE)
            self._velocity_command = self.DeclareVectorInputPort("velocity_command", 3)
            self._acceleration_feedforward = self.DeclareVectorInputPort(
                "acceleration_feedforward", 3
            )
            self._command_derivatives = self.DeclareVectorInputPort(
                "command_derivatives", NUM_DERIVATIVES
            )
            self._DeclareController(
                {self.all_input_ports_ticket()}, parameters, gains, saturate
            )

    return Impl


Se3Controller = Se3Controller_[None]


def _CheckGains(gains: Gains) -> None:
    for name in ("velocity_gain", "attitude_bandwidth", "damping_ratio"):
        CheckPositiveParameter(name, getattr(gains, name))
    CheckFiniteParameter("heading", gains.heading)
    CheckNonNegativeParameter("disturbance_bandwidth", gains.disturbance_bandwidth)


def _CheckBody(body: Body) -> None:
    for name, value in body._asdict().items():
        CheckPositiveParameter(name, value)


@compilable
def AreUsable(gains: np.ndarray, body: np.ndarray) -> bool:
    """Tells whether the law can do with these; `SetGains` and `SetBody` say what it cannot."""
    return (
        np.isfinite(gains).all()
        and np.isfinite(body).all()
        and gains[:3].min() > 0.0
        and gains[4] >= 0.0
        and body.min() > 0.0
    )


def _MakeCompiled(sources: int) -> Any:
    @kernel
    def calc_input(
        state: np.ndarray,
        velocity_command: np.ndarray,
        acceleration: np.ndarray,
        derivatives: np.ndarray,
        disturbance: np.ndarray,
        gains: np.ndarray,
        body: np.ndarray,
        rotors: Rotors,
        gravity: float,
        saturate: bool,
    ) -> np.ndarray:
        sources  # noqa: B018 (enclosed to be in the key of the cache; see `digest`)
        usable = (
            np.isfinite(state).all()
            and np.isfinite(velocity_command).all()
            and np.isfinite(acceleration).all()
            and np.isfinite(derivatives).all()
            and np.isfinite(disturbance).all()
            and AreUsable(gains, body)
        )
        if not usable:
            return np.full(NUM_PROPELLERS, np.nan)
        return np.array(
            CalcPropellerInput(
                state,
                velocity_command,
                acceleration,
                derivatives,
                disturbance,
                gains,
                body,
                rotors,
                gravity,
                saturate,
            )
        )

    return calc_input


_CalcInputCompiled = _MakeCompiled(digest(se3_law, quadrotor, scalars))
"""The law as an array (4,), which is NaN where an input or a parameter cannot be used."""
