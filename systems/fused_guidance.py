"""Guidance and the SE(3) controller in one system, evaluated by one call of compiled code."""

import math
from typing import Any

import numpy as np
from pydrake.systems.framework import BasicVector_

from sgvf_drake.compiling import digest, kernel
from sgvf_drake.fields.base import Field
from sgvf_drake.fields.compiled import evaluation as fields
from sgvf_drake.fields.compiled.evaluation import field_jet, motion_jet
from systems import controller, guidance, quadrotor, scalars, se3_law
from systems.controller import DEFAULT_GAINS, AreUsable, Se3Methods
from systems.guidance import (
    DEFAULT_ALTITUDE,
    DEFAULT_SPEED,
    MAX_APPROACH_RATE,
    CompleteCommands,
    GuidanceSystem_,
)
from systems.quadrotor import (
    ATTITUDE,
    POSITION,
    STATE_SIZE,
    VELOCITY,
    QuadrotorParameters,
    Rotors,
)
from systems.scalars import (
    CheckFinite,
    ToList,
    ToVector,
    compilable,
    template,
)
from systems.se3_law import CalcAcceleration, CalcPropellerInput, Gains

EVALUATED = {
    "propeller_force": slice(0, 4),
    "velocity_command": slice(4, 7),
    "acceleration_feedforward": slice(7, 10),
    "acceleration": slice(10, 13),
}
"""Where the output `evaluation` of `FusedGuidance` has what its ports of these names have."""

_NUM_EVALUATED = 13
_COMMANDS = slice(4, 10)
# Behind these stand the rate of a heading, and for what motion and parameters the commands are.
_MEMORY_SIZE = 9
# Where the constants have what: speed, altitude and approach length; gains; body; the rotors;
# mass, gravity, and whether there are limits and a feed-forward.
_GUIDING, _GAINS, _BODY, _ROTORS = slice(0, 3), slice(3, 8), slice(8, 12), slice(12, 16)
_APPROACH_LENGTH = 2
_MASS, _GRAVITY, _SATURATES, _FEEDS_FORWARD, _NUM_CONSTANTS = range(16, 21)
# No speed is negative, so that nothing is taken for what was evaluated before.
_NOTHING = -1.0


@template
def FusedGuidance_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(GuidanceSystem_[T], Se3Methods(T)):  # type: ignore[misc, valid-type]
        """Is a `GuidanceSystem` and the controller that it commands, evaluated in one call.

        .. pydrake_system::

            name: FusedGuidance
            input_ports:
            - state
            - speed
            - heading
            - predicted_velocity
            output_ports:
            - position
            - velocity_command
            - acceleration_feedforward
            - speed
            - command_derivatives
            - propeller_force
            - acceleration
            - constants
            - evaluation

        It has the ports, the parameters and the methods of both, of `GuidanceSystem` and of
        `Se3Controller`, but for the inputs by which one is connected with the other.  `state`
        (12) is QuadrotorPlant's, and `position` (3) a part of it.  With a directed field it has
        the input `intended_direction` and the output `heading` of a `GuidanceSystem`; the input
        `heading` is another thing, the yaw.  There is `predicted_velocity` only where the gains
        have a disturbance bandwidth.

        `evaluation` holds propeller forces, velocity command, feed-forward and acceleration
        (see `EVALUATED`), and behind them what is only for this system.  So are `constants`,
        which it needs and which seldom change.  Where the field has a compiled form, one
        compiled call gives all of it, with the feed-forward by J v, which is cheaper than J.
        It is as the other ports have it, which are evaluated on their own, to rounding.
        `GuidanceLoop` takes from it what it needs by a system in C++: an output in Python costs
        more than the law.

        Where only the attitude, the rates or the predicted velocity have changed since the last
        evaluation, the field is not evaluated again: its commands are remembered in the port's
        own value, and so in the Context, with what they were evaluated for.

        Args:
            field: As in `GuidanceSystem`, and so is what follows up to `max_approach_rate`.
            speed: The commanded speed in m/s.
            altitude: The altitude in m.
            feedforward: Whether there is a feed-forward.
            max_approach_rate: The fastest approach in 1/s.
            parameters: As in `Se3Controller`, and so is what follows up to `saturate`.
            gains: The gains.
            saturate: Whether there are limits.

        Raises:
            ConfigurationError: as in the two.
            NonFiniteValueError: on evaluation, as in the two.
        """

        def _construct(
            self,
            field: Field,
            speed: float = DEFAULT_SPEED,
            altitude: float = DEFAULT_ALTITUDE,
            feedforward: bool = True,
            max_approach_rate: float = MAX_APPROACH_RATE,
            parameters: QuadrotorParameters | None = None,
            gains: Gains = DEFAULT_GAINS,
            saturate: bool = True,
        ) -> None:
            self._state = self.DeclareVectorInputPort("state", STATE_SIZE)
            measured = {self.input_port_ticket(self._state.get_index())}
            self.DeclareVectorOutputPort("position", 3, self._CopyPosition, measured)
            self._DeclareGuidance(
                measured, field, speed, altitude, feedforward, max_approach_rate
            )
            self._velocity_command = self.GetOutputPort("velocity_command")
            self._acceleration_feedforward = self.GetOutputPort("acceleration_feedforward")
            sources = {self.all_input_ports_ticket(), self.xc_ticket()}
            self._DeclareController(sources, parameters, gains, saturate)
            # A port, because a cache entry takes Python twice as long to read.
            self._constants = self.DeclareVectorOutputPort(
                "constants",
                _NUM_CONSTANTS,
                self._CalcConstants,
                {
                    self.all_parameters_ticket(),
                    self.input_port_ticket(self._asked.get_index()),
                    self.input_port_ticket(self._heading.get_index()),
                },
            )
            size = _NUM_EVALUATED + self.num_continuous_states() + _MEMORY_SIZE
            self._evaluation = self.DeclareVectorOutputPort(
                "evaluation",
                BasicVector_[T]([_NOTHING] * size),
                self._CalcEvaluation,
                {*sources, self.all_parameters_ticket()},
            )

        def _CalcConstants(self, context: Any, constants: Any) -> None:
            guiding, vehicle = self._ReadParameters(context), self._parameters
            guiding[0] = self._FlownSpeed(context, guiding[0])
            body = context.get_numeric_parameter(self.body_index).CopyToVector()
            values = (
                *(*guiding, *self._ReadGains(context), *body, *vehicle.rotors),
                *(vehicle.mass, vehicle.gravity, self._saturate, self._feedforward),
            )
            constants.SetFromVector(ToVector(T, values))

        def _CalcTimeDerivatives(self, context: Any, derivatives: Any) -> None:
            rate = self._evaluation.Eval(context)[_NUM_EVALUATED:-_MEMORY_SIZE]
            derivatives.get_mutable_vector().SetFromVector(rate)

        def _CopyPosition(self, context: Any, output: Any) -> None:
            output.SetFromVector(self._state.Eval(context)[POSITION])

        def _EvalVehicle(self, context: Any) -> tuple[np.ndarray, np.ndarray]:
            state = self._state.Eval(context)
            return state[POSITION], state[VELOCITY]

        def _CheckVehicle(self, context: Any) -> None:
            CheckFinite(self, context, self._state, ToList(self._state.Eval(context)))

        def _CalcEvaluation(self, context: Any, output: Any) -> None:
            if T is not float or not self._CalcCompiled(context, output):
                output.SetFromVector(self._CalcInTwo(context))

        def _CalcCompiled(self, context: Any, output: Any) -> bool:
            """Fills in the evaluation; returns whether it can be used."""
            constants = self._constants.Eval(context)
            field = self._Flown(constants[_APPROACH_LENGTH]).arguments
            if field is None:
                return False
            predicted = self._undisturbed
            if self._predicted_velocity is not None:
                predicted = self._predicted_velocity.Eval(context)
            evaluation, state = output.get_mutable_value(), self._state.Eval(context)
            if self._intended is None:
                return _CalcFused(evaluation, state, predicted, constants, *field)
            intended = np.zeros(self._field.dim)
            if self._intended.HasValue(context):
                intended = self._intended.Eval(context)
            heading = self.GetHeading(context)
            turning = (heading, intended, self._memory_length)
            return _CalcFusedTurning(evaluation, state, predicted, constants, *turning, *field)

        def _CalcInTwo(self, context: Any) -> np.ndarray:
            """Returns the evaluation by the ports of both, which say what is wrong if it is."""
            parts = [self.GetOutputPort(name).Eval(context) for name in EVALUATED]
            if self._intended is not None:
                turn = self._Turn(context, self._EvalMotion(context))
                parts.append(self._FlownSpeed(context, self.GetSpeed(context)) * turn)
            return np.concatenate([*parts, np.full(_MEMORY_SIZE, T(_NOTHING))])

    return Impl


FusedGuidance = FusedGuidance_[None]


@compilable
def _IsFor(memory: np.ndarray, state: np.ndarray, guiding: np.ndarray) -> bool:
    """Tells whether the commands are those for this motion; if not, they will be."""
    known = True
    for i in range(3):
        for k, value in ((i, state[i]), (3 + i, state[6 + i]), (6 + i, guiding[i])):
            if memory[k] != value:
                memory[k] = value
                known = False
    return known


@compilable
def _FillInForces(
    evaluation: np.ndarray,
    state: np.ndarray,
    predicted_velocity: np.ndarray,
    constants: np.ndarray,
) -> bool:
    """Adds to the commands what follows of them; returns whether all can be used."""
    commands, gains, body = evaluation[_COMMANDS], constants[_GAINS], constants[_BODY]
    rotor = constants[_ROTORS]
    rotors = Rotors(rotor[0], rotor[1], rotor[2], rotor[3])
    gravity, saturates = constants[_GRAVITY], constants[_SATURATES] != 0.0
    if constants[_FEEDS_FORWARD] == 0.0:
        commands[3:] = 0.0
    disturbance = gains[4] * (state[VELOCITY] - predicted_velocity)
    unknown = commands[:0]
    forces = CalcPropellerInput(
        *(state, commands[:3], commands[3:], unknown, disturbance),
        *(gains, body, rotors, gravity, saturates),
    )
    lift = 0.0
    for i in range(4):
        evaluation[i] = forces[i]
        lift += rotors.force_constant * forces[i] / constants[_MASS]
    rpy = state[ATTITUDE]
    acceleration = CalcAcceleration((rpy[0], rpy[1], rpy[2]), lift, gravity)
    for i in range(3):
        evaluation[10 + i] = acceleration[i] + disturbance[i]
    # The limits of the forces hide a NaN, and the sums what is not used.
    return (
        AreUsable(gains, body)
        and constants[0] >= 0.0
        and math.isfinite(state.sum() + constants.sum() + evaluation.sum())
    )


def _MakeFused(sources: int) -> tuple[Any, Any]:
    @kernel
    def fused(
        evaluation: np.ndarray,
        state: np.ndarray,
        predicted_velocity: np.ndarray,
        constants: np.ndarray,
        *field: Any,
    ) -> bool:
        sources  # noqa: B018 (enclosed to be in the key of the cache; see `digest`)
        guiding = constants[_GUIDING]
        if not _IsFor(evaluation[_NUM_EVALUATED:], state, guiding):
            d = len(field[0])
            p, v = state[POSITION], state[VELOCITY]
            m = field_jet(p, v[:d].copy().reshape((1, d)), *field)
            commands = evaluation[_COMMANDS]
            for i in range(d):
                commands[i], commands[3 + i] = m[0, i], m[1, i]
            CompleteCommands(d, p, v, guiding[0], guiding[1], commands)
        return _FillInForces(evaluation, state, predicted_velocity, constants)

    @kernel
    def fused_turning(
        evaluation: np.ndarray,
        state: np.ndarray,
        predicted_velocity: np.ndarray,
        constants: np.ndarray,
        heading: np.ndarray,
        intended: np.ndarray,
        memory_length: float,
        *field: Any,
    ) -> bool:
        sources  # noqa: B018 (enclosed to be in the key of the cache; see `digest`)
        d = len(heading)
        p, v, speed = state[POSITION], state[VELOCITY], constants[0]
        # Along the motion at a constant heading, and along each axis of the heading: what it
        # turns to is only known with the value.
        directions = np.zeros((1 + d, 2 * d))
        for i in range(d):
            directions[0, i], directions[1 + i, d + i] = v[i], 1.0
        y = np.concatenate((p[:d], heading))
        m, tangent = motion_jet(y, directions, *field)
        commands = evaluation[_COMMANDS]
        for i in range(d):
            commands[i], commands[3 + i] = m[0, i], m[1, i]
        CompleteCommands(d, p, v, speed, constants[1], commands)
        target = intended if np.any(intended != 0.0) else tangent[0]
        for j in range(d):
            rate = speed * (target[j] - heading[j]) / memory_length
            evaluation[_NUM_EVALUATED + j] = rate
            for i in range(d):
                commands[3 + i] += speed * m[2 + j, i] * rate
        return _FillInForces(evaluation, state, predicted_velocity, constants)

    return fused, fused_turning


_SOURCES = (*fields.SOURCES, fields, controller, guidance, quadrotor, scalars, se3_law)

_CalcFused, _CalcFusedTurning = _MakeFused(digest(*_SOURCES))
"""Fill in the evaluation in place, with a field or with the motion of a directed one."""
