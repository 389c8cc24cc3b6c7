"""The recipe `robust`, the default: reliable on every cloud that shows its paths."""

from typing import TYPE_CHECKING, ClassVar

from sgvf_drake.fields import (
    Perceptron,
    RobustComposition,
    ScoreNetwork,
    StrandMixture,
    StrandNetwork,
)
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.learning.recipes.recipe import Fitted, Recipe
from sgvf_drake.progress import Progress

if TYPE_CHECKING:
    import pandas as pd
    from torch import Tensor

    from sgvf_drake.learning.config import Settings
    from sgvf_drake.learning.score_matching import Function

BATCH_SIZE = 256
WARMUP = 50
SCORE_LEARNING_RATE = 1e-2
TANGENT_LEARNING_RATE = 5e-3
# Keeps |N| well above the softening of its direction; small, since near the zeros that the
# topology demands (Poincare-Hopf) it has to give way.
UNIT_WEIGHT = 0.3
HINT_WEIGHT = 3.0


class RobustRecipe(Recipe):
    """The exact score as target, Fourier features, an orientation hint, |m| = 1 built in."""

    name = "robust"
    defaults: ClassVar = {
        "max_restarts": 2,
        "num_frequencies": 32,
        "exact_target": True,
        "score_hidden": (64, 64, 64, 64),
        "tangent_hidden": (64, 64, 64),
        "unit_weight": UNIT_WEIGHT,
        "orthogonality_weight": 1.0,
        "direction_weight": 1.0,
        "hint_weight": HINT_WEIGHT,
        "projection": True,
    }
    # The network of a score in the plane is too small for one in space, whose error was nearly
    # all of the error of its field; one as large as that of (x, g) is not.
    in_space: ClassVar = {"num_frequencies": 96, "score_hidden": (128, 128, 128)}
    strand_defaults: ClassVar = defaults | {
        "num_frequencies": 96,
        "tangent_hidden": (128, 128, 128),
        "tangent_iterations": 1_500,
    }

    def fit(
        self,
        points: FloatArray,
        hint: FloatArray,
        settings: "Settings",
        score: ScoreNetwork | None,
        progress: Progress,
    ) -> Fitted:
        """See `Recipe.fit`."""
        import torch

        from sgvf_drake.learning.optimization import Optimization
        from sgvf_drake.learning.score_matching import (
            NoiseSchedule,
            noisy_score_loss,
            robust_score_loss,
        )
        from sgvf_drake.learning.score_stage import ScoreStage, frozen_score, learn_score

        data = torch.as_tensor(points, dtype=torch.float32)
        schedule = NoiseSchedule(settings.sigma_min)
        loss = robust_score_loss if settings.exact_target else noisy_score_loss
        stage = ScoreStage(
            lambda network: loss(network, data, schedule, BATCH_SIZE),
            Optimization(settings.score_iterations, SCORE_LEARNING_RATE, WARMUP, cosine=True),
            scale=settings.sigma_min,
            scaled_inputs=True,
        )
        score, histories = learn_score(points.shape[1], settings, stage, score, progress)
        tangent, history = fit_tangent(frozen_score(score), data, hint, settings, progress)
        return Fitted(score, tangent, composition(settings), [*histories, history])

    def fit_strands(
        self, mixture: StrandMixture, settings: "Settings", progress: Progress
    ) -> "tuple[StrandMixture | StrandNetwork, list[pd.DataFrame]]":
        """See `Recipe.fit_strands`: one network of (x, g)."""
        from sgvf_drake.learning.directed import fit_strand_network

        strands, history = fit_strand_network(mixture, settings, progress)
        return strands, [history]


def composition(settings: "Settings") -> RobustComposition:
    """Returns how score and tangent are put together."""
    return RobustComposition(settings.gain, settings.sigma_min, projects=settings.projection)


def fit_tangent(
    score: "Function",
    data: "Tensor",
    hint: FloatArray,
    settings: "Settings",
    progress: Progress,
) -> "tuple[Perceptron, pd.DataFrame]":
    """Learns the tangent on a fixed score; returns its network and the history."""
    import torch

    from sgvf_drake.learning.networks import Network
    from sgvf_drake.learning.optimization import Optimization, optimize
    from sgvf_drake.learning.tangent import robust_tangent_loss

    dim = data.shape[1]
    tangent = Network(
        dim,
        settings.tangent_hidden,
        dim,
        settings.num_frequencies,
        settings.frequency_std,
        scaled=True,
    )
    losses = robust_tangent_loss(
        tangent,
        score,
        data,
        torch.as_tensor(hint, dtype=torch.float32),
        settings.sigma_min,
        BATCH_SIZE,
        settings.weights,
    )
    steps = Optimization(
        settings.tangent_iterations, TANGENT_LEARNING_RATE, WARMUP, cosine=True
    )
    history = optimize(tangent, losses, steps, "tangent", progress)
    return tangent.to_perceptron(), history
