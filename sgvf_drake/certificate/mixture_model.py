"""A Gaussian mixture over squares: bounds of V, models of grad V and of its derivatives.

With weights w_i(x) proportional to exp(-|x - x_i|^2 / 2 sigma^2) and their mean m(x) = sum_i
w_i x_i, grad V = (x - m) / sigma^2.  Along a step d the weights are tilted by exp(a_i), a_i =
d . (x_i - m) / sigma^2, so that the derivatives of m are joint cumulants of x_i and a_i.

With C the covariance of the waypoints by the weights at x, the Jacobian of the score S = -grad
V is C / sigma^4 - I / sigma^2, and C(x + d) is a series of joint cumulants of y_i = x_i - m,
y_i and as many a_i.
"""

from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import kernels
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.expansions import LIBRARY
from sgvf_drake.certificate.kernels import LARGEST, SLACK, TINY, UNDERFLOW, UNIT
from sgvf_drake.certificate.taylor_model import DualModel, TaylorModel
from sgvf_drake.fields import GaussianMixture, GuidingField
from sgvf_drake.lyapunov import LyapunovFunction


@dataclass(frozen=True, eq=False)
class MixtureModel:
    """V = -log sum_i exp(-|x - x_i|^2 / 2 sigma^2) - lowest of a planar mixture.

    Attributes:
        mixture: The mixture, in the unit of the squares.
        lowest: What is taken off; any number, which the levels then refer to.
    """

    mixture: GaussianMixture
    lowest: float = 0.0

    def level_range(self, boxes: Boxes) -> tuple[FloatArray, FloatArray]:
        """Returns bounds (n,) of V over squares.

        From the nearest and the farthest each waypoint can be: right for any square, tight
        for small ones.
        """
        points, sigma = self.mixture.points, self.mixture.sigma
        tops, logarithms = kernels.log_sums(boxes.centers, boxes.half, points, sigma)
        V = -tops - logarithms - self.lowest
        # Exponents are off by a few roundings of themselves, those that matter by no more
        # than those of the top and of UNDERFLOW; what is left out of a sum is far less.
        error = UNIT * (8 * (np.abs(tops) + UNDERFLOW) + 2 * (len(points) + 2 * LIBRARY))
        error += 4 * UNIT * abs(self.lowest)
        return V[:, 0] - error[:, 0], V[:, 1] + error[:, 1]

    def squares_below(self, level: float, within: Boxes, half: float) -> Boxes:
        """Returns the parts of squares on which V may be at most a level.

        Args:
            level: c.
            within: The squares, of one size.
            half: Half-side of the parts.
        """
        boxes = within
        while True:
            boxes = boxes[self.level_range(boxes)[0] <= level]
            if not len(boxes) or boxes.half[0] <= half:
                return boxes
            boxes = boxes.quarters()

    def gradient(self, boxes: Boxes) -> TaylorModel:
        """Returns the models of grad V, per unit of length."""
        points, sigma = self.mixture.points, self.mixture.sigma
        parts, change, spread, tops = kernels.tilted_means(
            boxes.centers, boxes.half, points, sigma
        )
        variance = sigma**2
        models = TaylorModel(boxes.half, parts / variance, change / variance)
        # Weights are off by the roundings of their exponents.
        off = UNIT * (8 * (np.abs(tops) + UNDERFLOW) + 4 * (len(points) + 2 * LIBRARY))
        rounding = 4 * off[:, None] * (models.magnitude + spread / variance)
        rounding += SLACK * np.abs(boxes.centers) / variance
        remainder = (1 + SLACK) * models.remainder + rounding + TINY
        return replace(models, remainder=remainder)

    def level(self, boxes: Boxes, gradient: TaylorModel) -> TaylorModel:
        """Returns the models (n, 1) of V, from those of its gradient.

        V(c + d) - V(c) is the integral of grad V(c + t d) . d over t from 0 to 1.
        """
        low, high = self.level_range(Boxes(boxes.centers, np.zeros_like(boxes.half)))
        parts = np.empty((len(boxes), 6, 1))
        parts[:, 0, 0] = (low + high) / 2
        parts[:, 1:3, 0] = gradient.value
        hessian = gradient.jacobian / 2
        parts[:, 3, 0], parts[:, 5, 0] = hessian[:, 0, 0], hessian[:, 1, 1]
        parts[:, 4, 0] = hessian[:, 0, 1] + hessian[:, 1, 0]
        bends, half = np.abs(gradient.quadratic).sum(axis=1), boxes.half[:, None]
        rest = half * (half**2 * bends / 3 + gradient.remainder).sum(axis=1, keepdims=True)
        rest = (1 + SLACK) * (rest + (high - low)[:, None] / 2)
        models = TaylorModel(boxes.half, parts, rest)
        return replace(models, remainder=models.remainder + SLACK * models.magnitude)


def mixture_of(field: GuidingField, sigma: float) -> GaussianMixture:
    """Returns the mixture of V at a noise level, in normalised units."""
    return GaussianMixture(field.cloud.normalize(field.mixture.points), sigma)


def lowest_of(mixture: GaussianMixture) -> float:
    """Returns what makes the lowest V zero, but for rounding; see `MixtureModel`."""
    at = mixture.points[:1]
    free, _ = MixtureModel(mixture).level_range(Boxes(at, np.zeros(1)))
    return float(free[0] - LyapunovFunction(mixture)(at)[0])


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
