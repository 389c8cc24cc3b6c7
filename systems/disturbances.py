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
    Integrator,
    MatrixGain,
    PassThrough,
    RandomSource,
    ZeroOrderHold,
)

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from systems.context_matrix import AddMatrix, Matrix, SetMatrix
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

DRIFT_SIZE = 6
"""Position and velocity."""


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

    @property
    def structure(self) -> "Disturbance":
        """What is built in: whether there are gusts and a lag; all else lies in the Context."""
        return Disturbance(gust=float(self.gust > 0.0), motor_lag=float(self.motor_lag > 0.0))

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
    6 states, driven by the whole velocity past the air.  It is the plant of the believed body,
    whose propellers give what moves it as theirs move the true one: that is linear as well.
    The gusts are an Ornstein-Uhlenbeck process on each axis, of Drake's RandomSource; see
    `SetNoiseSeed`.

    The disturbance lies in the Context, see `SetDisturbance`; only whether there are gusts and
    a lag of the motors at all is built in.

    Args:
        parameters: The vehicle as it is believed.
        disturbance: What disturbs it, in the default Context.
    """

    def __init__(self, parameters: QuadrotorParameters, disturbance: Disturbance) -> None:
        super().__init__()
        self._body = parameters
        self._structure = disturbance.structure
        builder = DiagramBuilder()
        self._quadrotor = builder.AddNamedSystem("quadrotor", parameters.MakePlant())
        self._AddPropellers(builder, disturbance)
        wind = AddWind(builder, disturbance)
        self._drift = builder.AddNamedSystem("drift", Integrator(DRIFT_SIZE))
        state, drift = self._quadrotor.get_output_port(), self._drift.get_output_port()
        rate = _DriftRate(disturbance, parameters)
        change = AddMatrix(builder, "drift_rate", rate, state, wind, drift)
        builder.Connect(change, self._drift.get_input_port())
        added = builder.AddNamedSystem("added", MatrixGain(_ADDED))
        builder.Connect(drift, added.get_input_port())
        whole = builder.AddNamedSystem("state", Adder(2, STATE_SIZE))
        builder.Connect(state, whole.get_input_port(0))
        builder.Connect(added.get_output_port(), whole.get_input_port(1))
        builder.ExportOutput(whole.get_output_port(), "state")
        builder.ExportOutput(wind, "wind")
        builder.BuildInto(self)

    def _AddPropellers(self, builder: DiagramBuilder, disturbance: Disturbance) -> None:
        command = builder.AddNamedSystem("propeller_force", PassThrough(NUM_PROPELLERS))
        builder.ExportInput(command.get_input_port(), "propeller_force")
        force = command.get_output_port()
        self._motors: Any = None
        if disturbance.motor_lag > 0.0:
            self._motors = builder.AddNamedSystem("motors", Integrator(NUM_PROPELLERS))
            lagging = self._motors.get_output_port()
            change = AddMatrix(builder, "motor_rate", _MotorRate(disturbance), force, lagging)
            builder.Connect(change, self._motors.get_input_port())
            force = lagging
        force = AddMatrix(builder, "thrust", _Thrust(disturbance, self._body), force)
        builder.Connect(force, self._quadrotor.get_input_port())

    def SetDisturbance(self, root_context: Context, disturbance: Disturbance) -> None:
        """Sets what disturbs the vehicle.

        Args:
            root_context: The Context of the whole diagram.
            disturbance: With gusts and a lag of the motors where the built one has them.

        Raises:
            ConfigurationError: if it has others.
        """
        if disturbance.structure != self._structure:
            raise ConfigurationError(
                "gusts and the lag of the motors are built in: they can change, but neither "
                "begin nor end"
            )
        context = self.GetMyMutableContextFromRoot(root_context)
        SetWind(self, context, disturbance)
        SetMatrix(self, context, "drift_rate", _DriftRate(disturbance, self._body))
        SetMatrix(self, context, "thrust", _Thrust(disturbance, self._body))
        if self._motors is not None:
            SetMatrix(self, context, "motor_rate", _MotorRate(disturbance))

    def SetVehicleState(self, root_context: Context, state: Any) -> None:
        """Sets the state of the vehicle; its propellers carry its weight.

        Args:
            root_context: The Context of the whole diagram.
            state: The state (12,), as QuadrotorPlant's.
        """
        values = [(self._quadrotor, state), (self._drift, np.zeros(DRIFT_SIZE))]
        if self._motors is not None:
            context = self.GetMyContextFromRoot(root_context)
            hover = np.full(NUM_PROPELLERS, self._body.hover_force / self._body.force_constant)
            values.append(
                (self._motors, np.linalg.solve(Matrix(self, context, "thrust"), hover))
            )
        for system, value in values:
            system.GetMyMutableContextFromRoot(root_context).SetContinuousState(value)


_ADDED: Any = np.zeros((STATE_SIZE, DRIFT_SIZE))
"""What the drift, position and velocity, adds to the state."""
_ADDED[POSITION, :3] = _ADDED[VELOCITY, 3:] = np.eye(3)


def _DriftRate(disturbance: Disturbance, believed: QuadrotorParameters) -> FloatArray:
    """Returns how the drift changes, (6, 21), with the undisturbed state, the wind and itself.

    The air pulls with drag times its velocity past the vehicle, which moves with both.
    """
    rate = disturbance.drag / disturbance.BodyOf(believed).mass * np.eye(3)
    matrix = np.zeros((DRIFT_SIZE, STATE_SIZE + 3 + DRIFT_SIZE))
    matrix[:3, -3:] = np.eye(3)
    matrix[3:, VELOCITY] = matrix[3:, -3:] = -rate
    matrix[3:, STATE_SIZE : STATE_SIZE + 3] = rate
    return matrix


def _Thrust(disturbance: Disturbance, believed: QuadrotorParameters) -> FloatArray:
    """Returns the forces, (4, 4), that move the believed body as those of the motors the true.

    A body of another mass moves as this one by a thrust that is smaller by the same factor;
    so it is with the moments of inertia, all of one factor, and the torques.
    """
    mixing = believed.MixingMatrix()
    inertia = np.full(3, disturbance.inertia_factor)
    factors = disturbance.thrust_factor / np.concatenate(([disturbance.mass_factor], inertia))
    return np.asarray(np.linalg.solve(mixing, factors[:, None] * mixing))


def _MotorRate(disturbance: Disturbance) -> FloatArray:
    """Returns how forces that lag change, (4, 8), with the commanded ones and themselves."""
    rate = np.eye(NUM_PROPELLERS) / disturbance.motor_lag
    return np.hstack((rate, -rate))


def AddWind(builder: DiagramBuilder, disturbance: Disturbance) -> OutputPort:
    """Adds the mean wind and the gusts; returns the velocity of the air (3,).

    See `SetWind` for another Context than the default one.
    """
    mean_wind: Any = np.array(disturbance.wind)
    mean = builder.AddNamedSystem(MEAN_WIND, ConstantVectorSource(mean_wind))
    if disturbance.gust == 0.0:
        return mean.get_output_port()
    noise = builder.AddNamedSystem(
        "gust_random", RandomSource(RandomDistribution.kGaussian, 3, GUST_PERIOD)
    )
    gusts = builder.AddNamedSystem("gusts", ZeroOrderHold(GUST_PERIOD, 3))
    ports = noise.get_output_port(), gusts.get_output_port()
    after = AddMatrix(builder, "next_gusts", _NextGusts(disturbance), *ports)
    builder.Connect(after, gusts.get_input_port())
    wind = builder.AddNamedSystem("wind", Adder(2, 3))
    builder.Connect(mean.get_output_port(), wind.get_input_port(0))
    builder.Connect(gusts.get_output_port(), wind.get_input_port(1))
    return wind.get_output_port()


def SetWind(diagram: Diagram, context: Context, disturbance: Disturbance) -> None:
    """Sets the mean wind, and the gusts if there are any.

    Args:
        diagram: The one that was built by `AddWind`.
        context: This diagram's own.
        disturbance: With gusts where the built one has them.
    """
    mean: Any = diagram.GetSubsystemByName(MEAN_WIND)
    own = diagram.GetMutableSubsystemContext(mean, context)
    mean.get_mutable_source_value(own).SetFromVector(np.array(disturbance.wind))
    if disturbance.gust > 0.0:
        SetMatrix(diagram, context, "next_gusts", _NextGusts(disturbance))


def _NextGusts(disturbance: Disturbance) -> FloatArray:
    """Returns what gusts become, (3, 6), of noise and of those before."""
    kept = math.exp(-GUST_PERIOD / disturbance.gust_time)
    # Of this variance, whatever the period.
    driven = disturbance.gust * math.sqrt(1.0 - kept * kept)
    return np.hstack((driven * np.eye(3), kept * np.eye(3)))
