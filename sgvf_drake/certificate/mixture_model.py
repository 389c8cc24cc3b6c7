"""The Lyapunov function of a Gaussian mixture over squares: bounds of V, and models of grad V.

With weights w_i(x) proportional to exp(-|x - x_i|^2 / 2 sigma^2) and their mean m(x) = sum_i
w_i x_i, grad V = (x - m) / sigma^2.  Along a step d the weights are tilted by exp(a_i), a_i =
d . (x_i - m) / sigma^2, so that the derivatives of m are joint cumulants of x_i and a_i.
"""

from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.expansions import LIBRARY
from sgvf_drake.certificate.taylor_model import (
    SLACK,
    TINY,
    UNIT,
    TaylorModel,
)
from sgvf_drake.fields import GaussianMixture, GuidingField
from sgvf_drake.lyapunov import LyapunovFunction

# exp is zero in float64 below minus this.
UNDERFLOW = 746.0
# A weight that grows to the exponential of more says nothing any more, and would overflow.
LARGEST = 500.0


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
        away = np.abs(boxes.centers[:, None] - self.mixture.points)
        half = boxes.half[:, None, None]
        near = (np.maximum(away - half, 0) ** 2).sum(axis=2)
        far = ((away + half) ** 2).sum(axis=2)
        return self._log_sum(near, -1), self._log_sum(far, 1)

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

    def _log_sum(self, squares: FloatArray, side: int) -> FloatArray:
        """Returns -log sum exp(-squares / 2 sigma^2) (n,), rounded to a side."""
        exponents = squares / (-2 * self.mixture.sigma**2)
        top = exponents.max(axis=1)
        total = np.exp(exponents - top[:, None]).sum(axis=1)
        # Exponents are off by a few roundings of themselves, those that matter by no more
        # than those of the top and of UNDERFLOW.
        count = len(self.mixture.points)
        error = UNIT * (8 * (np.abs(top) + UNDERFLOW) + 2 * (count + 2 * LIBRARY))
        error += 4 * UNIT * abs(self.lowest)
        return np.asarray(-top - np.log(total) - self.lowest + side * error)

    def gradient(self, boxes: Boxes) -> TaylorModel:
        """Returns the models of grad V, per unit of length."""
        points, variance = self.mixture.points, self.mixture.sigma**2
        offsets = points - boxes.centers[:, None]
        exponents = (offsets**2).sum(axis=2) / (-2 * variance)
        top = exponents.max(axis=1, keepdims=True)
        weights = np.exp(exponents - top)
        total = weights.sum(axis=1, keepdims=True)
        weights /= total
        logarithms = exponents - top - np.log(total)
        mean = (weights[:, None] @ offsets)[:, 0]
        y = offsets - mean[:, None]
        # First and second derivative of the mean: covariance and third moments.
        first, second = weights * y[..., 0], weights * y[..., 1]
        moments = np.stack([first, second], axis=1)
        covariance = moments @ y
        third = np.stack(
            [
                (moments * y[:, None, :, i] * y[:, None, :, j]).sum(axis=2)
                for i, j in ((0, 0), (0, 1), (1, 1))
            ],
            axis=1,
        )
        third *= np.array([1.0, 2.0, 1.0])[:, None] / (2 * variance**2)
        change, spread = self._tilted(boxes, weights, logarithms, y)
        jacobian = (np.eye(2) - covariance / variance) / variance
        models = TaylorModel(
            boxes.half, -mean / variance, jacobian, -third / variance, change / variance
        )
        # Weights are off by the roundings of their exponents.
        count = len(points)
        off = UNIT * (8 * (np.abs(top) + UNDERFLOW) + 4 * (count + 2 * LIBRARY))
        rounding = 4 * off * (models.magnitude + spread / variance)
        rounding += SLACK * np.abs(boxes.centers) / variance
        remainder = (1 + SLACK) * models.remainder + rounding + TINY
        return replace(models, remainder=remainder)

    def level(self, boxes: Boxes, gradient: TaylorModel) -> TaylorModel:
        """Returns the models (n, 1) of V, from those of its gradient.

        V(c + d) - V(c) is the integral of grad V(c + t d) . d over t from 0 to 1.
        """
        low, high = self.level_range(Boxes(boxes.centers, np.zeros_like(boxes.half)))
        hessian, bends = gradient.jacobian / 2, np.abs(gradient.quadratic).sum(axis=1)
        quadratic = [hessian[:, 0, 0], hessian[:, 0, 1] + hessian[:, 1, 0], hessian[:, 1, 1]]
        half = boxes.half[:, None]
        rest = half * (half**2 * bends / 3 + gradient.remainder).sum(axis=1, keepdims=True)
        models = TaylorModel(
            boxes.half,
            (low + high)[:, None] / 2,
            gradient.value[..., None],
            np.stack(quadratic, axis=1)[..., None],
            (1 + SLACK) * (rest + (high - low)[:, None] / 2),
        )
        return replace(models, remainder=models.remainder + SLACK * models.magnitude)

    def _tilted(
        self, boxes: Boxes, weights: FloatArray, logarithms: FloatArray, y: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Returns what the third derivative of the mean adds, and E|y_k| of tilted weights.

        Both (n, 2).  The tilted weights are w_i exp(a_i) / Z, with Z = sum_i w_i exp(a_i) at
        least one, since E a = 0 (Jensen).  By the logarithms, since a weight that is zero to
        float64 at the centre may be all that counts in a corner.
        """
        variance, half = self.mixture.sigma**2, boxes.half[:, None]
        size = np.abs(y)
        tilt = half / variance * size.sum(axis=2)
        error = 32 * UNIT * np.abs(logarithms).max(axis=1, keepdims=True)
        exponents = logarithms + tilt + error
        grown = np.exp(np.minimum(exponents, LARGEST))
        grown[exponents > LARGEST] = np.inf
        total = grown.sum(axis=1, keepdims=True)
        # Where the mean moves to: weights change by a factor between exp(-tilt) / Z and
        # exp(tilt).
        shrunk = weights * np.exp(-tilt) / total
        moved = (np.maximum(grown - weights, weights - shrunk)[:, None] @ size)[:, 0]
        about = size + moved[:, None]
        tilt = half / variance * about.sum(axis=2)
        square = grown * tilt**2
        # The fourth joint cumulant, E[Y a^3] - 3 E[Y a] E[a^2], by absolute moments.
        first = ((grown * tilt)[:, None] @ about)[:, 0]
        fourth = ((square * tilt)[:, None] @ about)[:, 0]
        change = (fourth + 3 * first * square.sum(axis=1, keepdims=True)) / 6
        spread = (grown[:, None] @ size)[:, 0]
        return change, spread


def mixture_of(field: GuidingField, sigma: float) -> GaussianMixture:
    """Returns the mixture of V at a noise level, in normalised units."""
    return GaussianMixture(field.cloud.normalize(field.mixture.points), sigma)


def lowest_of(mixture: GaussianMixture) -> float:
    """Returns what makes the lowest V zero, but for rounding; see `MixtureModel`."""
    at = mixture.points[:1]
    free, _ = MixtureModel(mixture).level_range(Boxes(at, np.zeros(1)))
    return float(free[0] - LyapunovFunction(mixture)(at)[0])
