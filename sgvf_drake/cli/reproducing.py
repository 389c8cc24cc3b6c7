"""The command for every experiment of the paper: reproduce."""

from typing import Annotated

import typer

from sgvf_drake.cli.application import FAILED, app, console, progress
from sgvf_drake.cli.claims import print_reproduction
from sgvf_drake.cli.options import Jobs, Out, Overwrite


@app.command()
def reproduce(
    out: Out,
    quick: Annotated[
        bool, typer.Option("--quick", help="Small cases, to see that everything works.")
    ] = False,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="A scenario to run, in place of all; repeatable."),
    ] = None,
    jobs: Jobs = 1,
    overwrite: Overwrite = False,
) -> None:
    """Run every experiment of the paper into one report; goes on where it was interrupted."""
    from sgvf_drake.paper import run_reproduce
    from sgvf_drake.paper.reproduce import REPORT, Status

    with progress() as report:
        summary = run_reproduce(
            out,
            quick=quick,
            only=only or (),
            jobs=jobs,
            overwrite=overwrite,
            progress=report,
        )
    print_reproduction(summary)
    console.print(f"report in {out / REPORT}", markup=False, highlight=False, soft_wrap=True)
    if any(entry["status"] == Status.FAILED for entry in summary["scenarios"].values()):
        raise typer.Exit(FAILED)
