"""The trials of the robust recipe's ablation: complete, and without each of its parts."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sgvf_drake.experiments.paper.ablation.along_path import directions, sample_path
from sgvf_drake.experiments.paper.ablation.measures import (
    checked_row,
    direction_row,
    followed_row,
)
from sgvf_drake.experiments.quality.measures import measure_score
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import ScoreNetwork
from sgvf_drake.paths import make_shape

COMPLETE = "complete"
NOISY_TARGET, NO_FEATURES = "noisy-target", "no-features"
NO_HINT, NO_PROJECTION = "no-hint", "no-projection"
VARIANTS: dict[str, dict[str, Any]] = {
    COMPLETE: {},
    NOISY_TARGET: {"exact_target": False},
    NO_FEATURES: {"num_frequencies": 0},
    NO_HINT: {"hint_weight": 0.0},
    NO_PROJECTION: {"projection": False},
}
"""The options of each variant; the names are also those of its files."""

OF_THE_SCORE = (NOISY_TARGET, NO_FEATURES)
"""The variants that learn another score; the others share that of the complete recipe."""


@dataclass(frozen=True)
class RecipeTrial:
    """The variants of one training.

    Attributes:
        shape: A named shape of closed pieces.
        seed: Of the cloud and of the training.
        starts: Agents that follow each field.
        variants: The variants beside the complete recipe.
        ratios: The noise levels of V that the sublevel checks try, in those of the field.
        score_iterations: Optimisation steps of the score network.
        tangent_iterations: Of the tangent network.
    """

    shape: str
    seed: int
    starts: int
    variants: tuple[str, ...]
    ratios: tuple[float, ...]
    score_iterations: int
    tangent_iterations: int


def measure_recipe(trial: RecipeTrial, folder: Path) -> Row:
    """Trains and measures all variants; leaves `VARIANT.safetensors` and `VARIANT.npz`.

    No training starts again, so that what is measured is the first attempt.

    Returns:
        For each variant following: see `followed_row`; check: see `checked_row`; score: see
        `quality.measures.measure_score`; whole: see `direction_row`, of m; passed: whether
        the self-check did; train_cpu_s, of the score only where it was learned.
    """
    # Imported here: what reads the records does without torch.
    from sgvf_drake.learning import TrainingConfig, train

    cloud, reference = make_shape(trial.shape, seed=trial.seed)
    unit = cloud.unit_length
    samples = sample_path(reference, unit)
    rows: Row = {}
    shared: ScoreNetwork | None = None
    for name in (COMPLETE, *trial.variants):
        config = TrainingConfig(
            seed=trial.seed,
            max_restarts=0,
            score_iterations=trial.score_iterations,
            tangent_iterations=trial.tangent_iterations,
            **VARIANTS[name],
        )
        result = train(cloud, config, score=None if name in OF_THE_SCORE else shared)
        field = result.field
        if name == COMPLETE:
            assert isinstance(field.score_model, ScoreNetwork)
            shared = field.score_model
        field.save(folder / f"{name}.safetensors")
        rows[name] = {
            "following": followed_row(
                field, reference, trial.starts, 1.0, folder / f"{name}.npz"
            ),
            "check": checked_row(field, reference, trial.ratios),
            "score": measure_score(field, reference, trial.seed),
            "whole": direction_row(directions(samples, field(samples.points), unit)),
            "passed": result.self_check.passed,
            "train_cpu_s": result.cpu_s,
        }
    return rows
