"""Waypoints from a score network alone: the ridge of the density, to which it points.

A planar score is followed from a grid over the box of the paper's shapes: along itself until
the ridge is near, then only across (Ozertem and Erdogmus, JMLR 2011), as the rest of it would
carry the points along the path to its densest places.
"""

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.clouds.point_cloud import BOX_FACTOR, HALF_EXTENT_UNITS
from sgvf_drake.fields.importing import steepest_fall
from sgvf_drake.fields.mixture import GaussianMixture
from sgvf_drake.fields.perceptron import ScoreNetwork

# The box of the paper's shapes, +-5, in the unit of its networks.
BOX_HALF_SIZE = BOX_FACTOR * HALF_EXTENT_UNITS
STARTS_PER_SIDE = 40
# So many of the largest steps cross the box from corner to corner.
CLIMB_STEPS = 30
LARGEST_STEP = 0.5
# The score of a noise level of 1 falls by 1 per unit of length; a path's falls faster.
SMALLEST_STEEPNESS = 1.0
# A badly learned score has side ridges, which are less steep: their noise level, for how near
# a ridge is, is at most three times the paper's.
FARTHEST_NEAR = 0.3
# Waypoints nearer to each other than this are thinned out.
SPACING = 0.1
FEWEST_POINTS = 3


def recover_waypoints(model: ScoreNetwork | GaussianMixture) -> tuple[FloatArray, str]:
    """Returns the waypoints that a planar score was trained on, as far as it shows them.

    Args:
        model: The score, of two dimensions, in the unit of the paper's shapes.

    Returns:
        Waypoints on its ridge, (N, 2), and "score"; or, where there are fewer than three,
        a square whose box is that of the paper's shapes, and "box".
    """
    points = _thinned(_ridge(model), SPACING)
    if len(points) < FEWEST_POINTS:
        return _square(), "box"
    return points, "score"


def _ridge(model: ScoreNetwork | GaussianMixture) -> FloatArray:
    """Returns where the climbs from the grid end, of those that reach a ridge, (n, 2)."""
    side = np.linspace(-BOX_HALF_SIZE, BOX_HALF_SIZE, STARTS_PER_SIDE)
    x = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    for _ in range(CLIMB_STEPS):
        score, across, steepness = steepest_fall(model, x)
        near = _is_near(score, steepness)
        along_normal = (score * across).sum(axis=1, keepdims=True) * across
        # As mean shift: a score that falls by 1/sigma^2 is off its zero by sigma^2 |S|.
        step = np.where(near[:, None], along_normal, score)
        step /= np.maximum(steepness, SMALLEST_STEEPNESS)[:, None]
        length = np.linalg.norm(step, axis=1, keepdims=True)
        step *= LARGEST_STEP / np.maximum(length, LARGEST_STEP)
        x = np.clip(x + step, -BOX_HALF_SIZE, BOX_HALF_SIZE)
    score, _, steepness = steepest_fall(model, x)
    arrived = _is_near(score, steepness) & (steepness > SMALLEST_STEEPNESS)
    return x[arrived & (np.abs(x) < BOX_HALF_SIZE).all(axis=1)]


def _is_near(score: FloatArray, steepness: FloatArray) -> BoolArray:
    """Whether the score tells less than a noise level to go, (n,)."""
    size = np.linalg.norm(score, axis=1)
    # sigma^2 |S| < sigma, where sigma^2 is one over the steepness; and not far in any case.
    near: BoolArray = (size < np.sqrt(np.maximum(steepness, 0))) & (
        size < FARTHEST_NEAR * steepness
    )
    return near


def _thinned(points: FloatArray, spacing: float) -> FloatArray:
    """Returns points of which no two are nearer than `spacing`."""
    if len(points) == 0:
        return points
    neighbours = cKDTree(points).query_ball_point(points, spacing)
    free = np.ones(len(points), bool)
    kept = []
    for number, near in enumerate(neighbours):
        if free[number]:
            kept.append(number)
            free[near] = False
    return points[kept]


def _square() -> FloatArray:
    """Returns the outline of the square of half-extent 4, one unit apart: its box is +-5."""
    size = HALF_EXTENT_UNITS
    along = np.arange(-size, size)
    edge = np.column_stack([along, np.full(len(along), -size)])
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    return np.concatenate([edge @ np.linalg.matrix_power(turn, n) for n in range(4)])
