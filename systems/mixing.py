"""From thrust and torque to four propeller forces within what the motors can give."""

from systems.quadrotor import QuadrotorParameters
from systems.scalars import Scalar


def CalcPropellerForces(
    parameters: QuadrotorParameters, thrust: Scalar, torque: tuple[Scalar, Scalar, Scalar]
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Returns the propeller forces in N, each in [0, max_propeller_force].

    This inverts `QuadrotorParameters.MixingMatrix`.  Where the motors cannot give all
    that is asked, attitude comes first, since thrust is only useful in the right
    direction: roll and pitch torque are kept (and scaled together only where they alone
    exceed the motors), then the thrust is moved as little as needed, and yaw torque gets
    what is left.

    Args:
        parameters: The vehicle.
        thrust: Along B's z axis in N.
        torque: About B's x, y and z axes in N m.
    """
    f_max = parameters.max_propeller_force
    roll = torque[0] / (2.0 * parameters.arm_length)  # Propellers 1 and 3 differ by it.
    pitch = torque[1] / (2.0 * parameters.arm_length)  # Propellers 2 and 0 differ by it.
    largest = max(abs(roll), abs(pitch))
    if largest > 0.5 * f_max:
        scale = 0.5 * f_max / largest
        roll, pitch, largest = roll * scale, pitch * scale, 0.5 * f_max
    mean = min(max(0.25 * thrust, largest), f_max - largest)
    # Yaw torque raises propellers 0 and 2 and lowers 1 and 3.  Both bounds hold for yaw
    # = 0, so the interval is never empty.
    yaw = torque[2] / (4.0 * parameters.yaw_arm)
    yaw = max(yaw, abs(pitch) - mean, mean + abs(roll) - f_max)
    yaw = min(yaw, f_max - mean - abs(pitch), mean - abs(roll))
    forces = (
        mean - pitch + yaw,
        mean + roll - yaw,
        mean + pitch + yaw,
        mean - roll - yaw,
    )
    # Rounding alone can leave the interval, by parts in 1e16.
    return tuple(min(max(force, 0.0), f_max) for force in forces)
