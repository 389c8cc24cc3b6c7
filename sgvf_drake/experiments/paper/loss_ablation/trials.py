"""The trials of Fig. 4: the paper's recipe complete, and without each of its losses."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sgvf_drake.experiments.paper.ablation.along_path import directions, sample_path
from sgvf_drake.experiments.paper.ablation.measures import (
    checked_row,
    direction_row,
    followed_row,
)
from sgvf_drake.experiments.paper.loss_ablation.measures import drift_row, lengths_row
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import GuidingField, ScoreNetwork
from sgvf_drake.paths import ReferencePath, make_shape

COMPLETE = "complete"
NO_UNIT, NO_ORTHOGONALITY, NO_DIRECTION = "no-unit", "no-orthogonality", "no-direction"
VARIANTS: dict[str, dict[str, float]] = {
    COMPLETE: {},
    NO_UNIT: {"unit_weight": 0.0},
    NO_ORTHOGONALITY: {"orthogonality_weight": 0.0},
    NO_DIRECTION: {"direction_weight": 0.0},
}
"""The options of each variant; the names are also those of its files."""


@dataclass(frozen=True)
class LossTrial:
    """One score network, and the tangent networks of all variants on it.

    Attributes:
        shape: A named shape of closed pieces.
        seed: Of the cloud and of the training.
        hidden: Hidden widths of the tangent network.
        starts: Agents that follow each field.
        patience: Their time to run, in the usual one for a field of unit length: the paper's
            fields are slow on their path.
        ratios: The noise levels of V that the sublevel checks try, in those of the field.
        score_iterations: Optimisation steps of the score network.
        tangent_iterations: Of each tangent network.
    """

    shape: str
    seed: int
    hidden: tuple[int, ...]
    starts: int
    patience: float
    ratios: tuple[float, ...]
    score_iterations: int
    tangent_iterations: int


def measure_losses(trial: LossTrial, folder: Path) -> Row:
    """Trains and measures all variants; leaves `VARIANT.safetensors` and `VARIANT.npz`.

    The variants differ in nothing but the loss that is removed: they share the score, and
    begin with the same tangent network and the same random numbers.

    Returns:
        For each variant what `measure_variant` returns.
    """
    # Imported here: what reads the records does without torch.
    from sgvf_drake.learning import TrainingConfig, train

    cloud, reference = make_shape(trial.shape, seed=trial.seed)
    rows: Row = {}
    score: ScoreNetwork | None = None
    for name, weights in VARIANTS.items():
        options: dict[str, Any] = {**weights, "tangent_hidden": trial.hidden}
        config = TrainingConfig(
            recipe="paper",
            seed=trial.seed,
            score_iterations=trial.score_iterations,
            tangent_iterations=trial.tangent_iterations,
            **options,
        )
        field = train(cloud, config, score=score).field
        assert isinstance(field.score_model, ScoreNetwork)
        score = field.score_model
        field.save(folder / f"{name}.safetensors")
        rows[name] = measure_variant(field, reference, trial, folder / f"{name}.npz")
    return rows


def measure_variant(
    field: GuidingField, reference: ReferencePath, trial: LossTrial, file: Path
) -> Row:
    """Measures one field of a trial.

    Returns:
        following: see `followed_row`; check: see `checked_row`; lengths: see `lengths_row`;
        drift: see `drift_row`; tangent, whole: see `direction_row`, of v and of m.
    """
    samples = sample_path(reference, field.cloud.unit_length)
    ways = {
        name: direction_row(directions(samples, vectors, field.cloud.unit_length))
        for name, vectors in (
            ("tangent", field.tangent(samples.points)),
            ("whole", field(samples.points)),
        )
    }
    return {
        "following": followed_row(field, reference, trial.starts, trial.patience, file),
        "check": checked_row(field, reference, trial.ratios),
        "lengths": lengths_row(field, reference, samples),
        "drift": drift_row(field, reference, samples),
        **ways,
    }
