"""Proposes what is to be proved of a quadrotor's flight: walls, bounds, errors at the start.

Samples of the field between walls tell where a proof may succeed; there the field is bounded,
and the errors that hold are iterated from those of the start until they do not grow.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
import math
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import FoundTube, find_tube
from sgvf_drake.certificate.flown_field import AT_MOST, FlownBounds, bound_flown, region
from sgvf_drake.certificate.tube_cells import Parts
from sgvf_drake.certificate.vehicle import (
    ErrorBounds,
    VehicleLaw,
    attitude_responses,
    feed,
    held_from,
)
from sgvf_drake.certificate.vehicle_claim import VehicleProposal, VehicleResult
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress
from systems import DEFAULT_GAINS, Disturbance, Gains, QuadrotorParameters
from systems.guidance import (
    ALTITUDE_GAIN,
    DIFFERENCE_TIME,
    MAX_APPROACH_RATE,
    MAX_CLIMB_RATE,
)
from systems.se3_law import (
    LIFT_SHARE,
    MAX_DESIRED_ANGULAR_ACCELERATION,
    MAX_DESIRED_RATE,
    MAX_HEADING_ERROR,
    MAX_TILT,
    MIN_LIFT,
    THRUST_SHARE,
)

# Parts of what walls tolerate that the velocity error may be.
SHARES = (0.95, 0.6, 0.3, 0.15)
# Samples between walls, the step of their differences, normalised, and what a bound may be more
# than what they see.
SAMPLES, STEP, MORE = 3000, 1e-4, 1.25
# How many times the changes that are seen are asked for, and with which part of the velocity
# errors that are tolerated at the start.
LOOSER, SOME = (32.0, 16.0, 8.0, 4.0, 2.0), 0.1
# Of so many cells it is found out first whether bounds of all cost too much.
FEW = 64
# What differences are off by, of what second derivatives change by over their reach.
OFF = 0.2
# The errors at the start are in proportion: the thrust's that makes up for such a part of the
# velocity error, the rate's in which the attitude error would turn at such a part of the
# bandwidth; the vertical velocity error, of all.
THRUST, RATE, VERTICAL = 0.5, 0.5, 0.15
# Of the speed, a velocity error that is hardly any.
SMALL = 1e-3
# Approach rates that are tried, 1/s, where none is asked for; the first is that of a quadrotor.
RATES = (MAX_APPROACH_RATE, 2.0, 1.5, 1.25, 1.0, 0.75)
# What is tolerated of the largest disturbance, so that errors at the start have their part.
DISTURBED = 0.5
# How often bounds are iterated, what they are grown by, and how often a share is halved.
ITERATIONS, GROWN, BISECTIONS = 60, 1.0001, 8


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
        look=DIFFERENCE_TIME,
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
    """Walls between which a proof succeeds for small errors at the start.

    Attributes:
        trial: The search between them.
        bounds: Bounds of the field between them.
        change: The bound that was asked for `along_change`.
        disturbance: The largest that is tolerated, m/s^2.
    """

    trial: "Trial"
    bounds: FlownBounds
    change: float
    disturbance: float

    def propose(self, disturbance: float) -> VehicleProposal | None:
        """Returns the proposal with the largest errors at the start; None: nothing holds."""
        trial, bounds = self.trial, self.bounds

        def start(share: float) -> ErrorBounds:
            return trial.start(share * bounds.error * trial.law.speed)

        share = _largest(
            lambda share: trial.holding(start(share), bounds, disturbance) is not None
        )
        held = trial.holding(start(share), bounds, disturbance)
        if held is None:
            return None
        return VehicleProposal(
            *(trial.pairs, bounds.error, bounds.reach, self.change, start(share), held)
        )


@dataclass(frozen=True, eq=False)
class Trial:
    """The search between some walls of a piece.

    Attributes:
        law: The vehicle.
        unit: Metres in a normalised unit.
        pairs: The number of the walls.
        tolerated: The velocity error that they tolerate, m/s.
    """

    law: VehicleLaw
    unit: float
    pairs: int
    tolerated: float

    @property
    def small(self) -> ErrorBounds:
        """Errors at a start that are hardly any."""
        return self.start(SMALL * self.law.speed)

    def start(self, error: float) -> ErrorBounds:
        """Returns the errors at a start with a velocity error, m/s."""
        law = self.law
        attitude = THRUST * law.velocity_gain * error / law.gravity
        return ErrorBounds(error, VERTICAL * error, attitude, RATE * law.bandwidth * attitude)

    def holding(
        self, start: ErrorBounds, bounds: FlownBounds, disturbance: float
    ) -> ErrorBounds | None:
        """Returns bounds that hold from a start on and keep between the walls, if some do."""
        found = attitude_responses(self.law.bandwidth, self.law.damping)
        if found is None:
            return None
        errors = start
        for _ in range(ITERATIONS):
            fed = feed(self.law, errors, bounds, self.unit, disturbance)
            kept = held_from(found, start, fed)
            if fed.failures or not GROWN * kept.velocity < self.tolerated:
                return None
            pairs = list(zip(vars(kept).values(), vars(errors).values(), strict=True))
            if all(new < old for new, old in pairs):
                return errors
            errors = ErrorBounds(*(max(old, GROWN * new) for new, old in pairs))
        return None

    def loosest(self, seen: FlownBounds) -> FlownBounds:
        """Returns the loosest bounds of changes with which some errors at the start hold.

        Where patches are so large, remainders are most of it, so that differences are off by
        as much.
        """
        start = self.start(SOME * self.tolerated)
        for times in LOOSER:
            change = times * seen.along_change
            looser = replace(
                seen, along_change=change, along_off=change, bend_off=times * seen.bend_off
            )
            if self.holding(start, looser, 0.0) is not None:
                return looser
        return seen

    def tolerates(self, bounds: FlownBounds, most: float, share: float) -> bool:
        """Whether small errors hold under a share of the largest disturbance, m/s^2."""
        return self.holding(self.small, bounds, share * most) is not None

    def excess(self, bounds: FlownBounds) -> str:
        """Says what is in the way of a proof for small errors at the start."""
        fed = feed(self.law, self.small, bounds, self.unit, 0.0)
        told = (
            f"a velocity error of {fed.velocity:.2g} m/s is fed, of which "
            f"{self.tolerated:.2g} is tolerated"
        )
        return "; ".join(fed.failures or [told])


def _largest(holds: Callable[[float], bool]) -> float:
    """Returns the largest share of one at which something holds, about."""
    low, high = 0.0, 1.0
    for _ in range(BISECTIONS):
        share = (low + high) / 2
        low, high = (share, high) if holds(share) else (low, share)
    return low


def find_candidate(
    field: GuidingField, found: FoundTube, law: VehicleLaw, unit: float
) -> Candidate | str:
    """Returns the widest walls of a piece with which a proof succeeds, or why there are none.

    Args:
        field: As it is flown, in the plane.
        found: A tube of it, with walls.
        law: The vehicle.
        unit: Metres in a normalised unit.
    """
    if found.walls is None or found.walls_proof is None:
        return "there are no walls"
    reason = ""
    for pairs in range(len(found.walls_proof.e_star), 0, -1):
        e_star = found.walls_proof.e_star[pairs - 1]
        trial = Trial(law, unit, pairs, law.speed * e_star)
        cells = region(found.tube, found.walls, pairs)
        samples = _Samples.between(field, cells)
        for share in SHARES:
            seen = samples.bounds(share * e_star, law.look * law.speed / unit)
            if trial.holding(trial.small, seen, 0.0) is None:
                reason = trial.excess(seen)
                continue
            aimed = trial.loosest(seen)
            bounds = _bounded(field, cells, aimed)
            if bounds is None or trial.holding(trial.small, bounds, 0.0) is None:
                reason = f"the field is not bounded well enough by {AT_MOST} patches at once"
                continue
            most = law.velocity_gain * trial.tolerated
            holds = partial(trial.tolerates, bounds, most)
            return Candidate(trial, bounds, aimed.along_change, _largest(holds) * most)
    return reason


def _bounded(field: GuidingField, cells: Parts, aimed: FlownBounds) -> FlownBounds | None:
    """Returns bounds with the changes that are aimed at, if a part of the cells has them."""
    bound = partial(
        bound_flown, field, error=aimed.error, reach=aimed.reach, target=aimed.along_change
    )
    few = np.zeros(len(cells), bool)
    few[np.random.default_rng(0).permutation(len(cells))[:FEW]] = True
    if bound(cells[few], at_most=int(few.mean() * AT_MOST)) is None:
        return None
    return bound(cells)


@dataclass(frozen=True, eq=False)
class _Samples:
    """Samples of a field and of its derivatives, normalised.

    Attributes:
        m: (n, 2).
        J: (n, 2, 2).
        H: (n, 2, 2, 2).
        T: The rate of H along m, (n, 2, 2, 2).
    """

    m: FloatArray
    J: FloatArray
    H: FloatArray
    T: FloatArray

    @classmethod
    def between(cls, field: GuidingField, cells: Parts) -> "_Samples":
        rng = np.random.default_rng(0)
        i = rng.integers(len(cells), size=SAMPLES)
        t, s = rng.uniform(-1, 1, (2, SAMPLES, 1))
        first, last = (rows[i, 0] + s * rows[i, 1] for rows in (cells.start, cells.end))
        x = field.cloud.denormalize(((1 - t) * first + (1 + t) * last) / 2)
        unit = field.cloud.unit_length
        m, J = field.value_and_jacobian(x)
        H = [unit**2 * field.hessian(x + sign * STEP * unit * m) for sign in (0, 1, -1)]
        return cls(m, unit * J, H[0], (H[1] - H[2]) / (2 * STEP))

    def bounds(self, error: float, look: float) -> FlownBounds:
        """Returns about what `bound_flown` would, for a law that looks ahead so far by speed.

        How second derivatives change across m is taken to be how they do along it.
        """
        m, J, H, T = self.m, self.J, self.H, self.T
        speed = np.linalg.norm(m, axis=1)
        fastest, more = float(speed.max()) * 1.01 + error, (2 + error) * error
        slope = np.linalg.norm(J, 2, axis=(1, 2))
        bend, change = (np.linalg.norm(one.reshape(len(m), -1), axis=1) for one in (H, T))
        along, straight = (
            np.linalg.norm(np.einsum("nijk,nj,nk->ni", one, m, m), axis=1) for one in (H, T)
        )
        acceleration = np.linalg.norm(np.einsum("nij,nj->ni", J, m), axis=1)
        reach = look * fastest
        changes = MORE * reach * float((straight + (more + error) * change).max())
        return FlownBounds(
            error=error,
            reach=reach,
            along=MORE * float((along + more * bend).max()),
            along_off=OFF * changes,
            along_change=changes,
            bend=MORE * float(bend.max()),
            bend_off=OFF * MORE * reach * float(change.max()),
            acceleration=MORE * float((acceleration + error * slope).max()),
            slope=MORE * float(slope.max()),
            most_speed=float(speed.max()) * 1.01,
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
            candidate = (
                "there is no tube" if found is None else find_candidate(flown, found, law, unit)
            )
            if isinstance(candidate, str):
                piece_number = len(candidates) + 1
                reasons.append(f"at {rate:g} /s, along piece {piece_number}, {candidate}")
                break
            candidates.append(candidate)
        else:
            force = DISTURBED * min(candidate.disturbance for candidate in candidates)
            proposals = tuple(candidate.propose(force) for candidate in candidates)
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
    "the default law: the vehicle is taken to fly with the jerk feed-forward",
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
    speed = f"at {result.law.speed:g} m/s"
    if result.proved:
        widths, starts = [], []
        for piece in result.pieces:
            assert piece is not None
            start = piece.proposal.start
            assert piece.half_width is not None
            widths.append(piece.half_width)
            starts.append((start.velocity, start.attitude, start.rate))
        error, tilt, rate = np.min(starts, axis=0).tolist()
        return (
            f"with the jerk feed-forward the quadrotor follows the path {speed} within "
            f"{max(widths):.3g} m, from every state between these walls with a velocity error "
            f"up to {error:.2g} m/s, an attitude error up to {tilt:.2g} rad and a rate error "
            f"up to {rate:.2g} rad/s, under every acceleration up to "
            f"{result.disturbance:.2g} m/s^2 that nobody knows of"
        )
    failures = [
        f"piece {number}: {'; '.join(piece.failures)}"
        for number, piece in enumerate(result.pieces, start=1)
        if piece is not None and piece.failures
    ]
    why = "; ".join(failures) or reason
    return f"the flight {speed} is not proved: {why}; a lower speed or approach rate may be"
