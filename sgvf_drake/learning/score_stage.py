"""The first stage of a training: the score network, learned or given."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import pandas as pd
import torch
from torch import Tensor

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import ScoreNetwork
from sgvf_drake.fields.activation import SILU
from sgvf_drake.learning.networks import Network
from sgvf_drake.learning.optimization import Optimization, optimize
from sgvf_drake.learning.recipes import Recipe
from sgvf_drake.learning.score_matching import Function, Losses
from sgvf_drake.progress import Progress

if TYPE_CHECKING:
    from sgvf_drake.learning.config import Settings


@dataclass(frozen=True, eq=False)
class ScoreStage:
    """How a recipe learns the score.

    Attributes:
        losses: The loss terms for a network of (x, t), or for a function in its place.
        steps: Its optimisation.
        scale: What divides the outputs to make the score.
        scaled_inputs: Whether a network without features sees scaled inputs.
    """

    losses: Callable[[Function], Losses]
    steps: Optimization
    scale: float
    scaled_inputs: bool


def learn_score(
    dim: int,
    settings: "Settings",
    stage: ScoreStage,
    given: ScoreNetwork | None,
    progress: Progress,
) -> tuple[ScoreNetwork, list[pd.DataFrame]]:
    """Returns the score network and the history of its training, if there was one.

    A given score takes as many random numbers as its training would have taken, in a small
    part of the time: the tangent is then that of a run that trains both.

    Args:
        dim: d.
        settings: Those of the attempt.
        stage: How it is learned.
        given: A score that was trained before.
        progress: Told how far the training is.
    """
    # Drawn in any case.
    network = Network(
        dim + 1,
        settings.score_hidden,
        dim,
        settings.num_frequencies,
        settings.frequency_std,
        has_time=True,
        scaled=stage.scaled_inputs,
    )
    if given is not None:
        losses = stage.losses(lambda inputs: inputs[:, :dim])
        for _ in range(settings.score_iterations):
            losses()
        return given, []
    history = optimize(network, stage.losses(network), stage.steps, "score", progress)
    return ScoreNetwork(network.to_perceptron(), stage.scale), [history]


def frozen_score(model: ScoreNetwork) -> Function:
    """Returns the score at t = 1 in torch, (n, d) -> (n, d), without gradients."""
    network = Network.from_perceptron(model.network)

    def score(x: Tensor) -> Tensor:
        with torch.no_grad():
            return network(torch.cat([x, torch.ones(len(x), 1)], dim=1)) / model.scale

    return score


def check_given_score(score: ScoreNetwork, recipe: Recipe, dim: int) -> None:
    """Checks that a tangent can be learned on a score that was trained before.

    Raises:
        ConfigurationError: The recipe trains no score, or the score is of another kind.
    """
    if not recipe.learns_score:
        raise ConfigurationError(
            f"score is not for the recipe {recipe.name}, which has that of the mixture"
        )
    if not isinstance(score, ScoreNetwork):
        raise ConfigurationError(f"score must be a ScoreNetwork, not {type(score).__name__}")
    widths = score.network.num_inputs, len(score.network.biases[-1])
    if widths != (dim + 1, dim):
        raise ConfigurationError(
            f"score has {widths[0]} inputs and {widths[1]} outputs, but waypoints of "
            f"dimension {dim} need {dim + 1} and {dim}"
        )
    if score.network.activation is not SILU:
        raise ConfigurationError(
            f"score has the activation {score.network.activation.name}; a tangent is learned "
            f"on one of {SILU.name}"
        )
