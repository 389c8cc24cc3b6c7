"""Options that several commands share, and how their values are read."""

from pathlib import Path
from typing import Annotated

import typer

from sgvf_drake.exceptions import ConfigurationError

Out = Annotated[Path, typer.Option(help="Folder of the results.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace results in --out.")]
Jobs = Annotated[int, typer.Option(help="Processes that run trials at the same time.")]
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
