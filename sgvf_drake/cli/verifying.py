"""The command that checks the Lyapunov conditions of a field: verify."""

from typing import Annotated

import typer

from sgvf_drake.cli.application import app, errors, progress
from sgvf_drake.cli.options import (
    FieldPath,
    Out,
    Overwrite,
    ReferenceColumns,
    ReferenceFile,
    columns_of,
)
from sgvf_drake.cli.tables import print_folder, print_verification
from sgvf_drake.exceptions import ConfigurationError


@app.command()
def verify(
    field: FieldPath,
    out: Out,
    starts: Annotated[
        int,
        typer.Option(help="Agents on a grid over the box; those in the basin are followed."),
    ] = 64,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    fly: Annotated[
        bool, typer.Option("--fly", help="Fly too: velocity error against what V tolerates.")
    ] = False,
    speed: Annotated[float, typer.Option(help="Commanded speed of --fly, m/s.")] = 0.45,
    altitude: Annotated[float, typer.Option(help="Height of --fly, m.")] = 1.0,
    scale: Annotated[float, typer.Option(help="Metres in one unit of the waypoints.")] = 1.0,
    overwrite: Overwrite = False,
) -> None:
    """Check by sampling where V decreases along a field, and name what speaks against it."""
    from sgvf_drake.experiments import choose_path, open_field, run_verify, scale_reference

    if starts < 1:
        raise ConfigurationError(f"the number of starts must be at least 1, not {starts}")
    loaded = open_field(field)
    path, kind = choose_path(loaded, reference, columns_of(columns, reference, "--reference"))
    with progress() as report:
        summary = run_verify(
            loaded.rescaled(scale),
            (scale_reference(path, scale), kind),
            out,
            starts=starts,
            speed=speed if fly else None,
            altitude=altitude,
            overwrite=overwrite,
            progress=report,
        )
    print_verification(summary)
    if not summary["holds"]:
        errors.print("warning: the conditions do not hold", style="bold red")
    print_folder(out)
