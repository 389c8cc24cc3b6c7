"""One field of Fig. 2: trained, followed by agents from everywhere, and by two to look at."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sgvf_drake.experiments.follow import PATIENCE, FollowResult, follow
from sgvf_drake.experiments.quality.measures import following, measure_score
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import FloatArray
from sgvf_drake.metrics import default_duration
from sgvf_drake.paths import ReferencePath, make_shape

FIELD, LOSSES, AGENTS = "field.safetensors", "losses.parquet", "agents.npy"
# Every so many samples of a trajectory are kept for the picture.
THINNING = 2


@dataclass(frozen=True)
class OverviewTrial:
    """A training and what follows it.

    Attributes:
        shape: One of `SHAPES`, of closed pieces.
        recipe: Of the training.
        seed: Of the cloud and of the training.
        starts: Number of agents on a grid over the box.
    """

    shape: str
    recipe: str
    seed: int
    starts: int


def measure_overview(trial: OverviewTrial, folder: Path) -> Row:
    """Trains a field and follows it; leaves the field, its losses and one agent a piece."""
    # Imported here: what was measured before is shown without torch.
    from sgvf_drake.learning import TrainingConfig, train

    cloud, path = make_shape(trial.shape, seed=trial.seed)
    settings: dict[str, Any] = {"recipe": trial.recipe, "seed": trial.seed}
    result = train(cloud, TrainingConfig(**settings))
    duration = PATIENCE.get(trial.recipe, 1.0) * default_duration(path, cloud.unit_length)
    run = follow(result.field, path, trial.starts, duration)
    result.field.save(folder / FIELD)
    result.history.to_parquet(folder / LOSSES, index=False)
    agents = run.positions[::THINNING, far_starts(run, path)]
    np.save(folder / AGENTS, agents.astype(np.float32))
    lapped = run.metrics.lapped
    return {
        **following(run, cloud.unit_length),
        **measure_score(result.field, path, trial.seed),
        "pieces": len(path.pieces),
        "pieces_lapped": len(np.unique(run.metrics.piece[lapped])),
        "all_lap": bool(lapped.all()),
        "restarts": result.restarts,
        "train_cpu_s": result.cpu_s,
    }


def far_starts(run: FollowResult, path: ReferencePath) -> list[int]:
    """Returns one agent for each piece: of the starts nearest to it, the farthest away.

    What becomes of it has no part in the choice.
    """
    projection = path.project(run.positions[0])
    return [
        _farthest(projection.distance, projection.piece == k) for k in range(len(path.pieces))
    ]


def _farthest(distance: FloatArray, mask: np.ndarray) -> int:
    return int(np.argmax(np.where(mask, distance, -1.0)))
