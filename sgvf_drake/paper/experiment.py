"""What an experiment of the paper is: trials, and what their rows show.

An experiment runs trials, each of which gives a row of plain values and may leave files for
the figures.  Tables and claims follow from the rows alone, so that the stored rows of a
reproduction are enough to draw the tables and judge the claims again.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
import pandas as pd

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.intervals import interval_columns, over_seeds
from sgvf_drake.experiments.results import plain, save_figure
from sgvf_drake.experiments.workbench import Measure, Row, Workbench
from sgvf_drake.paper.claims import Claim, Count, Finding, Rows, judge

FOLDER = "folder"
"""The column of the files that a trial left; stored rows are without it."""


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

    @property
    def file(self) -> str:
        """The name of its file."""
        return f"{self.name}.{'png' if isinstance(self.content, Figure) else 'csv'}"

    def save(self, folder: Path) -> None:
        """Writes its file into a folder."""
        if isinstance(self.content, Figure):
            save_figure(self.content, folder / self.file)
        else:
            self.content.to_csv(folder / self.file, index=False)


class Experiment(ABC):
    """A kind of experiment: its fields are the options that a scenario file may set."""

    seeds: list[int]

    @abstractmethod
    def measure(self, bench: Workbench) -> Rows:
        """Runs the trials; returns a table for each kind of them, made by `run_trials`."""

    @abstractmethod
    def claims(self) -> Sequence[Claim]:
        """Returns the claims that are put to the test, in the order of the paper."""

    @abstractmethod
    def tables(self, rows: Rows) -> Sequence[Exhibit]:
        """Returns the tables, from the rows alone."""

    @abstractmethod
    def figures(self, rows: Rows) -> Sequence[Exhibit]:
        """Returns the figures, from the rows and the files that the trials left."""

    def logs(self, rows: Rows) -> Mapping[str, pd.DataFrame]:
        """Returns long tables that are stored and not shown."""
        return {}

    def findings(self, rows: Rows) -> list[Finding]:
        """Judges the claims by the rows."""
        return [judge(claim, rows) for claim in self.claims()]


Range = tuple[float, float]

Column = tuple[str, Range | Callable[[pd.Series], Any]]
"""A measure, and what its seeds give: the mean with its interval, which is within a range, or
what a function makes of them: a value, or several columns."""


@dataclass(frozen=True, eq=False)
class SeedsTable:
    """A table of one row a group, with what its seeds say.

    Attributes:
        name: Name of the exhibit.
        caption: Its caption.
        columns: The columns beside those of the group, by their headers.
    """

    name: str
    caption: str
    columns: Mapping[str, Column]

    def of(self, rows: pd.DataFrame, by: Sequence[str]) -> Exhibit:
        """Returns the table of rows, one a seed of a group with the same values of `by`."""

        def row_of(own: pd.DataFrame) -> Row:
            row: Row = {}
            for header, (measure, kind) in self.columns.items():
                if isinstance(kind, tuple):
                    row |= interval_columns(header, own[measure].astype(float), kind)
                else:
                    told = kind(own[measure])
                    row |= told if isinstance(told, Mapping) else {header: told}
            return row

        return Exhibit(self.name, self.caption, over_seeds(rows, by, row_of))


def first(values: pd.Series) -> Any:
    """Returns the first of the values, where all are the same or one stands for all."""
    return values.iloc[0]


def count(outcomes: pd.Series) -> str:
    """Returns how many outcomes are good, as "5 of 6"."""
    return str(Count.of(outcomes))


def check_names(what: str, names: Iterable[str], known: Iterable[str]) -> None:
    """Raises a `ConfigurationError` if one of the names is not among those that are known."""
    for name in names:
        if name not in known:
            raise ConfigurationError(
                f"there is no {what} {name!r} (they are {', '.join(known)})"
            )


def run_trials(
    bench: Workbench,
    measure: Measure,
    trials: Sequence[Any],
    stage: str,
) -> pd.DataFrame:
    """Runs trials; returns one row each: what the trial is, what it found, its folder.

    Args:
        bench: Runs them, or has their rows from before.
        measure: What measures one.
        trials: Frozen dataclasses.
        stage: What they are called where progress is shown.
    """
    records = bench.run(measure, trials, stage)
    return pd.DataFrame(
        {**asdict(trial), **record.row, FOLDER: record.folder}
        for trial, record in zip(trials, records, strict=True)
    )


def save_rows(rows: Rows, file: Path) -> None:
    """Writes the rows of trials as JSON, one line a row, without what is left in folders."""
    lines = [
        f"{json.dumps(name)}: [\n"
        + ",\n".join(
            json.dumps(plain(row), allow_nan=False)
            for row in table.drop(columns=FOLDER, errors="ignore").to_dict("records")
        )
        + "\n]"
        for name, table in rows.items()
    ]
    file.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")


def load_rows(file: Path) -> dict[str, pd.DataFrame]:
    """Returns the rows that `save_rows` has written."""
    stored = json.loads(file.read_text(encoding="utf-8"))
    return {name: pd.DataFrame(rows) for name, rows in stored.items()}
