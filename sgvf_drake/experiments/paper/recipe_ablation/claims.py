"""Whether each part of the robust recipe is worth its place.

Taking a part out makes a measure worse on a shape where the whole interval of the paired
differences over the seeds is on the worse side, and their mean is at least so large that it
matters.  The intervals of all measures on all shapes hold together in 95 %.  A part is worth
its place where something that agents do, or the sublevel checks, gets worse on at least one
shape; in part where only the accuracy of score and tangent does; not where nothing does.
"""

from dataclasses import dataclass

import pandas as pd

from sgvf_drake.experiments.outcome import Claim, Verdict
from sgvf_drake.experiments.paper.ablation.effects import Effect, effect_of
from sgvf_drake.experiments.paper.recipe_ablation.trials import (
    NO_FEATURES,
    NO_HINT,
    NO_PROJECTION,
    NOISY_TARGET,
)

SOURCE = "robust recipe"
SPEED_ERROR = "following.speed_error"
"""The largest | |m| - 1 | on the path, from the speeds of `quality.measures.following`."""

STATEMENTS = {
    NOISY_TARGET: "The exact score of the waypoints as the target, in place of Algorithm 1's "
    "noisy one, is worth its place.",
    NO_FEATURES: "Random Fourier features are worth their place.",
    NO_HINT: "The orientation hint is worth its place.",
    NO_PROJECTION: "Taking the score's part along the tangent out, near the path, is worth "
    "its place.",
}
"""What is claimed of each part, by the variant that lacks it."""


@dataclass(frozen=True)
class Measure:
    """Something that may get worse.

    Attributes:
        column: Its column.
        name: In words.
        worse: 1 where more is worse, -1 where less is.
        least: The smallest change that matters.
        counts: Whether it is something that agents do or the checks find.
    """

    column: str
    name: str
    worse: int
    least: float
    counts: bool = True


# The smallest changes that matter: one start in a hundred; a tenth of the noise level, which
# is 0.1 U; the tolerance of the speed on the path; one seed in five; and a tenth of the angles
# that are usual.
MEASURES = (
    Measure("following.lap", "share of starts that lap", -1, 0.01),
    Measure("following.rms_u", "RMS error, U", 1, 0.01),
    Measure("following.max_u", "largest error, U", 1, 0.01),
    Measure(SPEED_ERROR, "largest | |m| - 1 | on the path", 1, 0.02),
    Measure("check.holds", "share of seeds whose checks hold", -1, 0.2),
    Measure("score.score_cosine", "cosine of the score", -1, 0.005, counts=False),
    Measure("score.orthogonality", "|cos(S, v)| near the path", 1, 0.02, counts=False),
)


@dataclass(frozen=True)
class Finding:
    """A measurable change of a measure on a shape.

    Attributes:
        measure: The measure.
        shape: The shape.
        effect: What taking the part out does.
        is_worse: Whether that makes it worse, else better.
    """

    measure: Measure
    shape: str
    effect: Effect
    is_worse: bool

    def __str__(self) -> str:
        return f"{self.measure.name} on {self.shape} {self.effect}"


def with_speed_error(table: pd.DataFrame) -> pd.DataFrame:
    """Returns the table with the column `SPEED_ERROR`."""
    slow, fast = 1 - table["following.speed_min"], table["following.speed_max"] - 1
    return table.assign(**{SPEED_ERROR: pd.concat([slow, fast], axis=1).max(axis=1)})


def recipe_claims(table: pd.DataFrame) -> list[Claim]:
    """Returns one claim a part that was taken out.

    Args:
        table: One row a shape, variant and seed; see `ablation_tables.field_table`, with
            `SPEED_ERROR`.
    """
    measured = set(table["variant"])
    return [
        _claim(table, variant, statement)
        for variant, statement in STATEMENTS.items()
        if variant in measured
    ]


def findings_of(table: pd.DataFrame, variant: str) -> list[Finding]:
    """Returns what changes measurably without a part, in the order of `MEASURES`."""
    found = []
    comparisons = len(MEASURES) * table["shape"].nunique()
    for measure in MEASURES:
        for shape, fields in table.groupby("shape", sort=False):
            effect = effect_of(fields, measure.column, variant, comparisons=comparisons)
            matters = abs(effect.change[0]) >= measure.least
            if matters and (effect.rises or effect.falls):
                is_worse = effect.rises == (measure.worse > 0)
                found.append(Finding(measure, str(shape), effect, is_worse))
    return found


def _claim(table: pd.DataFrame, variant: str, statement: str) -> Claim:
    found = findings_of(table, variant)
    worse = [finding for finding in found if finding.is_worse]
    better = [finding for finding in found if not finding.is_worse]
    gain, loss = (any(finding.measure.counts for finding in part) for part in (worse, better))
    verdict = Verdict.PARTLY if worse else Verdict.FAILS
    if gain and not loss:
        verdict = Verdict.HOLDS
    evidence = f"Worse without it: {_listed(worse)}; better without it: {_listed(better)}."
    return Claim(f"robust-{variant}", SOURCE, statement, verdict, evidence, of_paper=False)


def _listed(findings: list[Finding]) -> str:
    return ", ".join(map(str, findings)) or "nothing measurable"
