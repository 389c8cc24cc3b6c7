"""From a velocity command to propeller forces, on plain scalars: the SE(3) law and the mixing.

Source of the law: T. Lee, M. Leok, N. H. McClamroch, "Geometric tracking control of a quadrotor
UAV on SE(3)", IEEE Conference on Decision and Control, 2010: its attitude error, thrust and
torque, for a commanded velocity and acceleration in place of a trajectory.

The functions work on scalars and tuples: AutoDiffXd as they are, floats compiled (see
`systems.scalars`).  Square roots are taken only of values that cannot be zero, where their
derivative would be infinite.

Notation: W is the world frame, z up; B the body frame, D the desired body frame.  A
rotation is the tuple of its columns, so R_WB = (bx_W, by_W, bz_W).
"""

import math
from typing import Any, NamedTuple

from systems.quadrotor import ATTITUDE, NUM_PROPELLERS, RATES, VELOCITY, Rotors
from systems.scalars import Cos, Scalar, Sin, Sqrt, compilable

Vector3 = tuple[Scalar, Scalar, Scalar]
Rotation = tuple[Vector3, Vector3, Vector3]

MAX_TILT = math.radians(70.0)
"""Greatest tilt of the demanded thrust, rad.  Roll-pitch-yaw is singular at 90 degrees."""

_MAX_SLOPE = math.tan(MAX_TILT)

MIN_LIFT = 0.1
"""Least vertical part of the demanded thrust over the weight: never upside down."""

LIFT_SHARE = 0.75
"""Share of the thrust beyond the weight that the vertical demand alone may take.

Less than `THRUST_SHARE`, so that some is always left to accelerate sideways.
"""

THRUST_SHARE = 0.9
"""Share of the thrust beyond the weight that may be demanded; torques need the rest."""

MAX_DESIRED_RATE = 10.0
"""Greatest angular velocity of the desired attitude, rad/s."""

MAX_DESIRED_ANGULAR_ACCELERATION = 100.0
"""Greatest angular acceleration of the desired attitude, rad/s^2."""

MAX_HEADING_ERROR = math.radians(45.0)
"""The demanded heading is at most so far from the present yaw, rad.  Half a turn then takes
0.6 s.  On a circle of 1 m at 0.45 m/s, with default sensors, it throws the vehicle no farther
off than 0.7 mm, as no turn does; without a limit it is 10 mm and takes 1.5 s."""

_LEAST_COSINE = math.cos(MAX_HEADING_ERROR)

SLOW_SPEED = 0.05
"""Below about this speed, m/s, the direction of travel is not known well enough to turn."""

NUM_DERIVATIVES = 24
"""What a command tells beside itself and its rate, in W, with U the velocity that is commanded
at a place and v the vehicle's own: D2U[v, v] (3) in m/s^3, D3U[v, v, v] (3) in m/s^4, DU (3, 3)
in 1/s and D2U[v, .] (3, 3) in 1/s^2, both by rows."""


class Gains(NamedTuple):
    """The gains of the law.

    Attributes:
        velocity_gain: From velocity error to acceleration, 1/s.
        attitude_bandwidth: Natural frequency wn of the attitude loop, rad/s.
        damping_ratio: Damping ratio of the attitude loop.
        heading: Desired yaw angle, rad, of any number of turns.
        disturbance_bandwidth: Bandwidth of the estimate of what disturbs the vehicle, which is
            made up for, rad/s; 0: there is none, and a steady force leaves a steady error.
    """

    velocity_gain: Scalar
    attitude_bandwidth: Scalar
    damping_ratio: Scalar
    heading: Scalar
    disturbance_bandwidth: Scalar = 0.0


class Body(NamedTuple):
    """What the controller believes of the vehicle's rigid body.

    Attributes:
        mass: In kg.
        I_xx: Moment of inertia about B's x axis in kg m^2.
        I_yy: About B's y axis.
        I_zz: About B's z axis.
    """

    mass: Scalar
    I_xx: Scalar
    I_yy: Scalar
    I_zz: Scalar


@compilable
def CalcPropellerInput(
    state: Any,
    velocity_command: Any,
    acceleration: Any,
    derivatives: Any,
    disturbance: Any,
    gains: Any,
    body: Any,
    rotors: Rotors,
    gravity: float,
    saturate: bool,
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Returns the input of QuadrotorPlant, which is not a number where the law has none.

    Args:
        state: The vehicle's, (12,).
        velocity_command: The velocity command in W, (3,) in m/s.
        acceleration: The feed-forward in W, (3,) in m/s^2.
        derivatives: Those of the command, (`NUM_DERIVATIVES`,), or (0,): they are not known.
        disturbance: What else accelerates the vehicle, in W, (3,) in m/s^2.
        gains: The `Gains`, (5,).
        body: The `Body`, (4,).
        rotors: Where the propellers stand, and what they can give.
        gravity: The acceleration of gravity, m/s^2.
        saturate: Whether demands and forces are limited to what the vehicle can give.
    """
    thrust, torque = CalcThrustAndTorque(
        state,
        velocity_command,
        acceleration,
        derivatives,
        disturbance,
        Gains(gains[0], gains[1], gains[2], gains[3], gains[4]),
        Body(body[0], body[1], body[2], body[3]),
        gravity,
        NUM_PROPELLERS * rotors.max_force,
        saturate,
    )
    a, b, c, d = CalcPropellerForces(rotors, thrust, torque, saturate)
    # Limits would hide a NaN: the least of a number and a NaN may be the number.
    nothing = 0.0 * (thrust + torque[0] + torque[1] + torque[2])
    k = rotors.force_constant
    return a / k + nothing, b / k + nothing, c / k + nothing, d / k + nothing


@compilable
def CalcThrustAndTorque(
    state: Any,
    velocity_command: Any,
    acceleration: Any,
    derivatives: Any,
    disturbance: Any,
    gains: Gains,
    body: Body,
    gravity: float,
    max_thrust: float,
    saturate: bool,
) -> tuple[Scalar, Vector3]:
    """Returns the thrust along B's z axis in N and the torque about B's axes in N m.

    The demanded acceleration is a_ff + k_v (v_cmd - v) - d; its thrust vector sets the desired
    attitude at a fixed heading, and the torque tracks that attitude.  How the thrust vector
    changes follows of the derivatives of the command (see `CalcThrustRates`); where they are
    not known it is taken to turn with the path (see `CalcTurnRate`).  The arguments are those
    of `CalcPropellerInput`, and the greatest thrust of all propellers together in N.  Without
    saturation the law is smooth wherever the thrust vector is not zero.
    """
    rpy, rpy_rates = _Vector3(state[ATTITUDE]), _Vector3(state[RATES])
    vx, vy, vz = v_W = _Vector3(state[VELOCITY])
    ax, ay, az = a_W = _Vector3(acceleration)
    dx, dy, dz = _Vector3(disturbance)
    ux, uy, uz = _Vector3(velocity_command)
    m, k_v, g = body.mass, gains.velocity_gain, gravity
    F_W = (
        m * (ax + k_v * (ux - vx) - dx),
        m * (ay + k_v * (uy - vy) - dy),
        m * (az + k_v * (uz - vz) - dz + g),
    )
    if saturate:
        F_W = LimitThrust(m * g, max_thrust, F_W)
    heading = LimitHeading(gains.heading, rpy[2]) if saturate else gains.heading
    R_WB, w_WB_B = CalcAttitude(rpy, rpy_rates)
    if len(derivatives) > 0:
        F_dot_W, F_ddot_W = CalcThrustRates(
            F_W, R_WB, w_WB_B, a_W, derivatives, (dx, dy, dz), m, k_v, g
        )
    else:
        w_path = CalcTurnRate(v_W, a_W)
        # The demand turns with the path; the error k_v (v_cmd - v) is small or short, and what
        # disturbs the vehicle changes slowly.
        F_dot_W = Cross(w_path, (m * ax, m * ay, m * az))
        F_ddot_W = Cross(w_path, F_dot_W)
    R_WD, w_WD_W, alpha_WD_W = CalcDesiredAttitude(F_W, F_dot_W, F_ddot_W, heading, saturate)
    torque = CalcTorque(body, gains, R_WB, w_WB_B, R_WD, w_WD_W, alpha_WD_W)
    return Dot(F_W, R_WB[2]), torque


@compilable
def LimitThrust(weight: Scalar, max_thrust: float, F_W: Vector3) -> Vector3:
    """Returns the thrust vector nearest in kind to F_W that the vehicle can point and give.

    The vertical part is kept first, so that a hard turn does not cost altitude; the
    horizontal part is then scaled down to `MAX_TILT` and to the available thrust.  All is in N,
    the vectors in W; the weight is the one that is believed.
    """
    x, y, z = F_W
    spare = max_thrust - weight
    z = min(max(z, MIN_LIFT * weight), weight + LIFT_SHARE * spare)
    largest = weight + THRUST_SHARE * spare
    # Zero where a body is believed that is too heavy to lift.
    limit = max(min((_MAX_SLOPE * z) ** 2, largest * largest - z * z), 0.0)
    horizontal = x * x + y * y
    if horizontal > limit:
        scale = Sqrt(limit / horizontal)
        x, y = x * scale, y * scale
    return x, y, z


@compilable
def LimitHeading(heading: Scalar, yaw: Scalar) -> Scalar:
    """Returns the heading in rad, or what is toward it within `MAX_HEADING_ERROR` of the yaw.

    The torque that turns a vehicle is the sine of the error, which vanishes half a turn away,
    and an error of the yaw takes from the torque that points the thrust: without a limit a
    vehicle would not turn from there, and one that turns would leave its path.
    """
    turn = heading - yaw
    if Cos(turn) >= _LEAST_COSINE:
        return heading
    return yaw + (MAX_HEADING_ERROR if Sin(turn) >= 0.0 else -MAX_HEADING_ERROR)


@compilable
def CalcTurnRate(v_W: Vector3, a_W: Vector3) -> Vector3:
    """Returns the angular velocity at which the velocity turns, (v x a) / |v|^2, in rad/s.

    On a path of constant curvature, at constant speed, all derivatives of the velocity
    turn with it, so that this gives the rates of the acceleration feed-forward without
    higher derivatives of the field.  Elsewhere the change of curvature is left out.  The
    velocity in m/s is the vehicle's, the acceleration in m/s^2 the feed-forward, both in W.
    """
    scale = 1.0 / (Dot(v_W, v_W) + SLOW_SPEED**2)
    x, y, z = Cross(v_W, a_W)
    return x * scale, y * scale, z * scale


@compilable
def CalcThrustRates(
    F_W: Vector3,
    R_WB: Rotation,
    w_WB_B: Vector3,
    a_W: Vector3,
    derivatives: Any,
    disturbance: Vector3,
    mass: Scalar,
    velocity_gain: Scalar,
    gravity: float,
) -> tuple[Vector3, Vector3]:
    """Returns the first and the second rate of the demanded thrust, in N/s and N/s^2, in W.

    They are exact where the thrust is given that F_W demands along the body's axis, the
    disturbance is what it is taken for and does not change, and the speed of the command does
    not either: attitude and body rate tell how the vehicle accelerates, and how that changes.
    With these the desired attitude and its rates are functions of the state alone, as for a
    trajectory that is known (differential flatness: D. Mellinger, V. Kumar, "Minimum snap
    trajectory generation and control for quadrotors", ICRA 2011).

    Args:
        F_W: The demanded thrust vector in N.
        R_WB: The attitude.
        w_WB_B: The body's angular velocity in rad/s.
        a_W: DU v, the rate of the command, m/s^2.
        derivatives: Those of the command, (`NUM_DERIVATIVES`,).
        disturbance: What else accelerates the vehicle, m/s^2.
        mass: In kg, as it is believed.
        velocity_gain: In 1/s.
        gravity: In m/s^2.
    """
    second, third = _Vector3(derivatives[:3]), _Vector3(derivatives[3:6])
    DU, D2U_v = derivatives[6:15], derivatives[15:24]
    q = _Scaled(1.0 / mass, F_W)
    bx, by, bz = R_WB
    wx, wy, _ = w_WB_B
    bz_dot = _Sum(wy, bx, -wx, by)
    lift = Dot(q, bz)
    acceleration = _Sum(lift, bz, 1.0, disturbance)
    acceleration = acceleration[0], acceleration[1], acceleration[2] - gravity
    a_dot = _Sum(1.0, second, 1.0, _Times(DU, acceleration))
    error_dot = _Sum(1.0, acceleration, -1.0, a_W)
    q_dot = _Sum(1.0, a_dot, -velocity_gain, error_dot)
    jerk = _Sum(Dot(q_dot, bz) + Dot(q, bz_dot), bz, lift, bz_dot)
    a_ddot = _Sum(3.0, _Times(D2U_v, acceleration), 1.0, _Times(DU, jerk))
    a_ddot = _Sum(1.0, third, 1.0, a_ddot)
    error_ddot = _Sum(1.0, jerk, -1.0, a_dot)
    q_ddot = _Sum(1.0, a_ddot, -velocity_gain, error_ddot)
    return _Scaled(mass, q_dot), _Scaled(mass, q_ddot)


@compilable
def CalcDesiredAttitude(
    F_W: Vector3,
    F_dot_W: Vector3,
    F_ddot_W: Vector3,
    heading: Scalar,
    saturate: bool = True,
) -> tuple[Rotation, Vector3, Vector3]:
    """Returns the desired attitude R_WD with its angular velocity and acceleration.

    D's z axis is along the thrust vector and its x axis is as near as possible to the
    heading (Lee et al. 2010).  The angular velocity in rad/s and its rate in rad/s^2 are those
    of this very construction at a fixed heading.  Both are expressed in W, and limited to
    `MAX_DESIRED_RATE` and `MAX_DESIRED_ANGULAR_ACCELERATION` if saturated.

    Args:
        F_W: The thrust vector in N, in W; its tilt stays below `MAX_TILT`.
        F_dot_W: Its rate of change in N/s, in W.
        F_ddot_W: The rate of change of that in N/s^2, in W.
        heading: The desired yaw angle in rad.
        saturate: Whether the rates are limited.
    """
    cx, cy = Cos(heading), Sin(heading)
    s = 1.0 / Sqrt(Dot(F_W, F_W))
    bz = zx, zy, zz = F_W[0] * s, F_W[1] * s, F_W[2] * s
    # n = bz x heading; never short, because bz is never near the horizontal plane.
    nx, ny, nz = -zz * cy, zz * cx, zx * cy - zy * cx
    r = 1.0 / Sqrt(nx * nx + ny * ny + nz * nz)
    by = (nx * r, ny * r, nz * r)
    bx = Cross(by, bz)
    shrink = s * Dot(bz, F_dot_W)
    dx, dy, dz = (  # bz', the rate of bz.
        s * F_dot_W[0] - shrink * zx,
        s * F_dot_W[1] - shrink * zy,
        s * F_dot_W[2] - shrink * zz,
    )
    # by' = w x by gives the part of w along bz: -bx . by' = -bx . (bz' x heading) / |n|.
    spin = -r * (bx[2] * (dx * cy - dy * cx) + dz * (bx[1] * cx - bx[0] * cy))
    # w = bz x bz' + spin bz, and bz x bz'' needs only the part of bz'' normal to bz.
    wx, wy, wz = Cross(bz, (dx, dy, dz))
    w_WD_W = (wx + spin * zx, wy + spin * zy, wz + spin * zz)
    ax, ay, az = Cross(
        bz,
        (
            s * F_ddot_W[0] - 2.0 * shrink * dx,
            s * F_ddot_W[1] - 2.0 * shrink * dy,
            s * F_ddot_W[2] - 2.0 * shrink * dz,
        ),
    )
    alpha = (ax + spin * dx, ay + spin * dy, az + spin * dz)
    # by stays normal to the heading: so do the rates of that, which give the part along bz.
    ux, uy, _ = _Sum(1.0, Cross(alpha, by), 1.0, Cross(w_WD_W, Cross(w_WD_W, by)))
    spin_dot = (ux * cx + uy * cy) / (bx[0] * cx + bx[1] * cy)
    alpha_WD_W = _Sum(1.0, alpha, spin_dot, bz)
    if saturate:
        w_WD_W = _Limit(w_WD_W, MAX_DESIRED_RATE)
        alpha_WD_W = _Limit(alpha_WD_W, MAX_DESIRED_ANGULAR_ACCELERATION)
    return (bx, by, bz), w_WD_W, alpha_WD_W


@compilable
def CalcAttitudeError(R_WD: Rotation, R_WB: Rotation) -> Vector3:
    """Returns e_R = 1/2 (R_WD^T R_WB - R_WB^T R_WD)^vee (Lee et al. 2010).

    For small errors it is the rotation vector from D to B, expressed in B, in rad.
    """
    dx, dy, dz = R_WD
    bx, by, bz = R_WB
    return (
        0.5 * (Dot(dz, by) - Dot(dy, bz)),
        0.5 * (Dot(dx, bz) - Dot(dz, bx)),
        0.5 * (Dot(dy, bx) - Dot(dx, by)),
    )


@compilable
def CalcTorque(
    body: Body,
    gains: Gains,
    R_WB: Rotation,
    w_WB_B: Vector3,
    R_WD: Rotation,
    w_WD_W: Vector3,
    alpha_WD_W: Vector3,
) -> Vector3:
    """Returns the torque about B's axes in N m (Lee et al. 2010).

    Gains are per inertia, so that a bandwidth means the same for any vehicle:

        M = J (-wn^2 e_R - 2 zeta wn e_w) + w x J w - J (w x R^T R_d w_d - R^T R_d w_d')

    Here w is w_WB_B and R_d w_d is w_WD_W, in rad/s, and R_d w_d' is alpha_WD_W in rad/s^2.
    """
    _, Jx, Jy, Jz = body
    wn = gains.attitude_bandwidth
    k_R, k_w = wn * wn, 2.0 * gains.damping_ratio * wn
    ex, ey, ez = CalcAttitudeError(R_WD, R_WB)
    x, y, z = w_WB_B
    bx, by, bz = R_WB
    dx, dy, dz = Dot(bx, w_WD_W), Dot(by, w_WD_W), Dot(bz, w_WD_W)  # w_WD in B.
    ax = Dot(bx, alpha_WD_W) - k_R * ex - k_w * (x - dx) - (y * dz - z * dy)
    ay = Dot(by, alpha_WD_W) - k_R * ey - k_w * (y - dy) - (z * dx - x * dz)
    az = Dot(bz, alpha_WD_W) - k_R * ez - k_w * (z - dz) - (x * dy - y * dx)
    return (
        Jx * ax + (Jz - Jy) * y * z,
        Jy * ay + (Jx - Jz) * z * x,
        Jz * az + (Jy - Jx) * x * y,
    )


@compilable
def CalcAttitude(rpy: Vector3, rpy_rates: Vector3) -> tuple[Rotation, Vector3]:
    """Returns R_WB = Rz(yaw) Ry(pitch) Rx(roll) and w_WB_B, from rad and rad/s to rad/s."""
    roll, pitch, yaw = rpy
    roll_rate, pitch_rate, yaw_rate = rpy_rates
    sr, cr = Sin(roll), Cos(roll)
    sp, cp = Sin(pitch), Cos(pitch)
    sy, cy = Sin(yaw), Cos(yaw)
    R_WB = (
        (cy * cp, sy * cp, -sp),
        (cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr),
        (cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr),
    )
    w_WB_B = (
        roll_rate - sp * yaw_rate,
        cr * pitch_rate + cp * sr * yaw_rate,
        cp * cr * yaw_rate - sr * pitch_rate,
    )
    return R_WB, w_WB_B


@compilable
def CalcAcceleration(rpy: Vector3, lift: Scalar, gravity: float) -> Vector3:
    """Returns what the propellers accelerate a vehicle by, in W, all in m/s^2 but the rad."""
    R_WB, _ = CalcAttitude(rpy, (0.0, 0.0, 0.0))
    x, y, z = R_WB[2]
    return lift * x, lift * y, lift * z - gravity


@compilable
def CalcPropellerForces(
    rotors: Rotors, thrust: Scalar, torque: Vector3, saturate: bool
) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Returns the propeller forces in N, each in [0, max_force] if saturated.

    This inverts `QuadrotorParameters.MixingMatrix`.  Where the motors cannot give all
    that is asked, attitude comes first, since thrust is only useful in the right
    direction: roll and pitch torque are kept (and scaled together only where they alone
    exceed the motors), then the thrust is moved as little as needed, and yaw torque gets
    what is left.  The thrust in N is along B's z axis, the torque in N m about B's axes.
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


@compilable
def _Vector3(a: Any) -> Vector3:
    return a[0], a[1], a[2]


@compilable
def _Scaled(s: Scalar, a: Vector3) -> Vector3:
    return s * a[0], s * a[1], s * a[2]


@compilable
def _Sum(s: Scalar, a: Vector3, t: Scalar, b: Vector3) -> Vector3:
    """Returns s a + t b."""
    return s * a[0] + t * b[0], s * a[1] + t * b[1], s * a[2] + t * b[2]


@compilable
def _Times(rows: Any, a: Vector3) -> Vector3:
    """Returns the product of a matrix, by rows (9,), with a."""
    x, y, z = a
    return (
        rows[0] * x + rows[1] * y + rows[2] * z,
        rows[3] * x + rows[4] * y + rows[5] * z,
        rows[6] * x + rows[7] * y + rows[8] * z,
    )


@compilable
def Dot(a: Vector3, b: Vector3) -> Scalar:
    """Returns a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compilable
def Cross(a: Vector3, b: Vector3) -> Vector3:
    """Returns a x b."""
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@compilable
def _Limit(a: Vector3, largest: float) -> Vector3:
    """Returns the vector, shortened to the largest length."""
    square = Dot(a, a)
    if square <= largest * largest:
        return a
    scale = largest / Sqrt(square)
    return a[0] * scale, a[1] * scale, a[2] * scale
