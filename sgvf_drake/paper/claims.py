"""Claims of the paper, and the one function that judges them.

A claim measures a few figures from the rows of the trials, from which a verdict follows.  The
figures say themselves how they are told, so that the evidence needs no words of its own.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
import math

import pandas as pd

from sgvf_drake.experiments.intervals import SHARE, interval

Rows = Mapping[str, pd.DataFrame]
"""What the trials of an experiment found: a table a kind of trial, one row a trial."""


class Verdict(StrEnum):
    """What the measurement says of a claim."""

    HOLDS = "holds"
    PARTLY = "holds in part"
    FAILS = "does not hold"

    @classmethod
    def when(cls, holds: bool, partly: bool = False) -> "Verdict":
        """Holds under the first condition, in part under the second, else not."""
        return cls.HOLDS if holds else cls.PARTLY if partly else cls.FAILS

    @classmethod
    def every(cls, *counts: "Count") -> "Verdict":
        """Holds where each count is all; in part where some of any are good."""
        all_good = all(0 < count.good == count.all for count in counts)
        return cls.when(all_good, any(count.good > 0 for count in counts))


@dataclass(frozen=True)
class Count:
    """How many of some things are so, told as "5 of 6"."""

    good: int
    all: int

    @classmethod
    def of(cls, outcomes: Iterable[bool]) -> "Count":
        """Counts the good ones among outcomes."""
        known = [bool(outcome) for outcome in outcomes]
        return cls(sum(known), len(known))

    def __str__(self) -> str:
        return f"{self.good} of {self.all}"


class Share(float):
    """A part of a whole, told in per cent."""

    def __str__(self) -> str:
        return f"{self:.0%}"


@dataclass(frozen=True)
class Mean:
    """A mean share over the seeds with its 95 % interval, told as "50% [40%, 60%]".

    The bounds are NaN for a single value, which shows nothing: no bound compares with it.
    """

    mean: float
    low: float
    high: float

    @classmethod
    def of(cls, values: pd.Series, within: tuple[float, float] = SHARE) -> "Mean":
        """Returns the mean and interval of values, one a seed; see `interval`."""
        return cls(*interval(values, within))

    def __str__(self) -> str:
        if math.isnan(self.low):
            return f"{self.mean:.0%}"
        return f"{self.mean:.0%} [{self.low:.0%}, {self.high:.0%}]"


@dataclass(frozen=True)
class Span:
    """The least and the largest of some values, told as "0.1 to 0.3"."""

    low: float
    high: float
    percent: bool = False

    @classmethod
    def of(cls, values: Iterable[float]) -> "Span":
        """Returns the span of values."""
        known = [float(value) for value in values]
        return cls(min(known), max(known))

    def __str__(self) -> str:
        form = ".0%" if self.percent else ".3g"
        return f"{self.low:{form}} to {self.high:{form}}"


Figure = Count | Share | Mean | Span | float | int | str
Figures = Mapping[str, Figure]
"""What is measured of a claim, by what it is called where it is told."""

Judged = tuple[Figures, Verdict]
"""The figures of a claim, and the verdict that follows from them."""


@dataclass(frozen=True)
class Claim:
    """Something that is said of a field, and how it is put to the test.

    Attributes:
        key: Names it, in small letters with hyphens; no two claims share one.
        source: Where the paper says so: "Section V-C, Fig. 4 (a)".
        statement: What it says, in one sentence of ours.
        measure: Figures from the rows of the trials, and the verdict.
        of_paper: Whether the paper says so of what was measured; else the claim is ours, or
            is judged by the robust recipe, which is ours.
    """

    key: str
    source: str
    statement: str
    measure: Callable[[Rows], Judged]
    of_paper: bool = True


class Claims(list[Claim]):
    """Claims in the order in which they are told."""

    def add(
        self, key: str, source: str, of_paper: bool = True
    ) -> Callable[[Callable[[Rows], Judged]], Callable[[Rows], Judged]]:
        """Adds a claim that the function below measures; its docstring is the statement."""

        def keep(measure: Callable[[Rows], Judged]) -> Callable[[Rows], Judged]:
            statement = " ".join((measure.__doc__ or "").split())
            assert statement, f"the claim {key} says nothing"
            self.append(Claim(key, source, statement, measure, of_paper))
            return measure

        return keep

    def of_recipes(self, recipes: Iterable[str]) -> list[Claim]:
        """Returns the same claims of each of several recipes, the paper's and ours.

        Each is measured from the rows whose column `recipe` names its recipe.  In the
        statement, {} stands for the recipe.
        """

        def measured(claim: Claim, recipe: str) -> Callable[[Rows], Judged]:
            return lambda rows: claim.measure(
                {name: own[own["recipe"] == recipe] for name, own in rows.items()}
            )

        return [
            Claim(
                f"{claim.key}-{recipe}",
                claim.source,
                claim.statement.format(f"(recipe {recipe})"),
                measured(claim, recipe),
                of_paper=recipe == "paper",
            )
            for recipe in recipes
            for claim in self
        ]


@dataclass(frozen=True)
class Finding:
    """A claim that was judged; what is not named here is as that of the `Claim`.

    Attributes:
        verdict: What follows from the figures.
        evidence: The figures, as "name: figure; name: figure".
    """

    key: str
    source: str
    statement: str
    verdict: Verdict
    evidence: str
    of_paper: bool = True


def judge(claim: Claim, rows: Rows) -> Finding:
    """Returns the verdict on a claim, and the figures that it rests on."""
    figures, verdict = claim.measure(rows)
    told = "; ".join(f"{name}: {_text(figure)}" for name, figure in figures.items())
    own = claim.key, claim.source, claim.statement
    return Finding(*own, verdict, f"{told}.", claim.of_paper)


def _text(figure: Figure) -> str:
    # A `Share` is a float with a text of its own.
    return f"{figure:.3g}" if type(figure) is float else str(figure)
