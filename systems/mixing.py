"""From thrust and torque to four propeller forces within what the motors can give."""

from systems.quadrotor import Rotors
from systems.scalar_math import compilable
from systems.scalars import Scalar


@compilable
def CalcPropellerForces(
    rotors: Rotors,
    thrust: Scalar,
    torque: tuple[Scalar, Scalar, Scalar],
    saturate: bool,
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Returns the propeller forces in N, each in [0, max_force] if saturated.

    This inverts `QuadrotorParameters.MixingMatrix`.  Where the motors cannot give all
    that is asked, attitude comes first, since thrust is only useful in the right
    direction: roll and pitch torque are kept (and scaled together only where they alone
    exceed the motors), then the thrust is moved as little as needed, and yaw torque gets
    what is left.

    Args:
        rotors: Where the propellers stand, and what they can give.
        thrust: Along B's z axis in N.
        torque: About B's x, y and z axes in N m.
        saturate: Whether the forces are limited to what the motors can give.
    """
    mean = 0.25 * thrust
    roll = torque[0] / (2.0 * rotors.arm_length)  # Propellers 1 and 3 differ by it.
    pitch = torque[1] / (2.0 * rotors.arm_length)  # Propellers 2 and 0 differ by it.
    yaw = torque[2] / (4.0 * rotors.yaw_arm)  # Raises 0 and 2, lowers 1 and 3.
    if not saturate:
        return _Combine(mean, roll, pitch, yaw)
    f_max = rotors.max_force
    largest = max(abs(roll), abs(pitch))
    if largest > 0.5 * f_max:
        scale = 0.5 * f_max / largest
        roll, pitch, largest = roll * scale, pitch * scale, 0.5 * f_max
    mean = min(max(mean, largest), f_max - largest)
    # Both bounds hold for yaw = 0, so the interval is never empty.
    yaw = max(yaw, abs(pitch) - mean, mean + abs(roll) - f_max)
    yaw = min(yaw, f_max - mean - abs(pitch), mean - abs(roll))
    # Rounding alone can leave the interval, by parts in 1e16.
    a, b, c, d = _Combine(mean, roll, pitch, yaw)
    return (
        min(max(a, 0.0), f_max),
        min(max(b, 0.0), f_max),
        min(max(c, 0.0), f_max),
        min(max(d, 0.0), f_max),
    )


@compilable
def _Combine(
    mean: Scalar, roll: Scalar, pitch: Scalar, yaw: Scalar
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    return mean - pitch + yaw, mean + roll - yaw, mean + pitch + yaw, mean - roll - yaw
