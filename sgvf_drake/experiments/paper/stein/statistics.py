"""What the moments of Stein's identity say: residuals, standard errors, convergence."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import stats

from sgvf_drake.experiments.paper.stein.trials import BLOCK, Moments
from sgvf_drake.fields import FloatArray

RAW, SQUASHED = 0, 1
"""Which of the two fields of `Moments` stands for the score."""

# A sample size needs so many independent samples of it for its root mean square.
FEWEST_GROUPS = 8
# Chance at which a set of true identities is taken for false.
SIGNIFICANCE = 0.01


@dataclass(frozen=True)
class Departure:
    """How far an expectation is from what an identity makes of it.

    Attributes:
        residual: Its size, relative to the largest that the Cauchy-Schwarz inequality
            allows: sqrt(E|S|^2 E|f|^2) for E[S f^T].
        error: The standard error of it, relative to the same.
        z: The largest of its entries in standard errors of that entry.
    """

    residual: float
    error: float
    z: float


def identity(moments: Moments, which: int = RAW, scale: float = 1.0) -> list[Departure]:
    """Returns the departures of scale E[S f^T] from -E[grad f], one for each probe."""
    residuals = scale * moments.products[:, which] + moments.gradients
    bounds = _bounds(moments, which, scale)
    return [_departure(residuals[:, k], bound) for k, bound in enumerate(bounds)]


def zero_mean(moments: Moments, which: int = RAW) -> Departure:
    """Returns the departure of E[S] from zero."""
    return _departure(moments.means[:, which], np.sqrt(_square(moments, which)))


def log_density(moments: Moments, which: int = RAW) -> Departure:
    """Returns the departure of E[S log p] from zero, the paper's f = log p.

    log p is a scalar and has no compact support.  The identity holds all the same, since
    p log p falls to zero with the Gaussian tails of p, and it says E[S log p] = -E[S]; that
    is zero because the integral of S p = grad p is.
    """
    bound = np.sqrt(_square(moments, which) * moments.log_squares.mean())
    return _departure(moments.log_products[:, which], bound)


def best_scale(moments: Moments) -> float:
    """Returns the factor with which the squashed score comes nearest to the identity."""
    products, gradients = moments.products[:, SQUASHED].mean(axis=0), moments.gradients.mean(0)
    weights = 1 / moments.probe_squares.mean(axis=0)[:, None, None]
    return float(-(weights * products * gradients).sum() / (weights * products**2).sum())


def score_error(moments: Moments) -> float:
    """Returns the root mean square error of the score under p, relative to its own."""
    return float(np.sqrt(moments.error_squares.mean() / moments.exact_squares.mean()))


def signals(moments: Moments, which: int = RAW, scale: float = 1.0) -> FloatArray:
    """Returns what the identity says, |E[grad f]| of each probe, (K,), relative as above."""
    sizes = np.linalg.norm(moments.gradients.mean(axis=0), axis=(1, 2))
    return np.asarray(sizes / _bounds(moments, which, scale))


def convergence(moments: Moments, which: int = RAW, scale: float = 1.0) -> pd.DataFrame:
    """Returns the residual over the number of draws: columns draws, residual.

    The root mean square over the probes and over independent samples of that many draws;
    the last row is that of all draws.
    """
    residuals = scale * moments.products[:, which] + moments.gradients
    bounds = _bounds(moments, which, scale)
    relative = residuals / bounds[:, None, None]
    blocks, sizes = len(relative), [1]
    while blocks // (2 * sizes[-1]) >= FEWEST_GROUPS:
        sizes.append(2 * sizes[-1])
    rows = []
    for size in (*sizes, blocks):
        groups = relative[: blocks // size * size].reshape(-1, size, *relative.shape[1:])
        squares = (groups.mean(axis=1) ** 2).sum(axis=(2, 3))
        rows.append({"draws": size * BLOCK, "residual": float(np.sqrt(squares.mean()))})
    return pd.DataFrame(rows)


def slope(curve: pd.DataFrame) -> float:
    """Returns the exponent with which a residual falls with the number of draws."""
    # All draws are a single sample, whose residual says little of its root mean square.
    several = curve.iloc[:-1]
    return float(np.polyfit(np.log(several["draws"]), np.log(several["residual"]), 1)[0])


def z_limit(count: int) -> float:
    """Returns the z that the largest of `count` entries passes by chance in `SIGNIFICANCE`.

    By Bonferroni's bound, whatever their correlation.
    """
    return float(stats.norm.isf(SIGNIFICANCE / 2 / count))


def _square(moments: Moments, which: int) -> float:
    return float(moments.squares[:, which].mean())


def _bounds(moments: Moments, which: int, scale: float) -> FloatArray:
    """Returns the bound on scale |E[S f^T]| for each probe, (K,)."""
    return scale * np.sqrt(_square(moments, which) * moments.probe_squares.mean(axis=0))


def _departure(blocks: FloatArray, bound: float) -> Departure:
    """Returns the departure of a mean of blocks (B, ...) from zero."""
    entries = blocks.reshape(len(blocks), -1)
    mean = entries.mean(axis=0)
    errors = entries.std(axis=0, ddof=1) / np.sqrt(len(entries))
    z = np.abs(mean) / np.maximum(errors, np.finfo(np.float64).tiny)
    return Departure(
        residual=float(np.linalg.norm(mean) / bound),
        error=float(np.linalg.norm(errors) / bound),
        z=float(z.max()),
    )
