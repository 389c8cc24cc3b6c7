"""Level sets of V: the conditions C1 and C2 by bounds over squares, and what follows from them.

C1 is that V falls along m wherever c_in <= V <= c_out, C2 that m is nowhere zero where
V <= c_in.  So all that starts in {V <= c_out} comes to the tube {V <= c_in} in bounded time,
and stays in it.  Tubes and walls say more of most paths; this says it of the levels on which a
`LyapunovFunction` is watched.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
import math
from typing import Any

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.boxes import (
    HALF_WIDTH,
    Answer,
    Boxes,
    BoxSizes,
    Division,
    divide,
)
from sgvf_drake.certificate.field_model import model_field
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.mixture_model import MixtureModel, mixture_of
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField
from sgvf_drake.paths import ReferencePath

LOW, HIGH, RATE, MARGIN, STEP = range(5)
"""Columns of the facts of C1: bounds of V; a bound from above of V_dot where V is in the
band; bounds from below there of -V_dot / |grad V|, the speed at which m crosses the levels, and
of -V_dot / |m|^2."""


SPEED = 0
"""The only column of the facts of C2: a bound of |m| from below."""

# Intervals of levels on which the rate and the margin are told.
NUM_INTERVALS = 200


@dataclass(frozen=True)
class Conditions:
    """C1 and C2, in the field's normalised units.

    C1: V_dot <= -alpha along m wherever c_in <= V <= c_out.  C2: |m| >= delta wherever
    V <= c_in.

    Attributes:
        sigma: The noise level of V.
        lowest: What is taken off -log sum_i exp(-|x - x_i|^2 / 2 sigma^2) to make V.
        c_in: The lower level.
        c_out: The upper level.
        alpha: The rate, per normalised unit of length.
        delta: The speed.
        share: The part of V_dot and |m| that their bounds keep on every square; how sharp
            what follows is, not what is true.

    Raises:
        ConfigurationError: One is no number, or out of its range: with a rate or a speed of
            zero, or an empty band, the conditions would hold and say nothing.
    """

    sigma: float
    lowest: float
    c_in: float
    c_out: float
    alpha: float
    delta: float
    share: float

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not isinstance(value, (int, float)) or not math.isfinite(value):
                raise ConfigurationError(f"{name} must be a number, not {value!r}")
        positive = min(self.sigma, self.c_in, self.alpha, self.delta)
        if not (positive > 0 and self.c_in < self.c_out and 0 <= self.share < 1):
            raise ConfigurationError(
                "sigma, c_in, alpha and delta must be above zero, c_out above c_in, and share "
                f"from 0 to below 1, not {asdict(self)}"
            )


@dataclass(frozen=True, eq=False)
class Decrease:
    """C1, the question whether V_dot <= -alpha wherever c_in <= V <= c_out.

    Attributes:
        field: m.
        levels: V, in the field's normalised units.
        c_in: The lowest level of the band.
        c_out: The highest.
        alpha: The rate, per normalised unit of length.
        share: Squares are divided until the bound of V_dot is at least this part of V_dot at
            their centre; at zero alpha alone is proved, which says little of the rate.
    """

    field: GuidingField
    levels: MixtureModel
    c_in: float
    c_out: float
    alpha: float
    share: float

    def prove(self, boxes: Boxes, smallest: float) -> Division:
        """Answers it over squares that cover the band."""
        return divide(boxes, self._ask, self._refute, smallest)

    def _ask(self, boxes: Boxes) -> Answer:
        facts = np.full((len(boxes), 5), np.nan)
        facts[:, LOW], facts[:, HIGH] = self.levels.level_range(boxes)
        inside = self._touches(facts)
        with np.errstate(over="ignore", invalid="ignore"):
            patches = boxes[inside].patches
            gradient = self.levels.gradient(patches)
            V = self.levels.level(patches, gradient)
            facts[inside, LOW] = np.fmax(facts[inside, LOW], V.lower[:, 0])
            facts[inside, HIGH] = np.fmin(facts[inside, HIGH], V.upper[:, 0])
            still = self._touches(facts[inside])
            inside[inside] = still
            V, gradient = V[still], gradient[still]
            m = model_field(self.field, boxes[inside].patches)
            V_dot = gradient.dot(m)
            rate = self._rate(V_dot, V)
            steepest, fastest = (
                (1 + SLACK) * np.linalg.norm(models.magnitude, axis=1)
                for models in (gradient, m)
            )
            facts[inside, RATE:] = np.column_stack(
                [rate, -rate / steepest, -rate / ((1 + SLACK) * fastest**2)]
            )
        # What is not a number is not below anything either.
        decided = ~inside
        wanted = -np.maximum(self.alpha, self.share * np.abs(V_dot.value[:, 0]))
        decided[inside] = rate <= wanted
        return Answer(decided, facts, int(inside.sum()))

    def _touches(self, facts: FloatArray) -> BoolArray:
        return (facts[:, HIGH] >= self.c_in) & (facts[:, LOW] <= self.c_out)

    def _rate(self, V_dot: TaylorModel, V: TaylorModel) -> FloatArray:
        """Returns a bound of V_dot where V is in the band, (n,)."""
        rate = V_dot.upper[:, 0]
        # On the rim of the band, V_dot has to be bounded on one side of the level alone: where
        # V >= c_in it is at most V_dot + k (V - c_in), for any k >= 0.  This varies least with
        # the k that takes out what V_dot and V have in common.
        slopes = V.slopes[..., 0]
        common = (V_dot.slopes[..., 0] * slopes).sum(axis=1) / (slopes**2).sum(axis=1)
        rims = ((self.c_in, np.maximum(-common, 0)), (self.c_out, np.minimum(-common, 0)))
        for level, k in rims:
            on_one_side = V_dot + V.shifted(-level).weighted(k[:, None])
            rate = np.fmin(rate, on_one_side.upper[:, 0])
        return rate

    def _refute(self, z: FloatArray) -> BoolArray:
        score = self.levels.mixture.score(z)
        V = self.levels.level_range(Boxes.points(z))
        m = self.field(self.field.cloud.denormalize(z))
        V_dot = -(score * m).sum(axis=1)
        return (V[0] >= self.c_in) & (V[1] <= self.c_out) & (V_dot > -self.alpha)


@dataclass(frozen=True, eq=False)
class Speed:
    """C2, the question whether |m| >= delta wherever V <= c_in.

    Attributes:
        field: m.
        levels: V, in the field's normalised units.
        c_in: The level of the tube.
        delta: The speed.
        share: Squares are divided until the bound of |m| is at least this part of |m| at their
            centre.
    """

    field: GuidingField
    levels: MixtureModel
    c_in: float
    delta: float
    share: float

    def prove(self, boxes: Boxes, smallest: float) -> Division:
        """Answers it over squares that cover the tube."""
        return divide(boxes, self._ask, self._refute, smallest)

    def _ask(self, boxes: Boxes) -> Answer:
        facts = np.full((len(boxes), 1), np.nan)
        inside = self.levels.level_range(boxes)[0] <= self.c_in
        with np.errstate(over="ignore", invalid="ignore"):
            m = model_field(self.field, boxes[inside].patches)
            # By the direction of m at the centre; a direction need not be exactly of length
            # one to bound |m|, but not longer.
            length = np.linalg.norm(m.value, axis=1, keepdims=True)
            along = m.weighted(m.value / ((1 + SLACK) * length))
            facts[inside, SPEED] = along.lower[:, 0]
        decided = ~inside
        wanted = np.maximum(self.delta, self.share * length[:, 0])
        decided[inside] = facts[inside, SPEED] >= wanted
        return Answer(decided, facts, int(inside.sum()))

    def _refute(self, z: FloatArray) -> BoolArray:
        _, V = self.levels.level_range(Boxes.points(z))
        m = self.field(self.field.cloud.denormalize(z))
        return (self.c_in >= V) & (np.linalg.norm(m, axis=1) < self.delta)


@dataclass(frozen=True, eq=False)
class Rates:
    """How fast V falls on a band, by intervals of levels.  All are bounds from below.

    Attributes:
        levels: (k + 1,) from c_in to c_out.
        alpha: (k,) -V_dot between each level and the next, per normalised unit of length.
        e_star: (k,) the inward speed of m across the levels.
        step: -V_dot / |m|^2 in the whole band.
    """

    levels: FloatArray
    alpha: FloatArray
    e_star: FloatArray
    step: float

    @property
    def entry_time(self) -> float:
        """Bound of the time from c_out to c_in: the integral of dc / alpha(c).

        In normalised units of length at |m| = 1.  With one alpha for all levels the bound is
        longer many times over.
        """
        return float((np.diff(self.levels) / self.alpha).sum() * (1 + SLACK * NUM_INTERVALS))


def rates(decrease: Division, c_in: float, c_out: float) -> Rates:
    """Returns how fast V falls on a band on which C1 is proved."""
    facts = decrease.facts[~np.isnan(decrease.facts[:, RATE])]
    levels = np.geomspace(c_in, c_out, NUM_INTERVALS + 1)
    alpha, e_star = np.empty(NUM_INTERVALS), np.empty(NUM_INTERVALS)
    for k in range(NUM_INTERVALS):
        there = (facts[:, LOW] <= levels[k + 1]) & (facts[:, HIGH] >= levels[k])
        alpha[k] = -facts[there, RATE].max()
        e_star[k] = facts[there, MARGIN].min()
    return Rates(levels, alpha, e_star, float(facts[:, STEP].min()))


def falling_area(decrease: Division, c_in: float, c_out: float) -> float:
    """Returns the area of squares inside of the band, on all of which V was proved to fall."""
    facts = decrease.facts
    inside = (facts[:, LOW] >= c_in) & (facts[:, HIGH] <= c_out)
    return float((4 * decrease.boxes.half[inside] ** 2).sum())


@dataclass(frozen=True)
class Levels:
    """What is proved of level sets of V; lengths are in the unit of the waypoints.

    Times are those at |m| = 1.

    Attributes:
        conditions: C1 and C2.
        sigma: The noise level of V.
        alpha: The rate at which V falls in the band at least, per unit of length.
        delta: |m| in the tube {V <= c_in} at least.
        tube_half_width: Largest distance of that tube from the path, at most.
        decrease_fraction: Part of the box where V was proved to fall, in the band.
        entry_time_bound: Time from V = c_out to that tube, at most.
        levels: Levels of V from c_in to c_out.
        e_star: The disturbance that m tolerates on the levels between each and the next, at
            least: {V <= c} stays invariant under x_dot = m + d with |d| below it.
        step_bound: V falls with Euler steps of m that are shorter in time, from anywhere in
            the band.
    """

    conditions: Conditions
    sigma: float
    alpha: float
    delta: float
    tube_half_width: float
    decrease_fraction: float
    entry_time_bound: float
    levels: tuple[float, ...]
    e_star: tuple[float, ...]
    step_bound: float

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "Levels":
        """Returns what a JSON object tells; see `Conditions` for the errors raised."""
        lists = {name: tuple(body[name]) for name in ("levels", "e_star")}
        return cls(**{**body, **lists, "conditions": Conditions(**body["conditions"])})


@dataclass(frozen=True, eq=False)
class LevelsProof:
    """How a proof of C1 and C2 ended.

    Attributes:
        levels: What is proved; None: not both.
        reason: Why it is not, in words.
        obstacle: (2,) in normalised units, where a condition does not hold or was not decided;
            None: there is no such place.
        boxes: Over how many squares the field was bounded.
    """

    levels: Levels | None
    reason: str = ""
    obstacle: FloatArray | None = None
    boxes: int = 0


def prove_levels(
    field: GuidingField, conditions: Conditions, reference: ReferencePath
) -> LevelsProof:
    """Proves C1 and C2.

    Args:
        field: The field, of closed paths in the plane.
        conditions: What is to be proved.
        reference: The path, for the width of the tube.
    """
    sizes, c = BoxSizes.of(field), conditions
    V = MixtureModel(mixture_of(field, c.sigma), c.lowest)
    basin = V.squares_below(c.c_out, sizes.everything, sizes.first)
    if not len(basin) or np.abs(basin.centers).max() + sizes.first >= HALF_WIDTH:
        return LevelsProof(None, "{V <= c_out} is not a set in the square")
    falls = Decrease(field, V, c.c_in, c.c_out, c.alpha, c.share).prove(basin, sizes.last)
    if not falls.proved:
        return _undone(field, "V falls along m on the band", [falls])
    tube = V.squares_below(c.c_in, sizes.everything, sizes.ring)
    moves = Speed(field, V, c.c_in, c.delta, c.share).prove(tube, sizes.last)
    if not moves.proved:
        return _undone(field, "m is nowhere zero in the tube", [falls, moves])
    unit, found = field.cloud.unit_length, rates(falls, c.c_in, c.c_out)
    lower, upper = field.cloud.box
    near = V.squares_below(c.c_in, sizes.everything, sizes.cover)
    off = reference.project(field.cloud.denormalize(near.centers)).distance.max()
    levels = Levels(
        conditions=c,
        sigma=c.sigma * unit,
        alpha=float(found.alpha.min()) / unit,
        delta=float(np.nanmin(moves.facts[:, SPEED])),
        tube_half_width=float(off + np.sqrt(2) * sizes.cover * unit),
        decrease_fraction=falling_area(falls, c.c_in, c.c_out)
        / float(np.prod((upper - lower) / unit)),
        entry_time_bound=found.entry_time * unit,
        levels=tuple(found.levels.tolist()),
        e_star=tuple(found.e_star.tolist()),
        # The Hessian of V is at most I / sigma^2.
        step_bound=2 * c.sigma**2 * found.step * unit,
    )
    return LevelsProof(levels, boxes=falls.evaluated + moves.evaluated)


def _undone(field: GuidingField, what: str, divisions: list[Division]) -> LevelsProof:
    """Returns what the last of some divisions left open or refuted."""
    last, boxes = divisions[-1], sum(division.evaluated for division in divisions)
    if last.counterexample is None:
        reason = f"it is undecided on {len(last.undecided)} squares whether {what}"
        return LevelsProof(None, reason, last.undecided.centers[0], boxes)
    x, y = field.cloud.denormalize(last.counterexample).tolist()
    reason = f"it is not so that {what}, at ({x:.4g}, {y:.4g})"
    return LevelsProof(None, reason, last.counterexample, boxes)
