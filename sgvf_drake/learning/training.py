"""From a cloud of waypoints to a trained guiding field."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
import time
from typing import Any

import numpy as np
import pandas as pd
import torch

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    Composition,
    FloatArray,
    GaussianMixture,
    GuidingField,
    PaperComposition,
    RobustComposition,
    ScoreNetwork,
)
from sgvf_drake.learning.config import Settings, TrainingConfig
from sgvf_drake.learning.networks import Network
from sgvf_drake.learning.optimization import Optimization, optimize
from sgvf_drake.learning.score_matching import Function, NoiseSchedule, mixture_score
from sgvf_drake.learning.score_stage import (
    PAPER_BATCH_SIZE,
    PAPER_LEARNING_RATE,
    ROBUST_BATCH_SIZE,
    ROBUST_WARMUP,
    check_given_score,
    frozen_score,
    learn_score,
)
from sgvf_drake.learning.self_check import SelfCheck, check_field
from sgvf_drake.learning.support import SIGMA_DEFAULT, SUPPORT_SPACING, Support, find_support
from sgvf_drake.learning.tangent import paper_tangent_loss, robust_tangent_loss
from sgvf_drake.paths import PathNetwork
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.progress import Progress, no_progress

ROBUST_TANGENT_LEARNING_RATE = 5e-3


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """A trained field and how it came about.

    Attributes:
        field: The field of the last attempt; check `self_check.passed`.
        settings: The configuration with every value filled in, those of the first attempt.
        network: What was found in the waypoints.
        support: The points that were learned from.
        self_check: What following the field from the path itself showed.
        restarts: How many attempts failed their self-check before this one.
        history: Loss terms: columns stage, iteration, one a term, total.
        cpu_s: Processor time of all attempts, seconds.
        wall_s: Elapsed time of all attempts, seconds.
    """

    field: GuidingField
    settings: Settings
    network: PathNetwork
    support: Support
    self_check: SelfCheck
    restarts: int
    history: pd.DataFrame
    cpu_s: float
    wall_s: float


def train(
    source: PointCloud | PathNetwork,
    config: TrainingConfig | None = None,
    progress: Progress = no_progress,
    score: ScoreNetwork | None = None,
) -> TrainingResult:
    """Trains a guiding field for a cloud of waypoints, or for a network that was found in one.

    After training, the field is followed from every piece and from around it; where that
    fails, training starts again with another seed, wider networks and more iterations, at
    most ``max_restarts`` times.  A field that fails to the end is returned all the same,
    with ``self_check.passed`` false.

    Args:
        source: The waypoints, in any order and any unit; or a network, whose lines are then
            the waypoints.
        config: The recipe and its overrides; None: the robust recipe, seed 0.
        progress: Called with (stage, done, total) now and then.
        score: The `score_model` of a field that was trained on the same cloud at the same
            noise level.  It is kept as it is, in every attempt, and only the tangent is
            trained; where it came from a first attempt with the same seed and the same
            options of the score, the tangent is the one of a run that trains both.

    Raises:
        PointCloudError: The waypoints show no path.
        ConfigurationError: The options do not fit the cloud, or the score does not; or the
            paths branch or cross, which no field of the position alone can follow.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    config = config or TrainingConfig()
    cloud, network = _paths_of(source, config)
    if score is not None:
        check_given_score(score, config.recipe, cloud.dim)
    support = find_support(cloud, network, config.sigma_min)
    settings = config.resolved(support.sigma)
    for attempt in range(settings.max_restarts + 1):
        with _torch_session(settings.seed, attempt):
            field, history = _train_once(
                cloud, network, support, settings.grown(attempt), score, progress
            )
        self_check = check_field(field, support.path)
        if self_check.passed:
            break
    return TrainingResult(
        field=field,
        settings=settings,
        network=network,
        support=support,
        self_check=self_check,
        restarts=attempt,
        history=history,
        cpu_s=time.process_time() - cpu,
        wall_s=time.perf_counter() - wall,
    )


def _paths_of(
    source: PointCloud | PathNetwork, config: TrainingConfig
) -> tuple[PointCloud, PathNetwork]:
    """Returns the waypoints and their network.

    Raises:
        ConfigurationError: If no field of the position alone can follow it.
    """
    if isinstance(source, PathNetwork):
        if config.of_path != {}:
            given = ", ".join(config.of_path)
            raise ConfigurationError(f"{given}: a network has its own; find_paths takes it")
        network = source
        step = SUPPORT_SPACING * SIGMA_DEFAULT * network.unit_length
        lines = [line.sample(max(3, round(line.length / step))) for line in network.path.pieces]
        cloud = PointCloud(np.concatenate(lines))
    else:
        cloud, network = source, find_paths(source, **config.of_path)
    for piece in range(network.num_pieces):
        if not (network.is_simple(piece) or config.anyway):
            doubt = f" (unsure: {network.unsure})" if network.unsure else ""
            raise ConfigurationError(
                f"piece {piece + 1} is a {network.describe(piece)}{doubt}: no field of the "
                "position alone follows it; --anyway (anyway=True) trains one all the same"
            )
    return cloud, network


def _train_once(
    cloud: PointCloud,
    network: PathNetwork,
    support: Support,
    settings: Settings,
    score: ScoreNetwork | None,
    progress: Progress,
) -> tuple[GuidingField, pd.DataFrame]:
    if settings.recipe == "paper":
        # To the letter: from the waypoints as they are.
        parts = _fit_paper(cloud.normalize(cloud.points), settings, score, progress)
        points = ends = None
    else:
        parts = _fit_robust(support, settings, score, progress)
        points = cloud.denormalize(support.points)
        ends = cloud.denormalize(support.ends) if len(support.ends) else None
    provenance: dict[str, Any] = {"training": asdict(settings)}
    if score is not None:
        provenance["score"] = "given"
    field = GuidingField(
        cloud=cloud,
        sigma=settings.sigma_min,
        score_model=parts.score_model,
        tangent_network=parts.tangent.to_perceptron(),
        composition=parts.composition,
        recipe=settings.recipe,
        seed=settings.seed,
        support=points,
        end_points=ends,
        path_network=network,
        provenance=provenance,
    )
    return field, pd.concat(parts.histories, ignore_index=True)


@dataclass(frozen=True, eq=False)
class _Parts:
    """What an attempt leaves behind."""

    score_model: ScoreNetwork | GaussianMixture
    tangent: Network
    composition: Composition
    histories: list[pd.DataFrame]


def _fit_paper(
    points: FloatArray, settings: Settings, score: ScoreNetwork | None, progress: Progress
) -> _Parts:
    """Algorithms 1 and 2 to the letter; the network of paths is not asked."""
    dim = points.shape[1]
    data = torch.as_tensor(points, dtype=torch.float32)
    score, histories = learn_score(data, settings, score, progress)
    tangent = Network(dim, settings.tangent_hidden, dim)
    losses = paper_tangent_loss(
        tangent,
        frozen_score(score),
        data,
        NoiseSchedule(settings.sigma_min),
        settings.gain,
        PAPER_BATCH_SIZE,
        settings.weights,
    )
    steps = Optimization(settings.tangent_iterations, PAPER_LEARNING_RATE)
    histories.append(optimize(tangent, losses, steps, "tangent", progress))
    return _Parts(score, tangent, PaperComposition(settings.gain), histories)


def _fit_robust(
    support: Support, settings: Settings, score: ScoreNetwork | None, progress: Progress
) -> _Parts:
    """The robust recipe, and the exact one: the same tangent on the closed-form score."""
    points = support.points
    dim = points.shape[1]
    data = torch.as_tensor(points, dtype=torch.float32)
    sigma = settings.sigma_min
    histories: list[pd.DataFrame] = []
    score_model: ScoreNetwork | GaussianMixture
    if settings.recipe == "exact":
        score_model = GaussianMixture(points, sigma)
        frozen: Function = lambda x: mixture_score(x, sigma, data)  # noqa: E731
    else:
        score_model, histories = learn_score(data, settings, score, progress)
        frozen = frozen_score(score_model)

    hint = torch.as_tensor(support.tangents, dtype=torch.float32)
    tangent = Network(
        dim,
        settings.tangent_hidden,
        dim,
        settings.num_frequencies,
        settings.frequency_std,
        scaled=True,
    )
    losses = robust_tangent_loss(
        tangent, frozen, data, hint, sigma, ROBUST_BATCH_SIZE, settings.weights
    )
    steps = Optimization(
        settings.tangent_iterations,
        ROBUST_TANGENT_LEARNING_RATE,
        ROBUST_WARMUP,
        cosine=True,
    )
    histories.append(optimize(tangent, losses, steps, "tangent", progress))
    composition = RobustComposition(settings.gain, sigma, projects=settings.projection)
    return _Parts(score_model, tangent, composition, histories)


@contextmanager
def _torch_session(seed: int, attempt: int) -> Iterator[None]:
    """Seeds torch for one attempt on one thread, and leaves its global state as it was.

    One thread: networks this small are no faster on two, and sums stay in one order.
    """
    threads = torch.get_num_threads()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(np.random.SeedSequence([seed, attempt]).generate_state(1)[0]))
        torch.set_num_threads(1)
        try:
            yield
        finally:
            torch.set_num_threads(threads)
