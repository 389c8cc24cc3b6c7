"""Claims of the paper as rows of a table, and the one function that judges them.

A claim measures a few figures from the rows of the trials and has a rule that turns them into
a verdict.  The figures say themselves how they are told, so that the evidence needs no words
of its own.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
import math
from typing import Any

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


@dataclass(frozen=True)
class Claim:
    """Something that is said of a field, and how it is put to the test.

    Attributes:
        key: Names it, in small letters with hyphens; no two claims share one.
        source: Where the paper says so: "Section V-C, Fig. 4 (a)".
        statement: What it says, in one sentence of ours.
        measure: Figures from the rows of the trials.
        rule: The verdict that follows from the figures.
        of_paper: Whether the paper says so of what was measured; else the claim is ours, or
            is judged by the robust recipe, which is ours.
    """

    key: str
    source: str
    statement: str
    measure: Callable[[Rows], Figures]
    rule: Callable[[Mapping[str, Any]], Verdict]
    of_paper: bool = True


@dataclass(frozen=True)
class Finding:
    """A claim that was judged; what is not named here is as that of the `Claim`.

    Attributes:
        verdict: What its rule says.
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
    figures = claim.measure(rows)
    told = "; ".join(f"{name}: {_text(figure)}" for name, figure in figures.items())
    return Finding(
        claim.key,
        claim.source,
        claim.statement,
        claim.rule(figures),
        f"{told}.",
        claim.of_paper,
    )


def claims_of_recipes(
    experiment: str,
    source: str,
    recipes: Iterable[str],
    table: Iterable[tuple[str, str, Callable[[Rows], Figures], str]],
) -> list[Claim]:
    """Returns the same claims of each of several recipes, the paper's and ours.

    Args:
        experiment: The first part of the keys.
        source: Where the paper says so.
        recipes: The recipes; the column `recipe` of every row of a trial says which is its.
        table: Key, statement with {} for the recipe, measure from the rows of one recipe, and
            the name of the `Count` in it that has to be all.
    """
    return [
        Claim(
            f"{experiment}-{key}-{recipe}",
            source,
            statement.format(f"(recipe {recipe})"),
            partial(_of_recipe, recipe=recipe, measure=measure),
            every(counted),
            of_paper=recipe == "paper",
        )
        for recipe in recipes
        for key, statement, measure, counted in table
    ]


def _of_recipe(rows: Rows, recipe: str, measure: Callable[[Rows], Figures]) -> Figures:
    return measure({name: own[own["recipe"] == recipe] for name, own in rows.items()})


def every(*names: str) -> Callable[[Figures], Verdict]:
    """Returns the rule that each `Count` of these names is all; in part: some of any."""

    def rule(figures: Figures) -> Verdict:
        counts = [count for name in names if isinstance(count := figures[name], Count)]
        return Verdict.when(
            all(0 < count.good == count.all for count in counts),
            any(count.good > 0 for count in counts),
        )

    return rule


def _text(figure: Figure) -> str:
    # A `Share` is a float with a text of its own.
    return f"{figure:.3g}" if type(figure) is float else str(figure)
