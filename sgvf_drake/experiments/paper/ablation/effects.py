"""What taking a part out does to a measure, seed by seed."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from sgvf_drake.paper.intervals import interval

COMPLETE = "complete"
"""The variant that lacks nothing."""

Interval = tuple[float, float, float]
"""A mean over the seeds with the ends of its 95 % interval."""


@dataclass(frozen=True)
class Effect:
    """A measure of the complete recipe, of the one without a part, and the change.

    Attributes:
        complete: Of the complete recipe.
        removed: Of the one without the part.
        change: Of the differences of the same seed, removed less complete; those of the
            logarithms for a factor.
        is_factor: Whether the change is told as a factor.
    """

    complete: Interval
    removed: Interval
    change: Interval
    is_factor: bool = False

    @property
    def rises(self) -> bool:
        """Whether the interval of the change is above zero; never so for a single seed."""
        return self.change[1] > 0

    @property
    def falls(self) -> bool:
        """Whether it is below zero."""
        return self.change[2] < 0

    def __str__(self) -> str:
        told = f"{self.complete[0]:.2g} -> {self.removed[0]:.2g}"
        if np.isnan(self.change[1]):
            return told
        if self.is_factor:
            mean, low, high = np.exp(self.change)
            return f"{told}, a factor of {mean:.2g} [{low:.2g}, {high:.2g}]"
        mean, low, high = self.change
        return f"{told}, change {mean:+.2g} [{low:+.2g}, {high:+.2g}]"


def effect_of(
    table: pd.DataFrame,
    measure: str,
    variant: str,
    *,
    factor: bool = False,
    comparisons: int = 1,
) -> Effect:
    """Returns the effect of a variant on a measure.

    Seeds at which either value is missing are left out of the change.

    Args:
        table: One row a variant and seed, columns variant, seed and the measure.
        measure: The column.
        variant: The variant that lacks the part.
        factor: Whether the change is a factor, as for a length that may grow without bounds,
            of which a few seeds otherwise say little.
        comparisons: The number of changes that are judged together; see `interval`.
    """
    values = table.pivot(index="seed", columns="variant", values=measure).astype(float)
    with_part, without = values[COMPLETE].to_numpy(), values[variant].to_numpy()
    change = np.log(without / with_part) if factor else without - with_part
    judged = interval(change, comparisons=comparisons)
    return Effect(interval(with_part), interval(without), judged, factor)
