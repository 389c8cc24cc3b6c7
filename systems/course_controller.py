"""The course law as a system: from a velocity command to a turn rate, in any wind."""

import math
from typing import Any, NamedTuple

import numpy as np
import pydrake.math
from pydrake.systems.framework import BasicVector_, LeafSystem_

from systems.planar_vehicle import (
    HEADING,
    PLANAR_STATE_SIZE,
    PLANAR_VELOCITY,
    PlanarVehicleParameters,
)
from systems.scalars import (
    CheckFinite,
    CheckPositiveParameter,
    Cos,
    Scalar,
    Sin,
    Sqrt,
    ToFloat,
    ToList,
    template,
)

MAX_COURSE_GAIN = 8.0
"""1/s.  Sampled at 100 Hz, a larger gain brings nothing."""

MAX_LAGGED_GAIN = 0.5
"""Course gain times turn lag, for a damping ratio of 0.7."""

LEAST_PROGRESS = 0.05
"""The least that |v_g| cos(heading - course) counts as, in parts of the airspeed: straight
against wind of 95 % of it."""

STANDING = 1e-3
"""A part of the airspeed; below it the course over ground is that of the heading."""


def DefaultCourseGain(parameters: PlanarVehicleParameters) -> float:
    """Returns a gain in 1/s at which a vehicle turns its fastest for an error of 90 degrees."""
    gain = min(parameters.max_turn_rate, MAX_COURSE_GAIN)
    if parameters.turn_lag > 0.0:
        gain = min(gain, MAX_LAGGED_GAIN / parameters.turn_lag)
    return gain


@template
def CourseController_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Turns a vehicle of constant airspeed onto the course of a velocity command.

        .. pydrake_system::

            name: CourseController
            input_ports:
            - state
            - velocity_command
            - acceleration_feedforward
            output_ports:
            - turn_rate
            - course
            - lateral_acceleration

        `state` (7) is that of a `PlanarVehicle`.  `velocity_command` (3) in m/s and
        `acceleration_feedforward` (3) in m/s^2 are in W; of the command only the direction in
        the plane counts, for the vehicle has one speed.

        `turn_rate` (1) in rad/s, to the left, is what the vehicle is to turn at.  It is not
        limited: the vehicle is.

        `course` (1) and `lateral_acceleration` (1) are what px4_msgs/FixedWingLateralSetpoint
        takes, if x of W is east and y north: the course in rad from north, to the right, in
        [-pi, pi], and the feed-forward part of the lateral acceleration in m/s^2, to the right.

        With the course error e, the angle from the velocity v_g over ground to the command
        m, the course has to turn at

            m x a / |m|^2 + k sin e,

        the rate of the command's own direction (a is the feed-forward) and the gain k times
        the error, which beyond 90 degrees counts as 90.  In wind, heading and course turn at
        different rates: the heading's is that times

            |v_g| / (v_a cos(heading - course)),

        with the airspeed v_a.  So the line is held in any wind that is slower than the vehicle,
        and no wind is estimated.  Faster wind blows the vehicle away: the cosine then counts as
        no less than `LEAST_PROGRESS` allows.  Where the command is zero, it goes on straight.

        The one numeric parameter (index `parameter_index`) is the gain k in 1/s; see `SetGain`.
        All outputs are direct feed-through.

        Args:
            parameters: The vehicle.
            gain: k in 1/s; None: `DefaultCourseGain`.

        Raises:
            ConfigurationError: if the gain cannot be used; on evaluation too.
            NonFiniteValueError: on evaluation, where an input is not finite.
        """

        def _construct(
            self,
            parameters: PlanarVehicleParameters,
            gain: float | None = None,
        ) -> None:
            gain = DefaultCourseGain(parameters) if gain is None else gain
            CheckPositiveParameter("gain", gain)
            self._parameters = parameters
            self._state = self.DeclareVectorInputPort("state", PLANAR_STATE_SIZE)
            self._velocity_command = self.DeclareVectorInputPort("velocity_command", 3)
            self._acceleration_feedforward = self.DeclareVectorInputPort(
                "acceleration_feedforward", 3
            )
            self.parameter_index = self.DeclareNumericParameter(BasicVector_[T]([gain]))
            sources = {self.all_input_ports_ticket(), self.all_parameters_ticket()}
            for name, calc in (
                ("turn_rate", self._CalcTurnRate),
                ("course", self._CalcCourse),
                ("lateral_acceleration", self._CalcLateralAcceleration),
            ):
                self.DeclareVectorOutputPort(name, 1, calc, sources)

        @property
        def parameters(self) -> PlanarVehicleParameters:
            """The vehicle."""
            return self._parameters

        def GetGain(self, context: Any) -> Scalar:
            """Returns the gain in 1/s."""
            return context.get_numeric_parameter(self.parameter_index).GetAtIndex(0)

        def SetGain(self, context: Any, gain: Scalar) -> None:
            """Sets the gain in 1/s; this system's own Context is wanted."""
            CheckPositiveParameter("gain", gain)
            context.get_mutable_numeric_parameter(self.parameter_index).SetAtIndex(0, gain)

        def _CalcTurnRate(self, context: Any, output: Any) -> None:
            gain = self.GetGain(context)
            CheckPositiveParameter("gain", gain)
            turn = self._EvalTurn(context)
            output.SetAtIndex(0, turn.scale * (turn.feedforward + gain * turn.error))

        def _CalcCourse(self, context: Any, output: Any) -> None:
            mx, my, _ = self._velocity_command.Eval(context)
            output.SetAtIndex(0, pydrake.math.atan2(mx, my))

        def _CalcLateralAcceleration(self, context: Any, output: Any) -> None:
            turn = self._EvalTurn(context)
            output.SetAtIndex(0, -self._parameters.airspeed * turn.scale * turn.feedforward)

        def _EvalTurn(self, context: Any) -> "_Turn":
            ports = (self._state, self._velocity_command, self._acceleration_feedforward)
            state, command, feedforward = (port.Eval(context) for port in ports)
            for port, values in zip(ports, (state, command, feedforward), strict=True):
                CheckFinite(self, context, port, ToList(values))
            return _CalcTurn(state, command, feedforward, self._parameters.airspeed)

    return Impl


CourseController = CourseController_[None]


class _Turn(NamedTuple):
    """How the course has to turn.

    Attributes:
        feedforward: The rate of the command's direction, rad/s.
        error: The sine of the course error, and beyond 90 degrees its sign.
        scale: From the rate of the course to that of the heading.
    """

    feedforward: Scalar
    error: Scalar
    scale: Scalar


def _CalcTurn(
    state: np.ndarray, command: np.ndarray, feedforward: np.ndarray, airspeed: float
) -> _Turn:
    heading, (vx, vy, _) = state[HEADING], state[PLANAR_VELOCITY]
    (mx, my, _), (ax, ay, _) = command, feedforward
    ahead_x, ahead_y = Cos(heading), Sin(heading)
    ground = vx * vx + vy * vy
    along = airspeed * (ahead_x * vx + ahead_y * vy)
    scale = ground / max(along, LEAST_PROGRESS * airspeed**2)
    if ground < (STANDING * airspeed) ** 2:
        vx, vy, ground = ahead_x, ahead_y, 1.0
    squared = mx * mx + my * my
    if squared == 0.0:
        return _Turn(0.0 * squared, 0.0 * squared, scale)
    length = Sqrt(ground * squared)
    error = (vx * my - vy * mx) / length
    if vx * mx + vy * my < 0.0:
        error = error * 0.0 + math.copysign(1.0, ToFloat(error))
    return _Turn((mx * ay - my * ax) / squared, error, scale)
