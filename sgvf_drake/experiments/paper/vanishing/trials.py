"""Trials of score vanishing: the zeros of a learned score, and how large |chi| stays."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.optimize import minimize
from scipy.spatial import cKDTree

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.experiments.simulation import simulate_agents
from sgvf_drake.experiments.singularities import singularity_summary, zero_rows
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import FourierCurve, GuidingField, ParametricField
from sgvf_drake.lyapunov import (
    NEAR_PATH,
    Singularities,
    find_singularities,
    measure_vanishing,
)
from sgvf_drake.metrics import grid_starts
from sgvf_drake.paths import PointCloud, ReferencePath, make_shape, shape_path

FIELD = "field.safetensors"
STATES = "states.npz"

# Of the paper's score (Section V-A).
PAPER_ITERATIONS = 10_000
# Cells along each axis of the box, whose connected parts off the path are its regions.
REGION_CELLS = 201
# Positions along each axis of the box and parameters along the curve at which |chi| is taken,
# and how many of the places with the least are gone down from.
GRID_POSITIONS, GRID_PARAMETERS = 61, 401
DESCENTS = 20
# Agents that follow a field with a parameter, for so many lengths of its curve, seconds
# between two samples, and steps of the integrator, U at unit speed.
STARTS, LENGTHS, LOG_PERIOD, STEP = 9, 1.2, 0.1, 0.02


@dataclass(frozen=True)
class VanishingTrial:
    """A score that is learned of a shape.

    Attributes:
        shape: One of `SHAPES`.
        recipe: `robust`; or `paper`, of which only the score is trained.
        seed: Of the waypoints' order and the networks.
        effort: Part of the recipe's iterations.
    """

    shape: str
    recipe: str
    seed: int
    effort: float


@dataclass(frozen=True)
class ParametricTrial:
    """A field with a parameter around each piece of a shape.

    Attributes:
        shape: One of `SHAPES`, of closed pieces.
        num_points: Waypoints, in order, on each piece.
    """

    shape: str
    num_points: int


def measure_score_zeros(trial: VanishingTrial, folder: Path) -> Row:
    """Finds where a learned score vanishes, and what is there; leaves the field.

    Returns:
        `singularity_summary`, the summary of `measure_vanishing`, the zeros, and the regions
        of the box off the path; see `region_indices`.
    """
    # Imported here: what reads the records does without torch.
    from sgvf_drake.learning import TrainingConfig, train

    cloud, path = make_shape(trial.shape, seed=trial.seed)
    field = train(cloud, TrainingConfig(**_settings(trial))).field
    found = find_singularities(field)
    vanishing = measure_vanishing(field, found, path)
    field.save(folder / FIELD)
    return {
        **singularity_summary(found),
        "sigma": field.mixture.sigma,
        "unit": cloud.unit_length,
        "vanishing": vanishing.summary(),
        "zeros": zero_rows(found, vanishing),
        "regions": region_indices(field, found, path),
    }


def _settings(trial: VanishingTrial) -> dict[str, Any]:
    """Returns the options of the training."""
    from sgvf_drake.learning.config import SCORE_ITERATIONS, TANGENT_ITERATIONS

    if trial.recipe == "paper":
        # The tangent takes most of the time, and is not asked for.
        return {
            "recipe": "paper",
            "seed": trial.seed,
            "score_iterations": round(trial.effort * PAPER_ITERATIONS),
            "tangent_iterations": 1,
        }
    return {
        "seed": trial.seed,
        # The zeros of whatever score comes out are asked for.
        "max_restarts": 0,
        "score_iterations": round(trial.effort * SCORE_ITERATIONS),
        "tangent_iterations": round(trial.effort * TANGENT_ITERATIONS),
    }


def region_indices(
    field: GuidingField, found: Singularities, path: ReferencePath
) -> list[dict[str, int]]:
    """Sums the indices of the zeros of the score over each region of the box off the path.

    A region is a connected part of the box farther from the path than `NEAR_PATH` noise
    levels: a hole, what lies between two pieces, or what is outside of all.

    Returns:
        The Euler characteristic of each (1 less its holes), which is what Poincare and Hopf
        have for a field that points out of the region on the path's side and into the box on
        its border; the sum of the indices; and the number of zeros.
    """
    lower, upper = found.box
    steps = (np.arange(REGION_CELLS) + 0.5) / REGION_CELLS
    cells = lower + np.stack(np.meshgrid(steps, steps, indexing="ij"), -1) * (upper - lower)
    near = NEAR_PATH * field.mixture.sigma
    off = path.project(cells.reshape(-1, 2)).distance > near
    labels, count = ndimage.label(off.reshape(REGION_CELLS, REGION_CELLS))
    inside = labels > 0
    x = found.score.points
    away = path.project(x).distance > near
    indices = np.array([zero.index for zero in found.score.zeros])
    # A zero on the rim may lie in a cell whose middle is nearer to the path.
    of_zero = labels[inside][cKDTree(cells[inside]).query(x)[1]]
    return [
        {
            "euler": 1 - _holes(labels == label),
            "index_sum": int(indices[away & (of_zero == label)].sum()),
            "zeros": int((away & (of_zero == label)).sum()),
        }
        for label in range(1, count + 1)
    ]


def _holes(region: BoolArray) -> int:
    """The number of parts of the rest that do not reach the border of the array."""
    # Cells of a region touch along their sides, so those of the rest may touch at corners.
    _, parts = ndimage.label(np.pad(~region, 1, constant_values=True), np.ones((3, 3)))
    return int(parts) - 1


def measure_parametric(trial: ParametricTrial, folder: Path) -> Row:
    """Looks for the least |chi| of the singularity-free field of each piece; leaves its flow.

    Returns:
        `pieces`: the least on a grid, the least after descents from the lowest of it, the
        state (x, y, w) there in normalised units, what follows from the formula, and the
        least speed in the plane.
    """
    fields = parametric_fields(trial)
    flows = {f"piece_{k}": flow(field) for k, field in enumerate(fields)}
    np.savez_compressed(folder / STATES, allow_pickle=False, **flows)
    return {"pieces": [least_chi(field) for field in fields]}


def parametric_fields(trial: ParametricTrial) -> list[ParametricField]:
    """Returns the field around each piece, through the Fourier series of its waypoints."""
    points = [piece.sample(trial.num_points) for piece in shape_path(trial.shape).pieces]
    # One cloud: the fields share the box and the unit.
    cloud = PointCloud(np.concatenate(points))
    return [ParametricField(cloud, FourierCurve(cloud.normalize(own))) for own in points]


def chi(field: ParametricField, states: FloatArray) -> FloatArray:
    """Returns the field before it is scaled, at normalised states (n, 3).

    chi = (f'(w) - k phi, 1 + k phi . f'(w)) with phi = (x, y) - f(w), so that |chi|^2 =
    1 + |f'|^2 + k^2 |phi|^2 + (k phi . f')^2.
    """
    f, f_w = field.curve.derivatives(states[:, 2], 1)
    return field.chi(states[:, :2] - f, f_w)


def least_chi(field: ParametricField) -> Row:
    """Searches the box and all of the curve's parameter; see `measure_parametric`."""
    lower, upper = (field.cloud.normalize(corner) for corner in field.cloud.box)
    axes = [np.linspace(lower[k], upper[k], GRID_POSITIONS) for k in range(2)]
    x = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    w = np.linspace(0, field.curve.length, GRID_PARAMETERS)
    f, f_w = field.curve.derivatives(w, 1)
    # One parameter at a time, since all of them at once do not fit into the cache.
    norms = np.stack(
        [
            np.linalg.norm(field.chi(x - f[k], np.broadcast_to(f_w[k], x.shape)), axis=1)
            for k in range(len(w))
        ]
    )
    lowest = np.argsort(norms, axis=None)[:DESCENTS]
    k, place = np.unravel_index(lowest, norms.shape)
    found = [
        minimize(lambda state: float((chi(field, state[None]) ** 2).sum()), start, tol=1e-12)
        for start in np.column_stack([x[place], w[k]])
    ]
    best = min(found, key=lambda result: float(result.fun))
    return {
        "grid": norms.min(),
        "least": np.sqrt(best.fun),
        "state": best.x,
        "formula": np.sqrt(1 + (f_w**2).sum(axis=1).min()),
        "plane": _least_in_plane(field, w),
    }


def _least_in_plane(field: ParametricField, w: FloatArray) -> float:
    """The least speed of (x, y): it is looked for where a robot waits for its point."""
    f, f_w = field.curve.derivatives(w, 1)
    waiting = np.column_stack([f + f_w / field.gain, w])
    return float(np.linalg.norm(chi(field, waiting)[:, :2], axis=1).min())


def flow(field: ParametricField) -> FloatArray:
    """Returns the states (T, n, 3) of agents from a grid of starts, in the user's unit."""
    _, states, _ = simulate_agents(
        field,
        field.lift(grid_starts(field.cloud.box, STARTS, 2)),
        field.cloud.unit_length,
        way=LENGTHS * field.curve.length,
        step=STEP,
        log_period=LOG_PERIOD,
    )
    return states
