"""What Fig. 3 says, against what was flown."""

from collections.abc import Sequence
from dataclasses import dataclass

from sgvf_drake.experiments.outcome import Claim, Verdict
from sgvf_drake.experiments.paper.flights.measures import Motion

SECTION = "Section V-B, Fig. 3"
# The speed stays below this many times the commanded one.  How slow the field is belongs to
# another claim.
FASTEST = 1.5
# Within one sample of 10 ms the velocity changes by at most this part of the commanded speed,
# and a force by this part of its limit; more is a jump.
LARGEST_STEP = 0.05


@dataclass(frozen=True)
class Flight:
    """A flight, for the tables and the claims.

    Attributes:
        shape: Of the waypoints.
        recipe: Of the training.
        seed: Of the training and of the noise.
        error: How it lost control; None: it did not.
        completed: Whether every piece was flown.
        legs: Number of pieces that it came to, and of the tour.
        rms_m: Root mean square of the cross-track error on the pieces, the worst of them.
        max_m: Largest of it.
        motion: After the take-off; None where control was lost.
        tolerance_m: The cross-track error up to which a piece counts as followed.
        speed_m_s: Commanded.
        limit_n: Largest force of a propeller.
    """

    shape: str
    recipe: str
    seed: int
    error: str | None
    completed: bool
    legs: tuple[int, int]
    rms_m: float
    max_m: float
    motion: Motion | None
    tolerance_m: float
    speed_m_s: float
    limit_n: float

    @property
    def follows(self) -> bool:
        """Whether all pieces were flown, and near enough."""
        return self.completed and self.rms_m <= self.tolerance_m

    @property
    def outcome(self) -> str:
        """What became of it, in words."""
        if self.error is not None:
            return "lost control"
        if not self.completed:
            return f"{self.legs[0]} of {self.legs[1]} pieces"
        return "completed" if self.follows else "strayed"

    @property
    def is_smooth(self) -> bool:
        """Whether velocity and forces stay within their bounds, without jumps."""
        motion = self.motion
        if motion is None:
            return False
        return (
            motion.speed_max_m_s <= FASTEST * self.speed_m_s
            and motion.force_min_n > 0
            and motion.force_max_n < self.limit_n
            and motion.velocity_step_m_s <= LARGEST_STEP * self.speed_m_s
            and motion.force_step_n <= LARGEST_STEP * self.limit_n
        )


def flights_claims(flights: Sequence[Flight]) -> list[Claim]:
    """Returns two claims for each recipe."""
    by_recipe: dict[str, list[Flight]] = {}
    for flight in flights:
        by_recipe.setdefault(flight.recipe, []).append(flight)
    return [
        claim
        for recipe, own in by_recipe.items()
        for claim in (_branches_claim(recipe, own), _smooth_claim(recipe, own))
    ]


def _branches_claim(recipe: str, flights: Sequence[Flight]) -> Claim:
    good = [flight.follows for flight in flights]
    followed = [flight for flight in flights if flight.follows]
    evidence = f"{len(followed)} of {len(flights)} flights followed all of their pieces"
    if followed:
        evidence += (
            f", with a cross-track RMS of at most "
            f"{1e3 * max(flight.rms_m for flight in followed):.1f} mm and a largest error of "
            f"{1e3 * max(flight.max_m for flight in followed):.0f} mm"
        )
    others = [flight for flight in flights if not flight.follows]
    if others:
        evidence += "; the others: " + ", ".join(
            f"{flight.shape} seed {flight.seed}, {flight.outcome}" for flight in others
        )
    return Claim(
        f"flights-branches-{recipe}",
        SECTION,
        f"One field lets a quadrotor follow several branches in turn (recipe {recipe}).",
        Verdict.of(good),
        evidence + ".",
        of_paper=recipe == "paper",
    )


def _smooth_claim(recipe: str, flights: Sequence[Flight]) -> Claim:
    good = [flight.is_smooth for flight in flights]
    motions = [(flight, flight.motion) for flight in flights if flight.motion is not None]
    evidence = f"{sum(good)} of {len(good)} flights are so after the take-off"
    if motions:
        evidence += (
            f": speed {min(m.speed_min_m_s / f.speed_m_s for f, m in motions):.0%} to "
            f"{max(m.speed_max_m_s / f.speed_m_s for f, m in motions):.0%} of the commanded "
            f"one, propeller forces {min(m.force_min_n / f.limit_n for f, m in motions):.0%} "
            f"to {max(m.force_max_n / f.limit_n for f, m in motions):.0%} of their limit, and "
            "within 10 ms at most "
            f"{max(m.velocity_step_m_s / f.speed_m_s for f, m in motions):.1%} and "
            f"{max(m.force_step_n / f.limit_n for f, m in motions):.1%} of change"
        )
    return Claim(
        f"flights-smooth-{recipe}",
        SECTION,
        f"Velocity and motor inputs remain smooth and bounded (recipe {recipe}).",
        Verdict.of(good),
        evidence + ".",
        of_paper=recipe == "paper",
    )
