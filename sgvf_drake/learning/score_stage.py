"""The first stage of a training: the score network, learned or given."""

import pandas as pd
import torch
from torch import Tensor

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import ScoreNetwork
from sgvf_drake.fields.activation import SILU
from sgvf_drake.learning.config import Settings
from sgvf_drake.learning.networks import Network
from sgvf_drake.learning.optimization import Optimization, optimize
from sgvf_drake.learning.score_matching import (
    Function,
    Losses,
    NoiseSchedule,
    noisy_score_loss,
    paper_score_loss,
    robust_score_loss,
)
from sgvf_drake.progress import Progress

# Paper, Section V-A.
PAPER_BATCH_SIZE = 512
PAPER_LEARNING_RATE = 1e-3

ROBUST_BATCH_SIZE = 256
ROBUST_WARMUP = 50
ROBUST_SCORE_LEARNING_RATE = 1e-2


def learn_score(
    data: Tensor, settings: Settings, given: ScoreNetwork | None, progress: Progress
) -> tuple[ScoreNetwork, list[pd.DataFrame]]:
    """Returns the score network and the history of its training, if there was one.

    A given score takes as many random numbers as its training would have taken, in a small
    part of the time: the tangent is then that of a run that trains both.

    Args:
        data: The points that are learned from, (N, d).
        settings: Those of the attempt.
        given: A score that was trained before.
        progress: Told how far the training is.
    """
    dim = data.shape[1]
    is_paper = settings.recipe == "paper"
    # Drawn in any case.
    network = Network(
        dim + 1,
        settings.score_hidden,
        dim,
        settings.num_frequencies,
        settings.frequency_std,
        has_time=True,
        scaled=not is_paper,
    )
    if given is not None:
        losses = _losses(lambda inputs: inputs[:, :dim], data, settings)
        for _ in range(settings.score_iterations):
            losses()
        return given, []
    steps = Optimization(
        settings.score_iterations,
        PAPER_LEARNING_RATE if is_paper else ROBUST_SCORE_LEARNING_RATE,
        0 if is_paper else ROBUST_WARMUP,
        cosine=not is_paper,
    )
    history = optimize(network, _losses(network, data, settings), steps, "score", progress)
    scale = 1.0 if is_paper else settings.sigma_min
    return ScoreNetwork(network.to_perceptron(), scale), [history]


def _losses(network: Function, data: Tensor, settings: Settings) -> Losses:
    schedule = NoiseSchedule(settings.sigma_min)
    if settings.recipe == "paper":
        return paper_score_loss(
            network, data, schedule, PAPER_BATCH_SIZE, settings.exact_target
        )
    loss = robust_score_loss if settings.exact_target else noisy_score_loss
    return loss(network, data, schedule, ROBUST_BATCH_SIZE)


def frozen_score(model: ScoreNetwork) -> Function:
    """Returns the score at t = 1 in torch, (n, d) -> (n, d), without gradients."""
    network = Network.from_perceptron(model.network)

    def score(x: Tensor) -> Tensor:
        with torch.no_grad():
            return network(torch.cat([x, torch.ones(len(x), 1)], dim=1)) / model.scale

    return score


def check_given_score(score: ScoreNetwork, recipe: str, dim: int) -> None:
    """Checks that a tangent can be learned on a score that was trained before.

    Raises:
        ConfigurationError: The recipe trains no score, or the score is of another kind.
    """
    if recipe == "exact":
        raise ConfigurationError(
            "score is not for the recipe exact, which has that of the mixture"
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
