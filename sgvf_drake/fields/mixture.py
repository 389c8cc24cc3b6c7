"""The Gaussian mixture of the waypoints: density, score and Jacobian in closed form."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sgvf_drake.fields.analytic import check_positive
from sgvf_drake.fields.base import FloatArray

# Points times waypoints that one chunk of an evaluation holds at a time: 2 MB of float64,
# which stays in the cache.
CHUNK_ENTRIES = 250_000


@dataclass(frozen=True, eq=False)
class GaussianMixture:
    """p(x) = 1/N sum_i N(x; x_i, sigma^2 I), the waypoints after noise of one level.

    This is the marginal of the paper's forward process at the time whose noise level is
    sigma, so its score is what denoising score matching converges to (paper, Section III-A).

    Attributes:
        points: The waypoints x_i, (N, d).
        sigma: The noise level, in the unit of the points; above zero.

    Raises:
        ConfigurationError: sigma is not a positive number.
    """

    points: FloatArray
    sigma: float

    def __post_init__(self) -> None:
        check_positive("sigma", self.sigma)

    @property
    def dim(self) -> int:
        """The dimension d of the space."""
        return int(self.points.shape[1])

    def log_density(self, x: FloatArray) -> FloatArray:
        """Returns log p(x), normalised: (n, d) -> (n,)."""
        return self.log_density_and_score(x)[0]

    def log_density_and_score(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns log p, (n,), and S, (n, d), with one pass over the waypoints."""
        normaliser = 0.5 * self.dim * np.log(2 * np.pi * self.sigma**2)
        values, score = np.empty(len(x)), np.empty(x.shape)
        for rows in self._chunks(len(x)):
            exponents = self._exponents(x[rows])
            top = exponents.max(axis=1)
            weights = np.exp(exponents - top[:, None])
            total = weights.sum(axis=1)
            values[rows] = top + np.log(total / len(self.points))
            mean = weights @ self.points / total[:, None]
            score[rows] = (mean - x[rows]) / self.sigma**2
        return values - normaliser, score

    def score(self, x: FloatArray) -> FloatArray:
        """Returns S = grad log p: (n, d) -> (n, d)."""
        score = np.empty(x.shape, x.dtype)
        for rows in self._chunks(len(x)):
            score[rows] = (self._weights(x[rows]) @ self.points - x[rows]) / self.sigma**2
        return score

    def score_and_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns S, (n, d), and dS/dx = cov_w(x_i)/sigma^4 - I/sigma^2, (n, d, d).

        Real or complex x: with complex x the derivatives continue analytically.
        """
        score = np.empty(x.shape, x.dtype)
        jacobian = np.empty((*x.shape, self.dim), x.dtype)
        for rows in self._chunks(len(x)):
            weights = self._weights(x[rows])
            mean = weights @ self.points
            centred = self.points[None] - mean[:, None]
            covariance = np.einsum("np,npi,npj->nij", weights, centred, centred)
            score[rows] = (mean - x[rows]) / self.sigma**2
            jacobian[rows] = (covariance / self.sigma**2 - np.eye(self.dim)) / self.sigma**2
        return score, jacobian

    def _exponents(self, x: FloatArray) -> FloatArray:
        # Differences before squares: |x|^2 - 2 x.p + |p|^2 cancels near the path.
        squares = sum((x[:, None, k] - self.points[None, :, k]) ** 2 for k in range(self.dim))
        return np.asarray(-0.5 / self.sigma**2 * squares)

    def _weights(self, x: FloatArray) -> FloatArray:
        exponents = self._exponents(x)
        weights = np.exp(exponents - exponents.real.max(axis=1, keepdims=True))
        return np.asarray(weights / weights.sum(axis=1, keepdims=True))

    def _chunks(self, num_points: int) -> Iterator[slice]:
        step = max(1, CHUNK_ENTRIES // len(self.points))
        return (slice(start, start + step) for start in range(0, num_points, step))
