"""Trials of the corners: networks of several depths on one polygon, and agents along them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.experiments.follow import FollowResult, follow
from sgvf_drake.fields import GuidingField, ScoreNetwork
from sgvf_drake.lyapunov import find_guiding_zeros
from sgvf_drake.metrics import (
    SETTLE_DISTANCE,
    STALL_SPAN,
    STALL_WINDOW,
    default_duration,
)
from sgvf_drake.paths import PointCloud, ReferencePath
from sgvf_drake.paths.shapes import regular_polygon

RADIUS = 3.0
"""Of the corners, in the unit of the waypoints."""

# Of each of the paper's networks (Section V-A).
PAPER_ITERATIONS = 10_000
# Hidden widths of the tangent: the paper's, and its deeper one (Section VI-B).
PAPER_TANGENTS = {"shallow": (128,), "deep": (64, 64, 64, 64)}
# Samples of the speed along each side, at the middles of equal parts.
SIDE_SAMPLES = 100
# Of the trajectories every fifth sample is kept, one each quarter of U at unit speed.
THINNING = 5

Row = dict[str, Any]


@dataclass(frozen=True)
class CornerTrial:
    """A polygon and a seed.

    Attributes:
        corners: Of the polygon.
        seed: Of the order of the waypoints and of the networks.
        num_points: Waypoints, at equal steps from the first corner.
        starts: Agents that follow each field.
        patience: How many times as long as usual they have, since the paper's fields are
            slow on their path.
        effort: Part of the recipes' iterations.
    """

    corners: int
    seed: int
    num_points: int
    starts: int
    patience: float
    effort: float


def measure_corners(trial: CornerTrial, folder: Path) -> Row:
    """Trains a shallow and a deep tangent on one score of the paper's, and the robust recipe.

    Leaves each field as `NAME.safetensors` and what was seen along it as `NAME.npz`.
    """
    # Imported here: what reads the records does without torch.
    from sgvf_drake.learning import TrainingConfig, train
    from sgvf_drake.learning.config import SCORE_ITERATIONS, TANGENT_ITERATIONS

    path = regular_polygon(trial.corners, RADIUS)
    cloud = polygon_cloud(path, trial)
    score: ScoreNetwork | None = None
    results = {}
    for name, hidden in PAPER_TANGENTS.items():
        iterations = round(trial.effort * PAPER_ITERATIONS)
        config = TrainingConfig(
            recipe="paper",
            seed=trial.seed,
            score_iterations=iterations,
            tangent_hidden=hidden,
            tangent_iterations=iterations,
        )
        results[name] = train(cloud, config, score=score)
        learned = results[name].field.score_model
        assert isinstance(learned, ScoreNetwork)
        score = learned
    robust = TrainingConfig(
        seed=trial.seed,
        score_iterations=round(trial.effort * SCORE_ITERATIONS),
        tangent_iterations=round(trial.effort * TANGENT_ITERATIONS),
    )
    results["robust"] = train(cloud, robust)
    return {
        name: {
            **_measure(result.field, path, trial, folder / name),
            "self_check_passed": result.self_check.passed,
            "restarts": result.restarts,
        }
        for name, result in results.items()
    }


def polygon_cloud(path: ReferencePath, trial: CornerTrial) -> PointCloud:
    """Returns the waypoints of a trial, in random order."""
    points = path.pieces[0].sample(trial.num_points)
    return PointCloud(np.random.default_rng(trial.seed).permutation(points))


def _measure(field: GuidingField, path: ReferencePath, trial: CornerTrial, file: Path) -> Row:
    unit = field.cloud.unit_length
    run = follow(field, path, trial.starts, trial.patience * default_duration(path, unit))
    field.save(file.with_suffix(".safetensors"))
    np.savez_compressed(
        file.with_suffix(".npz"),
        positions=run.positions[::THINNING].astype(np.float32),
        **_along(field, path),
    )
    found = find_guiding_zeros(field)
    s, v = field.components(found.points)
    summary = run.summary()
    return {
        "unit": unit,
        "reached": run.metrics.reached,
        "lapped": run.metrics.lapped,
        "stalled": run.metrics.stalled,
        "paused": paused(run, unit),
        "final": run.positions[-1],
        "rms": summary["cross_track_rms"],
        "max": summary["cross_track_max"],
        "zeros": found.points,
        "zeros_index": [zero.index for zero in found.zeros],
        "zeros_stable": [zero.stable for zero in found.zeros],
        "zeros_score": np.linalg.norm(s, axis=1),
        "zeros_tangent": np.linalg.norm(v, axis=1),
        "undecided": found.undecided,
    }


def paused(run: FollowResult, unit: float) -> BoolArray:
    """Returns who stood still on the path for a while, as one does that stalls, and went on.

    Returns:
        (n,), False for those that stall in the end.
    """
    samples = round(STALL_WINDOW * unit / (run.times[1] - run.times[0])) + 1
    if samples > len(run.times):
        return np.zeros(run.positions.shape[1], bool)
    extent, away = (
        _over_windows(values, samples) for values in (run.positions, run.errors[..., None])
    )
    width = np.linalg.norm(extent[1] - extent[0], axis=2)
    near = away[1][..., 0] <= SETTLE_DISTANCE * unit
    still = (width < STALL_SPAN * unit) & near
    return np.asarray(still.any(axis=0) & ~run.metrics.stalled)


def _over_windows(values: FloatArray, samples: int) -> tuple[FloatArray, FloatArray]:
    """Returns the least and the largest of values (T, n, d) over each window of samples."""
    first = samples // 2
    inside = slice(first, first + len(values) - samples + 1)
    return (
        minimum_filter1d(values, samples, axis=0)[inside],
        maximum_filter1d(values, samples, axis=0)[inside],
    )


def _along(field: GuidingField, path: ReferencePath) -> dict[str, Any]:
    """Returns what the field does along the path, (corners, SIDE_SAMPLES) each, by name.

    |m|, its part along the path, and |v|.  Side k begins at corner k and runs
    counter-clockwise.
    """
    start = path.pieces[0].vertices
    side = np.roll(start, -1, axis=0) - start
    steps = (np.arange(SIDE_SAMPLES) + 0.5) / SIDE_SAMPLES
    points = start[:, None] + steps[:, None] * side[:, None]
    s, v = (part.reshape(points.shape) for part in field.components(points.reshape(-1, 2)))
    direction = side / np.linalg.norm(side, axis=1)[:, None]
    return {
        "speed": np.linalg.norm(s + v, axis=2),
        "progress": np.einsum("kij,kj->ki", s + v, direction),
        "tangent": np.linalg.norm(v, axis=2),
    }
