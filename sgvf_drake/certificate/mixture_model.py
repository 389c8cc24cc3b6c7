"""The Lyapunov function of a Gaussian mixture over squares: bounds of V, and models of grad V.

With weights w_i(x) proportional to exp(-|x - x_i|^2 / 2 sigma^2) and their mean m(x) = sum_i
w_i x_i, grad V = (x - m) / sigma^2.  Along a step d the weights are tilted by exp(a_i), a_i =
d . (x_i - m) / sigma^2, so that the derivatives of m are joint cumulants of x_i and a_i.
"""

from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import kernels
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.expansions import LIBRARY
from sgvf_drake.certificate.kernels import SLACK, TINY, UNDERFLOW, UNIT
from sgvf_drake.certificate.taylor_model import TaylorModel
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
