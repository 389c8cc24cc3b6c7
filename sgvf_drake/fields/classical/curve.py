"""Curves through waypoints in their order, and the nearest point of a curve."""

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Self

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import BoolArray, IntArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.paths import PointCloud

# Points of a curve between two waypoints, of which the nearest is where a search begins.
SAMPLES_PER_STEP = 8
# Newton steps of the search, at most; it ends where one changes w by less than this part of
# a step, since the next would change it by the square of that.
NEWTON_STEPS = 4
CONVERGED = 1e-8
# Of the derivatives: the Jacobian of a field along a curve needs the second.
HIGHEST_ORDER = 2


class Curve(ABC):
    """A smooth curve c(w) through waypoints in the order in which they are given.

    The parameter w runs from 0 to the length of the polyline of the waypoints, by the same
    amount from each to the next, so that |c'| is about 1 where they are evenly spaced.

    Args:
        points: (N, d) waypoints, at least 3 of a closed curve and 2 of an open one.
        closed: Whether the last waypoint is followed by the first.

    Raises:
        ConfigurationError: There are too few waypoints, or all are the same.
    """

    def __init__(self, points: FloatArray, closed: bool = True) -> None:
        fewest = 3 if closed else 2
        if len(points) < fewest or np.ptp(points, axis=0).max() == 0:
            raise ConfigurationError(
                f"a curve needs at least {fewest} waypoints, and not all the same; "
                f"got {len(points)}"
            )
        self.points = np.array(points, dtype=np.float64)
        self.closed = closed

    @classmethod
    def through(
        cls, cloud: PointCloud, order: IntArray | None = None, closed: bool = True
    ) -> Self:
        """Returns the curve through waypoints of a cloud, in its normalised units.

        Args:
            cloud: The waypoints.
            order: Which of them, and in which order; None: all, as they are.
            closed: Whether the last waypoint is followed by the first.
        """
        points = cloud.points if order is None else cloud.points[order]
        return cls(cloud.normalize(points), closed)

    @property
    def knots(self) -> FloatArray:
        """The waypoints, with the first one repeated at the end of a closed curve."""
        return np.concatenate([self.points, self.points[:1]]) if self.closed else self.points

    @cached_property
    def length(self) -> float:
        """The length of the polyline, the largest w."""
        return float(np.linalg.norm(np.diff(self.knots, axis=0), axis=1).sum())

    @cached_property
    def step(self) -> float:
        """The amount of w from one waypoint to the next."""
        return self.length / (len(self.knots) - 1)

    @abstractmethod
    def derivatives(self, w: FloatArray, order: int) -> FloatArray:
        """Returns c, c' and c'' at w, as far as the order: (n,) -> (order + 1, n, d).

        Args:
            w: Real or complex, also beyond the ends.
            order: 0, 1 or 2.
        """

    def distance(self, z: FloatArray) -> FloatArray:
        """Returns the distance to the nearest sample of the curve, (n, d) -> (n,)."""
        return np.asarray(self._samples[1].query(z.real)[0])

    def nearest(self, z: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Finds the nearest points of the curve to z (n, d).

        Returns:
            Their parameters w (n,); the slopes dw/dz (n, d), which are zero where the nearest
            point is the end of an open curve; and c, c', c'' there, (3, n, d).  With complex
            z all of them continue analytically, to first order.
        """
        w_samples, tree, at_samples = self._samples
        sample = tree.query(z.real)[1]
        start = w_samples[sample]
        w, c = start, at_samples[:, sample]
        for _ in range(NEWTON_STEPS):
            before, w = w, self._improved(w, start, c, z.real)
            c = self.derivatives(w, 2)
            if np.abs(w - before).max(initial=0.0) <= CONVERGED * self.step:
                break
        inside = self._inside(w)
        slope = np.where(inside, 1 / _tangency_slope(c, z), 0.0)
        if np.iscomplexobj(z):
            w = w - slope * _tangency(c, z)
            c = self.derivatives(w, 2)
            slope = np.where(inside, 1 / _tangency_slope(c, z), 0.0)
        return w, slope[:, None] * c[1], c

    @cached_property
    def _samples(self) -> tuple[FloatArray, cKDTree, FloatArray]:
        """Parameters of samples, a tree of them, and their derivatives to the second."""
        number = SAMPLES_PER_STEP * (len(self.knots) - 1)
        w = np.linspace(0, self.length, number + 1)[: number if self.closed else None]
        c = self.derivatives(w, 2)
        return w, cKDTree(c[0]), c

    def _improved(
        self, w: FloatArray, start: FloatArray, c: FloatArray, z: FloatArray
    ) -> FloatArray:
        """One Newton step for (c(w) - z) . c'(w) = 0, not beyond the neighbouring samples."""
        slope = _tangency_slope(c, z)
        # At a maximum of the distance Newton's step leads away; Gauss's leads back.
        slope = np.where(slope > 0, slope, np.maximum((c[1] ** 2).sum(axis=1), _TINY))
        reach = self.step / SAMPLES_PER_STEP
        w = np.clip(w - _tangency(c, z) / slope, start - reach, start + reach)
        return w if self.closed else np.clip(w, 0, self.length)

    def _inside(self, w: FloatArray) -> BoolArray:
        if self.closed:
            return np.ones(len(w), dtype=bool)
        return np.asarray((w > 0) & (w < self.length))


_TINY = float(np.finfo(np.float64).tiny)


def _tangency(c: FloatArray, z: FloatArray) -> FloatArray:
    return np.asarray(((c[0] - z) * c[1]).sum(axis=1))


def _tangency_slope(c: FloatArray, z: FloatArray) -> FloatArray:
    """Its derivative by w: (c - z) . c'' + c' . c'."""
    slope = ((c[0] - z) * c[2] + c[1] ** 2).sum(axis=1)
    return np.where(slope == 0, _TINY, slope)
