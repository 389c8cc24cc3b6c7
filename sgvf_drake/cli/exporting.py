"""The command that writes a field for other programs: export."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from sgvf_drake.cli.application import app
from sgvf_drake.cli.options import FieldPath, Out, Overwrite
from sgvf_drake.cli.tables import print_folder, print_table
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.export import C_FILES

if TYPE_CHECKING:
    from sgvf_drake.fields import DirectedField, GuidingField


class Options(NamedTuple):
    """What is asked of an export; None: not asked for.

    Attributes:
        precision: How numbers are stored and computed.
        routes: Edges of the network of a directed field, as "1,2,-3".
    """

    precision: str | None
    routes: list[str] | None


class Target(NamedTuple):
    """A form in which a field can be written.

    Attributes:
        write: Writes a field into a folder, as options say, and returns a summary.
        files: What it leaves there.
    """

    write: Callable[["GuidingField | DirectedField", Path, Options], dict[str, Any]]
    files: tuple[str, ...]


def _write_c(
    field: "GuidingField | DirectedField", folder: Path, options: Options
) -> dict[str, Any]:
    from sgvf_drake.export import export_c

    return export_c(field, folder, options.precision or "mixed", routes=options.routes)


TARGETS = {"c": Target(_write_c, C_FILES)}


@app.command()
def export(
    field: FieldPath,
    to: Annotated[str, typer.Option(help="What to write.", metavar=f"[{'|'.join(TARGETS)}]")],
    out: Out,
    precision: Annotated[
        str | None,
        typer.Option(
            metavar="[mixed|double|float]",
            help="Of C: mixed computes in double, and stores as float what that leaves exact  "
            "\\[default: mixed].",
        ),
    ] = None,
    route: Annotated[
        list[str] | None,
        typer.Option(
            help="Of paths that cross or branch: edges, as 1,2,-3, of a route to write; may be "
            "given several times  \\[default: one over each piece].",
        ),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(help="Write the field as sgvf fly flies it at this speed, m/s."),
    ] = None,
    scale: Annotated[
        float, typer.Option(help="With --speed: metres in one unit of the waypoints.")
    ] = 1.0,
    overwrite: Overwrite = False,
) -> None:
    """Write a field for programs without Python: as C."""
    if to not in TARGETS:
        raise ConfigurationError(f"--to cannot be {to!r}; it is one of {', '.join(TARGETS)}")
    from sgvf_drake.experiments import as_flown, open_field
    from sgvf_drake.experiments.results import SUMMARY, result_folder, write_summary

    loaded = open_field(field)
    if speed is not None:
        loaded = as_flown(loaded, speed, scale)
    target = TARGETS[to]
    with result_folder(out, (SUMMARY, *target.files), overwrite=overwrite) as folder:
        summary = {"target": to, **target.write(loaded, folder, Options(precision, route))}
        write_summary(folder, summary)
    print_table("Export", _rows(summary))
    print_folder(out)


def _rows(summary: dict[str, Any]) -> dict[str, str]:
    rows = {
        "field": f"m(x{', g' if summary['directed'] else ''}) in {summary['dim']}-D",
        "digest": summary["digest"][:16],
        "precision": summary["precision"],
        "numbers": f"{summary['stored_bytes'] / 1000:.0f} kB",
    }
    for number, edges in enumerate(summary["routes"]):
        rows[f"route {number}"] = f"edges {edges}"
    return rows
