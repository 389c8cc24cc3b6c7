"""Stein's identity by Monte Carlo: a score against test fields of compact support.

For a density p on R^d and a smooth field f of compact support, E[S f^T] = -E[grad f] with
S = grad log p and (grad f)_ij = df_j / dx_i (paper, Section II-B; Stein, 1972).  p is the
exact mixture of the noised waypoints, from which x can be drawn, so the one thing that is
tested is the score that stands for S.  Everything is in normalised units.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from sgvf_drake.experiments.clouds import make_cloud
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.fields import (
    PAPER_GAIN,
    FloatArray,
    GaussianMixture,
    GuidingField,
    PaperComposition,
    ScoreNetwork,
)
from sgvf_drake.paths import PointCloud

EXACT = "exact"
"""The score in closed form; the other ones are learned, and go by their recipe."""

MOMENTS = "moments.npz"

# Noise level of the exact mixture: the data end of the paper's schedule as we take it.
SIGMA = 0.1
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
FORMS = ("constant", "radial", "quadratic")


@dataclass(frozen=True)
class SteinTrial:
    """A score that is put to the identity.

    Attributes:
        cloud: Path of the cloud, one of `clouds.PATHS`.
        sampling: One of `clouds.SAMPLINGS`.
        score: `EXACT`, or the recipe that learns it.
        seed: Of the cloud, the training and the draws.
        draws: Number of samples of p, a multiple of `CHUNK`.
    """

    cloud: str
    sampling: str
    score: str
    seed: int
    draws: int


@dataclass(frozen=True, eq=False)
class Probe:
    """A smooth field f = b q of compact support in the plane: a bump times a polynomial.

    b(x) = exp(1 - 1 / (1 - |y|^2)) within |y| < 1 and 0 outside, y = (x - c) / R, and q is
    one of `FORMS`: a constant vector, y, or (y1^2 - y2^2, 2 y1 y2).  A rotation about c is
    y turned by a right angle, which turns the residual and does not change its size.

    Attributes:
        form: Which polynomial.
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
        q, dq = self._polynomial(y)
        gradient = slope[:, :, None] * q[:, None, :] + bump[:, None, None] * dq / self.radius
        return bump[:, None] * q, gradient

    def _polynomial(self, y: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns q (n, 2) and dq_j / dy_i (n, 2, 2), the first of them along i."""
        match self.form:
            case "constant":
                return np.broadcast_to(SLANT, y.shape), np.zeros((len(y), 2, 2))
            case "radial":
                return y, np.broadcast_to(np.eye(2), (len(y), 2, 2))
        first, second = y.T
        q = np.column_stack([first**2 - second**2, 2 * first * second])
        by_first = np.column_stack([2 * first, 2 * second])
        by_second = np.column_stack([-2 * second, 2 * first])
        return q, np.stack([by_first, by_second], axis=1)


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

    def save(self, folder: Path) -> None:
        """Leaves `MOMENTS` in a folder; single precision is far finer than the errors."""
        arrays = {name: value.astype(np.float32) for name, value in vars(self).items()}
        np.savez_compressed(folder / MOMENTS, **arrays)

    @classmethod
    def load(cls, folder: Path) -> "Moments":
        """Reads what `save` left."""
        with np.load(folder / MOMENTS) as arrays:
            names = [attribute.name for attribute in fields(cls)]
            return cls(**{name: arrays[name].astype(np.float64) for name in names})


def make_probes(waypoint: FloatArray) -> list[Probe]:
    """Returns the test fields: every form about a waypoint (2,) and over everything."""
    places = [(waypoint, radius) for radius in LOCAL_RADII]
    places.append((np.zeros(2), WIDE_RADIUS))
    return [Probe(form, centre, radius) for centre, radius in places for form in FORMS]


def measure_stein(trial: SteinTrial, folder: Path) -> Row:
    """Trains a score, if it is a learned one, and leaves the moments of its identity."""
    cloud, _ = make_cloud(trial.cloud, trial.sampling, trial.seed)
    if trial.score == EXACT:
        mixture = GaussianMixture(cloud.normalize(cloud.points), SIGMA)
        score: ScoreNetwork | GaussianMixture = mixture
    else:
        field = _learned(cloud, trial)
        points = cloud.points if field.support is None else field.support
        mixture, score = (
            GaussianMixture(cloud.normalize(points), field.sigma),
            field.score_model,
        )
    # The outermost in one direction: the same one in whatever order they come.
    probes = make_probes(mixture.points[np.argmax(mixture.points @ SLANT)])
    collect(score, mixture, probes, trial.draws, trial.seed).save(folder)
    return {
        "probes": [
            {"form": probe.form, "radius": probe.radius, "centre": probe.centre.tolist()}
            for probe in probes
        ]
    }


def _learned(cloud: PointCloud, trial: SteinTrial) -> GuidingField:
    """Returns a field of which the score is trained; the tangent is not asked for."""
    from sgvf_drake.learning import TrainingConfig, train

    settings: dict[str, Any] = {"recipe": trial.score, "seed": trial.seed}
    return train(cloud, TrainingConfig(**settings, tangent_iterations=1, max_restarts=0)).field


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
        seed: Of the samples.
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
