"""The command that makes a field of networks trained elsewhere: import."""

from pathlib import Path
from typing import Annotated

import typer

from sgvf_drake.cli.application import app
from sgvf_drake.cli.options import Columns, Out, Overwrite, columns_of
from sgvf_drake.cli.tables import print_folder, print_import
from sgvf_drake.fields import PAPER_GAIN


@app.command("import")
def import_(
    score: Annotated[
        Path, typer.Option(help="Score network of (x, t): a state dict saved by torch.")
    ],
    tangent: Annotated[
        Path, typer.Option(help="Tangent network of x: a state dict saved by torch.")
    ],
    out: Out,
    points: Annotated[
        Path | None,
        typer.Option(
            help="Waypoints of the training: CSV, text or .npy  \\[default: as the score "
            "shows them].",
        ),
    ] = None,
    columns: Columns = None,
    gain: Annotated[
        float, typer.Option("--k-s", "--gain", help="k_s of the normalised score.")
    ] = PAPER_GAIN,
    normalise: Annotated[
        bool, typer.Option("--normalise", help="Bring the field to length one.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Make a field of networks that were trained elsewhere."""
    chosen = columns_of(columns, points, "--points")
    # Slow to import, so only once the options are read.
    from sgvf_drake.experiments.importing import run_import

    summary = run_import(
        score,
        tangent,
        out,
        points=points,
        columns=chosen,
        gain=gain,
        normalise=normalise,
        overwrite=overwrite,
    )
    print_import(summary)
    print_folder(out)
