"""The vehicle: a proof that a quadrotor under the SE(3) law stays between walls, and closes in.

The law commands the velocity U(p): v0 m in the plane and a climb to the altitude.  It is told
the derivatives of U (see `systems.se3_law.CalcThrustRates`).  With the velocity error
e = v - U(p), the attitude error e_R between the body and the desired attitude, the body-rate
error beta and an acceleration d that nobody knows of, the closed loop is exactly

    e' = -k e + Delta + d,          Delta = (q . b) b - q,
    e_R' = E(R_e) (beta + eps),     E = (tr(R_e) I - R_e^T) / 2,
    beta' = -wn^2 e_R - 2 zeta wn beta + xi,

where q = a - k e + g is the demanded thrust over the mass, a = DU v, and b the thrust's axis.
eps and xi are zero but for d, and for what differences are off by in place of derivatives
(docs/vehicle.md derives all of it).  So the attitude does not depend on e but for these, and e
only on the attitude: |Delta| is |q| times the sine of the angle between b and q.

`prove_stage` shows that bounds of the errors, as long as they hold, feed no more than what they
allow: so they hold for ever, and shrink.  As |e| is below v0 e* there, the vehicle does not
leave the walls either.

Rounding: apart from a few differences, everything is sums, products and roots of numbers above
zero.  Inequalities are asked for with a margin of `MARGIN`, far above what some hundred
roundings make.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
import math

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.flown_field import FlownBounds
from sgvf_drake.certificate.responses import Responses, respond

MARGIN = 1e-6
"""Every inequality holds by such a part of its larger side."""

# The climb that an error of the altitude commands is so much more than the vertical error.
CLIMB = 1.05
# How often bounds are shrunk, and the time that each takes, s; see `Responses.late`.
SHRINKS, SETTLING = 12, 2.0
# The largest second derivative of the hyperbolic tangent, 4 / (3 sqrt 3), and a little more.
TANH_BEND = 0.77

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
        look: h, by which the law looks ahead and back, s.
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
    look: float
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
        velocity: The largest horizontal part of e, m/s.
        climb: The largest vertical part of e, m/s.
        attitude: The largest |e_R|, the sine of the attitude error, which is less than a right
            angle.
        rate: The largest |beta|, rad/s.
    """

    velocity: float
    climb: float
    attitude: float
    rate: float


@dataclass(frozen=True)
class Feeding:
    """What errors within bounds feed, and what they mean.

    Attributes:
        attitude: The most that is fed into the rate of e_R, rad/s.
        rate: The most that is fed into the rate of beta, rad/s^2.
        velocity: The horizontal velocity error falls to this at most, m/s.
        climb: The vertical velocity error falls to this at most, m/s.
        thrust: The largest |q|, m/s^2.
        causes: The parts of what is fed, by their causes: into the rates of e_R and of beta,
            and what a cause adds to the rate of e itself.
        tilt: The largest angle between thrust and demanded thrust, rad.
        tilt_demanded: The largest tilt of the demanded thrust, rad.
        least_force: The least force of a propeller, N.
        most_force: The largest force of a propeller, N.
        failures: What does not hold, in words.
    """

    attitude: float
    rate: float
    velocity: float
    climb: float
    thrust: float
    causes: dict[str, tuple[float, float, float]]
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
        at_start: What the held bounds feed.
        causes: What each cause makes of the velocity error, m/s.
    """

    failures: tuple[str, ...]
    final: ErrorBounds
    settling: float
    at_start: Feeding
    causes: dict[str, float]


@cache
def attitude_responses(bandwidth: float, damping: float) -> Responses | None:
    """Returns the responses of e_R' = beta, beta' = -wn^2 e_R - 2 zeta wn beta, if stable.

    Inputs are the two rates; they hold of the lengths of vectors as of numbers.
    """
    A = np.array([[0.0, 1.0], [-(bandwidth**2), -2 * damping * bandwidth]])
    return respond(A, np.eye(2), np.eye(2), SETTLING)


def prove_stage(
    law: VehicleLaw,
    start: ErrorBounds,
    held: ErrorBounds,
    bounds: FlownBounds,
    unit: float,
    disturbance: float,
) -> StageProof:
    """Proves how large the errors of a vehicle are as long as it is between walls.

    Args:
        law: The vehicle.
        start: Bounds of the errors at the start.
        held: Bounds of the errors that are claimed to hold from then on.
        bounds: Bounds of the field between the walls.
        unit: Metres in a normalised unit.
        disturbance: The largest |d|, m/s^2.
    """
    found = attitude_responses(law.bandwidth, law.damping)
    fed = feed(law, held, bounds, unit, disturbance)
    failures = list(fed.failures)
    if found is None or law.velocity_gain <= 0:
        failures.insert(0, "the linear loop is not stable")
        return StageProof(tuple(failures), held, 0, fed, {})
    kept = held_from(found, start, fed)
    for name, value in vars(held).items():
        mine = getattr(kept, name)
        if not mine * (1 + MARGIN) < value:
            failures.append(f"the bound of {name}: {mine:.4g}, not below {value:.4g}")
    final, last = held, fed
    for _ in range(0 if failures else SHRINKS):
        left = math.exp(-law.velocity_gain * SETTLING)
        attitude, rate = _turned(found, found.late, final, last)
        names = {
            "velocity": left * final.velocity + last.velocity,
            "climb": left * final.climb + last.climb,
            "attitude": attitude,
            "rate": rate,
        }
        final = ErrorBounds(
            **{n: min(getattr(final, n), (1 + MARGIN) * x) for n, x in names.items()}
        )
        last = feed(law, final, bounds, unit, disturbance)
    integral, k = found.integral[0], law.velocity_gain
    causes = {
        name: float(fed.thrust * (integral @ parts[:2]) + parts[2]) / k
        for name, parts in fed.causes.items()
    }
    return StageProof(tuple(failures), final, SHRINKS * SETTLING, fed, causes)


def held_from(found: Responses, start: ErrorBounds, fed: Feeding) -> ErrorBounds:
    """Returns bounds that hold from a start on while so much is fed."""
    attitude, rate = _turned(found, found.peak, start, fed)
    # A velocity error is no larger than the larger of what it was and of what it falls to.
    velocity, climb = max(start.velocity, fed.velocity), max(start.climb, fed.climb)
    return ErrorBounds(velocity, climb, attitude, rate)


def _turned(
    found: Responses, free: FloatArray, start: ErrorBounds, fed: Feeding
) -> tuple[float, float]:
    """Returns bounds of |e_R| and |beta|, from a start with these free responses."""
    parts = free @ [start.attitude, start.rate] + found.integral @ [fed.attitude, fed.rate]
    attitude, rate = parts.tolist()
    return attitude, rate


def feed(
    law: VehicleLaw, errors: ErrorBounds, bounds: FlownBounds, unit: float, disturbance: float
) -> Feeding:
    """Returns what errors within bounds feed into the linear system; see docs/vehicle.md."""
    v0, k, g, d = law.speed, law.velocity_gain, law.gravity, disturbance
    failures: list[str] = []

    def ask(what: str, less: float, more: float) -> None:
        if not less + MARGIN * max(abs(less), abs(more)) < more:
            failures.append(f"{what}: {less:.4g}, not below {more:.4g}")

    # The vehicle's velocity, and the derivatives of the command along it.
    climb, gain, top = CLIMB * errors.climb, law.altitude_gain, law.max_climb
    ask("the climb", climb, 0.9 * top)
    speed, v_z = v0 * bounds.most_speed + errors.velocity, climb + errors.climb
    ask("the velocity error against that of the bounds", errors.velocity, v0 * bounds.error)
    ask("how far the law looks", law.look * max(speed, v0), bounds.reach * unit)
    e = math.hypot(errors.velocity, errors.climb)
    slope, bent = max(v0 / unit * bounds.slope, gain), v0 / unit**2
    bent_z = TANH_BEND * gain**2 / top
    second = math.hypot(bent * v0**2 * bounds.along, bent_z * v_z**2)
    bend = max(bent * bounds.bend * speed, bent_z * v_z)
    # Differences in place of derivatives are off by this, along the velocity and as a matrix.
    off = math.hypot(bent * v0**2 * bounds.along_off, 2 * bent_z * v_z**2)
    off_bend = max(bent * bounds.bend_off * speed, 2 * bent_z * v_z)
    third = math.hypot(bent * v0**2 * bounds.along_change, 2 * bent_z * v_z**2) / law.look

    # The demanded thrust.
    a_h, a_z = v0**2 / unit * bounds.acceleration, gain * v_z
    q_h = a_h + k * errors.velocity
    q_low, q_high = g - a_z - k * errors.climb, g + a_z + k * errors.climb
    tangent = q_h / max(q_low, MARGIN)
    sine = min(errors.attitude, 0.9)
    ask("the sine of the attitude error", errors.attitude, 0.7)
    _ask_demand(law, ask, (q_h, q_low, q_high), sine, tangent)
    q, low = math.hypot(q_h, q_high), max(q_low, MARGIN)
    leaning = math.atan(tangent)
    tilt = min(math.asin(sine) + leaning, math.pi / 2)
    Delta = q * sine
    e_rate = k * e + Delta
    v_rate = math.hypot(a_h, a_z) + e_rate

    # How the desired attitude turns: W(q) q', across the thrust and about it, with its rate.
    cosine, high = math.cos(leaning), math.sin(leaning)
    K = k + slope
    q_1 = second + slope * v_rate + k * e_rate
    omega = q_1 / (low * cosine)
    body_rate = errors.rate + omega
    # With Delta, which turns with the desired attitude but for beta, v'' = q' + Delta'.
    Delta_rate = (q_1 + q * omega) * sine + q * errors.rate
    q_2 = third + 3 * bend * v_rate + slope * (q_1 + Delta_rate)
    q_2 += k * (Delta_rate + k * e_rate)
    twist = 1 + high / cosine, high / cosine**2 + (1 + high**2) / cosine**3
    across, about = (
        share * q_2 / low + part * (q_1 / low) ** 2
        for share, part in zip((1.0, tangent), twist, strict=True)
    )
    alpha = math.hypot(across, about)
    ask("the desired body rate", omega, law.max_rate)
    ask("the desired angular acceleration", alpha, law.max_angular_acceleration)

    # What is fed into the rates of e_R, of beta, and besides into that of e.
    def unknown(off: float, off_bend: float, d: float) -> tuple[float, float, float]:
        first = off + K * d
        then = 2 * bend * d + off_bend * v_rate + K * first + k * (off + slope * d)
        xi = then / (low * cosine) + math.hypot(*twist) * first * q_1 / low**2
        return first / (low * cosine), xi, d

    half = math.sqrt((1 - math.sqrt(1 - sine**2)) / 2)
    causes = {
        "differences": unknown(off, off_bend, 0.0),
        "disturbance": unknown(0.0, 0.0, d),
        "second order": (half * errors.rate, 0.0, 0.0),
    }
    attitude, rate, _ = np.sum(list(causes.values()), axis=0).tolist()
    stiffness, damping = law.bandwidth**2, 2 * law.damping * law.bandwidth
    own = stiffness * sine + damping * errors.rate + errors.rate * omega
    # The body's axes are off from the desired ones by the attitude error.
    turning = own + alpha, own + about + sine * across
    lift = low / g * math.sqrt(1 - sine**2), q / g
    least, most = _forces(law, lift, turning, body_rate)
    ask("no force of a propeller", 0.0, least)
    ask("the force of a propeller", most, law.max_force)
    return Feeding(
        attitude=attitude,
        rate=rate,
        velocity=(Delta + d) / k,
        climb=(Delta * math.sin(tilt) + d) / k,
        thrust=q,
        causes=causes,
        tilt=math.asin(sine),
        tilt_demanded=leaning,
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
    body_rate: float,
) -> tuple[float, float]:
    """Returns the least and the largest force of a propeller.

    Args:
        law: The vehicle.
        lift: The least and the largest thrust, over the weight.
        turning: The largest angular acceleration, and about the thrust.
        body_rate: The largest body rate.
    """
    Jx, Jy, Jz = law.inertia
    # Of two parts of a vector the product is at most half of its square.
    square = body_rate**2 / 2
    tilting = max(
        Jx * turning[0] + abs(Jz - Jy) * square, Jy * turning[0] + abs(Jx - Jz) * square
    )
    yawing = Jz * turning[1] + abs(Jy - Jx) * square
    torque = tilting / (2 * law.arm_length) + yawing / (4 * law.yaw_arm)
    weight = law.mass * law.gravity / 4
    return weight * lift[0] - torque, weight * lift[1] + torque
