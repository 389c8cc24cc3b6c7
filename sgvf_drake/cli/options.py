"""Options that several commands share, and how their values are read."""

import math
from pathlib import Path
from typing import Annotated

import typer

from sgvf_drake.exceptions import ConfigurationError

Out = Annotated[Path, typer.Option(help="Folder of the results.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace results in --out.")]
Jobs = Annotated[int, typer.Option(help="Processes that run trials at the same time.")]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Of a Dask scheduler, whose workers run the trials in place of processes here.",
    ),
]
FieldPath = Annotated[
    Path, typer.Argument(metavar="FIELD", help="A field file, or the folder of its training.")
]
Columns = Annotated[
    str | None,
    typer.Option(help="Columns of the coordinates, by name or number from 0: x_m,y_m or 0,1."),
]
ReferenceFile = Annotated[
    Path | None,
    typer.Option(help="True path to measure against: an ordered polyline, in a file."),
]
ReferenceColumns = Annotated[
    str | None, typer.Option(help="Columns of the reference file, as --columns.")
]


def columns_of(columns: str | None, file: Path | None, option: str) -> list[str | int] | None:
    """Reads --columns, a list of names or numbers; `option` is that of the file they are in."""
    if columns is None:
        return None
    if file is None:
        raise ConfigurationError(f"--columns {columns} chooses columns of {option}; give both")
    return [name.strip() for name in columns.split(",")]


def pair_of(text: str | None, option: str) -> tuple[str | None, str | None]:
    """Reads what is one name for score and tangent, or one for each."""
    if text is None:
        return None, None
    names = [name.strip() for name in text.split(",")]
    if len(names) > 2 or not all(names):
        raise ConfigurationError(
            f"{option} takes one name, or the score's and the tangent's, not {text!r}"
        )
    return names[0], names[-1]


# Here and not from `paths`, which imports numba.
DIRECTIONS = ("ccw", "cw", "reverse")
# Entries of --direction that leave a piece to the rule.
RULE_ENTRIES = ("", "-")


def directions_of(text: str | None) -> str | tuple[str | None, ...] | None:
    """Reads --direction: one direction for all pieces, or one for each."""
    if text is None:
        return None
    entries = tuple(_direction(entry.strip()) for entry in text.split(","))
    return entries[0] if len(entries) == 1 else entries


def _direction(entry: str) -> str | None:
    if entry in RULE_ENTRIES:
        return None
    if entry not in DIRECTIONS:
        names = ", ".join(DIRECTIONS)
        raise ConfigurationError(
            f"--direction cannot be {entry!r}; choose {names}, or - for the rule"
        )
    return entry


def point_of(text: str | None) -> tuple[float, ...] | None:
    """Reads --start, a point X,Y or X,Y,Z."""
    if text is None:
        return None
    try:
        point = tuple(float(coordinate) for coordinate in text.split(","))
    except ValueError:
        point = ()
    if len(point) < 2 or not all(map(math.isfinite, point)):
        raise ConfigurationError(f"--start must be a point X,Y, not {text!r}")
    return point
