"""The command that proves path following: certify."""

from pathlib import Path
from typing import Annotated

import typer

from sgvf_drake.cli.application import FAILED, app, progress
from sgvf_drake.cli.options import (
    FieldPath,
    Out,
    Overwrite,
    ReferenceColumns,
    ReferenceFile,
    columns_of,
)
from sgvf_drake.cli.tables import print_certificate, print_folder


@app.command()
def certify(
    field: FieldPath,
    out: Out,
    claimed: Annotated[
        Path | None,
        typer.Option("--check", help="A certificate to prove anew, without a search."),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(help="Certify the field as sgvf fly flies it at this speed, m/s."),
    ] = None,
    scale: Annotated[
        float, typer.Option(help="With --speed: metres in one unit of the waypoints.")
    ] = 1.0,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    overwrite: Overwrite = False,
) -> None:
    """Prove that robots follow a field along its path; exit 1 where that is not proved."""
    from sgvf_drake.certificate import Certificate
    from sgvf_drake.experiments import as_flown, choose_path, open_field, run_certify

    loaded = open_field(field)
    if speed is not None:
        loaded = as_flown(loaded, speed, scale)
    path = choose_path(loaded, reference, columns_of(columns, reference, "--reference"))
    certificate = None if claimed is None else Certificate.load(claimed)
    with progress() as report:
        summary = run_certify(
            loaded, path, out, claimed=certificate, overwrite=overwrite, progress=report
        )
    print_certificate(summary)
    print_folder(out)
    if not summary["certified"]:
        raise typer.Exit(FAILED)
