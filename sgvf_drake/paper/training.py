"""A recipe with a part of its iterations, as the experiments of the paper train it."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sgvf_drake.learning import TrainingConfig


def shortened(recipe: str, seed: int, effort: float, **settings: Any) -> "TrainingConfig":
    """Returns a training run with a part of the iterations that a recipe has.

    Args:
        recipe: One of `RECIPES`.
        seed: Seed of the networks.
        effort: Part of the iterations; 1 takes all that the recipe has at the usual noise
            level.
        settings: Other arguments of `TrainingConfig`; they count before these.
    """
    # Imported here: what reads the rows of trials does not import torch.
    from sgvf_drake.learning import TrainingConfig
    from sgvf_drake.learning.scales import SIGMA_DEFAULT

    base: dict[str, Any] = {"recipe": recipe, "seed": seed}
    usual = TrainingConfig(**base).resolved(SIGMA_DEFAULT)
    iterations = {
        name: round(effort * getattr(usual, name))
        for name in ("score_iterations", "tangent_iterations")
    }
    return TrainingConfig(**(base | iterations | settings))
