"""The score of a Gaussian mixture over squares with its derivatives, by cumulants.

With C the covariance of the waypoints x_i by the weights at x, the Jacobian of the score S is
C / sigma^4 - I / sigma^2.  A step d tilts the weights by exp(a_i), so that C(x + d) is a series
of joint cumulants of y_i = x_i - mean, y_i and as many a_i; see `mixture_model`.
"""

from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.dual_model import DualModel
from sgvf_drake.certificate.expansions import LIBRARY
from sgvf_drake.certificate.kernels import LARGEST, SLACK, TINY, UNDERFLOW, UNIT
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.fields import GaussianMixture

# More than the factors by which rounding of weights enters a cumulant of order four.
FACTORS = 64
AXES = (0, 1)


def dual_mixture(mixture: GaussianMixture, boxes: Boxes) -> DualModel:
    """Returns the models of the score of a planar mixture and of its derivatives."""
    waypoints = _Weighted.over(mixture, boxes)
    first, second = (waypoints.slope(boxes, mixture.sigma**2, axis) for axis in AXES)
    return DualModel(MixtureModel(mixture).gradient(boxes).scaled(-1.0), (first, second))


@dataclass(frozen=True, eq=False)
class _Weighted:
    """N waypoints with their weights at the centres of n squares, and over these.

    Attributes:
        y: (n, N, 2) from the mean.
        weights: (n, N) at the centre.
        off: (n,) what these are off by through rounding, relative to themselves.
        grown: (n, N) what the weights are at most anywhere.
        about: (n, N, 2) what |y| is at most anywhere.
        error: (n, N, 2) a bound of the size of y against which `off` is its rounding.
    """

    y: FloatArray
    weights: FloatArray
    off: FloatArray
    grown: FloatArray
    about: FloatArray
    error: FloatArray

    @classmethod
    def over(cls, mixture: GaussianMixture, boxes: Boxes) -> "_Weighted":
        """Returns them for a mixture."""
        variance, half = mixture.sigma**2, boxes.half[:, None]
        offsets = mixture.points - boxes.centers[:, None]
        exponents = (offsets**2).sum(axis=2) / (-2 * variance)
        top = exponents.max(axis=1, keepdims=True)
        weights = np.exp(exponents - top)
        total = weights.sum(axis=1, keepdims=True)
        weights /= total
        y = offsets - (weights[:, None] @ offsets)
        size = np.abs(y)
        logarithms = exponents - top - np.log(total)
        tilt = half / variance * size.sum(axis=2)
        raised = logarithms + tilt + 32 * UNIT * np.abs(logarithms).max(axis=1, keepdims=True)
        grown = np.exp(np.minimum(raised, LARGEST))
        grown[raised > LARGEST] = np.inf
        shrunk = weights * np.exp(-tilt) / grown.sum(axis=1, keepdims=True)
        change = np.maximum(grown - weights, weights - shrunk)
        about = size + change[:, None] @ size
        off = UNIT * (8 * (np.abs(top[:, 0]) + UNDERFLOW) + 4 * (y.shape[1] + 2 * LIBRARY))
        error = about + grown[:, None] @ (size + np.abs(offsets))
        return cls(y, weights, off, grown, about, error)

    def slope(self, boxes: Boxes, variance: float, axis: int) -> TaylorModel:
        """Returns the models (n, 2) of the derivatives of the score by one coordinate."""
        columns = [self._entry(boxes, variance, axis, k) for k in AXES]
        parts, remainder = (np.stack(part, axis=-1) for part in zip(*columns, strict=True))
        parts[:, 0, axis] -= 1 / variance
        models = TaylorModel(boxes.half, parts, remainder)
        rounding = SLACK * (models.magnitude + 1 / variance) + TINY
        return replace(models, remainder=(1 + SLACK) * remainder + rounding)

    def _entry(
        self, boxes: Boxes, variance: float, k: int, m: int
    ) -> tuple[FloatArray, FloatArray]:
        """Returns the parts (n, 6) of the model of C_km / sigma^4, and its remainder."""
        w, y = self.weights, self.y
        pair = w * y[..., k] * y[..., m]
        C = np.einsum("np,npi,npj->nij", w, y, y)
        third = np.einsum("np,npi->ni", pair, y)
        fourth = np.einsum("np,npi,npj->nij", pair, y, y)
        fourth -= C[:, k, m][:, None, None] * C
        fourth -= C[:, k, :, None] * C[:, m, None, :] + C[:, m, :, None] * C[:, k, None, :]
        fourth /= 2 * variance**2
        quadratic = (fourth[:, 0, 0], 2 * fourth[:, 0, 1], fourth[:, 1, 1])
        slopes = third.T / variance
        parts = np.stack([C[:, k, m], *slopes, *quadratic], axis=1)
        rest = self._fifth(self.about, boxes, variance, k, m)
        rest += FACTORS * self.off * self._all(self.error, boxes, variance, k, m)
        return parts / variance**2, (1 + SLACK) * rest / variance**2

    def _fifth(
        self, size: FloatArray, boxes: Boxes, variance: float, k: int, m: int
    ) -> FloatArray:
        """A sixth of the cumulant of y_k, y_m and three a, at most, by absolute moments.

        It is E[y_k y_m a^3] less the products of a pair's moment and that of the other three:
        of y_k y_m, three times of y_k a, of y_m a and of a a.
        """
        a, y_k, y_m = self._tilts(size, boxes, variance), size[..., k], size[..., m]
        return (
            self._mean(y_k * y_m * a**3)
            + self._mean(y_k * y_m) * self._mean(a**3)
            + 3 * self._mean(y_k * a) * self._mean(y_m * a**2)
            + 3 * self._mean(y_m * a) * self._mean(y_k * a**2)
            + 3 * self._mean(a**2) * self._mean(y_k * y_m * a)
        ) / 6

    def _all(
        self, size: FloatArray, boxes: Boxes, variance: float, k: int, m: int
    ) -> FloatArray:
        """The size of all that a cumulant of order two, three or four is summed up from."""
        a, y_k, y_m = self._tilts(size, boxes, variance), size[..., k], size[..., m]
        return (
            self._mean(y_k * y_m * (1 + a + a**2))
            + self._mean(y_k * y_m) * self._mean(a**2)
            + 2 * self._mean(y_k * a) * self._mean(y_m * a)
        )

    def _tilts(self, size: FloatArray, boxes: Boxes, variance: float) -> FloatArray:
        """What |a| is at most, (n, N)."""
        return boxes.half[:, None] / variance * size.sum(axis=2)

    def _mean(self, values: FloatArray) -> FloatArray:
        """The mean (n,) of values (n, N) by weights, at most."""
        return (self.grown * values).sum(axis=1)
