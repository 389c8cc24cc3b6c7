"""What a loop, a flight and its log have to know of a vehicle; the quadrotor says it here."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
from pydrake.systems.framework import System
from pydrake.systems.primitives import ZeroOrderHold

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import Field
from systems.controller import DEFAULT_GAINS, Se3Controller
from systems.disturbances import Disturbance, DisturbedQuadrotor
from systems.guidance import DEFAULT_SPEED, MAX_APPROACH_RATE, FieldForSpeed
from systems.quadrotor import STATE_SIZE, VELOCITY, QuadrotorParameters
from systems.se3_law import Gains
from systems.sensing import IdealMotionCapture, MotionCapture, SensorParameters


@dataclass(frozen=True)
class Feasibility:
    """Whether a vehicle can do what a path demands.

    Attributes:
        demand: The largest demand of the path: of a quadrotor speed^2 |J m| in m/s^2, the
            acceleration of a vehicle that moves exactly along the field; of a vehicle that
            only turns the curvature in 1/m.
        limit: What the vehicle can give: the horizontal acceleration that the thrust allows
            in level flight, or one over the turn radius.
        quantity: "acceleration" or "curvature".
        unit: Its unit.
    """

    demand: float
    limit: float
    quantity: str = "acceleration"
    unit: str = "m/s^2"

    @property
    def is_feasible(self) -> bool:
        """Whether the demand stays below the limit."""
        return self.demand < self.limit

    def figures(self) -> dict[str, float]:
        """Returns demand and limit by the names of `summary.json`."""
        unit = self.unit.replace("/", "_").replace("^", "")
        return {
            f"{self.quantity}_demand_{unit}": self.demand,
            f"{self.quantity}_limit_{unit}": self.limit,
        }


class Vehicle(ABC):
    """A kind of vehicle: its systems, its state, its limits and the columns of its log.

    The plant has an input of the name `actuation` and an output `state`; the controller has
    inputs `state`, `velocity_command` and `acceleration_feedforward`, and an output of the
    name `actuation`.  The state begins with the position p_WB (3).

    Attributes:
        name: The name by which it is chosen.
        default_speed: The speed where none is asked for, m/s.
        actuation: The port by which a controller commands the plant.
        actuation_columns: The names of its entries in a log.
        state_columns: The names of the entries of the state.
        velocity: The entries of v_WB in the state.
        can_rest: Whether it can stop, hover and slow down.
    """

    name: ClassVar[str]
    default_speed: ClassVar[float]
    actuation: ClassVar[str]
    actuation_columns: ClassVar[tuple[str, ...]]
    state_columns: ClassVar[tuple[str, ...]]
    velocity: ClassVar[slice]
    can_rest: ClassVar[bool]

    @classmethod
    @abstractmethod
    def Make(
        cls,
        speed: float,
        turn_radius: float | None = None,
        parameters: QuadrotorParameters | None = None,
        gains: Gains = DEFAULT_GAINS,
    ) -> Self:
        """Returns the vehicle for a flight.

        Args:
            speed: The speed of the flight, m/s.
            turn_radius: That of its tightest turn, m; None: its own.
            parameters: Those of a quadrotor; None: the paper's.
            gains: Those of the controller of a quadrotor.

        Raises:
            ConfigurationError: if it has no such thing, or a value cannot be used.
        """

    @property
    def own_speed(self) -> float:
        """The speed at which it flies where nothing else is asked for, m/s."""
        return self.default_speed

    @property
    @abstractmethod
    def approach_rate(self) -> float:
        """How fast a flown field may ask it to turn toward the path, 1/s."""

    @property
    @abstractmethod
    def actuation_limits(self) -> tuple[float, float]:
        """What the entries of the actuation are limited to."""

    @abstractmethod
    def MakePlant(self, disturbance: Disturbance | None = None) -> System:
        """Returns the plant, in moving air where there is a disturbance.

        Raises:
            ConfigurationError: if it cannot move in it.
        """

    @abstractmethod
    def MakeController(self) -> System:
        """Returns what turns the commands of guidance into the actuation."""

    @abstractmethod
    def MakeMotionCapture(
        self, sample_period: float, sensors: SensorParameters | None, fused: bool = False
    ) -> IdealMotionCapture | MotionCapture | ZeroOrderHold:
        """Returns what measures the state; without sensors it is ideal.

        With `fused`, what samples ideally is a mere hold of the state: `FusedGuidance` needs no
        parts of it, and a Diagram around a hold costs a flight more time than the hold.

        Raises:
            ConfigurationError: if the vehicle has no such sensors.
        """

    @abstractmethod
    def CheckGuided(self, dim: int, speed: float) -> None:
        """Raises ConfigurationError, with the reason, on what it cannot follow.

        Args:
            dim: The dimension of the field.
            speed: The commanded speed, m/s.
        """

    @abstractmethod
    def StartState(
        self, position: FloatArray, guiding: Any, disturbance: Disturbance | None = None
    ) -> FloatArray:
        """Returns the state with which a flight begins.

        Args:
            position: p_WB (3,) in m.
            guiding: The field, in metres.
            disturbance: What disturbs the vehicle.
        """

    @abstractmethod
    def CheckFeasibility(
        self,
        guiding: Field,
        pieces: Sequence[FloatArray],
        speed: float,
        disturbance: Disturbance | None = None,
    ) -> Feasibility:
        """Compares what a path demands with what the vehicle can give.

        Args:
            guiding: The field, in metres.
            pieces: Points (n, d) at equal steps along each piece, in m.
            speed: The commanded speed, m/s.
            disturbance: What disturbs the vehicle.

        Raises:
            ConfigurationError: if the path cannot be followed at all.
        """

    def FlownField(self, field: Any, speed: float) -> Any:
        """Returns the field as the vehicle flies it; see `FieldForSpeed`."""
        return FieldForSpeed(field, speed, self.approach_rate)


@dataclass(frozen=True)
class Quadrotor(Vehicle):
    """Drake's QuadrotorPlant, flown by the `Se3Controller`.

    Attributes:
        parameters: As the controller believes them.
        gains: Those of the controller.
        saturate: As in `Se3Controller`.
    """

    parameters: QuadrotorParameters = field(default_factory=QuadrotorParameters)
    gains: Gains = DEFAULT_GAINS
    saturate: bool = True

    name = "quadrotor"
    default_speed = DEFAULT_SPEED
    actuation = "propeller_force"
    actuation_columns = ("force_1", "force_2", "force_3", "force_4")
    state_columns = (
        *("x", "y", "z", "roll", "pitch", "yaw"),
        *("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate"),
    )
    velocity = VELOCITY
    can_rest = True

    @classmethod
    def Make(
        cls,
        speed: float,
        turn_radius: float | None = None,
        parameters: QuadrotorParameters | None = None,
        gains: Gains = DEFAULT_GAINS,
    ) -> Self:
        """Returns the quadrotor of these parameters and gains."""
        if turn_radius is not None:
            raise ConfigurationError(
                "a quadrotor turns on the spot: it has no turn radius to choose"
            )
        return cls(parameters or QuadrotorParameters(), gains)

    @property
    def approach_rate(self) -> float:
        """That of the attitude, whatever the parameters."""
        return MAX_APPROACH_RATE

    @property
    def actuation_limits(self) -> tuple[float, float]:
        """The forces of a propeller, N."""
        return 0.0, self.parameters.max_propeller_force

    def MakePlant(self, disturbance: Disturbance | None = None) -> System:
        """Returns Drake's plant, or a `DisturbedQuadrotor`."""
        if disturbance is None:
            return self.parameters.MakePlant()
        return DisturbedQuadrotor(self.parameters, disturbance)

    def MakeController(self) -> System:
        """Returns the `Se3Controller`."""
        controller: System = Se3Controller(self.parameters, self.gains, self.saturate)
        return controller

    def MakeMotionCapture(
        self, sample_period: float, sensors: SensorParameters | None, fused: bool = False
    ) -> IdealMotionCapture | MotionCapture | ZeroOrderHold:
        """Returns ideal motion capture, or with noise and delay."""
        if sensors is not None:
            return MotionCapture(sensors)
        if fused and sample_period > 0.0:
            return ZeroOrderHold(sample_period, STATE_SIZE)
        return IdealMotionCapture(sample_period)

    def CheckGuided(self, dim: int, speed: float) -> None:
        """Refuses nothing: it flies in the plane and in space, and at any speed."""

    def StartState(
        self,
        position: FloatArray,
        guiding: Any,
        disturbance: Disturbance | None = None,
    ) -> FloatArray:
        """Returns a hover, level and at rest."""
        return np.concatenate((position, np.zeros(STATE_SIZE - 3)))

    def CheckFeasibility(
        self,
        guiding: Field,
        pieces: Sequence[FloatArray],
        speed: float,
        disturbance: Disturbance | None = None,
    ) -> Feasibility:
        """Compares the acceleration with what the thrust allows."""
        flown = self.FlownField(guiding, speed)
        m, J = flown.value_and_jacobian(np.concatenate(pieces))
        turning = np.linalg.norm(np.einsum("nij,nj->ni", J, m), axis=1)
        return Feasibility(
            speed**2 * float(turning.max()), self.parameters.max_horizontal_acceleration
        )
