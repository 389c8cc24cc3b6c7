"""The commands that use a field: follow, fly and demo."""

from pathlib import Path
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
from sgvf_drake.cli.tables import (
    print_flight,
    print_folder,
    print_following,
    print_training,
)


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


@app.command()
def fly(
    field: FieldPath,
    out: Out,
    speed: Annotated[float, typer.Option(help="Commanded speed, m/s.")] = 0.45,
    laps: Annotated[float, typer.Option(help="Laps of every closed piece, at least 1.")] = 2.0,
    altitude: Annotated[float, typer.Option(help="Height of a planar flight, m.")] = 1.0,
    scale: Annotated[float, typer.Option(help="Metres in one unit of the waypoints.")] = 1.0,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    overwrite: Overwrite = False,
) -> None:
    """Fly Drake's quadrotor along every piece of the path."""
    from sgvf_drake.experiments import choose_reference, open_field, run_fly, scale_reference

    loaded = open_field(field)
    path, kind = choose_reference(
        loaded, reference, columns_of(columns, reference, "--reference")
    )
    metric = loaded.rescaled(scale)
    with progress() as report:
        summary = run_fly(
            metric,
            (scale_reference(path, scale), kind),
            out,
            speed=speed,
            laps=laps,
            altitude=altitude,
            overwrite=overwrite,
            progress=report,
        )
    print_flight(summary)
    print_folder(out)


@app.command()
def demo(out: Out = Path("demo"), overwrite: Overwrite = False) -> None:
    """Train on the paper's concentric rings, follow them, and fly each of them."""
    from sgvf_drake.experiments import run_demo

    with progress() as report:
        summary = run_demo(out, overwrite=overwrite, progress=report)
    print_training(summary["train"])
    print_following(summary["follow"])
    print_flight(summary["fly"])
    print_folder(out)
