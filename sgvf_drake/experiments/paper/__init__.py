"""The experiments of the paper; each class is a kind that a scenario names."""

from dataclasses import dataclass

from sgvf_drake.paper.baselines import BaselineComparison
from sgvf_drake.paper.corners import Corners
from sgvf_drake.paper.flights import Flights
from sgvf_drake.paper.indexing import Indexing
from sgvf_drake.paper.loss_ablation import LossAblation
from sgvf_drake.paper.overview import Overview
from sgvf_drake.paper.recipe_ablation import RecipeAblation
from sgvf_drake.paper.stein import SteinIdentity
from sgvf_drake.paper.vanishing import ScoreVanishing


@dataclass
class NoExperiment:
    """Stands where a scenario names no kind."""


KINDS: tuple[type, ...] = (
    BaselineComparison,
    Corners,
    Flights,
    Indexing,
    LossAblation,
    Overview,
    RecipeAblation,
    ScoreVanishing,
    SteinIdentity,
)
"""The kinds of experiment; the name of a class is its tag in a scenario."""

__all__ = ["KINDS", "NoExperiment"]
