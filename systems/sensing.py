"""How the vehicle's state is measured: ideally, or with noise, delay and losses."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
import math
from typing import Any

import numpy as np
from pydrake.common import RandomDistribution, RandomGenerator
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem_,
    OutputPort,
)
from pydrake.systems.primitives import (
    Demultiplexer,
    DiscreteTimeDelay,
    PassThrough,
    RandomSource,
    ZeroOrderHold,
)

from sgvf_drake.exceptions import ConfigurationError
from systems.context_matrix import AddMatrix, SetMatrix
from systems.quadrotor import ATTITUDE, POSITION, RATES, STATE_SIZE, VELOCITY
from systems.scalars import ToFloat, template
from systems.selections import AddConcatenation, AddSelections
from systems.state_estimator import DEFAULT_BANDWIDTH, StateEstimator

DEFAULT_SAMPLE_PERIOD = 0.01
"""s; the motion capture of the paper's flights records at 100 Hz."""


TIME_TOLERANCE = 1e-6
"""Of a period; a time that is so close to that of a sample differs from it by rounding."""

NOISES = ("position_noise", "attitude_noise", "rate_noise")
"""The fields of `SensorParameters` that lie in the Context."""


@dataclass(frozen=True)
class SensorParameters:
    """How well a vehicle is measured, in SI units.

    The paper (experiments) gives the rate of the motion capture, 100 Hz, and that on-board
    sensors run at 1 kHz; noise and delay are what such systems usually have.

    Attributes:
        sample_period: Of the motion capture, in s.
        delay: Of a position when it arrives, in s; a multiple of the sample period.
        position_noise: Standard deviation of a measured coordinate, in m.
        onboard_period: Of the on-board attitude and rates, and so of the controller, in s.
        attitude_noise: Standard deviation of roll, pitch and yaw, in rad.
        rate_noise: Standard deviation of the rates of roll, pitch and yaw, in rad/s.
        bandwidth: Of the `StateEstimator`, in rad/s.

    Raises:
        ConfigurationError: if a value cannot be used.
    """

    sample_period: float = DEFAULT_SAMPLE_PERIOD
    delay: float = 0.01
    position_noise: float = 1e-3
    onboard_period: float = 0.002
    attitude_noise: float = 2e-3
    rate_noise: float = 0.01
    bandwidth: float = DEFAULT_BANDWIDTH

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            may_be_zero = field.name not in ("sample_period", "onboard_period", "bandwidth")
            if not (math.isfinite(value) and (value > 0.0 or (value == 0.0 and may_be_zero))):
                raise ConfigurationError(f"{field.name} cannot be {value}")
        if not math.isclose(self.delay_steps * self.sample_period, self.delay, abs_tol=1e-9):
            raise ConfigurationError(
                f"delay must be a multiple of the sample period of {self.sample_period} s, "
                f"got {self.delay}"
            )

    @property
    def structure(self) -> "SensorParameters":
        """What is built in: all but how strong the noise is, which lies in the Context."""
        return replace(self, **{name: float(getattr(self, name) > 0.0) for name in NOISES})

    @property
    def delay_steps(self) -> int:
        """The delay in sample periods."""
        return round(self.delay / self.sample_period)


class MotionCapture(Diagram):
    """Motion capture, on-board sensors and the estimate of the state that is made of them.

    .. pydrake_system::

        name: MotionCapture
        input_ports:
        - state
        - acceleration
        output_ports:
        - position
        - velocity
        - attitude
        - rates
        - state
        - measurement_age

    The input `state` (12) is the true one, QuadrotorPlant's; an entry of the position that
    is not finite is a lost measurement.  `acceleration` (3) in m/s^2 in W is the vehicle's, as
    an accelerometer tells it: `Se3Controller` has it; see `StateEstimator`.

    `position` (3) in m and `velocity` (3) in m/s are what the estimator makes of the positions
    of the motion capture, for guidance.  `attitude` (3) in rad and `rates` (3) in rad/s are
    sampled at the on-board rate, and the output `state` (12) is all four, for the controller.
    `measurement_age` (1) is the age of what was last measured in s.  None is a direct
    feed-through.

    The noise is Drake's `RandomSource`; see `SetNoiseSeed`.  How strong it is lies in the
    Context; see `SetNoise`.

    Args:
        parameters: Noise, delay and rates.
    """

    def __init__(self, parameters: SensorParameters) -> None:
        super().__init__()
        self._parameters = parameters
        builder = DiagramBuilder()
        parts = builder.AddNamedSystem("state_parts", Demultiplexer([3, 3, 3, 3]))
        builder.ExportInput(parts.get_input_port(), "state")
        position, attitude, _, rates = (parts.get_output_port(i) for i in range(4))
        self._estimator = self._AddEstimator(builder, position)
        self._holds: list[tuple[Any, slice]] = []
        estimate = [self._estimator.GetOutputPort(name) for name in ("position", "velocity")]
        held = []
        for name, port, noise, entries in (
            ("attitude", attitude, "attitude_noise", ATTITUDE),
            ("rates", rates, "rate_noise", RATES),
        ):
            deviation = getattr(parameters, noise)
            noisy = _AddNoise(builder, port, noise, deviation, parameters.onboard_period)
            hold = builder.AddNamedSystem(name, ZeroOrderHold(parameters.onboard_period, 3))
            builder.Connect(noisy, hold.get_input_port())
            self._holds.append((hold, entries))
            held.append(hold.get_output_port())
        for port in estimate:
            builder.ExportOutput(port, port.get_name())
        for port, name in zip(held, ("attitude", "rates"), strict=True):
            builder.ExportOutput(port, name)
        whole = (estimate[0], held[0], estimate[1], held[1])
        builder.ExportOutput(AddConcatenation(builder, "state", whole), "state")
        builder.ExportOutput(
            self._estimator.GetOutputPort("measurement_age"), "measurement_age"
        )
        builder.BuildInto(self)

    @property
    def parameters(self) -> SensorParameters:
        """Noise, delay and rates."""
        return self._parameters

    def SetNoise(self, context: Context, parameters: SensorParameters) -> None:
        """Sets how strong the noise is.

        Args:
            context: This system's own.
            parameters: With noise where the built ones have it; all else is the same.

        Raises:
            ConfigurationError: if anything else differs.
        """
        if parameters.structure != self._parameters.structure:
            raise ConfigurationError(
                "only the strength of a noise can be set anew: delay, rates and whether there "
                "is noise at all are built in"
            )
        for name in NOISES:
            deviation = getattr(parameters, name)
            if deviation > 0.0:
                SetMatrix(self, context, name, deviation * np.eye(3))

    def SetVectorState(self, context: Context, state: Any) -> None:
        """Makes the estimate the true state, as after a long look at a vehicle going straight.

        Args:
            context: This system's own.
            state: The state (12,), as QuadrotorPlant's.
        """
        for hold, entries in self._holds:
            hold.SetVectorState(self.GetMutableSubsystemContext(hold, context), state[entries])
        self._estimator.SetEstimate(
            self.GetMutableSubsystemContext(self._estimator, context),
            state[POSITION],
            state[VELOCITY],
        )
        if self._delay is not None:
            own: Any = self.GetMutableSubsystemContext(self._delay, context)
            period, time = self._parameters.sample_period, context.get_time()
            # A sample that is due now is still to come.
            to_sample = period * math.ceil(time / period - TIME_TOLERANCE) - time
            steps = np.arange(self._parameters.delay_steps, 0, -1)  # The oldest comes first.
            ahead = np.outer(to_sample - steps * period, state[VELOCITY])
            own.SetDiscreteState((state[POSITION] + ahead).ravel())

    def _AddEstimator(self, builder: DiagramBuilder, position: OutputPort) -> Any:
        """Adds what becomes of positions: noise, delay, estimator."""
        p = self._parameters
        # The estimator samples by itself, and sees what a discrete system held before the
        # sample: a hold delays by one period, and a delay of n steps by n + 1.
        self._delay: Any = None
        noisy = _AddNoise(
            builder, position, "position_noise", p.position_noise, p.sample_period
        )
        if p.delay_steps > 0:
            self._delay = builder.AddNamedSystem(
                "delay", DiscreteTimeDelay(p.sample_period, p.delay_steps - 1, 3)
            )
            builder.Connect(noisy, self._delay.get_input_port())
            noisy = self._delay.get_output_port()
        estimator = builder.AddNamedSystem(
            "estimator", StateEstimator(p.sample_period, p.delay, p.bandwidth)
        )
        builder.Connect(noisy, estimator.GetInputPort("measured_position"))
        builder.ExportInput(estimator.GetInputPort("acceleration"), "acceleration")
        return estimator


class IdealMotionCapture(Diagram):
    """Motion capture that samples the whole state at once, without noise or delay.

    .. pydrake_system::

        name: IdealMotionCapture
        input_ports:
        - state
        output_ports:
        - state
        - position
        - velocity

    The ports are those of `MotionCapture`.  The first sample is taken when a simulation starts
    to advance; until then it shows zeros, unless `SetVectorState` was called.

    Args:
        period: In s, for which a sample is held; 0 passes the state through in continuous time.
        size: That of the state, which begins with the position; by default QuadrotorPlant's.
        velocity: The entries of the velocity in it.
    """

    def __init__(
        self,
        period: float = DEFAULT_SAMPLE_PERIOD,
        size: int = STATE_SIZE,
        velocity: slice = VELOCITY,
    ) -> None:
        super().__init__()
        builder = DiagramBuilder()
        self._is_sampled = period > 0.0
        hold: Any = ZeroOrderHold(period, size) if self._is_sampled else PassThrough(size)
        self._hold: Any = builder.AddNamedSystem("state", hold)
        builder.ExportInput(hold.get_input_port(), "state")
        builder.ExportOutput(hold.get_output_port(), "state")
        parts = {"position": POSITION, "velocity": velocity}
        ports = AddSelections(builder, "parts", hold.get_output_port(), parts)
        for name, port in ports.items():
            builder.ExportOutput(port, name)
        builder.BuildInto(self)

    def SetVectorState(self, context: Context, state: Any) -> None:
        """Sets the sample that is held.

        Args:
            context: This system's own.
            state: The state, of the size of this system's.
        """
        if self._is_sampled:
            own = self.GetMutableSubsystemContext(self._hold, context)
            self._hold.SetVectorState(own, state)


def DrawNoise(diagram: Diagram, context: Context, generator: RandomGenerator) -> None:
    """Seeds the random sources of a diagram, so that what they give repeats exactly.

    Args:
        diagram: Its sources are seeded, and no others.
        context: This diagram's own.
        generator: Gives the seeds.
    """
    for system in diagram.GetSystems():
        if isinstance(system, RandomSource):
            system.SetRandomContext(
                diagram.GetMutableSubsystemContext(system, context), generator
            )


@template
def Dropout_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Loses some entries of a vector for some time: they are NaN then.

        .. pydrake_system::

            name: Dropout
            input_ports:
            - input
            output_ports:
            - output

        Both are vectors of the same size, and the output is the input but for the lost
        entries.  It belongs before what samples: its output depends on the time.

        Args:
            size: The size of the vector.
            intervals: When entries are lost: pairs of begin and end in s, the end excluded.
            entries: Which entries are lost: their indices.

        Raises:
            ConfigurationError: if an argument cannot be used.
        """

        def _construct(
            self,
            size: int,
            intervals: Sequence[tuple[float, float]],
            entries: Sequence[int],
        ) -> None:
            for begin, end in intervals:
                if not begin < end:
                    raise ConfigurationError(f"an interval cannot be from {begin} to {end} s")
            for entry in entries:
                if not 0 <= entry < size:
                    raise ConfigurationError(f"there is no entry {entry} of {size}")
            self._intervals, self._entries = tuple(intervals), list(entries)
            self._input = self.DeclareVectorInputPort("input", size)
            self.DeclareVectorOutputPort("output", size, self._CalcOutput)

        def _CalcOutput(self, context: Any, output: Any) -> None:
            values = self._input.Eval(context).copy()
            time = ToFloat(context.get_time())
            if any(begin <= time < end for begin, end in self._intervals):
                values[self._entries] = T(math.nan)
            output.SetFromVector(values)

    return Impl


Dropout = Dropout_[None]


def _AddNoise(
    builder: DiagramBuilder, port: OutputPort, name: str, deviation: float, period: float
) -> OutputPort:
    """Adds noise that is drawn anew every period; none where the deviation is zero."""
    if deviation == 0.0:
        return port
    source = builder.AddNamedSystem(
        f"{name}_source", RandomSource(RandomDistribution.kGaussian, port.size(), period)
    )
    matrix = deviation * np.eye(port.size())
    return AddMatrix(builder, name, matrix, source.get_output_port(), offset=port)
