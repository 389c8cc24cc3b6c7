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
from sgvf_drake.fields import DirectedField, GuidingField, ScoreNetwork
from sgvf_drake.learning.config import Settings, TrainingConfig
from sgvf_drake.learning.recipes import RECIPES
from sgvf_drake.learning.recipes.robust import composition
from sgvf_drake.learning.route_check import check_directed
from sgvf_drake.learning.score_stage import check_given_score
from sgvf_drake.learning.self_check import SelfCheck, check_field
from sgvf_drake.learning.strands import StrandSupport, find_strands
from sgvf_drake.learning.support import SIGMA_DEFAULT, SUPPORT_SPACING, Support, find_support
from sgvf_drake.paths import PathNetwork
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.progress import Progress, no_progress


@dataclass(frozen=True, eq=False)
class TrainingResult:
    """A trained field and how it came about.

    Attributes:
        field: The field of the last attempt; check `self_check.passed`.  A `DirectedField`
            if the paths branch or cross.
        settings: The configuration with every value filled in, those of the first attempt.
        network: What was found in the waypoints.
        support: The points that were learned from.
        self_check: What following the field from the path itself showed.
        restarts: How many attempts failed their self-check before this one.
        history: Loss terms: columns stage, iteration, one a term, total.
        cpu_s: Processor time of all attempts, seconds.
        wall_s: Elapsed time of all attempts, seconds.
    """

    field: GuidingField | DirectedField
    settings: Settings
    network: PathNetwork
    support: Support | StrandSupport
    self_check: SelfCheck
    restarts: int
    history: pd.DataFrame
    cpu_s: float
    wall_s: float

    @property
    def guiding_field(self) -> GuidingField:
        """The field, where it is one of the position alone.

        Raises:
            ConfigurationError: If it is a directed field.
        """
        if isinstance(self.field, DirectedField):
            raise ConfigurationError(
                f"the paths are a {self.network.describe(0)}, and their field a directed one"
            )
        return self.field


def train(
    source: PointCloud | PathNetwork,
    config: TrainingConfig | None = None,
    progress: Progress = no_progress,
    score: ScoreNetwork | None = None,
) -> TrainingResult:
    """Trains a guiding field for a cloud of waypoints, or for a network that was found in one.

    Paths that branch or cross get a directed field m(x, g), all others one of the position
    alone.

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
            paths branch or cross, which no field of this recipe can follow.
    """
    wall, cpu = time.perf_counter(), time.process_time()
    config = config or TrainingConfig()
    recipe = RECIPES[config.recipe]
    cloud, network = _paths_of(source, config)
    directed = not config.anyway and not all(map(network.is_simple, range(network.num_pieces)))
    if directed and recipe.strand_defaults is None:
        raise ConfigurationError(_no_stateless_field(network, config.recipe))
    if score is not None:
        check_given_score(score, recipe, cloud.dim)
        if directed:
            raise ConfigurationError(
                "score is not for paths that branch or cross, whose field has no score network"
            )
    support: Support | StrandSupport
    if directed:
        support = find_strands(cloud, network, config.sigma_min)
    else:
        support = find_support(cloud, network, config.sigma_min)
    settings = config.resolved(support.sigma, dim=cloud.dim, directed=directed)
    for attempt in range(settings.max_restarts + 1):
        own = settings.grown(attempt)
        with _torch_session(settings.seed, attempt):
            field: GuidingField | DirectedField
            if isinstance(support, StrandSupport):
                field, history = _train_directed(cloud, network, support, own, progress)
                self_check = check_directed(field)
            else:
                field, history = _train_once(cloud, network, support, own, score, progress)
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
    """Returns the waypoints and their network."""
    if not isinstance(source, PathNetwork):
        return source, find_paths(source, **config.of_path)
    if config.of_path != {}:
        given = ", ".join(config.of_path)
        raise ConfigurationError(f"{given}: a network has its own; find_paths takes it")
    step = SUPPORT_SPACING * SIGMA_DEFAULT * source.unit_length
    lines = [line.sample(max(3, round(line.length / step))) for line in source.path.pieces]
    return PointCloud(np.concatenate(lines)), source


def _no_stateless_field(network: PathNetwork, recipe: str) -> str:
    """Says why a recipe of fields of the position alone refuses a network."""
    piece = next(k for k in range(network.num_pieces) if not network.is_simple(k))
    doubt = f" (unsure: {network.unsure})" if network.unsure else ""
    return (
        f"piece {piece + 1} is a {network.describe(piece)}{doubt}: no field of the position "
        f"alone, as of the recipe {recipe}, follows it; --anyway (anyway=True) trains one all "
        "the same"
    )


def _train_once(
    cloud: PointCloud,
    network: PathNetwork,
    support: Support,
    settings: Settings,
    score: ScoreNetwork | None,
    progress: Progress,
) -> tuple[GuidingField, pd.DataFrame]:
    recipe = RECIPES[settings.recipe]
    learned_from = support.points if recipe.uses_paths else cloud.normalize(cloud.points)
    fitted = recipe.fit(learned_from, support.tangents, settings, score, progress)
    provenance: dict[str, Any] = {"training": asdict(settings)}
    if score is not None:
        provenance["score"] = "given"
    has_ends = recipe.uses_paths and len(support.ends) > 0
    field = GuidingField(
        cloud=cloud,
        sigma=settings.sigma_min,
        score_model=fitted.score_model,
        tangent_network=fitted.tangent_network,
        composition=fitted.composition,
        recipe=settings.recipe,
        seed=settings.seed,
        support=cloud.denormalize(support.points) if recipe.uses_paths else None,
        end_points=cloud.denormalize(support.ends) if has_ends else None,
        path_network=network,
        provenance=provenance,
    )
    return field, pd.concat(fitted.histories, ignore_index=True)


def _train_directed(
    cloud: PointCloud,
    network: PathNetwork,
    support: StrandSupport,
    settings: Settings,
    progress: Progress,
) -> tuple[DirectedField, pd.DataFrame]:
    recipe = RECIPES[settings.recipe]
    strands, histories = recipe.fit_strands(support.mixture, settings, progress)
    field = DirectedField(
        cloud=cloud,
        sigma=settings.sigma_min,
        strands=strands,
        composition=composition(settings),
        recipe=settings.recipe,
        seed=settings.seed,
        support=cloud.denormalize(support.mixture.points),
        end_points=cloud.denormalize(support.ends) if len(support.ends) else None,
        path_network=network,
        provenance={"training": asdict(settings)},
    )
    empty = pd.DataFrame({"stage": [], "iteration": [], "total": []})
    return field, pd.concat(histories, ignore_index=True) if histories else empty


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
