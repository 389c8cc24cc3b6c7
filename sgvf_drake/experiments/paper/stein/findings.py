"""What Stein's identity shows of one score over the seeds: its own, and squashed."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sgvf_drake.experiments.paper.stein.statistics import (
    RAW,
    SQUASHED,
    Departure,
    best_scale,
    convergence,
    identity,
    log_density,
    score_error,
    signals,
    slope,
    zero_mean,
)
from sgvf_drake.experiments.paper.stein.trials import EXACT, Moments
from sgvf_drake.fields import FloatArray

RECIPE_NAMES = {"robust": "robust recipe", "paper": "paper's recipe"}
SQUASHED_NAME = "exact, squashed"
RESCALED_NAME = "exact, squashed and rescaled"


@dataclass(frozen=True, eq=False)
class Finding:
    """One score against Stein's identity; relative sizes are as those of `Departure`.

    Attributes:
        density: The cloud and its sampling, in words.
        score: Which score, in words.
        residuals: Of the identity, (seeds, K) for K test fields.
        errors: Their standard errors, the same.
        signals: What the identity says, |E[grad f]|, (seeds, K).
        z: The largest entry of a residual in standard errors.
        entries: Number of entries, of which that is the largest.
        means: |E[S]|, (seeds,).
        mean_z: The largest entry of it in standard errors.
        logs: |E[S log p]|, (seeds,).
        log_z: The largest entry of it.
        score_errors: Root mean square error of the score under p, (seeds,).
        curve: The residual over the number of draws; see `convergence`.
        scale: What the score was multiplied with.
    """

    density: str
    score: str
    residuals: FloatArray
    errors: FloatArray
    signals: FloatArray
    z: float
    entries: int
    means: FloatArray
    mean_z: float
    logs: FloatArray
    log_z: float
    score_errors: FloatArray
    curve: pd.DataFrame
    scale: float

    @property
    def slope(self) -> float:
        """The exponent with which the residual falls with the number of draws."""
        return slope(self.curve)

    @property
    def share(self) -> float:
        """The residual over what the identity says, root mean square over the test fields.

        The square of a mean of draws exceeds that of the expectation by the square of its
        standard error on average, which is taken off.
        """
        square = float((self.residuals**2 - self.errors**2).mean())
        return float(np.sqrt(max(square, 0.0) / (self.signals**2).mean()))


def find(density: str, score: str, parts: Sequence[Moments]) -> list[Finding]:
    """Returns the finding of a score; of the exact one, also squashed, as is and rescaled.

    Args:
        density: The cloud and its sampling, in words.
        score: `EXACT`, or the recipe that learned it.
        parts: The moments of each seed.
    """
    name = RECIPE_NAMES.get(score, score)
    found = [_finding(density, name, parts, RAW, np.ones(len(parts)))]
    if score == EXACT:
        scales = np.array([best_scale(part) for part in parts])
        found += [
            _finding(density, SQUASHED_NAME, parts, SQUASHED, np.ones(len(parts))),
            _finding(density, RESCALED_NAME, parts, SQUASHED, scales),
        ]
    return found


def _finding(
    density: str, score: str, parts: Sequence[Moments], which: int, scales: FloatArray
) -> Finding:
    identities = [identity(part, which, k) for part, k in zip(parts, scales, strict=True)]
    means = [zero_mean(part, which) for part in parts]
    logs = [log_density(part, which) for part in parts]
    departures = [departure for row in identities for departure in row]
    return Finding(
        density=density,
        score=score,
        residuals=np.array([[departure.residual for departure in row] for row in identities]),
        errors=np.array([[departure.error for departure in row] for row in identities]),
        signals=np.array(
            [signals(part, which, k) for part, k in zip(parts, scales, strict=True)]
        ),
        z=_largest(departures),
        entries=len(departures) * parts[0].gradients[0, 0].size,
        means=np.array([departure.residual for departure in means]),
        mean_z=_largest(means),
        logs=np.array([departure.residual for departure in logs]),
        log_z=_largest(logs),
        score_errors=np.array([score_error(part) for part in parts]),
        curve=_mean_curve(parts, which, scales),
        scale=float(scales.mean()),
    )


def _largest(departures: Sequence[Departure]) -> float:
    return max(departure.z for departure in departures)


def _mean_curve(parts: Sequence[Moments], which: int, scales: FloatArray) -> pd.DataFrame:
    """Returns the root mean square of the seeds' curves."""
    curves = [convergence(part, which, k) for part, k in zip(parts, scales, strict=True)]
    squares = np.mean([curve["residual"] ** 2 for curve in curves], axis=0)
    return curves[0].assign(residual=np.sqrt(squares))
