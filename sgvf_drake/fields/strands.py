"""The mixture of directed strands: where a cloud's paths lead a robot that heads along g.

A path that crosses itself, or a network that is travelled either way, has several directions
of travel at one place.  Which of them is meant is told by g, an intended direction: strands
along g weigh more than strands across it.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray
from sgvf_drake.fields.analytic import check_positive
from sgvf_drake.fields.base import FloatArray
from sgvf_drake.fields.mixture import CHUNK_ENTRIES
from sgvf_drake.fields.perceptron import Perceptron
from sgvf_drake.paths.sections import KAPPA

ONE_WAY_SHARPNESS = 1.5
"""kappa of a strand that has a direction: enough to go straight over a crossing of 10 degrees;
at 0 the field would be that of the position alone."""

TWO_WAY_SHARPNESS = KAPPA
"""kappa of a strand that is travelled either way.  Past its end, the strand ahead takes over to
a distance of sigma sqrt(2 log cosh kappa), 2.6 sigma here, which has to stay within the three
in which the projection acts: up to 5.2."""


@dataclass(frozen=True, eq=False)
class StrandMixture:
    """A Gaussian mixture on strands, whose weights depend on the intended direction.

    A component of direction T at z has the weight, up to a common factor,

        one way:  exp(-|x - z|^2 / 2 sigma^2 + kappa T.g),      and pulls along T;
        two way:  exp(-|x - z|^2 / 2 sigma^2) cosh(kappa T.g),  along tanh(kappa T.g) T;

    the second being the sum of the first over both signs of T.  With g = 0 the one-way
    components make the score of a plain Gaussian mixture and a tangent of the position alone.

    Attributes:
        points: z, (M, d).
        directions: T, unit vectors, (M, d).
        one_way: Whether a component has one direction of travel only, (M,).
        sigma: The noise level, in the unit of the points; above zero.

    Raises:
        ConfigurationError: sigma is not a positive number.
    """

    points: FloatArray
    directions: FloatArray
    one_way: BoolArray
    sigma: float

    def __post_init__(self) -> None:
        check_positive("sigma", self.sigma)

    def __call__(self, x: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the score S and the tangent N: (n, d), (n, d) -> (n, d) each."""
        S, N = (np.empty(x.shape, np.result_type(x, g)) for _ in range(2))
        for rows in self._chunks(len(x)):
            weights, share, _ = self._weights(x[rows], g[rows])
            S[rows] = (weights @ self.points - x[rows]) / self.sigma**2
            N[rows] = (weights * share) @ self.directions
        return S, N

    def with_derivatives(
        self, x: FloatArray, g: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Returns S (n, d), its derivative by (x, g) (n, d, 2d), and the same of N.

        Every weight has the gradient z / sigma^2 by x and kappa share T by g, up to the mean
        of these, so that all derivatives are covariances of the components.
        """
        d = x.shape[1]
        S, N = (np.empty(x.shape, np.result_type(x, g)) for _ in range(2))
        dS, dN = (np.empty((*x.shape, 2 * d), S.dtype) for _ in range(2))
        for rows in self._chunks(len(x)):
            weights, share, curvature = self._weights(x[rows], g[rows])
            pull = share[:, :, None] * self.directions
            slopes = np.concatenate(
                [
                    np.broadcast_to(self.points / self.sigma**2, pull.shape),
                    self.sharpness[:, None] * pull,
                ],
                axis=2,
            )
            mean = weights @ self.points
            S[rows] = (mean - x[rows]) / self.sigma**2
            N[rows] = np.einsum("np,npi->ni", weights, pull)
            slopes = slopes - np.einsum("np,npj->nj", weights, slopes)[:, None]
            slopes = weights[:, :, None] * slopes
            dS[rows] = np.einsum("pi,npj->nij", self.points, slopes) / self.sigma**2
            dS[rows, :, :d] -= np.eye(d) / self.sigma**2
            dN[rows] = np.einsum("npi,npj->nij", pull, slopes)
            dN[rows, :, d:] += np.einsum(
                "np,pi,pj->nij", weights * curvature, self.directions, self.directions
            )
        return S, dS, N, dN

    @property
    def sharpness(self) -> FloatArray:
        """Kappa of each component, (M,)."""
        return np.where(self.one_way, ONE_WAY_SHARPNESS, TWO_WAY_SHARPNESS)

    def by_direction(self, g: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Returns what intended directions (n, d) make of the components, (n, M) each.

        They are added to the exponents of the weights; they are how far each component pulls
        along its T; and the derivative of that by T.g.
        """
        along = self.sharpness * (g @ self.directions.T)
        share = np.where(self.one_way, 1.0, np.tanh(along))
        curvature = np.where(self.one_way, 0.0, self.sharpness * (1 - share**2))
        return np.where(self.one_way, along, _log_cosh(along)), share, curvature

    def _weights(
        self, x: FloatArray, g: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The weights of the components, how far each pulls along T, and d share / d T.g."""
        # Differences before squares: |x|^2 - 2 x.p + |p|^2 cancels near the path.
        squares = sum((x[:, None, k] - self.points[None, :, k]) ** 2 for k in range(x.shape[1]))
        by_direction, share, curvature = self.by_direction(g)
        exponents = by_direction - squares / (2 * self.sigma**2)
        weights = np.exp(exponents - exponents.real.max(axis=1, keepdims=True))
        return weights / weights.sum(axis=1, keepdims=True), share, curvature

    def _chunks(self, num_points: int) -> Iterator[slice]:
        step = max(1, CHUNK_ENTRIES // len(self.points))
        return (slice(start, start + step) for start in range(0, num_points, step))


def _log_cosh(a: FloatArray) -> FloatArray:
    """Without overflow, and analytic, so that a complex step passes through."""
    size = np.where(a.real < 0, -a, a)
    return np.asarray(size + np.log1p(np.exp(-2 * size)) - np.log(2))


@dataclass(frozen=True, eq=False)
class StrandNetwork:
    """A network that learned a `StrandMixture`: (x, g) -> (sigma S, N).

    Attributes:
        network: 2d inputs (x in normalised units, g), 2d outputs.
        sigma: The noise level, normalised units.
        two_way: Whether all strands are travelled either way.  Then S is even and N odd in
            g, which is built in by averaging the network over both signs.
    """

    network: Perceptron
    sigma: float
    two_way: bool

    def __call__(self, x: FloatArray, g: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the score S and the tangent N: (n, d), (n, d) -> (n, d) each."""
        d = x.shape[1]
        output = self.network(np.concatenate([x, g], axis=1))
        if self.two_way:
            output = _average(output, self.network(np.concatenate([x, -g], axis=1)))
        return output[:, :d] / self.sigma, output[:, d:]

    def with_derivatives(
        self, x: FloatArray, g: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Returns S (n, d), its derivative by (x, g) (n, d, 2d), and the same of N."""
        d = x.shape[1]
        output, J = self.network.value_and_jacobian(np.concatenate([x, g], axis=1))
        if self.two_way:
            mirrored, J_mirrored = self.network.value_and_jacobian(
                np.concatenate([x, -g], axis=1)
            )
            J_mirrored[:, :, d:] *= -1
            output, J = _average(output, mirrored), _average(J, J_mirrored)
        return output[:, :d] / self.sigma, J[:, :d] / self.sigma, output[:, d:], J[:, d:]


def _average(output: FloatArray, mirrored: FloatArray) -> FloatArray:
    """The even part of the first half of the rows, and the odd part of the second."""
    d = output.shape[1] // 2
    signs = np.repeat([1.0, -1.0], d).reshape(-1, *(1,) * (output.ndim - 2))
    return np.asarray((output + signs * mirrored) / 2)
