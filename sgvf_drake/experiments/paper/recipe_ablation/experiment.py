"""The robust recipe, and what each of its parts is for; in the manner of the paper's Fig. 4."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import pandas as pd

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.figures.ablation import (
    MeasurePanel,
    measures_figure,
    variants_figure,
)
from sgvf_drake.paper.intervals import POSITIVE, SHARE
from sgvf_drake.experiments.outcome import Exhibit, Outcome
from sgvf_drake.experiments.paper.ablation.panels import panels_of
from sgvf_drake.experiments.paper.ablation.tables import (
    FOLLOWED,
    field_table,
    seeds_table,
)
from sgvf_drake.experiments.paper.recipe_ablation.claims import (
    SPEED_ERROR,
    recipe_claims,
    with_speed_error,
)
from sgvf_drake.experiments.paper.recipe_ablation.trials import (
    COMPLETE,
    NO_FEATURES,
    NO_HINT,
    NO_PROJECTION,
    NOISY_TARGET,
    RecipeTrial,
    measure_recipe,
)
from sgvf_drake.experiments.workbench import Record, Workbench
from sgvf_drake.lyapunov.band import SIGMA_RATIOS

NAMES = {
    COMPLETE: "complete",
    NOISY_TARGET: "noisy target",
    NO_FEATURES: "no Fourier features",
    NO_HINT: "no hint",
    NO_PROJECTION: "no projection",
}
COSINE = (-1.0, 1.0)
# Lengths of m that are told apart by colour.
SPAN = (0.2, 2.0)
PANELS = (
    MeasurePanel("following.lap", "share of starts that lap", SHARE),
    MeasurePanel("following.rms_u", "RMS error [U]", log=True),
    MeasurePanel("following.max_u", "largest error [U]", log=True),
    MeasurePanel(SPEED_ERROR, "largest $| |m| - 1 |$ on the path", log=True),
    MeasurePanel("score.score_cosine", "cosine of the score with the exact one", COSINE),
    MeasurePanel("score.orthogonality", "mean $|\\cos(S, v)|$ near the path", SHARE),
)
FOLLOWING_CAPTION = (
    "How the fields are followed from a grid of starts, without restarts; means with 95 % "
    "intervals over the seeds."
)
FIELDS_CAPTION = (
    "The same fields from within: the learned score against the exact one near the path, "
    "orthogonality, and the sampled Lyapunov checks."
)


@dataclass
class RecipeAblation:
    """Trains the robust recipe complete and without each of its parts.

    Attributes:
        shapes: Named shapes of closed pieces.
        starts: Agents on a grid over the box.
        variants: The variants beside the complete recipe, each of which lacks a part.
        ratios: The noise levels of V that the sublevel checks try, in those of the field.
        score_iterations: Optimisation steps of the score network.
        tangent_iterations: Of the tangent network.
        seeds: Of the clouds and the trainings; the first is drawn.
    """

    shapes: list[str] = field(default_factory=lambda: ["concentric-circles", "star"])
    starts: int = 100
    variants: list[str] = field(
        default_factory=lambda: [name for name in NAMES if name != COMPLETE]
    )
    ratios: list[float] = field(default_factory=lambda: list(SIGMA_RATIOS))
    score_iterations: int = 1_500
    tangent_iterations: int = 1_000
    seeds: list[int] = field(default_factory=lambda: [0, 1, 2, 3, 4])

    def run(self, bench: Workbench) -> Outcome:
        """Runs the trials on a bench and says what they show.

        Raises:
            ConfigurationError: There is no such variant.
        """
        names = self._names()
        trials = [
            RecipeTrial(
                shape=shape,
                seed=seed,
                starts=self.starts,
                variants=tuple(self.variants),
                ratios=tuple(self.ratios),
                score_iterations=self.score_iterations,
                tangent_iterations=self.tangent_iterations,
            )
            for seed in self.seeds
            for shape in self.shapes
        ]
        records = bench.run(measure_recipe, trials, "robust recipe")
        labels = [{"shape": trial.shape, "seed": trial.seed} for trial in trials]
        table = with_speed_error(field_table(labels, records))
        return Outcome(
            exhibits=[
                self._fields(records, names),
                Exhibit(
                    "measures",
                    "Every seed, and means with 95 % intervals: what the removal of a part "
                    "changes beyond the scatter of the seeds. On logarithmic axes the means "
                    "are geometric.",
                    measures_figure(table, PANELS, "shape", names),
                ),
                Exhibit("following", FOLLOWING_CAPTION, following_table(table)),
                Exhibit("inside", FIELDS_CAPTION, inside_table(table)),
            ],
            claims=recipe_claims(table),
            logs={"fields": table},
        )

    def _names(self) -> dict[str, str]:
        """Returns what the variants of this run are called, the complete recipe first."""
        for variant in self.variants:
            if variant == COMPLETE or variant not in NAMES:
                known = ", ".join(name for name in NAMES if name != COMPLETE)
                raise ConfigurationError(
                    f"there is no variant {variant!r} to compare (they are {known})"
                )
        return {name: NAMES[name] for name in (COMPLETE, *self.variants)}

    def _fields(self, records: Sequence[Record], names: Mapping[str, str]) -> Exhibit:
        """Draws the guiding fields of the first seed."""
        rows = {
            shape: panels_of(record.folder, shape, names, lambda whole: whole)
            for shape, record in zip(self.shapes, records, strict=False)
        }
        return Exhibit(
            "fields",
            f"The guiding field m complete and without each part, seed {self.seeds[0]}: arrows "
            "of one length, the colour, also of the waypoints, is |m|. Triangles mark where "
            "m turns around on the path, red dots where agents ended that completed no lap.",
            variants_figure(rows, "m", SPAN),
        )


def following_table(table: pd.DataFrame) -> pd.DataFrame:
    """Returns how well each variant is followed."""
    return seeds_table(
        table,
        ("shape", "variant"),
        NAMES,
        counts={"followable seeds": "following.followable"},
        means={
            **FOLLOWED,
            "max, U": ("following.max_u", POSITIVE),
            "| |m| - 1 | on the path, max": (SPEED_ERROR, POSITIVE),
        },
    )


def inside_table(table: pd.DataFrame) -> pd.DataFrame:
    """Returns what the score and the checks say of each variant."""
    return seeds_table(
        table,
        ("shape", "variant"),
        NAMES,
        counts={"checks hold": "check.holds", "self-check passes": "passed"},
        means={
            "cos of the score": ("score.score_cosine", COSINE),
            "its 5th percentile": ("score.score_cosine_p5", COSINE),
            "its bias, U": ("score.score_bias_u", POSITIVE),
            "|cos(S, v)|": ("score.orthogonality", SHARE),
            "smallest |m| in the tube": ("check.slowest", POSITIVE),
            "V falls, part of the box": ("check.falls", SHARE),
        },
    )
