"""Gaussian mixtures over patches: bounds of V, models of scores and of what strands pull along.

All are means by weights w_i(x) proportional to exp(-|x - x_i|^2 / 2 sigma^2): the score is
S = (m - x) / sigma^2 with the mean m of the x_i, and grad V = -S.  Along a step A u the weights
are tilted by exp(a_i), a_i = (A u) . (x_i - m) / sigma^2, so that the mean of any F_i is a
series of the joint cumulants of F_i and so many a_i.  Its derivatives are covariances of F_i
with x_i, and so means of products less products of means.
"""

from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import kernels
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.kernels import LIBRARY, SLACK, TINY, UNDERFLOW, UNIT
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import DualModel, TaylorModel
from sgvf_drake.fields import GaussianMixture, GuidingField, StrandMixture
from sgvf_drake.lyapunov import LyapunovFunction


@dataclass(frozen=True, eq=False)
class MixtureModel:
    """V = -log sum_i exp(-|x - x_i|^2 / 2 sigma^2) - lowest of a mixture.

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

    def gradient(self, patches: Patches) -> TaylorModel:
        """Returns the models of grad V, per unit of length."""
        return Components.of(self.mixture).model(patches).scaled(-1.0)

    def level(self, patches: Patches, gradient: TaylorModel) -> TaylorModel:
        """Returns the models (n, 1) of V, from those of its gradient.

        V(c + A u) - V(c) is the integral of grad V(c + t A u) . A u over t from 0 to 1.
        """
        low, high = self.level_range(Boxes.points(patches.centers))
        parts = np.empty((*gradient.parts.shape[:2], 1))
        parts[:, 0, 0] = (low + high) / 2
        rest, size, k = (high - low)[:, None] / 2, np.abs(parts[:, 0]), patches.axes.shape[2]
        along = [gradient.weighted(patches.axes[:, :, j]) for j in range(k)]
        rows = iter(range(1 + k, parts.shape[1]))
        for j, model in enumerate(along):
            parts[:, 1 + j] = model.value
            parts[:, next(rows)] = model.slopes[:, j] / 2
            for m in range(j + 1, k):
                parts[:, next(rows)] = (model.slopes[:, m] + along[m].slopes[:, j]) / 2
            rest = rest + np.abs(model.quadratic).sum(axis=1) / 3 + model.remainder
            size = size + model.magnitude
        return TaylorModel(parts, (1 + SLACK) * rest + SLACK * size + TINY)


def mixture_of(field: GuidingField, sigma: float) -> GaussianMixture:
    """Returns the mixture of V at a noise level, in normalised units."""
    return GaussianMixture(field.cloud.normalize(field.mixture.points), sigma)


def lowest_of(mixture: GaussianMixture) -> float:
    """Returns what makes the lowest V zero, but for rounding; see `MixtureModel`."""
    at = mixture.points[:1]
    free, _ = MixtureModel(mixture).level_range(Boxes.points(at))
    return float(free[0] - LyapunovFunction(mixture)(at)[0])


@dataclass(frozen=True, eq=False)
class Components:
    """Weights exp(-|x - x_i|^2 / 2 sigma^2 + exponent_i), and what each component pulls along.

    Attributes:
        points: x_i, (N, d).
        exponents: (N,).
        pulls: (N, f); f may be zero.
        sigma: Noise level.
    """

    points: FloatArray
    exponents: FloatArray
    pulls: FloatArray
    sigma: float

    @classmethod
    def of(cls, mixture: GaussianMixture) -> "Components":
        """Returns those of a mixture, which pull along nothing."""
        count = len(mixture.points)
        return cls(mixture.points, np.zeros(count), np.empty((count, 0)), mixture.sigma)

    @classmethod
    def heading(cls, strands: StrandMixture, g: FloatArray) -> "Components":
        """Returns those of strands for one intended direction, (d,)."""
        exponents, share, _ = (part[0] for part in strands.by_direction(g[None]))
        return cls(
            strands.points, exponents, share[:, None] * strands.directions, strands.sigma
        )

    def model(self, patches: Patches) -> TaylorModel:
        """Returns the models (n, d + f) of the score, and of the mean of the pulls."""
        return self._score(patches, self._means(patches, products=False))

    def dual(self, patches: Patches) -> DualModel:
        """Returns the same with their derivatives, which are covariances with x_i."""
        means, d = self._means(patches, products=True), self.points.shape[1]
        base = means.functions(slice(d + self.pulls.shape[1]))
        centred = replace(base, parts=base.parts.copy())
        centred.parts[:, 0] = 0.0
        slopes = []
        for e in range(d):
            products = means.functions(slice(base.value.shape[1] + e, None, d))
            covariance = products - centred * centred.functions(slice(e, e + 1))
            slope = covariance.scaled(self._factors / self.sigma**2)
            slopes.append(slope.shifted(-self._factors * np.eye(len(self._factors))[e]))
        return DualModel(self._score(patches, base), tuple(slopes))

    def _means(self, patches: Patches, *, products: bool) -> TaylorModel:
        """Returns the models of the means, as of `kernels.tilted_means`."""
        waypoints = (self.points, self.exponents, self.pulls, self.sigma)
        return TaylorModel(
            *kernels.tilted_means(patches.centers, patches.axes, *waypoints, products)
        )

    def _score(self, patches: Patches, means: TaylorModel) -> TaylorModel:
        """Returns the score and the pulls, of the means of x_i - c and of the pulls."""
        nowhere = Patches(np.zeros_like(patches.centers), patches.axes)
        step = TaylorModel.position(nowhere, (0.0,) * self.pulls.shape[1])
        return (means - step).scaled(self._factors)

    @property
    def _factors(self) -> FloatArray:
        """What makes the score, and leaves the pulls as they are, (d + f,)."""
        d, f = self.points.shape[1], self.pulls.shape[1]
        return np.concatenate([np.full(d, 1 / self.sigma**2), np.ones(f)])
