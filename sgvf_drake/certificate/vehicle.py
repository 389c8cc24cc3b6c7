"""The vehicle: a proof that a quadrotor under the SE(3) law stays between walls, and closes in.

The law commands the velocity U(p): v0 m in the plane and a climb to the altitude.  With the
velocity error e = v - U(p), the attitude error e_R between the body and the desired attitude,
the body-rate error beta and an acceleration d that nobody knows of, the closed loop is exactly

    e' = -k e + Delta + d,          Delta = (q . b) b - q,
    e_R' = E(R_e) (beta + eps),     E = (tr(R_e) I - R_e^T) / 2,
    beta' = -wn^2 e_R - 2 zeta wn beta + xi,

where q = a - k e + g is the demanded thrust over the mass, a = DU v, b the thrust's axis, eps
comes of the jerk that the feed-forward does not know, and xi of what it leaves out of the
angular acceleration (docs/vehicle.md derives all of it).  With gamma = |q| / g,
rho = g e_R x b and sigma = g beta x b, across the thrust and in the body frame,

    e' = -k e + gamma rho + d + ...
    rho' = sigma + (K (-k e + gamma rho + d) - eta) / gamma + ...     K = k I - DU
    sigma' = -wn^2 rho - 2 zeta wn sigma + ...

and what is left out is of second order in the errors.  At K = K_0 and gamma = gamma_0 this is
one linear system for each of two coordinates, whose responses are bounded (`respond`); all else
counts as its input.  `prove_stage` shows that bounds of the errors, as long as they hold, feed
no more than what they allow: so they hold for ever, and shrink.  As |e| is below v0 e* there,
the vehicle does not leave the walls either.

Rounding: apart from a few differences, everything is sums, products and roots of numbers above
zero.  Inequalities are asked for with a margin of `MARGIN`, far above what some hundred
roundings make.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
import math

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.flown_jerk import FlownBounds
from sgvf_drake.certificate.responses import Responses, respond

MARGIN = 1e-6
"""Every inequality holds by such a part of its larger side."""

# The climb that an error of the altitude commands is so much more than the vertical error.
CLIMB = 1.05
# How often bounds are shrunk, and the time that each takes, s; see `Responses.late`.
SHRINKS, SETTLING = 12, 2.0

Ask = Callable[[str, float, float], None]


@dataclass(frozen=True)
class VehicleLaw:
    """A quadrotor and its SE(3) law, in SI units.

    Attributes:
        speed: v0, commanded.
        velocity_gain: k.
        bandwidth: wn.
        damping: zeta.
        mass: Of the vehicle, as it is believed.
        gravity: g.
        inertia: The principal moments.
        arm_length: Of a motor from the centre.
        yaw_arm: The yaw torque over the force of a propeller.
        max_force: Of a propeller.
        altitude_gain: From altitude to climb, U_z = c tanh(gain h / c).
        max_climb: c.
        slow: The speed in the turn rate (v x a) / (|v|^2 + slow^2).
        max_tilt: Of the demanded thrust.
        min_lift: The least vertical demand, of the weight.
        lift_share: The largest vertical demand, of the thrust beyond the weight.
        thrust_share: The largest demand, the same.
        max_rate: Of the desired attitude.
        max_angular_acceleration: Of the desired attitude.
        max_heading_error: From the yaw to the demanded heading.
    """

    speed: float
    velocity_gain: float
    bandwidth: float
    damping: float
    mass: float
    gravity: float
    inertia: tuple[float, float, float]
    arm_length: float
    yaw_arm: float
    max_force: float
    altitude_gain: float
    max_climb: float
    slow: float
    max_tilt: float
    min_lift: float
    lift_share: float
    thrust_share: float
    max_rate: float
    max_angular_acceleration: float
    max_heading_error: float


@dataclass(frozen=True)
class ErrorBounds:
    """Bounds of the error state of a vehicle.

    Attributes:
        across: Of the part of e across the thrust, m/s.
        rho: Of g times the attitude error about axes across the thrust, m/s^2.
        sigma: Of g times the body-rate error about these, m/s^3.
        change: Of -k e + gamma_0 rho across the thrust, m/s^2.
        yaw: Of the attitude error about the thrust, rad.
        yaw_rate: Of the body-rate error about it, rad/s.
        climb: Of the vertical part of e, m/s.
    """

    across: float
    rho: float
    sigma: float
    change: float
    yaw: float
    yaw_rate: float
    climb: float

    def speed(self, tilt: float) -> float:
        """Returns a bound of |e| where the sine of the tilt of the thrust is at most `tilt`.

        |e|^2 = |e across b|^2 + (e . b)^2, and |e . b| <= |e_z| + tilt |e|.
        """
        return _whole(self.across, self.climb, tilt)


def _whole(across: float, vertical: float, tilt: float) -> float:
    """Returns a bound of |x| with |x across b| <= across and |x . b| <= vertical + tilt |x|."""
    a, b = 1 - tilt**2, vertical * tilt
    return (b + math.sqrt(b * b + a * (across**2 + vertical**2))) / a * (1 + MARGIN)


@dataclass(frozen=True)
class Linear:
    """The linear system about which a stage is bounded.

    Attributes:
        gamma: gamma_0.
        gamma_range: Bounds of |q| / g.
        centre: K_0.
    """

    gamma: float
    gamma_range: tuple[float, float]
    centre: float


@dataclass(frozen=True)
class Feeding:
    """What errors within bounds feed, and what they mean.

    Attributes:
        into: Into e, rho, sigma, and d; then into yaw and yaw rate.
        climb: The bound of |e_z| that they keep.
        causes: The parts of the first four, by their causes.
        error: Of |e|.
        tilt: Of the sine between thrust and demanded thrust.
        tilt_demanded: Of the demanded thrust, rad.
        least_force: Of a propeller, N.
        most_force: Of a propeller, N.
        failures: What does not hold, in words.
    """

    into: tuple[float, ...]
    climb: float
    causes: dict[str, tuple[float, ...]]
    error: float
    tilt: float
    tilt_demanded: float
    least_force: float
    most_force: float
    failures: tuple[str, ...]


@dataclass(frozen=True)
class StageProof:
    """What is proved of the errors of a vehicle between walls.

    Attributes:
        failures: What is not proved, in words; empty: all is.
        final: The bounds that hold after `settling`.
        settling: s.
        error: Of |e| from the start, m/s.
        final_error: Of |e| after `settling`.
        at_start: What the held bounds feed.
        integral: What each unit that is fed makes of the velocity error across the thrust.
    """

    failures: tuple[str, ...]
    final: ErrorBounds
    settling: float
    error: float
    final_error: float
    at_start: Feeding
    integral: tuple[float, ...] = (np.inf,) * 4


@dataclass(frozen=True, eq=False)
class Loop:
    """The responses of the linear parts of the loop: across the thrust, and about it."""

    across: Responses
    yaw: Responses


def linear_loop(law: VehicleLaw, linear: Linear) -> Loop | None:
    """Returns the responses of the linear system; None: it is not stable."""
    k, K, gamma = law.velocity_gain, linear.centre, linear.gamma
    stiffness, damping = law.bandwidth**2, 2 * law.damping * law.bandwidth
    A = np.array([[-k, gamma, 0], [-k * K / gamma, K, 1], [0, -stiffness, -damping]])
    B = np.column_stack([np.eye(3), [1, K / gamma, 0]])
    outputs = np.concatenate([np.eye(3), [[-k, gamma, 0]]])
    across = respond(A, B, outputs, SETTLING)
    yaw = respond(
        np.array([[0.0, 1.0], [-stiffness, -damping]]), np.eye(2), np.eye(2), SETTLING
    )
    return None if across is None or yaw is None else Loop(across, yaw)


def prove_stage(
    law: VehicleLaw,
    linear: Linear,
    start: ErrorBounds,
    held: ErrorBounds,
    bounds: FlownBounds,
    unit: float,
    disturbance: float,
) -> StageProof:
    """Proves how large the errors of a vehicle are as long as it is between walls.

    Args:
        law: The vehicle.
        linear: The linear system.
        start: Of the errors at the start; `change` is not asked for.
        held: Bounds that are claimed to hold from the start on.
        bounds: Of the field between the walls, for |e| up to `bounds.error` v0.
        unit: Metres in a normalised unit.
        disturbance: Of |d|, m/s^2.
    """
    loop = linear_loop(law, linear)
    fed = feed(law, linear, held, bounds, unit, disturbance)
    failures = list(fed.failures)
    if loop is None:
        failures.insert(0, "the linear loop is not stable")
        return StageProof(tuple(failures), held, 0, np.inf, np.inf, fed)
    kept = held_from(loop, start, fed)
    for name, value in vars(held).items():
        mine = getattr(kept, name)
        if not mine * (1 + MARGIN) < value:
            failures.append(f"the bound of {name}: {mine:.4g}, not below {value:.4g}")
    final, last = held, fed
    for _ in range(0 if failures else SHRINKS):
        left = math.exp(-law.velocity_gain * SETTLING)
        less = _respond(loop, loop.across.late, loop.yaw.late, final, last, left)
        names = vars(final)
        final = ErrorBounds(
            **{n: min(names[n], (1 + MARGIN) * getattr(less, n)) for n in names}
        )
        last = feed(law, linear, final, bounds, unit, disturbance)
    settling, integral = SHRINKS * SETTLING, tuple(loop.across.integral[0].tolist())
    return StageProof(tuple(failures), final, settling, fed.error, last.error, fed, integral)


def held_from(loop: Loop, start: ErrorBounds, fed: Feeding) -> ErrorBounds:
    """Returns bounds that hold from a start on while so much is fed."""
    kept = _respond(loop, loop.across.peak, loop.yaw.peak, start, fed, 0.0)
    # The vertical error is no larger than the larger of what it was and of what is fed.
    return replace(kept, climb=max(start.climb, fed.climb))


def _respond(
    loop: Loop,
    free: FloatArray,
    free_yaw: FloatArray,
    start: ErrorBounds,
    fed: Feeding,
    left: float,
) -> ErrorBounds:
    """Returns what the errors are at most, from a start and under what is fed.

    Args:
        loop: The linear system.
        free: Of its free responses.
        free_yaw: The same of the yaw.
        start: The errors at first.
        fed: What is fed.
        left: What is left of the vertical error at first, a part of it.
    """
    into, into_yaw = np.array(fed.into[:4]), np.array(fed.into[4:])
    across = free @ [start.across, start.rho, start.sigma] + loop.across.integral @ into
    yaw = free_yaw @ [start.yaw, start.yaw_rate] + loop.yaw.integral @ into_yaw
    climb = left * start.climb + fed.climb
    return ErrorBounds(*(*across.tolist(), *yaw.tolist(), climb))


def feed(
    law: VehicleLaw,
    linear: Linear,
    errors: ErrorBounds,
    bounds: FlownBounds,
    unit: float,
    disturbance: float,
) -> Feeding:
    """Returns what errors within bounds feed into the linear system; see docs/vehicle.md."""
    v0, k, g = law.speed, law.velocity_gain, law.gravity
    failures: list[str] = []

    def ask(what: str, less: float, more: float) -> None:
        if not less + MARGIN * max(abs(less), abs(more)) < more:
            failures.append(f"{what}: {less:.4g}, not below {more:.4g}")

    # The errors of attitude and rate; `off` is the sine between thrust and demanded thrust.
    ez, tau, beta = errors.climb, errors.rho / g, errors.sigma / g
    yaw, beta_3 = errors.yaw, errors.yaw_rate
    sine = math.hypot(tau, yaw)
    ask("the sine of the attitude error", sine, 0.7)
    h = 1 - math.sqrt(1 - min(sine, 0.7) ** 2)
    off = min(tau * (1 + yaw), 0.9)
    error = bounds.error * v0

    # The command, its acceleration and turn, and the jerk that is not known.
    rate = v0 / unit
    gain, top = law.altitude_gain, law.max_climb
    climb = CLIMB * ez
    ask("the climb", climb, 0.9 * top)
    v_z = climb + ez
    a_z, a_h = gain * v_z, v0 * rate * bounds.acceleration
    a = math.hypot(a_z, a_h)
    slowest = max(v0 * (bounds.least_speed - bounds.error), 0.0)
    square = (slowest**2 + law.slow**2) * (1 - MARGIN)
    inverse = 1 / max(slowest, 2 * law.slow)
    w_z = rate * bounds.turn
    w = math.hypot(w_z, v_z * a_h / square + a_z * inverse)
    j = w * a
    v_a = v0 * v0 * rate * bounds.along + v_z * a_z
    eta_h = v0 * rate**2 * bounds.jerk
    eta_h += a_h * v_z * a_z / square + a_z**2 * inverse + w_z * a_h * v_z**2 / square
    eta_z = 2 * gain**2 / top * (climb / top) * v_z**2 + gain * a_z
    eta_z += a_z * v_a / square + v_z * a * a / square
    eta = math.hypot(eta_h, eta_z)

    # The demanded thrust.
    q_h, q_low, q_high = a_h + k * error, g - a_z - k * ez, g + a_z + k * ez
    low, high = linear.gamma_range
    ask("gamma from below", low * g, q_low)
    ask("gamma from above", math.hypot(q_high, q_h), high * g)
    q, slope = low * g, q_h / max(q_low, MARGIN)
    tilt_D = slope / math.hypot(1, slope)
    tilt_b = min(tilt_D + off, 0.9)
    _ask_demand(law, ask, (q_h, q_low, q_high), sine, slope)
    ask("the velocity error against that of the bounds", errors.speed(tilt_b), error)
    error = min(error, errors.speed(tilt_b))
    along = ez + tilt_b * error

    # K = k I - DU, e', and z = j - q' = K e' - eta.
    spread = max(
        rate * bounds.growth,
        abs(k + gain - linear.centre),
        abs(k + gain * (1 - (climb / top) ** 2) - linear.centre),
    )
    ask("the centre of the bounds", abs(k - rate * bounds.centre - linear.centre), 1e-6)
    norm, grows = linear.centre + spread, max(rate * bounds.slope, gain)
    strays = max(high - linear.gamma, linear.gamma - low)
    strays_inverse = max(1 / low - 1 / linear.gamma, 1 / linear.gamma - 1 / high)
    curl = high * g * tau * yaw
    e_across = errors.change + strays * errors.rho + curl + disturbance
    e_z = k * ez + (high * errors.rho + curl) * tilt_b + disturbance
    e_rate = _whole(e_across, e_z, tilt_b)
    z = eta + norm * e_rate
    z_b = tilt_b * z + eta_z + (k + gain) * e_z

    # The desired rate, in the body frame, and the body's own; what the feed-forward leaves out.
    y = j / q
    s = slope * y
    w_perp, w_3 = beta + y + s * off, beta_3 + s + y * off
    eps_3 = z / q * (off + slope)
    x, x_3 = beta + z / q * (1 + slope * off), beta_3 + eps_3
    chi = eta + grows * e_rate
    jerk_error = a / square * (e_rate * a + w * v_a)
    jerk_error += 2 * w * a * e_rate * inverse + (a * inverse + w) * chi
    xi = (jerk_error + z * y + (y + s) * z) / q
    y_q = (j + z) / q
    cosine = 1 - tilt_D**2
    bend = (1 + tilt_D**2) / cosine**1.5 + tilt_D / cosine
    xi_3 = y_q * y + bend * y_q * y + slope * ((w * j + jerk_error) / q + 2 * y * y_q)

    # What feeds the linear system.
    second = g * ((yaw * x + tau * x_3) / 2 + h * (x + x_3 / 2))
    second += (z * off + z_b + z * slope) * off / low
    causes: dict[str, tuple[float, ...]] = {
        "jerk": (0.0, (eta_h + eta_z * tilt_b) / low, 0.0, 0.0),
        "derivative of the field": (0.0, spread * e_rate / low, 0.0, 0.0),
        "angular acceleration": (0.0, 0.0, g * (xi + off * xi_3), 0.0),
        "thrust": (
            strays * errors.rho,
            k * linear.centre * strays_inverse * errors.across,
            *(0.0, 0.0),
        ),
        "disturbance": (
            *(0.0, linear.centre * strays_inverse * disturbance, 0.0),
            disturbance,
        ),
        "second order": (
            curl + w_3 * errors.across + w_perp * along,
            second + linear.centre / low * curl,
            *(0.0, 0.0),
        ),
    }
    into = np.sum(list(causes.values()), axis=0).tolist()
    yaw_into = (eps_3 + (tau * x + h * (2 * x_3 + x)) / 2, xi_3 + off * xi)
    alpha = w * j / q + (2 * y + s) * y
    ask("the desired body rate", math.hypot(y, s), law.max_rate)
    ask("the desired angular acceleration", alpha, law.max_angular_acceleration)
    omega = (y + s * off, s + y * off)
    stiffness, damping = law.bandwidth**2, 2 * law.damping * law.bandwidth
    turning = (
        stiffness * tau + damping * beta + alpha + beta * omega[1] + beta_3 * omega[0],
        stiffness * yaw + damping * beta_3 + alpha * off + beta * omega[0],
    )
    least, most = _forces(law, (low * math.sqrt(1 - off**2), high), turning, (w_perp, w_3))
    ask("no force of a propeller", 0.0, least)
    ask("the force of a propeller", most, law.max_force)
    return Feeding(
        into=(*into, *yaw_into),
        climb=((high * errors.rho + curl) * tilt_b + disturbance) / k,
        causes=causes,
        error=error,
        tilt=off,
        tilt_demanded=math.atan(slope),
        least_force=least,
        most_force=most,
        failures=tuple(failures),
    )


def _ask_demand(
    law: VehicleLaw, ask: Ask, demand: tuple[float, float, float], sine: float, slope: float
) -> None:
    """Asks whether the law limits neither the demanded thrust nor the heading.

    Args:
        law: The vehicle.
        ask: Asks whether one number is below another.
        demand: The largest horizontal demand over the mass, the least and the largest vertical.
        sine: Of the attitude error, at most.
        slope: The tangent of the tilt of the demand, at most.
    """
    horizontal, least, most = demand
    g, spare = law.gravity, 4 * law.max_force / law.mass - law.gravity
    ask("the least lift", law.min_lift * g, least)
    ask("the lift", most, g + law.lift_share * spare)
    ask("the tilt of the demanded thrust", slope, math.tan(law.max_tilt))
    ask("the demanded thrust", math.hypot(horizontal, most), g + law.thrust_share * spare)
    turned = math.asin(min(sine, 1.0)) + math.atan(slope)
    ask("the turn from the heading", turned, law.max_heading_error)


def _forces(
    law: VehicleLaw,
    lift: tuple[float, float],
    turning: tuple[float, float],
    body_rate: tuple[float, float],
) -> tuple[float, float]:
    """Returns the least and the largest force of a propeller.

    Args:
        law: The vehicle.
        lift: The least and the largest thrust, over the weight.
        turning: The largest angular accelerations across the thrust, and about it.
        body_rate: The largest body rates, the same.
    """
    Jx, Jy, Jz = law.inertia
    across = max(
        Jx * turning[0] + abs(Jz - Jy) * body_rate[0] * body_rate[1],
        Jy * turning[0] + abs(Jx - Jz) * body_rate[0] * body_rate[1],
    )
    about = Jz * turning[1] + abs(Jy - Jx) * body_rate[0] ** 2
    torque = across / (2 * law.arm_length) + about / (4 * law.yaw_arm)
    weight = law.mass * law.gravity / 4
    return weight * lift[0] - torque, weight * lift[1] + torque
