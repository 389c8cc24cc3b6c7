"""The robust recipe, and whether each of its parts is worth its place; as the paper's Fig. 4.

Taking a part out makes a measure worse on a shape where the whole interval of the paired
differences over the seeds is on the worse side, and their mean is at least so large that it
matters.  The intervals of all measures on all shapes hold together in 95 %.  A part is worth
its place where something that agents do, or the sublevel checks, gets worse on at least one
shape; in part where only the accuracy of score and tangent does; not where nothing does.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import pandas as pd

from sgvf_drake.experiments.intervals import POSITIVE, SHARE
from sgvf_drake.paper.ablation import (
    FIELDS,
    FOLLOWED,
    SPEED_ERROR,
    Ablation,
    MeasurePanel,
    effect_of,
)
from sgvf_drake.paper.claims import Claim, Judged, Rows, Verdict
from sgvf_drake.paper.experiment import SeedsTable, check_names, count

COSINE = (-1.0, 1.0)
NOTHING = "nothing measurable"
PANELS = (
    MeasurePanel("following.lap", "share of starts that lap", SHARE),
    MeasurePanel("following.rms_u", "RMS error [U]", log=True),
    MeasurePanel("following.max_u", "largest error [U]", log=True),
    MeasurePanel(SPEED_ERROR, "largest $| |m| - 1 |$ on the path", log=True),
    MeasurePanel("score.score_cosine", "cosine of the score with the exact one", COSINE),
    MeasurePanel("score.orthogonality", "mean $|\\cos(S, v)|$ near the path", SHARE),
)
TABLES = (
    SeedsTable(
        "following",
        "How the fields are followed from a grid of starts, without restarts; means with 95 % "
        "intervals over the seeds.",
        {
            "followable seeds": ("following.followable", count),
            **FOLLOWED,
            "max, U": ("following.max_u", POSITIVE),
            "| |m| - 1 | on the path, max": (SPEED_ERROR, POSITIVE),
        },
    ),
    SeedsTable(
        "inside",
        "The same fields from within: the learned score against the exact one near the path, "
        "orthogonality, and the sampled Lyapunov checks.",
        {
            "checks hold": ("check.holds", count),
            "self-check passes": ("passed", count),
            "cos of the score": ("score.score_cosine", COSINE),
            "its 5th percentile": ("score.score_cosine_p5", COSINE),
            "its bias, U": ("score.score_bias_u", POSITIVE),
            "|cos(S, v)|": ("score.orthogonality", SHARE),
            "smallest |m| in the tube": ("check.slowest", POSITIVE),
            "V falls, part of the box": ("check.falls", SHARE),
        },
    ),
)
STATEMENTS = {
    "noisy-target": "The exact score of the waypoints as the target, in place of Algorithm 1's "
    "noisy one, is worth its place.",
    "no-features": "Random Fourier features are worth their place.",
    "no-hint": "The orientation hint is worth its place.",
    "no-projection": "Taking the score's part along the tangent out, near the path, is worth "
    "its place.",
}
"""What is claimed of each part, by the variant that lacks it."""


@dataclass
class RecipeAblation(Ablation):
    """Trains the robust recipe complete and without each of its parts.

    Attributes:
        shapes: Named shapes of closed pieces.
        variants: The variants beside the complete recipe, each of which lacks a part.
    """

    score_iterations: int = 1_500
    tangent_iterations: int = 1_000
    shapes: list[str] = field(default_factory=lambda: ["concentric-circles", "star"])
    variants: list[str] = field(default_factory=lambda: list(STATEMENTS))

    group = "shape"
    symbol = "m"
    span = (0.2, 2.0)
    captions = (
        "The guiding field m complete and without each part, seed {}: arrows of one length, "
        "the colour, also of the waypoints, is |m|. Triangles mark where m turns around on "
        "the path, red dots where agents ended that completed no lap.",
        "Every seed, and means with 95 % intervals: what the removal of a part changes beyond "
        "the scatter of the seeds. On logarithmic axes the means are geometric.",
    )
    panels = PANELS
    seeds_tables = TABLES

    def cells(self) -> Sequence[Mapping[str, Any]]:
        """Returns a trial a shape.

        Raises:
            ConfigurationError: If there is no such variant.
        """
        check_names("variant", self.variants, STATEMENTS)
        own = {"recipe": "robust", "hidden": None, "patience": 1.0}
        variants = tuple(self.variants)
        return [{**own, "shape": shape, "variants": variants} for shape in self.shapes]

    def claims(self) -> Sequence[Claim]:
        return [
            Claim(
                f"robust-{variant}",
                "robust recipe",
                statement,
                partial(_is_worth_it, variant=variant),
                of_paper=False,
            )
            for variant, statement in STATEMENTS.items()
            if variant in self.variants
        ]


@dataclass(frozen=True)
class Measure:
    """Something that may get worse.

    Attributes:
        column: Its column.
        name: What it is, in words.
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


def changes_of(fields: pd.DataFrame, variant: str) -> list[tuple[Measure, bool, str]]:
    """Returns what changes measurably without a part, in the order of `MEASURES`.

    Returns:
        The measure, whether it gets worse, and the change in words: one for each measure and
        shape.
    """
    found = []
    comparisons = len(MEASURES) * fields["shape"].nunique()
    for measure in MEASURES:
        for shape, own in fields.groupby("shape", sort=False):
            effect = effect_of(own, measure.column, variant, comparisons=comparisons)
            is_sure = effect.rises() or effect.falls()
            if is_sure and abs(effect.change[0]) >= measure.least:
                is_worse = effect.rises() == (measure.worse > 0)
                found.append((measure, is_worse, f"{measure.name} on {shape} {effect}"))
    return found


def _is_worth_it(rows: Rows, variant: str) -> Judged:
    """Tells what gets worse and what gets better without a part, and how much of it counts."""
    changes = changes_of(rows[FIELDS], variant)
    worse, better = (
        [(measure, told) for measure, is_worse, told in changes if is_worse == side]
        for side in (True, False)
    )
    gain, loss = (sum(measure.counts for measure, _ in side) for side in (worse, better))
    return {
        "worse without it": ", ".join(told for _, told in worse) or NOTHING,
        "better without it": ", ".join(told for _, told in better) or NOTHING,
        "worse of agents and checks": gain,
        "better of agents and checks": loss,
    }, Verdict.when(gain > 0 and not loss, partly=bool(worse))
