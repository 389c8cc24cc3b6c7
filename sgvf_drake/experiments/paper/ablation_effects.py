"""What taking a part out does to a measure, seed by seed."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd

from sgvf_drake.experiments.intervals import interval
from sgvf_drake.experiments.outcome import Verdict

Interval = tuple[float, float, float]
"""A mean over the seeds with the ends of its 95 % interval."""


@dataclass(frozen=True)
class Effect:
    """A measure of the complete recipe, of the one without a part, and the change.

    Attributes:
        complete: Of the complete recipe.
        removed: Of the one without the part.
        change: Of the differences of the same seed, removed less complete.
    """

    complete: Interval
    removed: Interval
    change: Interval

    @property
    def rises(self) -> bool:
        """Whether the interval of the change is above zero; never so for a single seed."""
        return self.change[1] > 0

    @property
    def falls(self) -> bool:
        """Whether it is below zero."""
        return self.change[2] < 0

    def __str__(self) -> str:
        mean, low, high = self.change
        between = "" if np.isnan(low) else f", change {mean:+.2g} [{low:+.2g}, {high:+.2g}]"
        return f"{self.complete[0]:.2g} -> {self.removed[0]:.2g}{between}"


def effect_of(
    table: pd.DataFrame, measure: str, variant: str, complete: str = "complete"
) -> Effect:
    """Returns the effect of a variant on a measure.

    Seeds at which either value is missing are left out of the change.

    Args:
        table: One row a variant and seed, columns variant, seed and the measure.
        measure: The column.
        variant: The variant that lacks the part.
        complete: The one that has all.
    """
    values = table.pivot(index="seed", columns="variant", values=measure).astype(float)
    with_part, without = values[complete].to_numpy(), values[variant].to_numpy()
    return Effect(interval(with_part), interval(without), interval(without - with_part))


def verdict_of(parts: Mapping[str, bool]) -> Verdict:
    """Returns holds where every part of a claim was found, else in part where any was."""
    if all(parts.values()):
        return Verdict.HOLDS
    return Verdict.PARTLY if any(parts.values()) else Verdict.FAILS
