"""The recipe `exact`: the closed-form score of the mixture in place of a network."""

from typing import TYPE_CHECKING, ClassVar

from sgvf_drake.fields import GaussianMixture, ScoreNetwork, StrandMixture, StrandNetwork
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.learning.recipes.recipe import Fitted, Recipe
from sgvf_drake.learning.recipes.robust import RobustRecipe, composition, fit_tangent
from sgvf_drake.progress import Progress

if TYPE_CHECKING:
    import pandas as pd

    from sgvf_drake.learning.config import Settings


class ExactRecipe(Recipe):
    """The tangent of the robust recipe on the exact score; directed fields without learning."""

    name = "exact"
    defaults: ClassVar = RobustRecipe.defaults
    strand_defaults: ClassVar = RobustRecipe.defaults
    refused: ClassVar = {"exact_target": "which has no score network"}
    learns_score = False

    def fit(
        self,
        points: FloatArray,
        hint: FloatArray,
        settings: "Settings",
        score: ScoreNetwork | None,
        progress: Progress,
    ) -> Fitted:
        """See `Recipe.fit`; no score is given."""
        import torch

        from sgvf_drake.learning.score_matching import mixture_score

        data = torch.as_tensor(points, dtype=torch.float32)
        sigma = settings.sigma_min
        tangent, history = fit_tangent(
            lambda x: mixture_score(x, sigma, data), data, hint, settings, progress
        )
        mixture = GaussianMixture(points, sigma)
        return Fitted(mixture, tangent, composition(settings), [history])

    def fit_strands(
        self, mixture: StrandMixture, settings: "Settings", progress: Progress
    ) -> "tuple[StrandMixture | StrandNetwork, list[pd.DataFrame]]":
        """See `Recipe.fit_strands`: the mixture as it is."""
        return mixture, []
