"""What an experiment returns: figures and tables in reading order, and verdicts."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from matplotlib.figure import Figure
import pandas as pd


class Verdict(StrEnum):
    """What the measurement says of a claim."""

    HOLDS = "holds"
    PARTLY = "holds in part"
    FAILS = "does not hold"

    @classmethod
    def of(cls, outcomes: Iterable[bool]) -> "Verdict":
        """Holds where every outcome is good, in part where some are, else not."""
        good = list(outcomes)
        if good and all(good):
            return cls.HOLDS
        return cls.PARTLY if any(good) else cls.FAILS


@dataclass(frozen=True)
class Claim:
    """Something that is said of a field, and what was measured of it.

    Attributes:
        key: Names it, in small letters with hyphens; no two claims share one.
        source: Where the paper says so: "Section V-C, Fig. 4 (a)".
        statement: What it says, in one sentence of ours.
        verdict: Follows from the measured figures by a rule in the experiment.
        evidence: The figures, in one sentence.
        of_paper: Whether the paper says so of what was measured; else the claim is ours, or
            is judged by the robust recipe, which is ours.
    """

    key: str
    source: str
    statement: str
    verdict: Verdict
    evidence: str
    of_paper: bool = True


@dataclass(frozen=True, eq=False)
class Exhibit:
    """A figure or a table.

    Attributes:
        name: The stem of its file.
        caption: What is seen and what it means, in one or two sentences.
        content: A figure becomes a picture, a table a CSV file.  Where a table has three
            columns "X mean", "X low", "X high", they are shown as one.
    """

    name: str
    caption: str
    content: Figure | pd.DataFrame


@dataclass(frozen=True, eq=False)
class Outcome:
    """What an experiment found.

    Attributes:
        exhibits: In the order in which they are read.
        claims: One for each thing the paper says that was put to the test.
        figures: Further numbers by name, for `summary.json`.
        logs: Long tables by name, that are stored as Parquet and not shown.
    """

    exhibits: Sequence[Exhibit]
    claims: Sequence[Claim] = ()
    figures: Mapping[str, Any] = field(default_factory=dict)
    logs: Mapping[str, pd.DataFrame] = field(default_factory=dict)
