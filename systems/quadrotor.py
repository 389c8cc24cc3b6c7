"""The vehicle: its physical parameters, and Drake's plant made from them."""

from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any, NamedTuple
import warnings

import numpy as np
from numpy.typing import NDArray
from pydrake.examples import QuadrotorPlant

from sgvf_drake.exceptions import ConfigurationError, InertiaWarning
from systems.scalars import CheckPositiveParameter

STATE_SIZE = 12
POSITION, ATTITUDE, VELOCITY, RATES = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
"""QuadrotorPlant's state: p_WB in m, roll-pitch-yaw in rad, v_WB in m/s, and the rates of
roll-pitch-yaw in rad/s, which are not the body's angular velocity."""

NUM_PROPELLERS = 4

INERTIA_ROUNDING = 1e-9
"""Relative; a flat plate misses the triangle inequality by its rounding."""


class Rotors(NamedTuple):
    """Where the propellers stand and what each can give, as plain numbers for the mixing.

    Attributes:
        arm_length: From the centre of mass to a motor in m.
        yaw_arm: The yaw torque of a propeller per newton of its force, in m.
        max_force: The greatest force of one propeller in N.
        force_constant: Newtons per unit of the plant's input.
    """

    arm_length: float
    yaw_arm: float
    max_force: float
    force_constant: float


@dataclass(frozen=True)
class QuadrotorParameters:
    """The physical parameters of a quadrotor in SI units; by default the paper's vehicle.

    The propellers stand in the "+" layout of QuadrotorPlant: 0 on the body's +x axis,
    1 on +y, 2 on -x, 3 on -y; z points up, and propellers 0 and 2 turn against 1 and 3.

    Attributes:
        mass: In kg (paper, experiments).
        arm_length: From the centre of mass to a motor in m; the paper's motor-to-motor
            diagonal is 0.149 m.
        thrust_to_weight: Greatest total thrust over the weight (paper, experiments).
        inertia: Principal moments of inertia (I_xx, I_yy, I_zz) in kg m^2.  Not
            published; estimated from a box body with four motors of 25 g.  Some that are
            published are those of no rigid body; then the nearest ones that are, are used.
        force_constant: kF, newtons per unit of input; 1 makes the inputs newtons.
        moment_constant: kM, newton metres of yaw torque per unit of input; with kF = 1
            it is a length in m.
        gravity: The acceleration of gravity, m/s^2.

    Raises:
        ConfigurationError: if a value is not finite and positive, or if the vehicle cannot
            lift its weight.

    Warns:
        InertiaWarning: if no rigid body has this inertia.
    """

    mass: float = 0.46
    arm_length: float = 0.0745
    thrust_to_weight: float = 4.1
    inertia: tuple[float, float, float] = (4.5e-4, 6.0e-4, 8.5e-4)
    force_constant: float = 1.0
    moment_constant: float = 0.008
    gravity: float = 9.81

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "inertia":
                CheckPositiveParameter(name, value)
        if self.thrust_to_weight <= 1.0:
            raise ConfigurationError(
                f"thrust_to_weight must be greater than 1 to fly, got {self.thrust_to_weight}"
            )
        _CheckInertia(self.inertia)
        possible = NearestInertia(self.inertia)
        if possible != self.inertia:
            smallest, middle, largest = sorted(self.inertia)
            warnings.warn(
                f"no rigid body has the inertia {self.inertia} kg m^2: {largest:g} is more "
                f"than the sum of the others by {largest - smallest - middle:.3g}; the nearest "
                f"that one has is used, ({', '.join(f'{moment:.4g}' for moment in possible)})",
                InertiaWarning,
                stacklevel=3,
            )
            object.__setattr__(self, "inertia", possible)

    @classmethod
    def FromPlant(
        cls, plant: QuadrotorPlant, thrust_to_weight: float = 4.1
    ) -> "QuadrotorParameters":
        """Reads the parameters of a plant.

        Args:
            plant: Drake's plant, of any scalar type.
            thrust_to_weight: The plant does not limit its inputs, so this is free.

        Raises:
            ConfigurationError: if the plant's inertia has products of inertia.
        """
        I_B = np.asarray(plant.inertia(), dtype=np.float64)
        if np.any(np.diag(np.diag(I_B)) != I_B):
            raise ConfigurationError(f"inertia must be diagonal, got {I_B.tolist()}")
        return cls(
            mass=plant.m(),
            arm_length=plant.length(),
            thrust_to_weight=thrust_to_weight,
            inertia=(float(I_B[0, 0]), float(I_B[1, 1]), float(I_B[2, 2])),
            force_constant=plant.force_constant(),
            moment_constant=plant.moment_constant(),
            gravity=plant.g(),
        )

    @cached_property
    def weight(self) -> float:
        """The weight in N."""
        return self.mass * self.gravity

    @cached_property
    def max_propeller_force(self) -> float:
        """The greatest force of one propeller in N."""
        return self.thrust_to_weight * self.weight / NUM_PROPELLERS

    @cached_property
    def hover_force(self) -> float:
        """The force of one propeller in hover in N."""
        return self.weight / NUM_PROPELLERS

    @cached_property
    def max_horizontal_acceleration(self) -> float:
        """The greatest horizontal acceleration in m/s^2 that holds the altitude."""
        return self.gravity * math.sqrt(self.thrust_to_weight**2 - 1.0)

    @cached_property
    def yaw_arm(self) -> float:
        """The ratio kM / kF in m: the yaw torque of a propeller per newton of its force."""
        return self.moment_constant / self.force_constant

    @cached_property
    def rotors(self) -> Rotors:
        """What the mixing needs to know of the propellers."""
        return Rotors(
            self.arm_length, self.yaw_arm, self.max_propeller_force, self.force_constant
        )

    def MixingMatrix(self) -> NDArray[np.float64]:
        """Returns the (4, 4) matrix from propeller forces in N to thrust and torque.

        Its rows give the thrust along B's z axis in N, and the torque about B's x, y
        and z axes in N m.
        """
        L, k = self.arm_length, self.yaw_arm
        return np.array([[1, 1, 1, 1], [0, L, 0, -L], [-L, 0, L, 0], [k, -k, k, -k]])

    def MakePlant(self) -> QuadrotorPlant:
        """Returns Drake's QuadrotorPlant with these parameters.

        Raises:
            ConfigurationError: if `gravity` is not the plant's own, which is fixed.
        """
        I_B: Any = np.diag(self.inertia)  # Drake's stubs misname the type of arrays.
        plant = QuadrotorPlant(
            self.mass, self.arm_length, I_B, self.force_constant, self.moment_constant
        )
        if plant.g() != self.gravity:
            raise ConfigurationError(
                f"gravity is {plant.g()} m/s^2 in QuadrotorPlant, got {self.gravity}"
            )
        return plant


def NearestInertia(inertia: tuple[float, float, float]) -> tuple[float, float, float]:
    """Returns the moments nearest to these that a rigid body can have.

    None is more than the sum of the other two.  Where one is, by d, a third of d comes off it
    and goes to each of the others: the projection on that plane, on the positive side of the
    other two.

    Args:
        inertia: Positive principal moments of inertia in kg m^2.
    """
    smallest, middle, largest = np.argsort(inertia).tolist()
    excess = inertia[largest] - inertia[middle] - inertia[smallest]
    if excess <= INERTIA_ROUNDING * inertia[largest]:
        return inertia
    moved = [moment + excess / 3.0 for moment in inertia]
    moved[largest] = moved[smallest] + moved[middle]
    return moved[0], moved[1], moved[2]


def _CheckInertia(inertia: tuple[float, float, float]) -> None:
    if len(inertia) != 3:
        raise ConfigurationError(f"inertia must have 3 values, got {len(inertia)}")
    for moment in inertia:
        CheckPositiveParameter("inertia", moment)
