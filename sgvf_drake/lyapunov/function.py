"""The Lyapunov function of a cloud: V = -log(p / p*), in closed form."""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import FloatArray
from sgvf_drake.fields import Field, GaussianMixture, GuidingField

# Fixed-point iterations of the mean shift from every point to its mode; each is a step of
# expectation maximisation, so the density only rises.
MODE_ITERATIONS = 100
# A mode is found when a step is this much shorter than the noise level.
MODE_TOLERANCE = 1e-9
# Steps of Newton's method that follow, the longest in noise levels, and the least curvature
# that it reckons with; and what slope is zero.  The last three are in noise levels.
NEWTON_STEPS = 30
LONGEST = 0.25
FLATTEST = 1e-12
STATIONARY = 1e-8
# The global modes are searched from so many points, those that are highest after a few steps
# from every waypoint: which waypoint is the highest by itself says little at a low noise.
MODE_STARTS = 64
FIRST_ITERATIONS = 20


@dataclass(frozen=True, eq=False)
class LyapunovFunction:
    """V(x) = -log(p(x) / p*) >= 0 with p the Gaussian mixture of the waypoints.

    The paper (Section IV) takes V from the learned score, as if grad V = -s.  But s is
    squashed by tanh, and a network is no gradient; so V comes from an explicit density here,
    and grad V = -S of the mixture.  Its noise level is free: it need not be that of the field.

    Attributes:
        mixture: The density p, in the user's unit.
        lowest: -log p*, the smallest -log p; found from the mixture.
    """

    mixture: GaussianMixture
    lowest: float = field(init=False)

    def __post_init__(self) -> None:
        highest = self.mixture.log_density(find_modes(self.mixture, MODE_STARTS)).max()
        object.__setattr__(self, "lowest", -float(highest))

    @classmethod
    def of(cls, guiding: GuidingField, sigma: float | None = None) -> "LyapunovFunction":
        """Returns V from the points that a field was learned from.

        Args:
            guiding: The field.
            sigma: The noise level in the field's unit; None: that of the field.

        Raises:
            ConfigurationError: sigma is not a positive number.
        """
        mixture = guiding.mixture
        return cls(mixture if sigma is None else GaussianMixture(mixture.points, sigma))

    @property
    def dim(self) -> int:
        """The dimension d of the space."""
        return self.mixture.dim

    @property
    def sigma(self) -> float:
        """The noise level, in the user's unit."""
        return self.mixture.sigma

    def __call__(self, x: FloatArray) -> FloatArray:
        """Returns V: (n, d) -> (n,)."""
        return -self.mixture.log_density(x) - self.lowest

    def value_and_gradient(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns V (n,) and grad V (n, d) with one pass over the waypoints."""
        log_density, score = self.mixture.log_density_and_score(x)
        return -log_density - self.lowest, -score

    def gradient(self, x: FloatArray) -> FloatArray:
        """Returns grad V = -S, per unit of length: (n, d) -> (n, d)."""
        return -self.mixture.score(x)

    def gradient_and_hessian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns grad V (n, d) and its Jacobian (n, d, d), at most I / sigma^2."""
        score, jacobian = self.mixture.score_and_jacobian(x)
        return -score, -jacobian

    def derivative(self, x: FloatArray, velocity: FloatArray) -> FloatArray:
        """Returns V_dot = grad V . velocity, (n, d), (n, d) -> (n,) (paper, Lemma 1)."""
        return np.asarray((self.gradient(x) * velocity).sum(axis=1))

    def along(self, m: Field, x: FloatArray) -> FloatArray:
        """Returns V_dot along x_dot = m(x): (n, d) -> (n,)."""
        return self.derivative(x, m(x))


def find_modes(mixture: GaussianMixture, num_starts: int | None = None) -> FloatArray:
    """Returns local maxima of the density of a mixture, (k, d), each once; at least one.

    By mean shift, x <- x + sigma^2 S(x), from the waypoints, which cannot overshoot (Cheng,
    IEEE PAMI 1995), and then by Newton's method, since mean shift crawls along a ridge.  Of a
    ridge that is flat to rounding, the highest point is all that is returned.

    Args:
        mixture: The mixture.
        num_starts: Follow only so many of the highest, which is enough for the global ones;
            None: all.
    """
    x = _mean_shift(mixture, mixture.points, FIRST_ITERATIONS)
    if num_starts is not None:
        x = x[np.argsort(-mixture.log_density(x), kind="stable")[:num_starts]]
    x = _newton(mixture, _mean_shift(mixture, x, MODE_ITERATIONS))
    score, jacobian = mixture.score_and_jacobian(x)
    # In noise levels: the slope is zero, and the density is highest in every direction.
    is_mode = np.linalg.norm(score, axis=1) * mixture.sigma <= STATIONARY
    is_mode &= np.linalg.eigvalsh(jacobian).max(axis=1) * mixture.sigma**2 < 0
    highest = x[[np.argmax(mixture.log_density(x))]]
    return distinct(x[is_mode], 1e-3 * mixture.sigma) if is_mode.any() else highest


def _newton(mixture: GaussianMixture, x: FloatArray) -> FloatArray:
    """Moves points (n, d) to where the score vanishes, by steps that are not long."""
    for _ in range(NEWTON_STEPS):
        score, jacobian = mixture.score_and_jacobian(x)
        # Uphill along every axis of the Hessian, also where it is no maximum yet.
        values, axes = np.linalg.eigh(jacobian)
        slope = np.einsum("nij,ni->nj", axes, score)
        size = np.maximum(np.abs(values), FLATTEST / mixture.sigma**2)
        step = np.einsum("nij,nj->ni", axes, slope / size)
        length = np.linalg.norm(step, axis=1, keepdims=True)
        x = x + step * (LONGEST * mixture.sigma / np.maximum(length, LONGEST * mixture.sigma))
    return x


def _mean_shift(mixture: GaussianMixture, x: FloatArray, iterations: int) -> FloatArray:
    x, moving = x.copy(), np.ones(len(x), bool)
    for _ in range(iterations):
        step = mixture.sigma**2 * mixture.score(x[moving])
        x[moving] += step
        moving[moving] = np.linalg.norm(step, axis=1) > MODE_TOLERANCE * mixture.sigma
        if not moving.any():
            break
    return x


def distinct(points: FloatArray, distance: float) -> FloatArray:
    """Returns one of points (n, d) that are nearer to each other than a distance, the first."""
    kept = np.ones(len(points), bool)
    kept[cKDTree(points).query_pairs(distance, output_type="ndarray")[:, 1]] = False
    return points[kept]
