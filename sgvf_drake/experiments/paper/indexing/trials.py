"""What the order of waypoints decides: the curve through them, and the trained field."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sgvf_drake.experiments.follow import PATIENCE, follow
from sgvf_drake.experiments.paper.baselines.measures import coverage, find_ways
from sgvf_drake.experiments.paper.baselines.methods import CASES, make_case
from sgvf_drake.experiments.paper.baselines.trials import KEPT, TRAJECTORIES
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import FloatArray, FourierCurve, LagrangeCurve
from sgvf_drake.fields.classical import Curve
from sgvf_drake.metrics import default_duration
from sgvf_drake.paths import PointCloud, ReferencePath

FIELD = "field.safetensors"
CURVES: dict[str, type[Curve]] = {"fourier": FourierCurve, "lagrange": LagrangeCurve}
# Points of a curve at which its length and its distance from the path are taken; between two
# waypoints of 200 there are a hundred.
SAMPLES = 20_001


@dataclass(frozen=True)
class CurveTrial:
    """A curve through waypoints in the order in which they are given.

    Attributes:
        case: "ordered", "shuffled" or "branching", one of `CASES`.
        curve: One of `CURVES`.
        thinning: Every how many-th waypoint along the path is taken.
        seed: Of the order.
    """

    case: str
    curve: str
    thinning: int
    seed: int


@dataclass(frozen=True)
class LearnedTrial:
    """A field that is trained on waypoints in one order.

    Attributes:
        case: "ordered", "shuffled" or "branching", one of `CASES`.
        recipe: Of the training.
        seed: Of the order and of the training.
        starts: Number of agents on a grid over the box.
    """

    case: str
    recipe: str
    seed: int
    starts: int


def measure_curve(trial: CurveTrial, folder: Path) -> Row:
    """Measures a curve against the path that its waypoints come from; leaves nothing.

    Returns:
        waypoints; length_ratio, the length of the curve over that of the path; farthest_u,
        the largest distance of the curve from the path, U.
    """
    cloud, path = make_waypoints(trial)
    x = curve_points(trial.curve, cloud)
    return {
        "waypoints": cloud.num_points,
        "length_ratio": float(np.linalg.norm(np.diff(x, axis=0), axis=1).sum())
        / float(path.lengths.sum()),
        "farthest_u": float(path.project(x).distance.max()) / cloud.unit_length,
    }


def measure_learned(trial: LearnedTrial, folder: Path) -> Row:
    """Trains a field and follows it; leaves it, and the trajectories as `measure_baseline`.

    Returns:
        success and coverage, the share of agents that succeed and of waypoints they pass.
    """
    # Imported here: what was trained before is shown without torch.
    from sgvf_drake.learning import TrainingConfig, train

    cloud, path = make_case(CASES[trial.case], trial.seed)
    settings: dict[str, Any] = {"recipe": trial.recipe, "seed": trial.seed}
    # One attempt: at a fork, the self-check finds a fault in whatever was trained.
    field = train(cloud, TrainingConfig(**settings, max_restarts=0)).field
    unit = cloud.unit_length
    duration = PATIENCE.get(trial.recipe, 1.0) * default_duration(path, unit)
    run = follow(field, path, trial.starts, duration)
    ways = find_ways(run, path, unit)
    field.save(folder / FIELD)
    np.savez_compressed(
        folder / TRAJECTORIES,
        points=cloud.normalize(cloud.points),
        positions=cloud.normalize(run.positions[::KEPT]).astype(np.float32),
        good=ways.good,
    )
    return {"success": float(ways.good.mean()), "coverage": coverage(run, ways, cloud)}


def make_waypoints(trial: CurveTrial) -> tuple[PointCloud, ReferencePath]:
    """Returns the waypoints of a trial in their order, and the path.

    Shuffled waypoints are the ordered ones in another order.
    """
    shuffled = trial.case == "shuffled"
    cloud, path = make_case(CASES["ordered" if shuffled else trial.case], trial.seed)
    points = cloud.points[:: trial.thinning]
    if shuffled:
        points = np.random.default_rng([trial.seed, 3]).permutation(points)
    return PointCloud(points), path


def curve_points(curve: str, cloud: PointCloud) -> FloatArray:
    """Returns points (n, 2) of the closed curve through all waypoints, in their unit."""
    through = CURVES[curve].through(cloud)
    w = np.linspace(0, through.length, SAMPLES)
    return cloud.denormalize(through.derivatives(w, 0)[0])
