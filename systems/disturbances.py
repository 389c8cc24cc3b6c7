"""What disturbs a vehicle: wind, drag, slow motors, a body other than is believed."""

from dataclasses import dataclass, fields, replace
import math
from typing import Any

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import (
    Adder,
    ConstantVectorSource,
    FirstOrderLowPassFilter,
    Gain,
    LinearSystem,
    Multiplexer,
    RandomSource,
)

from sgvf_drake.exceptions import ConfigurationError
from systems.quadrotor import (
    NUM_PROPELLERS,
    POSITION,
    STATE_SIZE,
    VELOCITY,
    QuadrotorParameters,
)
from systems.scalars import (
    CheckFiniteParameter,
    CheckNonNegativeParameter,
    CheckPositiveParameter,
)

MEAN_WIND = "mean_wind"
"""The source of the mean wind in a plant; its value is a parameter of the Context."""

GUST_PERIOD = 0.01
"""s; the gusts change so often, which is much faster than they fade."""


@dataclass(frozen=True)
class Disturbance:
    """What disturbs a quadrotor, in SI units.

    Attributes:
        wind: Mean velocity of the air in W, (3,) in m/s.
        gust: Standard deviation of the velocity of the air on each axis, m/s.
        gust_time: Time over which a gust fades, s.
        drag: Force of the air over its velocity past the vehicle, N s/m.  The default is that
            of a quadrotor of half a kilogram.
        motor_lag: Time constant of the propellers' forces, s.
        mass_factor: The vehicle's mass over the one that the controller believes.
        inertia_factor: Its moments of inertia over those.
        thrust_factor: The propellers' forces over the commanded ones.

    Raises:
        ConfigurationError: if a value cannot be used.
    """

    wind: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gust: float = 0.0
    gust_time: float = 1.0
    drag: float = 0.1
    motor_lag: float = 0.0
    mass_factor: float = 1.0
    inertia_factor: float = 1.0
    thrust_factor: float = 1.0

    def __post_init__(self) -> None:
        if len(self.wind) != 3:
            raise ConfigurationError(f"wind must have 3 values, got {len(self.wind)}")
        for value in self.wind:
            CheckFiniteParameter("wind", value)
        for field in fields(self):
            if field.name in ("gust", "drag", "motor_lag"):
                CheckNonNegativeParameter(field.name, getattr(self, field.name))
            elif field.name != "wind":
                CheckPositiveParameter(field.name, getattr(self, field.name))

    def BodyOf(self, parameters: QuadrotorParameters) -> QuadrotorParameters:
        """Returns what flies where `parameters` are believed."""
        inertia: Any = tuple(self.inertia_factor * moment for moment in parameters.inertia)
        return replace(parameters, mass=self.mass_factor * parameters.mass, inertia=inertia)


class DisturbedQuadrotor(Diagram):
    """Drake's QuadrotorPlant in moving air, with propellers that lag.

    .. pydrake_system::

        name: DisturbedQuadrotor
        input_ports:
        - propeller_force
        output_ports:
        - state
        - wind

    `propeller_force` (4) and `state` (12) are QuadrotorPlant's; `wind` (3) is the velocity of
    the air in W in m/s.

    QuadrotorPlant takes no force of the air, but its translation is linear in forces, and they
    do not turn it: so what drag adds to position and velocity is a linear system beside it, of
    6 states, driven by the whole velocity past the air.  The gusts are an Ornstein-Uhlenbeck
    process on each axis, of Drake's RandomSource; see `SetNoiseSeed`.

    Args:
        parameters: The vehicle as it is believed.
        disturbance: What disturbs it.
    """

    def __init__(self, parameters: QuadrotorParameters, disturbance: Disturbance) -> None:
        super().__init__()
        self._body = disturbance.BodyOf(parameters)
        self._disturbance = disturbance
        builder = DiagramBuilder()
        self._quadrotor = builder.AddNamedSystem("quadrotor", self._body.MakePlant())
        self._AddPropellers(builder)
        wind = AddWind(builder, disturbance)
        self._drift = builder.AddNamedSystem(
            "drift", _MakeDrift(disturbance.drag / self._body.mass)
        )
        state, seen = self._quadrotor.get_output_port(), Multiplexer([STATE_SIZE, 3])
        builder.AddNamedSystem("state_and_wind", seen)
        builder.Connect(state, seen.get_input_port(0))
        builder.Connect(wind, seen.get_input_port(1))
        builder.Connect(seen.get_output_port(), self._drift.get_input_port())
        whole = builder.AddNamedSystem("state", Adder(2, STATE_SIZE))
        builder.Connect(state, whole.get_input_port(0))
        builder.Connect(self._drift.get_output_port(), whole.get_input_port(1))
        builder.ExportOutput(whole.get_output_port(), "state")
        builder.ExportOutput(wind, "wind")
        builder.BuildInto(self)

    def _AddPropellers(self, builder: DiagramBuilder) -> None:
        thrust = builder.AddNamedSystem(
            "thrust", Gain(self._disturbance.thrust_factor, NUM_PROPELLERS)
        )
        builder.ExportInput(thrust.get_input_port(), "propeller_force")
        force = thrust.get_output_port()
        self._motors: Any = None
        if self._disturbance.motor_lag > 0.0:
            self._motors = builder.AddNamedSystem(
                "motors", FirstOrderLowPassFilter(self._disturbance.motor_lag, NUM_PROPELLERS)
            )
            builder.Connect(force, self._motors.get_input_port())
            force = self._motors.get_output_port()
        builder.Connect(force, self._quadrotor.get_input_port())

    def SetVehicleState(self, root_context: Context, state: Any) -> None:
        """Sets the state of the vehicle; its propellers carry its weight.

        Args:
            root_context: The Context of the whole diagram.
            state: The state (12,), as QuadrotorPlant's.
        """
        values = [(self._quadrotor, state), (self._drift, np.zeros(6))]
        if self._motors is not None:
            hover = self._body.hover_force / self._body.force_constant
            values.append((self._motors, np.full(NUM_PROPELLERS, hover)))
        for system, value in values:
            system.GetMyMutableContextFromRoot(root_context).SetContinuousState(value)


def _MakeDrift(rate: float) -> LinearSystem:
    """Returns what drag adds to position and velocity, as a state (12,).

    Its input is the state (12,) without it and the wind (3,); `rate` is drag over mass in 1/s.
    """
    eye, zero = np.eye(3), np.zeros((3, 3))
    A: Any = np.block([[zero, eye], [zero, -rate * eye]])
    B, C = np.zeros((6, STATE_SIZE + 3)), np.zeros((STATE_SIZE, 6))
    B[3:, VELOCITY], B[3:, STATE_SIZE:] = -rate * eye, rate * eye
    C[POSITION, :3], C[VELOCITY, 3:] = eye, eye
    D: Any = np.zeros((STATE_SIZE, STATE_SIZE + 3))
    matrices: Any = (A, B, C, D)
    return LinearSystem(*matrices)


def AddWind(builder: DiagramBuilder, disturbance: Disturbance) -> OutputPort:
    """Adds the mean wind and the gusts; returns the velocity of the air (3,)."""
    mean_wind: Any = np.array(disturbance.wind)
    mean = builder.AddNamedSystem(MEAN_WIND, ConstantVectorSource(mean_wind))
    if disturbance.gust == 0.0:
        return mean.get_output_port()
    noise = builder.AddNamedSystem(
        "gust_random", RandomSource(RandomDistribution.kGaussian, 3, GUST_PERIOD)
    )
    kept, eye = math.exp(-GUST_PERIOD / disturbance.gust_time), np.eye(3)
    # Of this variance, whatever the period.
    driven = disturbance.gust * math.sqrt(1.0 - kept * kept)
    matrices: Any = (kept * eye, driven * eye, eye, np.zeros((3, 3)), GUST_PERIOD)
    gusts = builder.AddNamedSystem("gusts", LinearSystem(*matrices))
    wind = builder.AddNamedSystem("wind", Adder(2, 3))
    builder.Connect(noise.get_output_port(), gusts.get_input_port())
    builder.Connect(mean.get_output_port(), wind.get_input_port(0))
    builder.Connect(gusts.get_output_port(), wind.get_input_port(1))
    return wind.get_output_port()
