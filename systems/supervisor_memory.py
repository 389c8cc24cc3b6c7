"""What a branch supervisor sees, is told and remembers, and what it commands from that."""

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from sgvf_drake.arrays import FloatArray
from systems.guidance import VELOCITY_OFFSET
from systems.scalar_math import Sqrt
from systems.scalars import Scalar
from systems.transfer import NUM_CONTROL_POINTS

ON_TOUR = -2
"""The wanted branch: the one that the tour says."""

HOLD_POSITION = -1
"""The wanted branch: none, stop here."""

POSITION_GAIN = 2.0
"""From position error to velocity, 1/s, while a reference is flown; see `ALTITUDE_GAIN`."""

MAX_CORRECTION = 1.0
"""m/s; the greatest velocity for the sake of a position error."""


class Mode(IntEnum):
    """What a supervisor does."""

    FOLLOW = 0
    TRANSFER = 1
    HOLD = 2
    LAND = 3


class Settings(NamedTuple):
    """What a user may change in flight.

    Attributes:
        branch: Number of the wanted branch, or `HOLD_POSITION`, or `ON_TOUR`.
        laps: To be flown on each branch of the tour.
        hold_after: Age of a measurement in s beyond which the vehicle stops.
        land_after: Age of a measurement in s beyond which it lands.
    """

    branch: float
    laps: float
    hold_after: float
    land_after: float


class Seen(NamedTuple):
    """The inputs at one sample, in the units of the ports.

    Attributes:
        time: In s.
        position: p_WB, (3,).
        velocity: v_WB, (3,).
        velocity_command: Of guidance, (3,).
        acceleration_feedforward: Of guidance, (3,).
        speed: Commanded.
        age: Of the measurement.
    """

    time: float
    position: FloatArray
    velocity: FloatArray
    velocity_command: FloatArray
    acceleration_feedforward: FloatArray
    speed: float
    age: float


BRANCH_OFFSET = 13
"""Where the branch stands in a `Memory` as a vector: after mode, mixing and reference."""

CONTROL_POINTS_OFFSET = 21
"""Where the control points start."""


@dataclass
class Memory:
    """What a supervisor remembers from one sample to the next.

    Attributes:
        mode: A `Mode`.
        weight: Of guidance in the outputs, in [0, 1]; the rest is the reference's.
        scale: On the speed of guidance, in (0, 1].
        scale_rate: Its rate in 1/s.
        position: Of the reference (3,) in m.
        velocity: Of the reference (3,) in m/s.
        acceleration: Of the reference (3,) in m/s^2.
        branch: Number of the branch that is followed or flown to.
        stop: Place in the tour.
        flown: Distance in m along the branch.
        target: Branch that a departure is planned to; `ON_TOUR`: none.
        departure: Time in s of that departure.
        start: Time in s at which the planned motion started.
        duration: Of the planned motion in s.
        speed: The commanded speed at the last sample in m/s, -1 before the first.
        control_points: Of the planned motion, (6, d) in m.
    """

    mode: float
    weight: float
    scale: float
    scale_rate: float
    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    branch: float
    stop: float
    flown: float
    target: float
    departure: float
    start: float
    duration: float
    speed: float
    control_points: FloatArray

    @classmethod
    def AtStart(cls, branch: int, dim: int) -> "Memory":
        """Returns the memory of a supervisor that has not seen anything."""
        vector = np.zeros(CONTROL_POINTS_OFFSET + NUM_CONTROL_POINTS * dim)
        start = cls.FromVector(vector)
        start.weight, start.scale, start.duration = 1.0, 1.0, 1.0
        start.branch, start.target, start.speed = float(branch), float(ON_TOUR), -1.0
        return start

    @classmethod
    def FromVector(cls, values: FloatArray) -> "Memory":
        """Reads what `ToVector` has written."""
        start = CONTROL_POINTS_OFFSET
        v = values[:start].tolist()
        reference = values[4:BRANCH_OFFSET].reshape(3, 3).copy()
        points = values[start:].reshape(NUM_CONTROL_POINTS, -1).copy()
        attributes: list[Any] = [*v[:4], *reference, *v[BRANCH_OFFSET:], points]
        return cls(*attributes)

    def ToVector(self) -> FloatArray:
        """Returns all of it, in the order of the attributes, as one vector."""
        return np.concatenate(
            (
                (self.mode, self.weight, self.scale, self.scale_rate),
                self.position,
                self.velocity,
                self.acceleration,
                (self.branch, self.stop, self.flown, self.target, self.departure),
                (self.start, self.duration, self.speed),
                self.control_points.ravel(),
            )
        )


def CalcCommands(
    memory: list[Scalar],
    guided: int,
    state: list[Scalar],
    velocity_command: list[Scalar],
    acceleration: list[Scalar],
) -> list[Scalar]:
    """Returns the commands (6,): a mean of guidance's and of the reference's.

    Args:
        memory: `Memory` as a vector.
        guided: Number of axes, the first ones, that are the supervisor's.
        state: The vehicle's.
        velocity_command: Guidance's.
        acceleration: Guidance's feed-forward.
    """
    _, w, scale, scale_rate = memory[:4]
    v, a = velocity_command[:], acceleration[:]
    errors = [memory[4 + i] - state[i] for i in range(guided)]
    stretch = sum((e * e for e in errors), 0.0) * (POSITION_GAIN / MAX_CORRECTION) ** 2
    gain = POSITION_GAIN / Sqrt(1.0 + stretch)
    for i, error in enumerate(errors):
        v_ref, a_ref = memory[7 + i], memory[10 + i]
        v_flown = v_ref + gain * error
        a_flown = a_ref + gain * (v_ref - state[VELOCITY_OFFSET + i])
        a[i] = w * (scale * a[i] + scale_rate * v[i]) + (1.0 - w) * a_flown
        v[i] = w * scale * v[i] + (1.0 - w) * v_flown
    return [*v, *a]
