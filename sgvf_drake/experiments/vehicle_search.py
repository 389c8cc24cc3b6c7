"""Proposes what is to be proved of a quadrotor's flight: walls, bounds, errors at the start.

Samples of the field between walls tell where a proof may succeed; there the field is bounded,
and the errors that hold are iterated from those of the start until they do not grow.
"""

from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import product
import math
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import FoundTube, find_tube
from sgvf_drake.certificate.flown_jerk import FlownBounds, bound_flown, region
from sgvf_drake.certificate.tube_cells import Parts
from sgvf_drake.certificate.vehicle import (
    CLIMB,
    ErrorBounds,
    Linear,
    Loop,
    VehicleLaw,
    feed,
    held_from,
    linear_loop,
)
from sgvf_drake.certificate.vehicle_claim import VehicleProposal, VehicleResult
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress
from systems import DEFAULT_GAINS, Disturbance, Gains, QuadrotorParameters
from systems.guidance import ALTITUDE_GAIN, MAX_APPROACH_RATE, MAX_CLIMB_RATE
from systems.se3_law import (
    LIFT_SHARE,
    MAX_DESIRED_ANGULAR_ACCELERATION,
    MAX_DESIRED_RATE,
    MAX_HEADING_ERROR,
    MAX_TILT,
    MIN_LIFT,
    SLOW_SPEED,
    THRUST_SHARE,
)

# Parts of what walls tolerate that |e| may be, and what K_0 is more than the velocity gain by.
SHARES, CENTRES = (0.95, 0.75, 0.55, 0.4), (0.5, 0.75, 1.0)
# Samples between walls, and directions of the velocity error; what the jerk may be more than
# what they see, and the same of all else before it is bounded.
SAMPLES, DIRECTIONS, JERK, OTHERS = 3000, 24, 1.2, 1.12
# By how much more the jerk is asked for in turn.
TARGETS = (1.0, 1.18)
# The errors at the start are in proportion: the thrust's that makes up for such a part of the
# velocity error, the rate's in which the attitude error would turn at such a part of the
# bandwidth, and such a part of both about the thrust; the vertical one, of all.
THRUST, RATE, YAW, VERTICAL = 0.5, 0.5, 0.1, 0.15
# Of the speed, a velocity error that is hardly any.
SMALL = 1e-3
# Approach rates that are tried, 1/s, where none is asked for; the first is that of a quadrotor.
RATES = (MAX_APPROACH_RATE, 2.0, 1.5, 1.25, 1.0, 0.75)
# What is tolerated of the largest disturbance, so that errors at the start have their part.
DISTURBED = 0.5
ITERATIONS, GROWN, SETTLED, BISECTIONS = 150, 1.003, 1.0003, 8


def vehicle_law(speed: float, parameters: QuadrotorParameters, gains: Gains) -> VehicleLaw:
    """Returns the numbers of a quadrotor and its law at a commanded speed, m/s."""
    return VehicleLaw(
        speed=speed,
        velocity_gain=gains.velocity_gain,
        bandwidth=gains.attitude_bandwidth,
        damping=gains.damping_ratio,
        mass=parameters.mass,
        gravity=parameters.gravity,
        inertia=parameters.inertia,
        arm_length=parameters.arm_length,
        yaw_arm=parameters.yaw_arm,
        max_force=parameters.max_propeller_force,
        altitude_gain=ALTITUDE_GAIN,
        max_climb=MAX_CLIMB_RATE,
        slow=SLOW_SPEED,
        max_tilt=MAX_TILT,
        min_lift=MIN_LIFT,
        lift_share=LIFT_SHARE,
        thrust_share=THRUST_SHARE,
        max_rate=MAX_DESIRED_RATE,
        max_angular_acceleration=MAX_DESIRED_ANGULAR_ACCELERATION,
        max_heading_error=MAX_HEADING_ERROR,
    )


@dataclass(frozen=True, eq=False)
class Candidate:
    """Walls and a linear system with which a proof succeeds for small errors at the start.

    Attributes:
        pairs: The number of the walls.
        bounds: Of the field between them.
        centre: K_0.
        jerk: What was asked for of the jerk.
        disturbance: The largest that is tolerated, m/s^2.
    """

    pairs: int
    bounds: FlownBounds
    centre: float
    jerk: float
    disturbance: float


@dataclass(frozen=True, eq=False)
class Trial:
    """The search along one piece.

    Attributes:
        law: The vehicle.
        unit: Metres in a normalised unit.
    """

    law: VehicleLaw
    unit: float

    @property
    def small(self) -> ErrorBounds:
        """Errors at a start that are hardly any."""
        return self.start(SMALL * self.law.speed)

    def start(self, error: float) -> ErrorBounds:
        """Returns the errors at a start with a velocity error, m/s."""
        law = self.law
        rho = THRUST * law.velocity_gain * error
        sigma = RATE * law.bandwidth * rho
        yaw, yaw_rate = YAW * rho / law.gravity, YAW * sigma / law.gravity
        return ErrorBounds(error, rho, sigma, 0.0, yaw, yaw_rate, VERTICAL * error)

    def holding(
        self, start: ErrorBounds, bounds: FlownBounds, centre: float, disturbance: float
    ) -> tuple[ErrorBounds, Linear] | None:
        """Returns bounds that hold from a start on, with the linear system; None: none do."""
        errors, loop = start, _loop(self.law, centre)
        if loop is None:
            return None
        for _ in range(ITERATIONS):
            linear = self.linear(errors, bounds, centre)
            fed = feed(self.law, linear, errors, bounds, self.unit, disturbance)
            if fed.failures:
                return None
            kept = held_from(loop, start, fed)
            # A fixed point of what is a little larger is above what it feeds, by that little.
            kept = ErrorBounds(*(GROWN * one + 1e-7 for one in vars(kept).values()))
            grown = _each(max, errors, kept)
            if all(new <= SETTLED * old for new, old in _pairs(grown, errors)):
                linear = self.linear(grown, bounds, centre)
                last = feed(self.law, linear, grown, bounds, self.unit, disturbance)
                more = held_from(loop, start, last)
                holds = all(1.00001 * new < old for new, old in _pairs(more, grown))
                return (grown, linear) if holds and not last.failures else None
            errors = grown
        return None

    def largest(
        self, bounds: FlownBounds, centre: float, *, error: float, disturbance: float
    ) -> float:
        """Returns the largest part of an error at the start, or of a disturbance, that holds.

        Args:
            bounds: Of the field between the walls.
            centre: K_0.
            error: At the start, m/s; zero: a part of the disturbance is asked for.
            disturbance: m/s^2.
        """
        low, high = 0.0, 1.0
        for _ in range(BISECTIONS):
            share = (low + high) / 2
            start = self.start(share * error) if error else self.small
            force = disturbance if error else share * disturbance
            holds = self.holding(start, bounds, centre, force) is not None
            low, high = (share, high) if holds else (low, share)
        return low

    def linear(self, errors: ErrorBounds, bounds: FlownBounds, centre: float) -> Linear:
        """Returns the linear system with the bounds of |q| / g that errors have."""
        law, g = self.law, self.law.gravity
        across = law.speed**2 / self.unit * bounds.acceleration
        across += law.velocity_gain * bounds.error * law.speed
        up = (law.altitude_gain * (1 + CLIMB) + law.velocity_gain) * errors.climb
        low, high = (g - up) / g, math.hypot(g + up, across) / g
        return Linear(1.0, (low * (1 - 1e-5), high * (1 + 1e-5)), centre)


@cache
def _loop(law: VehicleLaw, centre: float) -> Loop | None:
    """Returns the responses of the linear system at K_0, which depend on nothing else."""
    return linear_loop(law, Linear(1.0, (0.9, 1.1), centre))


def _pairs(one: ErrorBounds, other: ErrorBounds) -> list[tuple[float, float]]:
    return list(zip(vars(one).values(), vars(other).values(), strict=True))


def _each(
    function: Callable[[float, float], float], one: ErrorBounds, other: ErrorBounds
) -> ErrorBounds:
    return ErrorBounds(*(function(a, b) for a, b in _pairs(one, other)))


def find_candidate(
    field: GuidingField, found: FoundTube, law: VehicleLaw, unit: float
) -> Candidate | None:
    """Returns the widest walls of a piece with which a proof succeeds; None: none do.

    Args:
        field: As it is flown, in the plane.
        found: A tube of it, with walls.
        law: The vehicle.
        unit: Metres in a normalised unit.
    """
    trial = Trial(law, unit)
    for pairs, cells, seen, centre in _tries(field, found, law, unit):
        if trial.holding(trial.small, seen, centre, 0.0) is None:
            continue
        found_here = _bounded(field, cells, trial, seen, centre)
        if found_here is not None:
            target, bounds = found_here
            most = law.velocity_gain * seen.error * law.speed
            part = trial.largest(bounds, centre, error=0.0, disturbance=most)
            return Candidate(pairs, bounds, centre, target, part * most)
    return None


def excess(field: GuidingField, found: FoundTube, law: VehicleLaw, unit: float) -> float:
    """Returns how many times too large velocity errors grow, at least, by samples.

    That is what errors as large as they may be feed, over what they may be, between the walls
    where this is least.  Below one there may still be no errors that hold all together.

    Args:
        field: As it is flown, in the plane.
        found: A tube of it, with walls.
        law: The vehicle.
        unit: Metres in a normalised unit.
    """
    trial, found_here = Trial(law, unit), [math.inf]
    for _, _, seen, centre in _tries(field, found, law, unit):
        if (loop := _loop(law, centre)) is not None:
            most = seen.error * law.speed
            errors = trial.start(most)
            linear = trial.linear(errors, seen, centre)
            fed = feed(law, linear, errors, seen, unit, 0.0)
            found_here.append(held_from(loop, trial.small, fed).across / most)
    return float(np.nanmin(found_here))


def _tries(
    field: GuidingField, found: FoundTube, law: VehicleLaw, unit: float
) -> Iterator[tuple[int, Parts, FlownBounds, float]]:
    """Yields walls, widest first, the cells between them, bounds by samples there, and K_0."""
    if found.walls is None or found.walls_proof is None:
        return
    for pairs in range(len(found.walls_proof.e_star), 0, -1):
        cells = region(found.tube, found.walls, pairs)
        samples = _Samples.between(field, cells)
        for share, more in product(SHARES, CENTRES):
            error, c = share * found.walls_proof.e_star[pairs - 1], -more * unit / law.speed
            seen = samples.bounds(error, law.slow / law.speed, c)
            yield pairs, cells, seen, law.velocity_gain + more


def _bounded(
    field: GuidingField, cells: Parts, trial: Trial, seen: FlownBounds, centre: float
) -> tuple[float, FlownBounds] | None:
    """Returns what was asked of the jerk, and bounds with which errors hold; None: none do.

    Squares of velocity errors reach past the disk of those that are sampled.
    """
    law = trial.law
    for more in TARGETS:
        target = more * seen.jerk
        aimed = replace(seen, jerk=target)
        if trial.holding(trial.small, aimed, centre, 0.0) is None:
            return None
        bounds = bound_flown(
            field,
            cells,
            error=seen.error,
            slow=law.slow / law.speed,
            centre=seen.centre,
            target=target,
        )
        if bounds is not None:
            holds = trial.holding(trial.small, bounds, centre, 0.0) is not None
            return (target, bounds) if holds else None
    return None


def propose(
    candidate: Candidate, law: VehicleLaw, unit: float, disturbance: float
) -> VehicleProposal | None:
    """Returns the proposal with the largest errors at the start; None: nothing holds."""
    trial, bounds, centre = Trial(law, unit), candidate.bounds, candidate.centre
    most = bounds.error * law.speed
    part = trial.largest(bounds, centre, error=most, disturbance=disturbance)
    start = trial.start(part * most)
    found = trial.holding(start, bounds, centre, disturbance)
    if found is None:
        return None
    held, linear = found
    return VehicleProposal(candidate.pairs, bounds.error, candidate.jerk, linear, start, held)


@dataclass(frozen=True, eq=False)
class _Samples:
    """m (n, 2), its Jacobian (n, 2, 2) and its second derivatives (n, 2, 2, 2), normalised."""

    m: FloatArray
    J: FloatArray
    H: FloatArray

    @classmethod
    def between(cls, field: GuidingField, cells: Parts) -> "_Samples":
        rng = np.random.default_rng(0)
        i = rng.integers(len(cells), size=SAMPLES)
        t, s = rng.uniform(-1, 1, (2, SAMPLES, 1))
        ends = (rows[i, 0] + s * rows[i, 1] for rows in (cells.start, cells.end))
        first, last = ends
        x = field.cloud.denormalize(((1 - t) * first + (1 + t) * last) / 2)
        unit = field.cloud.unit_length
        m, J = field.value_and_jacobian(x)
        return cls(m, unit * J, unit**2 * field.hessian(x))

    def bounds(self, error: float, slow: float, centre: float) -> FlownBounds:
        """Returns about what `bound_flown` would."""
        most = np.zeros(4)
        for angle in np.linspace(0, 2 * np.pi, DIRECTIONS, endpoint=False):
            n = self.m + error * np.array([np.cos(angle), np.sin(angle)])
            a = np.einsum("nij,nj->ni", self.J, n)
            omega = (n[:, 0] * a[:, 1] - n[:, 1] * a[:, 0]) / ((n**2).sum(axis=1) + slow**2)
            eta = np.einsum("nijk,nj,nk->ni", self.H, n, n)
            eta += np.einsum("nij,nj->ni", self.J, a)
            eta -= omega[:, None] * np.column_stack([-a[:, 1], a[:, 0]])
            found = [np.linalg.norm(eta, axis=1), np.linalg.norm(a, axis=1)]
            found += [np.abs(omega), np.abs((n * a).sum(axis=1))]
            most = np.maximum(most, np.max(found, axis=1))
        jerk, acceleration, turn, along = most.tolist()
        shifted = self.J - centre * np.eye(2)
        growth, slope = (
            float(np.linalg.norm(one, 2, axis=(1, 2)).max()) for one in (shifted, self.J)
        )
        speed = np.linalg.norm(self.m, axis=1)
        return FlownBounds(
            error,
            centre,
            JERK * jerk,
            OTHERS * acceleration,
            OTHERS * turn,
            2 * along,
            OTHERS * growth,
            OTHERS * slope,
            least_speed=float(speed.min()) - 0.01,
            most_speed=float(speed.max()) + 0.01,
            patches=0,
        )


@dataclass(frozen=True)
class VehicleQuestion:
    """What is asked of a vehicle's flight along a field.

    Attributes:
        speed: The commanded speed, m/s.
        scale: Metres in one unit of the waypoints.
        approach_rate: How fast the flown field asks to turn to the path, 1/s; None: the fastest
            of `RATES` with which the flight is proved.

    Raises:
        ConfigurationError: If one is not a positive number.
    """

    speed: float
    scale: float = 1.0
    approach_rate: float | None = None

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if value is not None and not 0 < value < math.inf:
                raise ConfigurationError(f"the {name} must be a positive number, not {value}")


@dataclass(frozen=True, eq=False)
class VehicleAnswer:
    """The field with which a flight may be proved, and what is proposed of each piece.

    Attributes:
        field: As it is flown.
        approach_rate: The largest at which it asks to turn, 1/s.
        law: The vehicle.
        disturbance: m/s^2.
        proposals: Of each piece; None: nothing.
        reason: Why there are none, in words.
    """

    field: GuidingField
    approach_rate: float
    law: VehicleLaw
    disturbance: float
    proposals: tuple[VehicleProposal | None, ...]
    reason: str = ""


def propose_flight(
    field: GuidingField,
    reference: ReferencePath,
    question: VehicleQuestion,
    progress: Progress = no_progress,
) -> VehicleAnswer:
    """Looks for the field, the walls and the errors with which a flight may be proved.

    Args:
        field: In the unit of its waypoints, planar, of closed pieces.
        reference: The path.
        question: What is asked.
        progress: Told how far it is.

    Raises:
        ConfigurationError: The field is not planar or a piece is open: there are no walls.
    """
    if field.dim != 2 or not all(reference.closed):
        raise ConfigurationError("--vehicle is for closed paths in the plane, which have walls")
    law = vehicle_law(question.speed, QuadrotorParameters(), DEFAULT_GAINS)
    unit = field.cloud.unit_length * question.scale
    rates = RATES if question.approach_rate is None else (question.approach_rate,)
    reasons = []
    for number, rate in enumerate(rates):
        progress("approach rates", number, len(rates))
        flown = widened(field, question, rate)
        candidates: list[Candidate] = []
        for piece in reference.pieces:
            found = find_tube(flown, field.cloud.normalize(piece.vertices), closed=True)
            candidate = None if found is None else find_candidate(flown, found, law, unit)
            if candidate is None:
                reason = "there are no walls"
                if found is not None and found.walls is not None:
                    times = excess(flown, found, law, unit)
                    reason = f"velocity errors feed {times:.2g} times what they may be"
                reasons.append(f"at {rate:g} /s, along piece {len(candidates) + 1}, {reason}")
                break
            candidates.append(candidate)
        else:
            force = DISTURBED * min(candidate.disturbance for candidate in candidates)
            proposals = tuple(propose(one, law, unit, force) for one in candidates)
            return VehicleAnswer(flown, rate, law, force, proposals)
    nothing = (None,) * len(reference.pieces)
    flown = widened(field, question, rates[0])
    return VehicleAnswer(flown, rates[0], law, 0.0, nothing, "; ".join(reasons))


def widened(field: GuidingField, question: VehicleQuestion, rate: float) -> GuidingField:
    """Returns a field as a vehicle flies it that turns to the path at a rate, 1/s, at most."""
    length = question.speed / rate / question.scale
    return field.with_approach_length(length) if length > field.approach_length else field


def told(result: VehicleResult, answer: VehicleAnswer | None) -> dict[str, Any]:
    """Returns what is proved of a flight, by the names of `summary.json`.

    Args:
        result: What is proved.
        answer: What was proposed; None: it was claimed.
    """
    fastest = result.law.speed + max(
        (piece.velocity_error or 0.0 for piece in result.pieces if piece is not None),
        default=0.0,
    )
    drag = Disturbance().drag / result.law.mass
    pieces = [None if piece is None else asdict(piece) for piece in result.pieces]
    return {
        "proved": result.proved,
        "sentence": sentence(result, NOTHING if answer is None else answer.reason),
        "speed_m_s": result.law.speed,
        "approach_rate_1_s": None if answer is None else answer.approach_rate,
        "disturbance_m_s2": result.disturbance,
        "wind_m_s": max(result.disturbance / drag - fastest, 0.0),
        "pieces": pieces,
        "what_it_does_not_cover": list(NOT_COVERED),
    }


NOTHING = "nothing was proposed"
NOT_COVERED = (
    "the hold of the 100 Hz loop: the law is taken to act in continuous time",
    "the estimator, sensors and delays: the state is taken to be known",
    "a wrong mass, thrust or inertia, and motors that lag",
    "Drake's integration error",
    "how the vehicle comes between the walls",
)


def sentence(result: VehicleResult, reason: str) -> str:
    """Says in one sentence what is proved, or what is in the way.

    Args:
        result: What is proved.
        reason: Why nothing was proposed.
    """
    speed, g = f"at {result.law.speed:g} m/s", result.law.gravity
    if result.proved:
        widths, starts = [], []
        for piece in result.pieces:
            assert piece is not None
            start = piece.proposal.start
            assert piece.half_width is not None
            widths.append(piece.half_width)
            starts.append((start.across, start.rho / g, start.sigma / g))
        error, tilt, rate = np.min(starts, axis=0).tolist()
        return (
            f"the quadrotor follows the path {speed} within {max(widths):.3g} m, from every "
            f"state between these walls with a velocity error up to {error:.2g} m/s, a tilt "
            f"error up to {tilt:.2g} rad and a rate error up to {rate:.2g} rad/s, under every "
            f"acceleration up to {result.disturbance:.2g} m/s^2 that nobody knows of"
        )
    failures = [
        f"piece {number}: {'; '.join(piece.failures)}"
        for number, piece in enumerate(result.pieces, start=1)
        if piece is not None and piece.failures
    ]
    why = "; ".join(failures) or reason
    return f"the flight {speed} is not proved: {why}; a lower speed or approach rate may be"
