"""The paper's claims about its losses (Section V-C), as measures of a field.

Without the unit length loss: how long v and m are, and whether v is longer near the path than
away from it.  Without orthogonality: whether v leads along the path, or off it.
"""

from dataclasses import replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.experiments.paper.ablation.along_path import PathSamples
from sgvf_drake.experiments.simulation import simulate_agents
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import GuidingField, NormalisedComposition
from sgvf_drake.fields.vectors import component_along, cosine
from sgvf_drake.metrics import SETTLE_DISTANCE
from sgvf_drake.paths import ReferencePath

# Points along each axis of the grid over the box.
GRID_SIZE = 121
# Near the path: within so many U; away from it: farther than that.
NEAR, AWAY = 0.1, 1.0
# Distances from the path, on both sides, at which it is asked whether v leads along it, U.
BESIDE = (0.05, 0.1, 0.2, 0.3)
# Agents that go where v points, how far they go, and the step of their simulation, U.
AGENTS = 60
WAY = 3.0
STEP = 0.05
# k_s so small that nothing is left of the score in m = s + v.
NO_SCORE = 1e-12


def lengths_row(field: GuidingField, reference: ReferencePath, samples: PathSamples) -> Row:
    """Measures how long v and m are, on the path and over the box.

    Args:
        field: The field, planar.
        reference: The true path.
        samples: Of the path.

    Returns:
        v_path, v_path_min, v_path_max, and the same of m: mean and extremes on the path;
        v_box, v_box_sd, v_box_min, v_box_max: of |v| on a grid over the box; m_error: the
        root mean square of |m| - 1 there; v_near, v_away: mean |v| at the points of the
        grid that are `NEAR` the path and `AWAY` from it; fading: the one over the other;
        leads_near, leads_away: the share of these points at which v is longer than s.
    """
    x = _grid(field)
    s, v = field.components(x)
    length = np.linalg.norm(v, axis=1)
    leads = length > np.linalg.norm(s, axis=1)
    error = np.linalg.norm(s + v, axis=1) - 1
    distance = reference.project(x).distance / field.cloud.unit_length
    near, away = distance < NEAR, distance > AWAY
    s_path, v_path = field.components(samples.points)
    return {
        **_extremes("v_path", np.linalg.norm(v_path, axis=1)),
        **_extremes("m_path", np.linalg.norm(s_path + v_path, axis=1)),
        **_extremes("v_box", length),
        "v_box_sd": float(length.std()),
        "m_error": float(np.sqrt((error**2).mean())),
        "v_near": float(length[near].mean()),
        "v_away": float(length[away].mean()),
        "fading": float(length[near].mean() / length[away].mean()),
        "leads_near": float(leads[near].mean()),
        "leads_away": float(leads[away].mean()),
    }


def _grid(field: GuidingField) -> FloatArray:
    lower, upper = field.cloud.box
    axes = [np.linspace(lower[k], upper[k], GRID_SIZE) for k in range(2)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def _extremes(name: str, values: FloatArray) -> Row:
    return {
        name: float(values.mean()),
        f"{name}_min": float(values.min()),
        f"{name}_max": float(values.max()),
    }


def drift_row(field: GuidingField, reference: ReferencePath, samples: PathSamples) -> Row:
    """Measures whether v leads along the path or off it.

    Returns:
        beside_cosine: mean |cos(s, v)| at distances `BESIDE` from the path; outward: the
        mean component of v / |v| away from the path there; kept: the share of agents that
        stay within `SETTLE_DISTANCE` of the path as they go `WAY` where v points, from the
        path on; drift_u: their mean distance from the path in the end, U.
    """
    unit = field.cloud.unit_length
    x, away = _beside(samples, unit)
    s, v = field.components(x)
    distance = _follow_tangent(field, reference, samples) / unit
    return {
        "beside_cosine": float(np.abs(cosine(s, v)).mean()),
        # Along v, whose length it is divided by.
        "outward": float(component_along(v, away).mean()),
        "kept": float((distance.max(axis=0) <= SETTLE_DISTANCE).mean()),
        "drift_u": float(distance[-1].mean()),
    }


def _beside(samples: PathSamples, unit: float) -> tuple[FloatArray, FloatArray]:
    """Returns points on both sides of a planar path, and unit vectors away from it."""
    normals = samples.tangents[:, ::-1] * [1.0, -1.0]
    away = np.concatenate([side * normals for side in (-1, 1) for _ in BESIDE])
    distances = np.tile(np.repeat(BESIDE, len(normals)), 2)[:, None]
    return np.tile(samples.points, (2 * len(BESIDE), 1)) + distances * unit * away, away


def _follow_tangent(
    field: GuidingField, reference: ReferencePath, samples: PathSamples
) -> FloatArray:
    """Returns the distances (T, n) of agents that go where v points, from the path on."""
    direction = replace(field, composition=NormalisedComposition(NO_SCORE))
    starts = samples.points[
        np.linspace(0, len(samples.points), AGENTS, endpoint=False).astype(int)
    ]
    _, positions, _ = simulate_agents(
        direction, starts, field.cloud.unit_length, way=WAY, step=STEP, log_period=STEP
    )
    return reference.project(positions.reshape(-1, 2)).distance.reshape(-1, AGENTS)
