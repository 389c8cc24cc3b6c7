"""Transfers: short motions in time that join one motion to another without a jump.

A motion here is a quintic in time, the least degree that takes a position, a velocity and an
acceleration at both ends.  It is held as the six control points of a Bezier curve (Bernstein
form; G. Farin, Curves and Surfaces for CAGD): plain numbers in metres, which bound the curve.
"""

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from sgvf_drake.arrays import FloatArray

NUM_CONTROL_POINTS = 6

SPEED_RANGE = (0.6, 1.3)
"""Least and greatest speed of a transfer over the commanded one: neither stops nor rushes."""

TURN_RATE = 1.0
"""1/s; a transfer weighs time against acceleration, and an acceleration of TURN_RATE times the
speed costs as much as the time does.  So it turns gently: over about a second at any speed."""

SHORTEST_TRANSFER = 1.4
"""s; nearly three periods of the attitude bandwidth of the default controller.  At 3 m/s and
more, shorter ones let propellers stand still; at 0.45 m/s it makes no difference."""

STOPPING_TIME = 1.5
"""s; the deceleration of a stop is speed / second at its peak, unless that is too much."""

_DETOURS = np.geomspace(0.8, 3.0, 24)
"""Lengths of transfers that are tried, at the commanded speed, over the distance flown."""

_SAMPLES = np.linspace(0.0, 1.0, 21)
"""Where speed and acceleration are looked at, in shares of the duration."""


class Motion(NamedTuple):
    """Where something is and how it moves, (d,) each, or (n, d) for n of them.

    Attributes:
        position: In m.
        velocity: In m/s.
        acceleration: In m/s^2.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray


class Transfer(NamedTuple):
    """A motion from one point to another.

    Attributes:
        control_points: Of shape (6, d), in m.
        duration: In s.
        cost: What was minimised, in s; at least the duration.
        violation: By how much it breaks the limits that it was planned for, relative to
            them; 0 if it keeps all of them.
    """

    control_points: FloatArray
    duration: float
    cost: float
    violation: float

    def Eval(self, time: float) -> Motion:
        """Returns the motion (d,) at a time in s since its start; it rests on both sides."""
        share = min(max(time / self.duration, 0.0), 1.0)
        motion = _Evaluate(self.control_points, np.array(self.duration), _Bases([share]))
        return Motion(*(values[0] for values in motion))


def PlanTransfer(
    start: Motion, entries: Motion, speed: float, max_acceleration: float
) -> Transfer:
    """Returns the best motion from a start to one of several entries.

    Among all entries and durations of a grid that keep the limits, it is the one with the
    least integral of 1 + (|a| / (TURN_RATE speed))^2 over time: a compromise of short and
    gentle.  The speed has to stay within `SPEED_RANGE` of the commanded one.  In the first
    half it may be as far outside as at the start, so that a vehicle can start from rest.

    Where nothing keeps all limits, the result is what breaks them least.

    Args:
        start: The motion at the start, (d,).
        entries: The motions at the entries, (n, d).
        speed: The commanded speed in m/s, positive.
        max_acceleration: In m/s^2.
    """
    distance = np.linalg.norm(entries.position - start.position, axis=1)
    durations = np.maximum(_DETOURS[:, None] * distance / speed, SHORTEST_TRANSFER)
    points = _ControlPoints(start, entries, durations)
    _, velocity, acceleration = _Evaluate(points, durations, _Bases(_SAMPLES))
    speeds = np.linalg.norm(velocity, axis=-1)
    accelerations = np.linalg.norm(acceleration, axis=-1)
    violation = np.maximum(
        _SpeedViolation(speeds, float(np.linalg.norm(start.velocity)), speed),
        np.maximum(accelerations / max_acceleration - 1.0, 0.0).max(axis=-1),
    )
    effort = np.mean((accelerations / (TURN_RATE * speed)) ** 2, axis=-1)
    cost = np.where(violation == violation.min(), durations * (1.0 + effort), np.inf)
    best = np.unravel_index(np.argmin(cost), cost.shape)
    return Transfer(
        points[best], float(durations[best]), float(cost[best]), float(violation[best])
    )


def PlanStop(start: Motion, max_acceleration: float) -> Transfer:
    """Returns a motion that brings a vehicle to rest.

    The speed falls as a cubic, which fixes where it stops.  From a start without
    acceleration, the deceleration is greatest in the middle: 1.5 |v| / duration.

    Args:
        start: The motion at the start, (d,).
        max_acceleration: In m/s^2, that this greatest deceleration has to keep.
    """
    p, v, a = start
    T = max(STOPPING_TIME, 1.5 * float(np.linalg.norm(v)) / max_acceleration)
    rest = Motion(p + v * T / 2.0 + a * T**2 / 12.0, np.zeros_like(v), np.zeros_like(a))
    return Transfer(_ControlPoints(start, rest, np.array(T)), T, cost=T, violation=0.0)


def _ControlPoints(start: Motion, end: Motion, duration: FloatArray) -> FloatArray:
    """Returns the control points (..., 6, d) of motions of durations (...)."""
    T = duration[..., None]
    p0, v0, a0 = start
    p1, v1, a1 = end
    shape = np.broadcast_shapes(p0.shape, p1.shape, (*T.shape[:-1], p0.shape[-1]))
    points = (
        p0,
        p0 + v0 * T / 5.0,
        p0 + v0 * T * 2.0 / 5.0 + a0 * T**2 / 20.0,
        p1 - v1 * T * 2.0 / 5.0 + a1 * T**2 / 20.0,
        p1 - v1 * T / 5.0,
        p1,
    )
    return np.stack([np.broadcast_to(point, shape) for point in points], axis=-2)


def _Bases(shares: Sequence[float] | FloatArray) -> tuple[FloatArray, ...]:
    """Returns the Bernstein polynomials of degrees 5, 4 and 3, (k, 6), (k, 5) and (k, 4)."""
    t = np.asarray(shares, dtype=np.float64)[:, None]
    bases = []
    for degree in (5, 4, 3):
        i = np.arange(degree + 1)
        binomials = np.array([math.comb(degree, int(j)) for j in i])
        bases.append(binomials * t**i * (1.0 - t) ** (degree - i))
    return tuple(bases)


def _Evaluate(
    points: FloatArray, duration: FloatArray, bases: tuple[FloatArray, ...]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns position, velocity and acceleration (..., k, d) of motions (..., 6, d)."""
    T = duration[..., None, None]
    first = np.diff(points, axis=-2)
    second = np.diff(first, axis=-2)
    return (
        bases[0] @ points,
        bases[1] @ first * (5.0 / T),
        bases[2] @ second * (20.0 / T**2),
    )


def _SpeedViolation(speeds: FloatArray, start_speed: float, speed: float) -> FloatArray:
    """Returns how far speeds (..., k) leave the range that is allowed, over the speed."""
    least, greatest = SPEED_RANGE[0] * speed, SPEED_RANGE[1] * speed
    early = _SAMPLES < 0.5
    lower = np.where(early, min(least, start_speed), least)
    upper = np.where(early, max(greatest, start_speed), greatest)
    outside = np.maximum(lower - speeds, speeds - upper).max(axis=-1)
    # Rounding is no violation.
    return np.maximum(outside / speed - 1e-9, 0.0)
