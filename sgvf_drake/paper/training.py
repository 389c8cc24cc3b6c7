"""Trainings as the experiments of the paper ask for them."""

from typing import TYPE_CHECKING, Any

from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import ScoreNetwork

if TYPE_CHECKING:
    from sgvf_drake.learning import TrainingResult


def trained(
    cloud: PointCloud,
    recipe: str,
    seed: int,
    *,
    effort: float | None = None,
    score: ScoreNetwork | None = None,
    **settings: Any,
) -> "TrainingResult":
    """Trains a field by a recipe, perhaps with a part of the recipe's iterations.

    Args:
        cloud: The waypoints.
        recipe: One of `RECIPES`.
        seed: Seed of the networks.
        effort: Part of the iterations; 1 takes all that the recipe has at the usual noise
            level, None those that it has at the noise level of the waypoints.
        score: A score network that is taken as it is; None: one is learned.
        settings: Other arguments of `TrainingConfig`; they count before these.
    """
    # Imported here: what reads the rows of trials does not import torch.
    from sgvf_drake.learning import TrainingConfig, train
    from sgvf_drake.learning.support import SIGMA_DEFAULT

    # The paper claims branches too, so they are trained on.
    base: dict[str, Any] = {"recipe": recipe, "seed": seed, "anyway": True}
    if effort is not None:
        usual = TrainingConfig(**base).resolved(SIGMA_DEFAULT)
        for name in ("score_iterations", "tangent_iterations"):
            base[name] = round(effort * getattr(usual, name))
    given: dict[str, Any] = {} if score is None else {"score": score}
    return train(cloud, TrainingConfig(**(base | settings)), **given)
