"""What every file of waypoints comes down to: a table of numbers, and places in the file."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.exceptions import PointCloudError

MOST_NAMES = 12
"""So many columns are named in an error; the others are counted."""

FEWEST_TRANSPOSED = 5
"""An array of two or three rows has the points in its columns if it has so many."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Some columns of a table.

    Attributes:
        values: (N, k), NaN where a number is missing.
        places: (N,) the line of each row in a text, or else its number.
        breaks: Rows in front of which the file has a blank line or another break.
    """

    values: FloatArray
    places: IntArray
    breaks: Sequence[int] = ()


@dataclass(frozen=True, eq=False)
class Table(ABC):
    """A file as a table.

    Attributes:
        path: The file.
        kind: What it is: "CSV", "GPX track".
        names: The names of its columns, if they have any.
        num_columns: How many there are.
        units: The units of the columns by their numbers, where a line of its own tells them.
        notes: What is to be said of it.
        place: What the places of its rows are: "line", "row".
    """

    path: Path
    kind: str
    names: Sequence[str] | None
    num_columns: int
    units: dict[int, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    place: str = "line"

    @abstractmethod
    def numbers(self, columns: Sequence[int]) -> Rows:
        """Returns the numbers in some columns.

        Raises:
            PointCloudError: If a field is no number.
        """

    def error(self, message: str, place: int | None = None) -> PointCloudError:
        """Makes an error that names the file, and the place in it."""
        where = "" if place is None else f", {self.place} {place}"
        return PointCloudError(f"{self.path}{where}: {message}")

    @property
    def columns_text(self) -> str:
        if self.names is None:
            return f"columns 0 to {self.num_columns - 1}, without names"
        more = self.num_columns - MOST_NAMES
        shown = ", ".join(repr(name) for name in self.names[:MOST_NAMES])
        return f"columns {shown}" + (f" and {more} more" if more > 0 else "")

    def label(self, column: int) -> str:
        """Returns what a column is called: its name, or "column 2"."""
        return self.names[column] if self.names else f"column {column}"


@dataclass(frozen=True, eq=False, kw_only=True)
class ArrayTable(Table):
    """A table whose numbers are there at once."""

    rows: Rows

    def numbers(self, columns: Sequence[int]) -> Rows:
        values = self.rows.values[:, list(columns)]
        return Rows(values, self.rows.places, self.rows.breaks)


def looks_transposed(shape: tuple[int, ...]) -> bool:
    """Tells whether an array holds a coordinate a row where a point a row was meant."""
    return len(shape) == 2 and shape[0] in (2, 3) and shape[1] >= FEWEST_TRANSPOSED


def array_of(rows: Sequence[Sequence[float]]) -> FloatArray:
    """Makes an array (N, k) of rows, also of none."""
    return np.array(rows, dtype=np.float64).reshape(len(rows), -1)
