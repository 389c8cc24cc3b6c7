"""The ridge of a cloud's density: where the score has no part across the path.

For the density p of the waypoints, smoothed by a Gaussian of standard deviation sigma, the
ridge is the set where the part of grad log p across the path vanishes.  Points climb to it by
subspace-constrained mean shift (Ozertem and Erdogmus, JMLR 2011): the mean of the waypoints
around a point, seen from it, is sigma^2 times the score; its part along the direction in which
those waypoints spread most is left out, so that points do not gather where the path is densest.
"""

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.compiling import kernel

THINNING_CELL = 0.4
"""Waypoints are averaged over cells of this many sigma: what is lost is far below sigma."""

KERNEL_REACH = 4.0
"""Waypoints farther than this many sigma have a weight of less than e^-8."""

MOST_STEPS = 60
STEP_TOLERANCE = 2e-3
"""A climb ends with a step below this many sigma, or after the most steps."""

LEAST_MASS = 0.12
"""Ridge points with less than this share of the median density belong to strays."""

DISTANCE = 0.35
"""Ridge points are kept this many sigma apart."""


def find_ridge(points: FloatArray, weights: FloatArray, sigma: float) -> FloatArray:
    """Returns points on the ridge of weighted waypoints (N, d), (N,) at the scale `sigma`.

    They are `DISTANCE` sigma apart or more, (n, d), in no order; those of strays are left out.
    """
    cells, weights = thin(points, weights, THINNING_CELL * sigma)
    # The square root keeps a place where a robot stood still from ruling its surroundings.
    climbed, mass = climb(cells, cells, np.sqrt(weights), sigma)
    dense = mass > LEAST_MASS * np.median(mass)
    return climbed[dense][_spread(climbed[dense], mass[dense], DISTANCE * sigma)]


def thin(points: FloatArray, weights: FloatArray, cell: float) -> tuple[FloatArray, FloatArray]:
    """Returns the mean point of each occupied cell of a grid, and the weight of the cell."""
    _, member = np.unique(np.floor(points / cell), axis=0, return_inverse=True)
    member = member.reshape(-1)
    total = np.bincount(member, weights)
    means = np.column_stack([np.bincount(member, weights * x) / total for x in points.T])
    return means, np.asarray(total, dtype=np.float64)


def climb(
    starts: FloatArray, points: FloatArray, weights: FloatArray, sigma: float
) -> tuple[FloatArray, FloatArray]:
    """Moves starts (n, d) to the ridge of weighted points (N, d), (N,).

    Returns:
        Where they arrive, (n, d), and the density there, (n,), not normalised.
    """
    # Neighbours are looked for in a window along the axis on which the points spread most.
    axis = int(np.ptp(points, axis=0).argmax())
    order = np.argsort(points[:, axis], kind="stable")
    return _climb(
        np.ascontiguousarray(starts),
        np.ascontiguousarray(points[order]),
        np.ascontiguousarray(weights[order]),
        sigma,
        axis,
    )


@kernel
def _climb(
    starts: FloatArray, points: FloatArray, weights: FloatArray, sigma: float, axis: int
) -> tuple[FloatArray, FloatArray]:
    count, dim = starts.shape
    reached, mass = starts.copy(), np.zeros(count)
    window = KERNEL_REACH * sigma
    sorted_axis = points[:, axis].copy()
    mean, tangent = np.zeros(dim), np.zeros(dim)
    spread = np.zeros((dim, dim))
    for i in range(count):
        x = reached[i]
        for _ in range(MOST_STEPS):
            first = np.searchsorted(sorted_axis, x[axis] - window)
            last = np.searchsorted(sorted_axis, x[axis] + window)
            total = 0.0
            mean[:] = 0.0
            spread[:] = 0.0
            for j in range(first, last):
                squared = 0.0
                for k in range(dim):
                    squared += (points[j, k] - x[k]) ** 2
                if squared >= window**2:
                    continue
                w = weights[j] * np.exp(-0.5 * squared / sigma**2)
                total += w
                for k in range(dim):
                    away = points[j, k] - x[k]
                    mean[k] += w * away
                    for m in range(k + 1):
                        spread[k, m] += w * away * (points[j, m] - x[m])
            if total <= 0.0:
                break
            for k in range(dim):
                mean[k] /= total
            for k in range(dim):
                for m in range(k + 1):
                    spread[k, m] = spread[k, m] / total - mean[k] * mean[m]
                    spread[m, k] = spread[k, m]
            if dim == 2:
                angle = 0.5 * np.arctan2(2 * spread[0, 1], spread[0, 0] - spread[1, 1])
                tangent[0], tangent[1] = np.cos(angle), np.sin(angle)
            else:
                tangent[:] = np.linalg.eigh(spread)[1][:, -1]
            along = 0.0
            for k in range(dim):
                along += mean[k] * tangent[k]
            moved = 0.0
            for k in range(dim):
                step = mean[k] - along * tangent[k]
                x[k] += step
                moved += step * step
            mass[i] = total
            if moved < (STEP_TOLERANCE * sigma) ** 2:
                break
    return reached, mass


def _spread(points: FloatArray, mass: FloatArray, distance: float) -> IntArray:
    """Chooses points `distance` apart, the densest first."""
    neighbours = cKDTree(points).query_ball_point(points, distance)
    free = np.ones(len(points), bool)
    chosen = []
    for i in np.argsort(-mass, kind="stable"):
        if free[i]:
            chosen.append(i)
            free[neighbours[i]] = False
    return np.array(chosen, dtype=np.intp)
