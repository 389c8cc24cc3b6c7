"""Curves through waypoints in their order: trigonometric and polynomial interpolation."""

from abc import ABC, abstractmethod
from functools import cached_property
from typing import Self

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import gammaln

from sgvf_drake.arrays import BoolArray, IntArray
from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.analytic import check_positive
from sgvf_drake.fields.base import FloatArray

# Points of a curve between two waypoints, of which the nearest is where a search begins.
SAMPLES_PER_STEP = 8
# Newton steps of the search, at most; it ends where one changes w by less than this part of
# a step, since the next would change it by the square of that.
NEWTON_STEPS = 4
CONVERGED = 1e-8
# Of the derivatives: the Jacobian of a field along a curve needs the second.
HIGHEST_ORDER = 2
# A wave of exactly the shortest length is kept.
ROUNDING = 1e-9
# Waypoints of a polynomial.  With more, the smallest of the weights, 2^-N of the largest, is
# zero in float64.
MOST_POINTS = 1_000
TINY = float(np.finfo(np.float64).tiny)


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
        slope = np.where(slope > 0, slope, np.maximum((c[1] ** 2).sum(axis=1), TINY))
        reach = self.step / SAMPLES_PER_STEP
        w = np.clip(w - _tangency(c, z) / slope, start - reach, start + reach)
        return w if self.closed else np.clip(w, 0, self.length)

    def _inside(self, w: FloatArray) -> BoolArray:
        if self.closed:
            return np.ones(len(w), dtype=bool)
        return np.asarray((w > 0) & (w < self.length))


def _tangency(c: FloatArray, z: FloatArray) -> FloatArray:
    return np.asarray(((c[0] - z) * c[1]).sum(axis=1))


def _tangency_slope(c: FloatArray, z: FloatArray) -> FloatArray:
    """Its derivative by w: (c - z) . c'' + c' . c'."""
    slope = ((c[0] - z) * c[2] + c[1] ** 2).sum(axis=1)
    return np.where(slope == 0, TINY, slope)


class FourierCurve(Curve):
    """The trigonometric interpolant of waypoints at equal steps of the parameter.

    A closed curve is the discrete Fourier series of its waypoints.  An open one is a
    straight line plus a sine series: what is left of the waypoints without the line from
    the first to the last one is zero at both ends, and its odd continuation is periodic.
    """

    def __init__(self, points: FloatArray, closed: bool = True) -> None:
        super().__init__(points, closed)
        self._offset, self._slope = np.zeros((2, self.points.shape[1]))
        values, period = self.points, self.length
        if not closed:
            self._offset = self.points[0]
            self._slope = (self.points[-1] - self.points[0]) / self.length
            w = np.linspace(0, self.length, len(self.points))[:, None]
            rest = self.points - self._offset - w * self._slope
            values, period = np.concatenate([rest, -rest[-2:0:-1]]), 2 * self.length
        series = 2 * np.fft.rfft(values, axis=0) / len(values)
        # The constant, and the highest frequency of an even number, stand there once.
        series[0] /= 2
        if len(values) % 2 == 0:
            series[-1] /= 2
        self._fundamental = 2 * np.pi / period
        self._set_series(series.real, -series.imag)

    def smoothed(self, wavelength: float) -> "FourierCurve":
        """Returns the curve without its waves that are shorter than a length.

        It no longer passes the waypoints: of all series of the longer waves it is the one
        with the least squares of the distances to them.

        Args:
            wavelength: A length, in the unit of w.

        Raises:
            ConfigurationError: The length is not a positive number.
        """
        check_positive("wavelength", wavelength)
        curve = FourierCurve(self.points, self.closed)
        shortest = 2 * np.pi / (wavelength * self._fundamental)
        kept = int(shortest * (1 + ROUNDING)) + 1
        curve._set_series(self._cosines[:kept], self._sines[:kept])
        return curve

    def derivatives(self, w: FloatArray, order: int) -> FloatArray:
        dim = self.points.shape[1]
        values = self._waves(w) @ self._amplitudes[:, : (order + 1) * dim]
        values[:, :dim] += self._offset + w[:, None] * self._slope
        if order > 0:
            values[:, dim : 2 * dim] += self._slope
        return values.reshape(len(w), order + 1, dim).transpose(1, 0, 2)

    def _waves(self, w: FloatArray) -> FloatArray:
        """Returns the cosines and then the sines of all frequencies, (n,) -> (n, 2 K)."""
        if np.iscomplexobj(w):
            phases = np.multiply.outer(w, self._frequencies)
            return np.concatenate([np.cos(phases), np.sin(phases)], axis=1)
        # By the powers of the first wave: many times faster, and as exact to 14 digits.
        first = np.exp(1j * self._fundamental * w)
        powers = np.vander(first, len(self._frequencies), increasing=True)
        return np.concatenate([powers.real, powers.imag], axis=1)

    def _set_series(self, cosines: FloatArray, sines: FloatArray) -> None:
        """Keeps amplitudes (K, d), and beside them those of the derivatives."""
        self._cosines, self._sines = cosines, sines
        self._frequencies = self._fundamental * np.arange(len(cosines))
        blocks = []
        for _ in range(HIGHEST_ORDER + 1):
            blocks.append(np.concatenate([cosines, sines]))
            cosines, sines = (
                self._frequencies[:, None] * sines,
                -self._frequencies[:, None] * cosines,
            )
        self._amplitudes = np.concatenate(blocks, axis=1)


class LagrangeCurve(Curve):
    """The one polynomial through all waypoints at equal steps of the parameter.

    In the barycentric form (Berrut and Trefethen, SIAM Review 2004), which is as exact as
    the problem allows.  The problem is the trouble: between equally spaced points a
    polynomial of high degree swings, by up to about 2^N times what it should be (Runge).

    A closed curve passes its first waypoint again at the end, with another direction.

    Raises:
        ConfigurationError: There are more than `MOST_POINTS` waypoints, too few, or all are
            the same.
    """

    def __init__(self, points: FloatArray, closed: bool = True) -> None:
        super().__init__(points, closed)
        if len(points) > MOST_POINTS:
            raise ConfigurationError(
                f"a polynomial passes at most {MOST_POINTS} waypoints, not {len(points)}"
            )

    def derivatives(self, w: FloatArray, order: int) -> FloatArray:
        offsets = w[:, None] - self._nodes
        hit = offsets == 0
        shares = self._weights / np.where(hit, 1.0, offsets)
        # At a node the interpolant is the value there.
        shares = np.where(hit.any(axis=1, keepdims=True), hit, shares)
        shares /= shares.sum(axis=1, keepdims=True)
        return np.stack([shares @ values for values in self._values[: order + 1]])

    @cached_property
    def _nodes(self) -> FloatArray:
        return np.linspace(0, self.length, len(self.knots))

    @cached_property
    def _weights(self) -> FloatArray:
        """The weights of equally spaced nodes: (-1)^j binomial(n, j), over the largest."""
        n = len(self.knots) - 1
        j = np.arange(n + 1)
        sizes = -gammaln(j + 1) - gammaln(n - j + 1)
        return np.asarray((-1.0) ** j * np.exp(sizes - sizes.max()))

    @cached_property
    def _values(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Value, first and second derivative at the nodes: polynomials are exact there."""
        offsets = self._nodes[:, None] - self._nodes
        np.fill_diagonal(offsets, 1.0)
        D = self._weights / self._weights[:, None] / offsets
        np.fill_diagonal(D, 0.0)
        # A constant has no derivative.
        np.fill_diagonal(D, -D.sum(axis=1))
        first = D @ self.knots
        return self.knots, first, D @ first
