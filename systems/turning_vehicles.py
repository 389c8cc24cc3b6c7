"""The vehicles that hold their speed and turn: a ground robot, and a fixed wing."""

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
import math
from typing import Any, ClassVar, Self

import numpy as np
from pydrake.systems.framework import System

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import Field
from systems.controller import DEFAULT_GAINS
from systems.course_controller import CourseController
from systems.disturbances import Disturbance
from systems.guidance import DEFAULT_SPEED
from systems.planar_vehicle import (
    PLANAR_STATE_SIZE,
    PLANAR_VELOCITY,
    PlanarVehicle,
    PlanarVehicleInWind,
    PlanarVehicleParameters,
)
from systems.quadrotor import QuadrotorParameters
from systems.scalars import CheckPositiveParameter
from systems.se3_law import Gains
from systems.sensing import IdealMotionCapture, MotionCapture, SensorParameters
from systems.vehicle import Feasibility, Vehicle

UNICYCLE_TURN_RATE = 2.0
"""rad/s, as small robots on two wheels have it."""

BANK_LIMIT = math.radians(35.0)
"""The greatest bank of a fixed wing, rad; with a speed v it turns at g tan(bank) / v."""

BANK_LAG = 0.3
"""s, in which a small fixed wing banks."""

GRAVITY = 9.81
"""m/s^2."""

APPROACH_RADII = 0.5
"""Turn radii over which a flown field turns to the path.  Twice that leaves a fifth more
error on a square."""

MOST_TURN = 1.05 * math.pi
"""rad, by which a path may turn within the length of half a circle of the vehicle.  Corners
pass, and so does a path that turns back once; rounding does not count."""


@dataclass(frozen=True)
class TurningVehicle(Vehicle):
    """A `PlanarVehicle` that is steered by the `CourseController`.

    Attributes:
        parameters: Speed, turn rate and lag.
    """

    parameters: PlanarVehicleParameters

    words: ClassVar[str]
    actuation = "turn_rate"
    actuation_columns = ("turn_rate",)
    state_columns = ("x", "y", "z", "heading", "vx", "vy", "vz")
    velocity = PLANAR_VELOCITY
    can_rest = False

    @classmethod
    def Make(
        cls,
        speed: float,
        turn_radius: float | None = None,
        parameters: QuadrotorParameters | None = None,
        gains: Gains = DEFAULT_GAINS,
    ) -> Self:
        """Returns the vehicle of this speed and turn radius."""
        if gains != DEFAULT_GAINS:
            raise ConfigurationError(
                f"{cls.words} has no gains to set: its course law needs no estimate of the wind"
            )
        CheckPositiveParameter("speed", speed)
        own = cls.Limits(speed)
        if turn_radius is None:
            return cls(own)
        CheckPositiveParameter("turn_radius", turn_radius)
        return cls(replace(own, max_turn_rate=speed / turn_radius))

    @classmethod
    @abstractmethod
    def Limits(cls, speed: float) -> PlanarVehicleParameters:
        """Returns what such a vehicle can do at a speed in m/s."""

    @property
    def own_speed(self) -> float:
        """The only one, m/s."""
        return self.parameters.airspeed

    @property
    def approach_rate(self) -> float:
        """Such that the field turns to the path over `APPROACH_RADII`."""
        return self.parameters.max_turn_rate / APPROACH_RADII

    @property
    def actuation_limits(self) -> tuple[float, float]:
        """The turn rates, rad/s."""
        return -self.parameters.max_turn_rate, self.parameters.max_turn_rate

    def MakePlant(self, disturbance: Disturbance | None = None) -> System:
        """Returns the vehicle, in moving air where it drifts."""
        if disturbance is None:
            plant: System = PlanarVehicle(self.parameters)
            return plant
        self._CheckAir(disturbance)
        return PlanarVehicleInWind(self.parameters, disturbance)

    def _CheckAir(self, disturbance: Disturbance) -> None:
        """Raises ConfigurationError on what disturbs other vehicles only, or is too strong."""
        air = Disturbance(disturbance.wind, disturbance.gust, disturbance.gust_time)
        if disturbance != replace(air, drag=disturbance.drag):
            raise ConfigurationError(
                f"{self.words} is disturbed by wind and gusts only: it has no propellers that "
                "lag or push less, and no mass to be mistaken for another"
            )
        wind = math.hypot(*disturbance.wind[:2])
        if wind >= self.parameters.airspeed:
            raise ConfigurationError(
                f"wind of {wind:g} m/s blows {self.words} away that flies at "
                f"{self.parameters.airspeed:g} m/s"
            )

    def MakeController(self) -> System:
        """Returns the `CourseController`."""
        controller: System = CourseController(self.parameters)
        return controller

    def MakeMotionCapture(
        self, sample_period: float, sensors: SensorParameters | None, fused: bool = False
    ) -> IdealMotionCapture | MotionCapture:
        """Returns ideal motion capture."""
        if sensors is not None:
            raise ConfigurationError(
                f"the sensors are those of a quadrotor; {self.words} is measured ideally"
            )
        return IdealMotionCapture(sample_period, PLANAR_STATE_SIZE, PLANAR_VELOCITY)

    def CheckGuided(self, dim: int, speed: float) -> None:
        """Refuses space, and any speed but its own."""
        if dim != 2:
            raise ConfigurationError(
                f"{self.words} keeps its altitude: it needs a field of dimension 2, got {dim}"
            )
        if speed != self.parameters.airspeed:
            raise ConfigurationError(
                f"{self.words} has one speed, {self.parameters.airspeed:g} m/s, not {speed:g}"
            )

    def StartState(
        self, position: FloatArray, guiding: Any, disturbance: Disturbance | None = None
    ) -> FloatArray:
        """Returns a heading along the field, at full speed."""
        airspeed = self.parameters.airspeed
        mx, my = self.FlownField(guiding, airspeed)(position[:2])
        heading = math.atan2(my, mx)
        ahead = np.array([math.cos(heading), math.sin(heading)])
        wind = np.array(disturbance.wind[:2] if disturbance else (0.0, 0.0))
        return np.array([*position, heading, *(airspeed * ahead + wind), 0.0])

    def CheckFeasibility(
        self,
        guiding: Field,
        pieces: Sequence[FloatArray],
        speed: float,
        disturbance: Disturbance | None = None,
    ) -> Feasibility:
        """Compares the curvature of the flown field with that of the tightest turn.

        With the wind behind it, a vehicle turns wider over ground: of airspeed v_a and wind w
        by (1 + w / v_a)^2.  Corners are sharper, and are turned wide.  A path is refused where
        it turns by more, in the length of half a circle of the vehicle, than that half circle.
        """
        flown, sharpest = self.FlownField(guiding, speed), 0.0
        for points in pieces:
            m, J = flown.value_and_jacobian(points)
            bent = np.einsum("nij,nj->ni", J, m)
            cross = m[:, 0] * bent[:, 1] - m[:, 1] * bent[:, 0]
            curvature = np.abs(cross) / np.sum(m * m, axis=1) ** 1.5
            sharpest = max(sharpest, float(curvature.max()))
            self._CheckTurn(m, points)
        wind = math.hypot(*disturbance.wind[:2]) if disturbance else 0.0
        widened = self.parameters.turn_radius * (1.0 + wind / self.parameters.airspeed) ** 2
        return Feasibility(sharpest, 1.0 / widened, "curvature", "1/m")

    def _CheckTurn(self, m: FloatArray, points: FloatArray) -> None:
        """Raises ConfigurationError where the directions along a piece turn too far."""
        radius = self.parameters.turn_radius
        step = float(np.median(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        course = np.unwrap(np.arctan2(m[:, 1], m[:, 0]))
        count = min(max(math.ceil(math.pi * radius / step), 1), len(course) - 1)
        turn = float(np.abs(course[count:] - course[:-count]).max())
        if turn > MOST_TURN:
            raise ConfigurationError(
                f"{self.words} with a turn radius of {radius:.3g} m cannot follow the path, "
                f"which turns by {math.degrees(turn):.0f} degrees within {count * step:.3g} m; "
                "choose a smaller turn radius or a larger scale"
            )


class Unicycle(TurningVehicle):
    """A robot on the ground, which no wind moves."""

    name, words, default_speed = "unicycle", "a unicycle", DEFAULT_SPEED

    @classmethod
    def Limits(cls, speed: float) -> PlanarVehicleParameters:
        """Returns what two wheels can do."""
        return PlanarVehicleParameters(speed, UNICYCLE_TURN_RATE)

    def _CheckAir(self, disturbance: Disturbance) -> None:
        raise ConfigurationError(f"{self.words} stands on the ground: no wind moves it")


class FixedWing(TurningVehicle):
    """An aircraft that turns by its bank, at one airspeed and one altitude."""

    name, words, default_speed = "fixed-wing", "a fixed wing", 15.0

    @classmethod
    def Limits(cls, speed: float) -> PlanarVehicleParameters:
        """Returns what the bank allows."""
        turn_rate = GRAVITY * math.tan(BANK_LIMIT) / speed
        return PlanarVehicleParameters(speed, turn_rate, BANK_LAG)
