"""Tables as the page shows them: text in its columns, intervals beside their means."""

from dataclasses import dataclass
from pathlib import Path

import pandas as pd
from pandas.api.types import is_bool_dtype, is_numeric_dtype

from sgvf_drake.experiments.report.numbers import cell_text, has_interval, interval_text

# Characters from which a text needs width.
PROSE = 50
MEAN, LOW, HIGH = " mean", " low", " high"


@dataclass(frozen=True)
class Column:
    """A column of a table on the page.

    Attributes:
        heading: What it holds, with the unit.
        numeric: Whether it is aligned to the right.
        cells: Its texts.
    """

    heading: str
    numeric: bool
    cells: tuple[str, ...]

    @property
    def kind(self) -> str:
        """What it is to the style sheet: numbers, sentences, or words."""
        if self.numeric:
            return "number"
        return "prose" if any(len(cell) > PROSE for cell in self.cells) else ""


@dataclass(frozen=True)
class TableView:
    """A table on the page.

    Attributes:
        caption: What is seen and what it means.
        columns: All of one length.
        intervals: Whether there are means with their intervals in it.
    """

    caption: str
    columns: tuple[Column, ...]
    intervals: bool

    @property
    def rows(self) -> list[tuple[tuple[Column, str], ...]]:
        """Its cells row by row, each with its column."""
        count = len(self.columns[0].cells) if self.columns else 0
        return [
            tuple((column, column.cells[index]) for column in self.columns)
            for index in range(count)
        ]


def read_table(path: Path) -> pd.DataFrame:
    """Reads a table of a result; only an empty cell has no value, the text "None" is one."""
    return pd.read_csv(path, keep_default_na=False, na_values=[""])


def view_table(table: pd.DataFrame, caption: str) -> TableView:
    """Returns a table as it is shown; "X mean", "X low" and "X high" become one column X."""
    columns, intervals = [], False
    for name in map(str, table.columns):
        stem, what = _part(name, table)
        if what == MEAN:
            parts = zip(table[name], table[stem + LOW], table[stem + HIGH], strict=True)
            cells = tuple(interval_text(*map(float, values)) for values in parts)
            columns.append(Column(stem, True, cells))
            intervals |= any(map(has_interval, cells))
        elif what is None:
            numeric = is_numeric_dtype(table[name]) and not is_bool_dtype(table[name])
            columns.append(Column(name, numeric, tuple(map(cell_text, table[name]))))
    return TableView(caption, tuple(columns), intervals)


def _part(name: str, table: pd.DataFrame) -> tuple[str, str | None]:
    """The name of the quantity and which part of its interval a column is, if of one."""
    for part in (MEAN, LOW, HIGH):
        stem = name.removesuffix(part)
        if stem != name and all(stem + each in table for each in (MEAN, LOW, HIGH)):
            return stem, part
    return name, None
