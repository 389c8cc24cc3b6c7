"""The singularity-free field in one more dimension: the least |chi|, and agents that climb."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.optimize import minimize

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray, plane_grid
from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments.simulation import simulate_agents
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import FourierCurve, ParametricField
from sgvf_drake.metrics import grid_starts
from sgvf_drake.paper.experiment import FOLDER
from sgvf_drake.paths import shape_path

STATES = "states.npz"
# Positions along each axis of the box and parameters along the curve at which |chi| is taken,
# and how many of the places with the least are gone down from.
GRID_POSITIONS, GRID_PARAMETERS = 61, 401
DESCENTS = 20
# Agents that follow a field with a parameter, for so many lengths of its curve, seconds
# between two samples, and steps of the integrator, U at unit speed.
STARTS, LENGTHS, LOG_PERIOD, STEP = 9, 1.2, 0.1, 0.02
# Points of a helix, from where the helices are seen, in degrees, and their colours.
HELIX = 400
ELEVATION, AZIMUTH = 22.0, -58.0
PIECES = (plotting.BLUE, plotting.RED, plotting.GREEN)


@dataclass(frozen=True)
class ParametricTrial:
    """Fields with a parameter, each around so many waypoints on one closed piece of a shape."""

    shape: str
    num_points: int


def measure_parametric(trial: ParametricTrial, folder: Path) -> Row:
    """Looks for the least |chi| of the singularity-free field of each piece; leaves its flow.

    Returns:
        `pieces`: what `least_chi` says of each.
    """
    fields = parametric_fields(trial.shape, trial.num_points)
    flows = {f"piece_{k}": flow(field) for k, field in enumerate(fields)}
    np.savez_compressed(folder / STATES, allow_pickle=False, **flows)
    return {"pieces": [least_chi(field) for field in fields]}


def parametric_fields(shape: str, num_points: int) -> list[ParametricField]:
    """Returns the field around each piece, through the Fourier series of its waypoints."""
    points = [piece.sample(num_points) for piece in shape_path(shape).pieces]
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
    """Searches the box and all of the curve's parameter for the least |chi|.

    Returns:
        The least on a `grid`; the `least` after descents from the lowest of it; the `state`
        (x, y, w) there in normalised units; what follows from the `formula`; and the least
        speed in the `plane`, which is looked for where a robot waits for its point.
    """
    lower, upper = (field.cloud.normalize(corner) for corner in field.cloud.box)
    _, _, x = plane_grid((lower, upper), GRID_POSITIONS)
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
    waiting = np.column_stack([f + f_w / field.gain, w])
    return {
        "grid": norms.min(),
        "least": np.sqrt(best.fun),
        "state": best.x,
        "formula": np.sqrt(1 + (f_w**2).sum(axis=1).min()),
        "plane": np.linalg.norm(chi(field, waiting)[:, :2], axis=1).min(),
    }


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


def plot_helices(axes: Any, trial: pd.Series) -> None:
    """Draws into axes in 3-D the curves of a trial over their parameter w, and its agents."""
    fields = parametric_fields(trial["shape"], trial["num_points"])
    with np.load(trial[FOLDER] / STATES) as stored:
        flows = [stored[name] for name in sorted(stored.files)]
    # Curves are drawn last, since agents are on them most of the time.
    axes.computed_zorder = False
    for number, (field, states) in enumerate(zip(fields, flows, strict=True)):
        color = PIECES[number % len(PIECES)]
        for agent in np.moveaxis(states, 1, 0):
            axes.plot(*agent.T, color=plotting.GREY, linewidth=0.9)
            axes.plot(*agent[:1].T, "o", color=color, markersize=4)
        unit = field.cloud.unit_length
        w = np.linspace(0, states[..., 2].max() / unit, HELIX)
        points = field.cloud.denormalize(field.curve.derivatives(w, 0)[0])
        label = f"piece {number + 1}, and starts"
        axes.plot(*points.T, w * unit, color=color, linewidth=2.2, label=label, zorder=3)
    axes.view_init(ELEVATION, AZIMUTH)
    axes.set(
        xlabel=f"x [{plotting.UNIT}]",
        ylabel=f"y [{plotting.UNIT}]",
        zlabel="parameter w",
        title="(d) the path in one more dimension, and agents",
    )
    axes.legend(loc="upper left", frameon=False)
