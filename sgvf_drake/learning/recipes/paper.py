"""The recipe `paper`: Algorithms 1 and 2 to the letter, there to be compared."""

from typing import TYPE_CHECKING, ClassVar

from sgvf_drake.fields import PaperComposition, ScoreNetwork
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.learning.recipes.recipe import Fitted, Recipe
from sgvf_drake.progress import Progress

if TYPE_CHECKING:
    from sgvf_drake.learning.config import Settings

# Paper, Section V-A.
BATCH_SIZE = 512
LEARNING_RATE = 1e-3


class PaperRecipe(Recipe):
    """Algorithms 1 and 2; the network of paths is not asked."""

    name = "paper"
    # Paper, Section V-A: networks, iterations, k_s and lambdas.  No restarts.
    defaults: ClassVar = {
        "max_restarts": 0,
        "sigma_min": 0.1,
        "gain": 0.2,
        "frequency_std": 0.0,
        "num_frequencies": 0,
        "exact_target": False,
        "score_hidden": (64, 64, 64, 64),
        "score_iterations": 10_000,
        "tangent_hidden": (128,),
        "tangent_iterations": 10_000,
        "unit_weight": 1.0,
        "orthogonality_weight": 1.0,
        "direction_weight": 1.0,
        "hint_weight": 0.0,
        "projection": False,
    }
    refused: ClassVar = {
        "num_frequencies": "whose networks see x and t themselves",
        "hint_weight": "which has no orientation hint",
        "projection": "whose field is the plain sum s + v",
    }
    uses_paths = False
    # Its fields are slow, with |m| from 0.3 to 0.6 on their path.
    patience = 4.0

    def fit(
        self,
        points: FloatArray,
        hint: FloatArray,
        settings: "Settings",
        score: ScoreNetwork | None,
        progress: Progress,
    ) -> Fitted:
        """See `Recipe.fit`; the hint is not used."""
        import torch

        from sgvf_drake.learning.networks import Network
        from sgvf_drake.learning.optimization import Optimization, optimize
        from sgvf_drake.learning.score_matching import NoiseSchedule, paper_score_loss
        from sgvf_drake.learning.score_stage import ScoreStage, frozen_score, learn_score
        from sgvf_drake.learning.tangent import paper_tangent_loss

        dim = points.shape[1]
        data = torch.as_tensor(points, dtype=torch.float32)
        schedule = NoiseSchedule(settings.sigma_min)
        stage = ScoreStage(
            lambda network: paper_score_loss(
                network, data, schedule, BATCH_SIZE, settings.exact_target
            ),
            Optimization(settings.score_iterations, LEARNING_RATE),
            scale=1.0,
            scaled_inputs=False,
        )
        score, histories = learn_score(dim, settings, stage, score, progress)
        tangent = Network(dim, settings.tangent_hidden, dim)
        losses = paper_tangent_loss(
            tangent,
            frozen_score(score),
            data,
            schedule,
            settings.gain,
            BATCH_SIZE,
            settings.weights,
        )
        steps = Optimization(settings.tangent_iterations, LEARNING_RATE)
        histories.append(optimize(tangent, losses, steps, "tangent", progress))
        composition = PaperComposition(settings.gain)
        return Fitted(score, tangent.to_perceptron(), composition, histories)
