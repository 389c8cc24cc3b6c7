"""Waypoints from a file: CSV, whitespace-separated text, or NumPy's .npy.

Every problem is one PointCloudError that names the file and, in text, the line.
"""

from collections.abc import Sequence
import csv
from dataclasses import dataclass
import math
from pathlib import Path
import re

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import PointCloudError

COORDINATE_NAME = re.compile(r"^([xyz])([_ \[(].*)?$", re.IGNORECASE)
"""Column names that are coordinates: "x", "y_m", "Z [m]", "x(t)"."""

VELOCITY_NAME = re.compile(r"^v_?([xyz])([_ \[(].*)?$", re.IGNORECASE)
"""Column names that are velocities: "vx", "vy_mps", "Vz [m/s]", "v_x"."""

MOST_UNNAMED_COLUMNS = 3
"""A file without known names and with no more columns than this holds coordinates only."""

DELIMITERS = (";", ",", "\t")
"""Looked for in this order, as a comma beside a semicolon is a decimal comma."""


@dataclass(frozen=True, eq=False)
class _Table:
    """The fields of a text file: `names` (or None) and `rows`, with their line numbers.

    The `values` of a .npy file are there at once; it has one row, for its width.
    """

    path: Path
    names: list[str] | None
    rows: list[list[str]]
    lines: list[int]
    values: FloatArray | None = None

    @property
    def num_columns(self) -> int:
        return len(self.rows[0])

    @property
    def columns_text(self) -> str:
        if self.names is None:
            return f"columns 0 to {self.num_columns - 1}, without names"
        return "columns " + ", ".join(repr(name) for name in self.names)


def read_points(
    path: str | Path, columns: str | Sequence[str | int] | None = None
) -> FloatArray:
    """Reads waypoints, one a line, in the order of the file.

    A text file is UTF-8 with fields separated by semicolons, commas, tabs or spaces, as
    its first line shows.  Blank lines and comments (from "#") are skipped.  Column names
    come from a first line without any number, or else from the last comment before the
    data, if it has as many fields as the data.

    Args:
        path: a .npy file with an array (N, columns), or else a text file.
        columns: the columns to take, by name or by number, counted from 0; a text of
            digits is a number, so "0,1" works, as does "x_m,y_m".  By default the columns
            named like x, y and (if there) z, or all columns if there are at most three.

    Returns:
        Array (N, d), d >= 2, finite.

    Raises:
        PointCloudError: if the file cannot be read, or a line or a column cannot be used.
    """
    table = _open(path)
    return _numbers(table, _choose(table, _listed(columns)))


def read_waypoints(
    path: str | Path, columns: str | Sequence[str | int] | None = None
) -> tuple[FloatArray, FloatArray | None]:
    """Reads waypoints as `read_points` does, and the velocities beside them.

    Velocities are the columns named like vx, vy and vz, of the same axes as the coordinates
    that are taken.  Coordinates of other names have them if both are as many.  Where a name
    occurs twice, as in vx_mps and vx_std, the plain "vx" is meant, or else none.

    Args:
        path: a .npy file with an array (N, columns), or else a text file.
        columns: the columns of the coordinates.

    Returns:
        The waypoints (N, d) and their velocities (N, d), finite; None where the file names
        none for every coordinate.

    Raises:
        PointCloudError: if the file cannot be read, or a line or a column cannot be used.
    """
    table = _open(path)
    chosen = _choose(table, _listed(columns))
    moving = _velocity_columns(table, chosen)
    return _numbers(table, chosen), _numbers(table, moving) if moving else None


def _listed(columns: str | Sequence[str | int] | None) -> Sequence[str | int] | None:
    if isinstance(columns, str):
        return [name.strip() for name in columns.split(",")]
    return columns


def _open(path: str | Path) -> "_Table":
    path = Path(path)
    if path.is_dir():
        raise PointCloudError(f"{path} is a folder, not a file of waypoints")
    if not path.exists():
        raise PointCloudError(f"{path}: there is no such file")
    if path.suffix.lower() == ".npy":
        return _read_npy(path)
    return _read_table(path)


def _read_npy(path: Path) -> _Table:
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise PointCloudError(f"{path} is not a readable .npy file: {error}") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        kind = getattr(array, "dtype", type(array).__name__)
        raise PointCloudError(f"{path} holds {kind}, not real numbers")
    if array.ndim != 2 or array.size == 0:
        raise PointCloudError(f"{path} holds an array {array.shape}; need (N, d) waypoints")
    return _Table(path, None, [[""] * array.shape[1]], [0], array.astype(np.float64))


def _read_table(path: Path) -> _Table:
    content: list[str] = []
    lines: list[int] = []
    comment = ""
    for line, raw in enumerate(_decode(path).split("\n"), start=1):
        # A "#" inside quotes belongs to a name, so a line with quotes has no comment.
        text, mark, after = raw.partition("#") if '"' not in raw else (raw, "", "")
        if text.strip():
            content.append(text)
            lines.append(line)
        elif mark and not content:
            comment = after
    if not content:
        raise PointCloudError(f"{path} holds no waypoints: it is empty")
    delimiter = next((mark for mark in DELIMITERS if mark in _unquoted(content[0])), None)
    rows = _split(path, content, lines, delimiter)
    names = None
    if not any(_is_number(field) for field in rows[0]):
        names, rows, lines = rows[0], rows[1:], lines[1:]
    elif comment:
        fields = _split(path, [comment], [0], delimiter)[0]
        if len(fields) == len(rows[0]) and not any(_is_number(field) for field in fields):
            names = fields
    if not rows:
        raise PointCloudError(f"{path} holds no waypoints: it has only a header")
    width = len(names or rows[0])
    for row, line in zip(rows, lines, strict=True):
        if len(row) != width:
            raise PointCloudError(f"{path}, line {line}: {len(row)} fields, not {width}")
    return _Table(path, names, rows, lines)


def _decode(path: Path) -> str:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PointCloudError(f"{path} cannot be read: {error.strerror}") from error
    if b"\0" in data:
        raise PointCloudError(f"{path} is not a text file: it holds zero bytes")
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise PointCloudError(f"{path}, line {line}: this is not UTF-8 text") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def _unquoted(text: str) -> str:
    return re.sub(r'"[^"]*"', "", text)


def _split(
    path: Path, content: list[str], lines: list[int], delimiter: str | None
) -> list[list[str]]:
    if delimiter is None and '"' not in content[0]:
        return [text.split() for text in content]
    reader = csv.reader(
        (text.strip() if delimiter is None else text for text in content),
        delimiter=delimiter or " ",
        skipinitialspace=True,
        strict=True,
    )
    rows: list[list[str]] = []
    try:
        for row in reader:
            if reader.line_num != len(rows) + 1:
                raise csv.Error("a quoted field runs over the end of the line")
            rows.append([field.strip() for field in row])
    except csv.Error as error:
        raise PointCloudError(f"{path}, line {lines[len(rows)]}: {error}") from error
    return rows


def _choose(table: _Table, columns: Sequence[str | int] | None) -> list[int]:
    """Returns the numbers of the columns to take."""
    if columns is None:
        chosen = _coordinate_columns(table)
        if chosen is None:
            raise PointCloudError(
                f"{table.path}: cannot tell which columns are coordinates; choose some "
                f"of its {table.num_columns} columns ({table.columns_text})"
            )
    else:
        chosen = [_column_number(table, column) for column in columns]
    if len(chosen) < 2:
        raise PointCloudError(
            f"{table.path}: a point needs two columns or more, not {len(chosen)}"
        )
    repeated = [column for column in chosen if chosen.count(column) > 1]
    if repeated:
        raise PointCloudError(f"{table.path}: column {repeated[0]} is chosen twice")
    return chosen


def _coordinate_columns(table: _Table) -> list[int] | None:
    """The columns named x, y and z, in this order; or all of them, if they are few."""
    by_axis = _by_axis(table, COORDINATE_NAME)
    if "x" in by_axis and "y" in by_axis:
        if any(len(candidates) > 1 for candidates in by_axis.values()):
            return None
        return [by_axis[axis][0] for axis in "xyz" if axis in by_axis]
    if table.num_columns <= MOST_UNNAMED_COLUMNS:
        return list(range(table.num_columns))
    return None


def _velocity_columns(table: _Table, chosen: list[int]) -> list[int] | None:
    """The columns of the velocities that belong to chosen coordinates, if there are any."""
    by_axis = {
        axis: column
        for axis, candidates in _by_axis(table, VELOCITY_NAME).items()
        if (column := _plain_one(table, candidates)) is not None
    }
    matches = [COORDINATE_NAME.match(table.names[column]) for column in chosen if table.names]
    axes = [match[1].lower() for match in matches if match]
    if len(axes) < len(chosen):
        axes = sorted(by_axis)
    columns = [by_axis[axis] for axis in axes if axis in by_axis]
    fits = len(columns) == len(chosen) and not set(columns) & set(chosen)
    return columns if fits else None


def _by_axis(table: _Table, pattern: re.Pattern[str]) -> dict[str, list[int]]:
    """The numbers of the columns whose names match, by the letter of their axis."""
    by_axis: dict[str, list[int]] = {}
    for number, name in enumerate(table.names or []):
        match = pattern.match(name)
        if match:
            by_axis.setdefault(match[1].lower(), []).append(number)
    return by_axis


def _plain_one(table: _Table, candidates: list[int]) -> int | None:
    """The only candidate, or the only one whose name has nothing added."""
    names = table.names or []
    plain = [column for column in candidates if len(names[column].replace("_", "")) == 2]
    best = plain if len(candidates) > 1 else candidates
    return best[0] if len(best) == 1 else None


def _column_number(table: _Table, column: str | int) -> int:
    if isinstance(column, str) and not column.isdecimal():
        if table.names is not None and column in table.names:
            if table.names.count(column) > 1:
                raise PointCloudError(f"{table.path}: two columns are named {column!r}")
            return table.names.index(column)
        raise PointCloudError(
            f"{table.path}: there is no column {column!r}; it has {table.columns_text}"
        )
    number = int(column)
    if not 0 <= number < table.num_columns:
        raise PointCloudError(
            f"{table.path}: there is no column {number}; it has columns 0 to "
            f"{table.num_columns - 1}"
        )
    return number


def _is_number(field: str) -> bool:
    try:
        _number(field)
    except ValueError:
        return False
    return True


def _number(field: str) -> float:
    # Python reads 1_000 as a number; in a file it is more likely a damaged line.
    if "_" in field:
        raise ValueError(field)
    return float(field)


def _numbers(table: _Table, chosen: list[int]) -> FloatArray:
    if table.values is not None:
        points = table.values[:, chosen]
        bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
        if len(bad):
            raise PointCloudError(
                f"{table.path}, waypoint {bad[0]}: {points[bad[0]]} is not finite"
            )
        return points
    points = np.empty((len(table.rows), len(chosen)))
    for axis, column in enumerate(chosen):
        values = []
        for row, line in zip(table.rows, table.lines, strict=True):
            try:
                value = _number(row[column])
            except ValueError:
                raise PointCloudError(
                    f"{table.path}, line {line}: {row[column]!r} is not a number"
                ) from None
            if not math.isfinite(value):
                raise PointCloudError(
                    f"{table.path}, line {line}: {row[column]!r} is not finite"
                )
            values.append(value)
        points[:, axis] = values
    return points
