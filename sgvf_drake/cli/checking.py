"""The commands that check a field: verify, certify and singularities."""

from pathlib import Path
from typing import Annotated

import typer

from sgvf_drake.cli.application import FAILED, app, errors, progress
from sgvf_drake.cli.options import (
    FieldPath,
    Out,
    Overwrite,
    ReferenceColumns,
    ReferenceFile,
    columns_of,
)
from sgvf_drake.cli.tables import (
    print_certificate,
    print_folder,
    print_singularities,
    print_verification,
)
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


@app.command()
def singularities(
    field: FieldPath,
    out: Out,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    prove: Annotated[
        bool, typer.Option("--prove", help="Prove that there are no other zeros.")
    ] = False,
    overwrite: Overwrite = False,
) -> None:
    """Find all zeros of a planar field, its score and its tangent, and where they lie."""
    from sgvf_drake.experiments import choose_reference, open_field, run_singularities

    loaded = open_field(field)
    chosen = choose_reference(loaded, reference, columns_of(columns, reference, "--reference"))
    summary = run_singularities(loaded, chosen, out, prove=prove, overwrite=overwrite)
    print_singularities(summary)
    print_folder(out)
