"""Polylines as arrays of vertices (n, d)."""

import numpy as np

from sgvf_drake.arrays import FloatArray


def arc_lengths(path: FloatArray) -> FloatArray:
    """The arc length at each vertex, (n,)."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def points_at(path: FloatArray, s: FloatArray) -> FloatArray:
    """The points (m, d) at arc lengths (m,)."""
    arc = arc_lengths(path)
    return np.column_stack([np.interp(s, arc, coordinate) for coordinate in path.T])


def aim(path: FloatArray, near: float, far: float) -> tuple[FloatArray, FloatArray]:
    """The point (d,) at one arc length, and the step (d,) from there to another.

    Where the polyline is shorter, they are at its half and at its end.
    """
    far = min(far, float(arc_lengths(path)[-1]))
    first, second = points_at(path, np.array([min(near, far / 2), far]))
    return first, second - first


def signed_area(loop: FloatArray) -> float:
    """Twice the signed area of a closed polyline in its first two coordinates."""
    x, y = loop[:, :2].T
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1))
