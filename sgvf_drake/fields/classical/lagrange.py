"""Polynomial interpolation of ordered waypoints."""

from functools import cached_property

import numpy as np
from scipy.special import gammaln

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.classical.curve import Curve

# Beyond it the smallest of the weights, 2^-N of the largest, is zero in float64.
MOST_POINTS = 1_000


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
