"""Stein's identity by Monte Carlo: a score against test fields of compact support.

For a density p on R^d and a smooth field f of compact support, E[S f^T] = -E[grad f] with
S = grad log p and (grad f)_ij = df_j / dx_i (paper, Section II-B; Stein, 1972).  p is the
exact mixture of the noised waypoints, from which x can be drawn, so the one thing that is
tested is the score that stands for S.  Everything is in normalised units.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import (
    PAPER_GAIN,
    FloatArray,
    GaussianMixture,
    PaperComposition,
    ScoreNetwork,
)

RAW, SQUASHED = 0, 1
"""Which of the two fields of `Moments` stands for the score."""

# Draws whose mean makes one block; the standard errors are from the spread of the blocks.
BLOCK = 500
# Draws that are evaluated at a time.
CHUNK = 20_000
# Supports of the test fields: about a waypoint, smaller and larger than the gap between the
# circles (2 U), and about the middle, over everything.  In units U.
LOCAL_RADII = (0.5, 2.0)
WIDE_RADIUS = 8.0
# A direction along no axis and no symmetry of a shape.
SLANT = np.array([np.cos(1.0), np.sin(1.0)])
FORMS = {"constant": 0, "radial": 1, "quadratic": 2}
"""The power of y, as a complex number, that a test field is a bump times of."""

# A sample size needs so many independent samples of it for its root mean square.
FEWEST_GROUPS = 8


@dataclass(frozen=True, eq=False)
class Probe:
    """A smooth field f = b q of compact support in the plane: a bump times a polynomial.

    b(x) = exp(1 - 1 / (1 - |y|^2)) within |y| < 1 and 0 outside, y = (x - c) / R, and q is
    one of `FORMS`: a constant vector, y, or (y1^2 - y2^2, 2 y1 y2).  A rotation about c is
    y turned by a right angle, which turns the residual and does not change its size.

    Attributes:
        form: Which polynomial, one of `FORMS`.
        centre: c, (2,).
        radius: R.
    """

    form: str
    centre: FloatArray
    radius: float

    def value_and_gradient(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns f (n, 2), and its gradient df_j / dx_i as [n, i, j]."""
        y = (x - self.centre) / self.radius
        inside = 1 - (y**2).sum(axis=1)
        within = inside > 0
        rest = np.where(within, inside, 1.0)
        bump = np.where(within, np.exp(1 - 1 / rest), 0.0)
        slope = (-2 * bump / rest**2)[:, None] * y / self.radius
        # The derivatives of a power of z = y1 + i y2 by y1 and y2 are q' and i q'.
        z, power = y[:, 0] + 1j * y[:, 1], FORMS[self.form]
        by_z = power * z ** max(power - 1, 0)
        q = _as_vectors(z**power) if power else np.broadcast_to(SLANT, y.shape)
        dq = _as_vectors(np.stack([by_z, 1j * by_z], axis=1))
        gradient = slope[:, :, None] * q[:, None, :] + bump[:, None, None] * dq / self.radius
        return bump[:, None] * q, gradient


def _as_vectors(z: Any) -> FloatArray:
    """Returns complex numbers (...) as vectors (..., 2)."""
    return np.stack([z.real, z.imag], axis=-1)


def make_probes(waypoints: FloatArray) -> list[Probe]:
    """Returns the test fields: every form about one of the waypoints and over everything.

    Args:
        waypoints: (N, 2), of which the outermost in one direction is chosen: the same one in
            whatever order they come.
    """
    waypoint = waypoints[np.argmax(waypoints @ SLANT)]
    places = [(waypoint, radius) for radius in LOCAL_RADII]
    places.append((np.zeros(2), WIDE_RADIUS))
    return [Probe(form, centre, radius) for centre, radius in places for form in FORMS]


@dataclass(frozen=True, eq=False)
class Moments:
    """Means of what the identity is made of, over blocks of draws; B blocks, K probes.

    Two fields stand for the score: S, and the squashed s = tanh(k_s |S|) S / |S|.

    Attributes:
        products: S f^T and s f^T, (B, 2, K, 2, 2): which of them, probe, row, column.
        gradients: grad f, (B, K, 2, 2).
        means: S and s, (B, 2, 2).
        log_products: S log p and s log p, (B, 2, 2).
        squares: |S|^2 and |s|^2, (B, 2).
        probe_squares: |f|^2, (B, K).
        log_squares: log^2 p, (B,).
        exact_squares: The square of the exact score, (B,).
        error_squares: |S - exact score|^2, (B,).
    """

    products: FloatArray
    gradients: FloatArray
    means: FloatArray
    log_products: FloatArray
    squares: FloatArray
    probe_squares: FloatArray
    log_squares: FloatArray
    exact_squares: FloatArray
    error_squares: FloatArray

    def best_scale(self) -> float:
        """Returns the factor with which the squashed score comes nearest to the identity."""
        products, gradients = self.products[:, SQUASHED].mean(axis=0), self.gradients.mean(0)
        weights = 1 / self.probe_squares.mean(axis=0)[:, None, None]
        return float(-(weights * products * gradients).sum() / (weights * products**2).sum())

    def departures(self, which: int = RAW, scale: float = 1.0) -> Row:
        """Returns how far a score is from Stein's identity.

        Sizes are relative to the largest that the Cauchy-Schwarz inequality allows:
        sqrt(E|S|^2 E|f|^2) for E[S f^T].  log p, the paper's f, is a scalar and has no
        compact support.  The identity holds all the same, since p log p falls to zero with
        the Gaussian tails of p, and it says E[S log p] = -E[S]; that is zero because the
        integral of S p = grad p is.

        Args:
            which: `RAW` or `SQUASHED`.
            scale: What the score is multiplied with.

        Returns:
            Of each probe, (K,): the size of E[S f^T] + E[grad f], the `residuals`; their
            standard `errors`; and what the identity says, |E[grad f]|, the `signals`.  The
            largest entry `z` of the residuals in standard errors.  E[S] and E[S log p] as
            `mean` and `log` with `mean_z` and `log_z`.  The root mean square `score_error`
            under p, relative to the score.  The `scale`.  And a `curve` over the number of
            `draws`: the residual, root mean square over the probes and over independent
            samples of that many draws; the last is that of all draws.
        """
        square = self.squares[:, which].mean()
        bounds = scale * np.sqrt(square * self.probe_squares.mean(axis=0))[:, None, None]
        blocks = (scale * self.products[:, which] + self.gradients) / bounds
        residuals, errors, z = _departure(blocks.reshape(*blocks.shape[:2], 4))
        mean, _, mean_z = _departure(self.means[:, which] / np.sqrt(square))
        log_bound = np.sqrt(square * self.log_squares.mean())
        log, _, log_z = _departure(self.log_products[:, which] / log_bound)
        sizes = [2**k for k in range(len(blocks)) if len(blocks) >> k >= FEWEST_GROUPS]
        sizes = [*(sizes or [1]), len(blocks)]
        return {
            "residuals": residuals,
            "errors": errors,
            "signals": np.linalg.norm(self.gradients.mean(axis=0) / bounds, axis=(1, 2)),
            "z": z,
            "mean": mean,
            "mean_z": mean_z,
            "log": log,
            "log_z": log_z,
            "score_error": np.sqrt(self.error_squares.mean() / self.exact_squares.mean()),
            "scale": scale,
            "draws": [size * BLOCK for size in sizes],
            "curve": [_residual_of(blocks, size) for size in sizes],
        }


def _departure(blocks: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Returns the sizes of means of blocks (B, ..., d), their errors, and the largest z."""
    mean = blocks.mean(axis=0)
    errors = blocks.std(axis=0, ddof=1) / np.sqrt(len(blocks))
    z = np.abs(mean) / np.maximum(errors, np.finfo(np.float64).tiny)
    return np.linalg.norm(mean, axis=-1), np.linalg.norm(errors, axis=-1), float(z.max())


def _residual_of(blocks: FloatArray, size: int) -> float:
    """Returns the root mean square residual of independent samples of so many blocks."""
    samples = blocks[: len(blocks) // size * size].reshape(-1, size, *blocks.shape[1:])
    return float(np.sqrt((samples.mean(axis=1) ** 2).sum(axis=(2, 3)).mean()))


def collect(
    score: ScoreNetwork | GaussianMixture,
    mixture: GaussianMixture,
    probes: Sequence[Probe],
    draws: int,
    seed: int,
) -> Moments:
    """Draws x from a mixture and averages what Stein's identity of a score is made of.

    Args:
        score: What stands for S.
        mixture: p.
        probes: The test fields f.
        draws: Number of samples, a multiple of `CHUNK`.
        seed: Seed of the samples.
    """
    chunks = [_moments(score, mixture, probes, x) for x in _samples(mixture, draws, seed)]
    return Moments(*(np.concatenate(blocks) for blocks in zip(*chunks, strict=True)))


def _samples(mixture: GaussianMixture, draws: int, seed: int) -> Iterator[FloatArray]:
    rng = np.random.default_rng(seed)
    for _ in range(draws // CHUNK):
        chosen = mixture.points[rng.integers(len(mixture.points), size=CHUNK)]
        yield chosen + mixture.sigma * rng.standard_normal(chosen.shape)


def _moments(
    score: ScoreNetwork | GaussianMixture,
    mixture: GaussianMixture,
    probes: Sequence[Probe],
    x: FloatArray,
) -> list[FloatArray]:
    """Returns what `Moments` holds, for the blocks of one chunk x (n, 2)."""
    log_p, exact = mixture.log_density_and_score(x)
    S = exact if score is mixture else score.score(x)
    s, _ = PaperComposition(PAPER_GAIN).components(S, np.zeros_like(S))
    both = np.stack([S, s], axis=1)
    f, gradients = (
        np.stack(arrays, axis=1)
        for arrays in zip(*(probe.value_and_gradient(x) for probe in probes), strict=True)
    )
    values = (
        both[:, :, None, :, None] * f[:, None, :, None, :],
        gradients,
        both,
        both * log_p[:, None, None],
        (both**2).sum(axis=2),
        (f**2).sum(axis=2),
        log_p**2,
        (exact**2).sum(axis=1),
        ((S - exact) ** 2).sum(axis=1),
    )
    return [value.reshape(-1, BLOCK, *value.shape[1:]).mean(axis=1) for value in values]
