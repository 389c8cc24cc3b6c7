"""The command that follows a field with agents: follow."""

from typing import Annotated

import typer

from sgvf_drake.cli.application import app, progress
from sgvf_drake.cli.options import (
    FieldPath,
    Out,
    Overwrite,
    ReferenceColumns,
    ReferenceFile,
    columns_of,
)
from sgvf_drake.cli.tables import print_folder, print_following


@app.command()
def follow(
    field: FieldPath,
    out: Out,
    starts: Annotated[int, typer.Option(help="Agents, on a grid over the box.")] = 400,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    duration: Annotated[
        float | None, typer.Option(help="Seconds at unit speed  \\[default: 1.5 laps + 15 U].")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Follow a field with many kinematic agents from a grid of starts."""
    from sgvf_drake.experiments import choose_reference, open_field, run_follow

    loaded = open_field(field)
    chosen = choose_reference(loaded, reference, columns_of(columns, reference, "--reference"))
    with progress() as report:
        summary = run_follow(
            loaded,
            chosen,
            out,
            starts=starts,
            duration=duration,
            overwrite=overwrite,
            progress=report,
        )
    print_following(summary)
    print_folder(out)
