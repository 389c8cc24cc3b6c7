"""From a cloud of waypoints to a trained guiding field."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
import time

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree
import torch
from torch import Tensor

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
from sgvf_drake.learning.direction import directed
from sgvf_drake.learning.networks import Network
from sgvf_drake.learning.optimization import Optimization, optimize
from sgvf_drake.learning.orientation import orientation_hint
from sgvf_drake.learning.schedule import NoiseSchedule
from sgvf_drake.learning.score_matching import (
    mixture_score,
    paper_score_loss,
    robust_score_loss,
)
from sgvf_drake.learning.self_check import SelfCheck, check_field
from sgvf_drake.learning.support import Support, find_support
from sgvf_drake.learning.tangent import Score, paper_tangent_loss, robust_tangent_loss
from sgvf_drake.paths import PointCloud
from sgvf_drake.progress import Progress, no_progress

# Paper, Section V-A.
PAPER_BATCH_SIZE = 512
PAPER_LEARNING_RATE = 1e-3

ROBUST_BATCH_SIZE = 256
ROBUST_SCORE_LEARNING_RATE = 1e-2
ROBUST_TANGENT_LEARNING_RATE = 5e-3
ROBUST_WARMUP = 50
ROBUST_FREQUENCIES = 32


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """A trained field and how it came about.

    Attributes:
        field: The field of the last attempt; check `self_check.passed`.
        settings: The configuration with every value filled in, those of the first attempt.
        support: The points that were learned from, and the scales that were found.
        self_check: What following the field from the path itself showed.
        restarts: How many attempts failed their self-check before this one.
        history: Loss terms: columns stage, iteration, one a term, total.
        cpu_s: Processor time of all attempts, seconds.
        wall_s: Elapsed time of all attempts, seconds.
    """

    field: GuidingField
    settings: Settings
    support: Support
    self_check: SelfCheck
    restarts: int
    history: pd.DataFrame
    cpu_s: float
    wall_s: float


def train(
    cloud: PointCloud,
    config: TrainingConfig | None = None,
    progress: Progress = no_progress,
) -> TrainingResult:
    """Trains a guiding field for a cloud of waypoints.

    After training, the field is followed from every piece and from around it; where that
    fails, training starts again with another seed, wider networks and more iterations, at
    most ``max_restarts`` times.  A field that fails to the end is returned all the same,
    with ``self_check.passed`` false.

    Args:
        cloud: The waypoints, in any order and any unit.
        config: The recipe and its overrides; None: the robust recipe, seed 0.
        progress: Called with (stage, done, total) now and then.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    config = config or TrainingConfig()
    support = _directed_support(cloud, config)
    settings = config.resolved(support.sigma)
    for attempt in range(settings.max_restarts + 1):
        with _torch_session(settings.seed, attempt):
            field, history = _train_once(cloud, support, settings.grown(attempt), progress)
        self_check = check_field(field, support)
        if self_check.passed:
            break
    return TrainingResult(
        field=field,
        settings=settings,
        support=support,
        self_check=self_check,
        restarts=attempt,
        history=history,
        cpu_s=time.process_time() - cpu,
        wall_s=time.perf_counter() - wall,
    )


def _directed_support(cloud: PointCloud, config: TrainingConfig) -> Support:
    closed = None if config.open is None else not config.open
    support = find_support(cloud.normalize(cloud.points), config.sigma_min, closed)
    start = None
    if config.start is not None:
        if len(config.start) != cloud.dim:
            raise ConfigurationError(
                f"start has {len(config.start)} coordinates, the waypoints have {cloud.dim}"
            )
        start = cloud.normalize(np.array(config.start))
    velocities = None
    if cloud.velocities is not None:
        # Those of the nearest waypoint: the points may be new ones.
        nearest = cKDTree(cloud.points).query(cloud.denormalize(support.points))[1]
        velocities = cloud.velocities[nearest]
    pieces = directed(support.points, support.pieces, config.direction, start, velocities)
    return replace(support, pieces=pieces)


def _train_once(
    cloud: PointCloud, support: Support, settings: Settings, progress: Progress
) -> tuple[GuidingField, pd.DataFrame]:
    if settings.recipe == "paper":
        # To the letter: from the waypoints as they are.
        parts = _fit_paper(cloud.normalize(cloud.points), settings, progress)
        points = ends = None
    else:
        parts = _fit_robust(support, settings, progress)
        points = cloud.denormalize(support.points)
        last = [piece.order[-1] for piece in support.pieces if not piece.closed]
        ends = points[last] if last else None
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
        provenance={"training": asdict(settings)},
    )
    return field, pd.concat(parts.histories, ignore_index=True)


@dataclass(frozen=True, eq=False)
class _Parts:
    """What an attempt leaves behind."""

    score_model: ScoreNetwork | GaussianMixture
    tangent: Network
    composition: Composition
    histories: list[pd.DataFrame]


def _fit_paper(points: FloatArray, settings: Settings, progress: Progress) -> _Parts:
    """Algorithms 1 and 2 to the letter; the spanning tree is not asked."""
    dim = points.shape[1]
    data = torch.as_tensor(points, dtype=torch.float32)
    schedule = NoiseSchedule(settings.sigma_min)
    batch, rate = PAPER_BATCH_SIZE, PAPER_LEARNING_RATE

    score = Network(dim + 1, settings.score_hidden, dim)
    losses = paper_score_loss(score, data, schedule, batch)
    steps = Optimization(settings.score_iterations, rate)
    score_history = optimize(score, losses, steps, "score", progress)

    tangent = Network(dim, settings.tangent_hidden, dim)
    frozen = _score_at_data_end(score, scale=1.0)
    losses = paper_tangent_loss(tangent, frozen, data, schedule, settings.gain, batch)
    steps = Optimization(settings.tangent_iterations, rate)
    tangent_history = optimize(tangent, losses, steps, "tangent", progress)
    return _Parts(
        score_model=ScoreNetwork(score.to_perceptron(), 1.0),
        tangent=tangent,
        composition=PaperComposition(settings.gain),
        histories=[score_history, tangent_history],
    )


def _fit_robust(support: Support, settings: Settings, progress: Progress) -> _Parts:
    """The robust recipe, and the exact one: the same tangent on the closed-form score."""
    points = support.points
    dim = points.shape[1]
    data = torch.as_tensor(points, dtype=torch.float32)
    sigma = settings.sigma_min
    histories = []
    score_model: ScoreNetwork | GaussianMixture
    if settings.recipe == "exact":
        score_model = GaussianMixture(points, sigma)
        frozen: Score = lambda x: mixture_score(x, sigma, data)  # noqa: E731
    else:
        network, history = _fit_robust_score(data, sigma, settings, progress)
        score_model = ScoreNetwork(network.to_perceptron(), sigma)
        frozen = _score_at_data_end(network, scale=sigma)
        histories.append(history)

    hint = torch.as_tensor(orientation_hint(points, support.pieces, sigma), dtype=torch.float32)
    tangent = Network(
        dim, settings.tangent_hidden, dim, ROBUST_FREQUENCIES, settings.frequency_std
    )
    losses = robust_tangent_loss(tangent, frozen, data, hint, sigma, ROBUST_BATCH_SIZE)
    steps = Optimization(
        settings.tangent_iterations,
        ROBUST_TANGENT_LEARNING_RATE,
        ROBUST_WARMUP,
        cosine=True,
    )
    histories.append(optimize(tangent, losses, steps, "tangent", progress))
    composition = RobustComposition(settings.gain, sigma)
    return _Parts(score_model, tangent, composition, histories)


def _fit_robust_score(
    data: Tensor, sigma: float, settings: Settings, progress: Progress
) -> tuple[Network, pd.DataFrame]:
    dim = data.shape[1]
    network = Network(
        dim + 1,
        settings.score_hidden,
        dim,
        ROBUST_FREQUENCIES,
        settings.frequency_std,
        has_time=True,
    )
    losses = robust_score_loss(network, data, NoiseSchedule(sigma), ROBUST_BATCH_SIZE)
    steps = Optimization(
        settings.score_iterations,
        ROBUST_SCORE_LEARNING_RATE,
        ROBUST_WARMUP,
        cosine=True,
    )
    return network, optimize(network, losses, steps, "score", progress)


def _score_at_data_end(network: Network, scale: float) -> Score:
    def score(x: Tensor) -> Tensor:
        with torch.no_grad():
            return network(torch.cat([x, torch.ones(len(x), 1)], dim=1)) / scale

    return score


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
