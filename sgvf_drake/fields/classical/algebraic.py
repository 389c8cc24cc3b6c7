"""An algebraic curve phi = 0, fitted to waypoints without an order."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.polynomial import chebyshev
from scipy.linalg import eigh

from sgvf_drake.clouds import PointCloud
from sgvf_drake.clouds.point_cloud import HALF_EXTENT_UNITS
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import FloatArray

# The lowest degree that comes this near to the waypoints (RMS, U) is taken: a higher one
# follows noise, and has more parts that belong to no waypoint.
TOLERANCE = 0.1
DEGREES = range(2, 9)
# Combinations of terms whose gradients vanish at all waypoints, to this part of the largest,
# say nothing of a distance, and are left out.
RANK_TOLERANCE = 1e-9
# Where the sign of a fit is settled: around the box, half-size 5 U.
FAR_AWAY = 5.0 * np.array(
    [[1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0], [-1, -1], [0, -1], [1, -1]]
)


@dataclass(frozen=True, eq=False)
class AlgebraicCurve:
    """A polynomial of the plane, near its zero set a signed distance in U, positive far away.

    Attributes:
        coefficients: (D + 1, D + 1) of the products of Chebyshev polynomials T_i(x) T_j(y),
            i + j <= D, at normalised coordinates over their half-extent.
        residual: Root mean square of the polynomial at the waypoints: about their distance
            from the curve, U.
    """

    coefficients: FloatArray
    residual: float

    @classmethod
    def fit(
        cls,
        cloud: PointCloud,
        degrees: Iterable[int] = DEGREES,
        tolerance: float = TOLERANCE,
    ) -> "AlgebraicCurve":
        """Fits a curve to the waypoints, whatever their order.

        Of each degree D it is the polynomial with the smallest mean square at the waypoints
        among those whose gradient there has a mean square of one, a generalised eigenvalue
        problem (Taubin, IEEE PAMI 1991): with |grad phi| about 1, phi is about a distance.

        Args:
            cloud: The waypoints, in the plane.
            degrees: The degrees to try, in ascending order; those that have more
                coefficients than there are waypoints are not.
            tolerance: The first degree whose residual is at most this, in U, is taken; if
                none is, the one of the smallest residual.

        Raises:
            ConfigurationError: The cloud is not planar, or has too few waypoints.
        """
        if cloud.dim != 2:
            raise ConfigurationError(f"an implicit curve is planar, the cloud {cloud.dim}-D")
        fits: list[AlgebraicCurve] = []
        for degree in degrees:
            if (degree + 1) * (degree + 2) // 2 > cloud.num_points:
                break
            fits.append(cls(*_fit(cloud.normalize(cloud.points), degree)))
            if fits[-1].residual <= tolerance:
                return fits[-1]
        if not fits:
            raise ConfigurationError(f"{cloud.num_points} waypoints are too few for a curve")
        return min(fits, key=lambda curve: curve.residual)

    @property
    def degree(self) -> int:
        """The degree D."""
        return len(self.coefficients) - 1

    def value(self, z: FloatArray) -> FloatArray:
        """Returns phi at normalised points, real or complex: (n, 2) -> (n,)."""
        return _evaluate(self.coefficients, z)

    def gradient(self, z: FloatArray) -> FloatArray:
        """Returns grad phi, (n, 2) -> (n, 2)."""
        return np.stack([_evaluate(c, z) for c in self._slopes], axis=1)

    def hessian(self, z: FloatArray) -> FloatArray:
        """Returns the second derivatives, (n, 2) -> (n, 2, 2)."""
        xx, xy, yy = (_evaluate(c, z) for c in self._curvatures)
        return np.stack([np.stack([xx, xy], axis=1), np.stack([xy, yy], axis=1)], axis=1)

    @cached_property
    def _slopes(self) -> tuple[FloatArray, FloatArray]:
        return _derivative(self.coefficients, 0), _derivative(self.coefficients, 1)

    @cached_property
    def _curvatures(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        x, y = self._slopes
        return _derivative(x, 0), _derivative(x, 1), _derivative(y, 1)


def _fit(points: FloatArray, degree: int) -> tuple[FloatArray, float]:
    """Returns the coefficients of one degree, and the residual in U."""
    i, j = (index for index in np.indices((degree + 1, degree + 1)))
    used = np.flatnonzero((i + j <= degree).ravel())
    terms = np.zeros((len(used), degree + 1, degree + 1))
    terms.reshape(len(used), -1)[np.arange(len(used)), used] = 1.0
    values = np.stack([_evaluate(term, points) for term in terms], axis=1)
    slopes = np.concatenate(
        [
            np.stack([_evaluate(_derivative(term, axis), points) for term in terms], axis=1)
            for axis in (0, 1)
        ]
    )
    # The constant term, the first, has no gradient: it makes the mean of phi zero.
    centred = values[:, 1:] - values[:, 1:].mean(axis=0)
    sizes, basis = eigh(slopes[:, 1:].T @ slopes[:, 1:] / len(points))
    kept = sizes > RANK_TOLERANCE * sizes[-1]
    basis = basis[:, kept] / np.sqrt(sizes[kept])
    projected = centred @ basis
    squares, vectors = eigh(projected.T @ projected / len(points), subset_by_index=[0, 0])
    weights = basis @ vectors[:, 0]
    coefficients = np.tensordot(weights, terms[1:], axes=1)
    coefficients[0, 0] = -float(values[:, 1:].mean(axis=0) @ weights)
    outside = float(_evaluate(coefficients, FAR_AWAY).sum())
    return coefficients * np.copysign(1.0, outside), float(np.sqrt(max(squares[0], 0.0)))


def _evaluate(coefficients: FloatArray, z: FloatArray) -> FloatArray:
    x, y = (z / HALF_EXTENT_UNITS).T
    return np.asarray(chebyshev.chebval2d(x, y, coefficients))


def _derivative(coefficients: FloatArray, axis: int) -> FloatArray:
    return np.asarray(chebyshev.chebder(coefficients, axis=axis, scl=1 / HALF_EXTENT_UNITS))
