"""Position and velocity from measured positions that are noisy, late and sometimes missing."""

import math
from typing import Any

import numpy as np
from pydrake.systems.framework import BasicVector_, LeafSystem_

from systems.scalars import (
    CheckFinite,
    CheckNonNegativeParameter,
    CheckPositiveParameter,
    Scalar,
    ToFloat,
    ToList,
    ToVector,
    template,
)

DEFAULT_BANDWIDTH = 25.0
"""rad/s; twice that of the attitude, so that the delay of the filter is the smaller one.  With
positions good to 1 mm at 100 Hz the velocity is then good to 1 cm/s."""

# The discrete state: position and velocity at the time of which the last sample tells, the last
# acceleration, the age of the sample without the known delay, the time of the last update (it
# is not a period ago where an estimate was set in between), and the phase.
_POSITION, _VELOCITY, _ACCELERATION = slice(0, 3), slice(3, 6), slice(6, 9)
_AGE, _TIME, _PHASE, _STATE_SIZE = 9, 10, 11, 12
# The phases: before the first update, before the first sample, and with an estimate.
_NEW, _WAITING, _STARTED = 0.0, 1.0, 2.0


@template
def StateEstimator_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Estimates position and velocity from positions sampled at a fixed period.

        .. pydrake_system::

            name: StateEstimator
            input_ports:
            - measured_position
            - acceleration
            output_ports:
            - position
            - velocity
            - measurement_age

        `measured_position` (3) in m is what the vehicle's position was `delay` ago, with
        noise.  A sample with a value that is not finite is a lost one, and so is what arrives
        before the delay has first passed, unless `SetEstimate` was called.  `acceleration` (3)
        in m/s^2 is measured or known otherwise; not connected, it is zero, and the velocity
        then lags by 2 a / bandwidth in a turn of acceleration a, which leaves the flight of
        a quadrotor across its path badly damped.

        `position` (3) in m and `velocity` (3) in m/s are the estimates for now, and
        `measurement_age` (1) in s is how old what was last measured is.  All are held
        between samples, and none is a direct feed-through.

        Each axis has an alpha-beta filter with both poles at exp(-bandwidth period), that
        is, critically damped (the fading-memory filter of degree 1: N. Morrison, Introduction
        to Sequential Smoothing and Prediction, 1969).  While samples are lost it predicts,
        with the acceleration.  Position and velocity are extrapolated over the delay with the
        last acceleration, so that a motion of constant acceleration is followed without error.
        The acceleration is taken as that of now, not of `delay` ago: while it changes at a
        rate j, the velocity is off by about 2 j delay / bandwidth.

        The one numeric parameter (index `parameter_index`) holds (bandwidth in rad/s, delay
        in s); see `SetBandwidth` and `SetDelay`.

        Args:
            period: Of the samples, in s.
            delay: Of a sample when it arrives, in s.
            bandwidth: In rad/s.

        Raises:
            ConfigurationError: if an argument cannot be used.
            NonFiniteValueError: at a sample, where the acceleration is not finite.
        """

        def _construct(
            self,
            period: float,
            delay: float = 0.0,
            bandwidth: float = DEFAULT_BANDWIDTH,
        ) -> None:
            CheckPositiveParameter("period", period)
            CheckNonNegativeParameter("delay", delay)
            CheckPositiveParameter("bandwidth", bandwidth)
            self._period = period
            self._measured = self.DeclareVectorInputPort("measured_position", 3)
            self._acceleration = self.DeclareVectorInputPort("acceleration", 3)
            self.parameter_index = self.DeclareNumericParameter(
                BasicVector_[T]([bandwidth, delay])
            )
            self._state_index = self.DeclareDiscreteState(_STATE_SIZE)
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._Update)
            sources = {
                self.discrete_state_ticket(self._state_index),
                self.all_parameters_ticket(),
            }
            for name, size, calc in (
                ("position", 3, self._CalcPosition),
                ("velocity", 3, self._CalcVelocity),
                ("measurement_age", 1, self._CalcAge),
            ):
                self.DeclareVectorOutputPort(name, size, calc, sources)

        def GetBandwidth(self, context: Any) -> Scalar:
            """Returns the bandwidth in rad/s."""
            return context.get_numeric_parameter(self.parameter_index).GetAtIndex(0)

        def SetBandwidth(self, context: Any, bandwidth: Scalar) -> None:
            """Sets the bandwidth in rad/s; this system's own Context is wanted."""
            CheckPositiveParameter("bandwidth", bandwidth)
            context.get_mutable_numeric_parameter(self.parameter_index).SetAtIndex(0, bandwidth)

        def GetDelay(self, context: Any) -> Scalar:
            """Returns the delay in s that is made up for."""
            return context.get_numeric_parameter(self.parameter_index).GetAtIndex(1)

        def SetDelay(self, context: Any, delay: Scalar) -> None:
            """Sets the delay in s; this system's own Context is wanted."""
            CheckNonNegativeParameter("delay", delay)
            context.get_mutable_numeric_parameter(self.parameter_index).SetAtIndex(1, delay)

        def SetEstimate(self, context: Any, position: Any, velocity: Any) -> None:
            """Sets what is estimated for now, as if it had just been measured.

            Args:
                context: This system's own.
                position: (3,) in m.
                velocity: (3,) in m/s.
            """
            position, velocity = np.asarray(position), np.asarray(velocity)
            then = position - velocity * self.GetDelay(context)
            state = [*then, *velocity, *np.zeros(3), 0.0, context.get_time(), _STARTED]
            context.SetDiscreteState(self._state_index, ToVector(T, state))

        def _Update(self, context: Any, values: Any) -> None:
            state = self._State(context)
            position, velocity = state[_POSITION], state[_VELOCITY]
            measured = self._measured.Eval(context)
            acceleration = np.zeros(3)
            if self._acceleration.HasValue(context):
                acceleration = self._acceleration.Eval(context)
                CheckFinite(self, context, self._acceleration, ToList(acceleration))
            now, phase = context.get_time(), ToFloat(state[_PHASE])
            elapsed = T(0.0) if phase == _NEW else now - state[_TIME]
            phase = max(phase, _WAITING)
            age = state[_AGE] + elapsed
            position = position + elapsed * (velocity + 0.5 * elapsed * acceleration)
            velocity = velocity + elapsed * acceleration
            if self._IsSample(context, measured, phase, age):
                age = T(0.0)
                if phase == _WAITING:
                    position, velocity, phase = measured, np.zeros(3), _STARTED
                pole = np.exp(-self.GetBandwidth(context) * self._period)
                innovation = measured - position
                position = position + (1.0 - pole * pole) * innovation
                velocity = velocity + (1.0 - pole) ** 2 / self._period * innovation
            vector = values.get_mutable_vector(self._state_index)
            vector.SetFromVector(
                ToVector(T, [*position, *velocity, *acceleration, age, now, phase])
            )

        def _IsSample(self, context: Any, measured: Any, phase: float, age: Scalar) -> bool:
            if not all(map(math.isfinite, ToList(measured))):
                return False
            # What arrives before the delay has passed was measured before there was a vehicle:
            # it is what a delay holds by default, and nothing to start from.
            earliest = ToFloat(self.GetDelay(context)) - 0.5 * self._period
            return phase == _STARTED or ToFloat(age) >= earliest

        def _State(self, context: Any) -> Any:
            return context.get_discrete_state(self._state_index).CopyToVector()

        def _CalcPosition(self, context: Any, output: Any) -> None:
            state, delay = self._State(context), self.GetDelay(context)
            mean_velocity = state[_VELOCITY] + 0.5 * delay * state[_ACCELERATION]
            output.SetFromVector(state[_POSITION] + delay * mean_velocity)

        def _CalcVelocity(self, context: Any, output: Any) -> None:
            state = self._State(context)
            output.SetFromVector(
                state[_VELOCITY] + self.GetDelay(context) * state[_ACCELERATION]
            )

        def _CalcAge(self, context: Any, output: Any) -> None:
            output.SetAtIndex(0, self._State(context)[_AGE] + self.GetDelay(context))

    return Impl


StateEstimator = StateEstimator_[None]
