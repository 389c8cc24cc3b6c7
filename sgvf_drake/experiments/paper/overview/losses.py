"""Whether the losses of a training came to rest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

# Parts into which a training is cut, each of which has one mean.
PARTS = 10
# The total has come to rest when its last two parts differ by no more than this part of it, or
# by no more than so many standard errors of what one batch differs from another...
REST, ERRORS = 0.1, 2.0
# ... but by no more than this, however noisy it is;
LARGEST_CHANGE = 0.25
# ... and has been stable when no part of the second half exceeds the end by this factor.
STABLE = 1.5


@dataclass(frozen=True)
class LossCourse:
    """The course of one loss.

    Attributes:
        begin: Mean over the first part of the training.
        end: Mean over the last part.
        change: Of the last part from the one before, relative to the end.
        error: Standard error of that change.
        peak: The highest part of the second half, relative to the end.
    """

    begin: float
    end: float
    change: float
    error: float
    peak: float

    @property
    def converged(self) -> bool:
        """Whether it fell, came to rest, and was stable on the way."""
        rests = abs(self.change) <= min(max(REST, ERRORS * self.error), LARGEST_CHANGE)
        return self.end < self.begin and rests and self.peak <= STABLE


def course(losses: pd.Series) -> LossCourse:
    """Returns the course of a loss, given at even steps of the training."""
    parts = np.array_split(losses.to_numpy(dtype=np.float64), PARTS)
    means = [float(part.mean()) for part in parts]
    variance = sum(float(part.var(ddof=1)) / len(part) for part in parts[-2:])
    end = means[-1]
    scale = max(end, float(np.finfo(np.float64).tiny))
    return LossCourse(
        begin=means[0],
        end=end,
        change=(end - means[-2]) / scale,
        error=float(np.sqrt(variance)) / scale,
        peak=max(means[PARTS // 2 :]) / scale,
    )


def tangent_courses(history: pd.DataFrame) -> dict[str, LossCourse]:
    """Returns the course of every loss of the tangent network, and of their total."""
    tangent = history[history["stage"] == "tangent"].dropna(axis=1, how="all")
    return {str(term): course(tangent[term]) for term in tangent.columns[2:]}


def losses_table(histories: Mapping[tuple[str, str], Sequence[pd.DataFrame]]) -> pd.DataFrame:
    """Returns one row a shape, recipe and loss, each figure the mean over the seeds.

    Args:
        histories: Of the trainings with each seed, by shape and recipe.
    """
    rows = []
    for (shape, recipe), own in histories.items():
        courses = [tangent_courses(history) for history in own]
        for term in courses[0]:
            these = [by_term[term] for by_term in courses]
            rows.append(
                {
                    "shape": shape,
                    "recipe": recipe,
                    "loss": term,
                    "first tenth": np.mean([one.begin for one in these]),
                    "last tenth": np.mean([one.end for one in these]),
                    "change, %": 100 * np.mean([one.change for one in these]),
                    "highest later, %": 100 * np.mean([one.peak for one in these]),
                }
            )
    return pd.DataFrame(rows)
