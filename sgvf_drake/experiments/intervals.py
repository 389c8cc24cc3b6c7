"""What a few seeds say: a mean with its interval, a fraction with its interval."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
import pandas as pd
from scipy import stats

CONFIDENCE = 0.95
SHARE = (0.0, 1.0)
"""The range of a share of something."""

POSITIVE = (0.0, np.inf)
"""The range of a length."""


def interval(
    values: ArrayLike,
    within: tuple[float, float] = (-np.inf, np.inf),
    comparisons: int = 1,
) -> tuple[float, float, float]:
    """Returns the mean of values and its 95 % interval, by Student's t.

    Not by the bootstrap, whose intervals of three to five values hold the mean of a normal
    distribution 75 to 83 % of the time.  NaN values are left out.  The interval is NaN for a
    single value, which says nothing of the spread; all three are NaN without any.

    Args:
        values: One a seed.
        within: The range that the mean is known to be in; the interval is cut to it.
        comparisons: The number of intervals of which all are to hold their means in 95 %, by
            Bonferroni's bound, whatever their correlation.
    """
    known = np.asarray(values, dtype=np.float64).ravel()
    known = known[~np.isnan(known)]
    if len(known) == 0:
        return (float("nan"),) * 3
    mean = float(known.mean())
    if len(known) == 1:
        return mean, float("nan"), float("nan")
    tail = (1 - CONFIDENCE) / 2 / comparisons
    half = float(stats.t.isf(tail, len(known) - 1) * stats.sem(known))
    low, high = np.clip((mean - half, mean + half), *within)
    return mean, float(low), float(high)


def fraction_interval(successes: int, trials: int) -> tuple[float, float, float]:
    """Returns successes / trials and its 95 % Wilson interval."""
    found = stats.binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return successes / trials, float(found.low), float(found.high)


def over_seeds(
    rows: pd.DataFrame,
    by: Sequence[str],
    columns: Callable[[pd.DataFrame], Mapping[str, Any]],
) -> pd.DataFrame:
    """Returns a table with one row a group: its labels, and columns made of its rows.

    Args:
        rows: One row a seed of a group.
        by: Columns whose values are the same in a group.
        columns: The further columns, from the rows of a group.
    """
    return pd.DataFrame(
        {**dict(zip(by, labels, strict=True)), **columns(own)}
        for labels, own in rows.groupby(list(by), sort=False)
    )


def interval_columns(
    name: str, values: ArrayLike, within: tuple[float, float] = POSITIVE
) -> Mapping[str, float]:
    """Returns `interval` as three columns of a table: "NAME mean", "NAME low", "NAME high".

    Args:
        name: What the columns are called.
        values: One a seed.
        within: The range of the mean; what is in tables is seldom negative.
    """
    return _columns(name, interval(values, within))


def fraction_columns(name: str, outcomes: Sequence[bool]) -> Mapping[str, float]:
    """Returns `fraction_interval` of yes-or-no outcomes as three columns of a table."""
    return _columns(name, fraction_interval(int(np.sum(outcomes)), len(outcomes)))


def _columns(name: str, values: tuple[float, float, float]) -> Mapping[str, float]:
    parts = zip(("mean", "low", "high"), values, strict=True)
    return {f"{name} {part}": value for part, value in parts}
