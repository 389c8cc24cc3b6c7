"""The command that finds the zeros of a field: singularities."""

from typing import Annotated

import typer

from sgvf_drake.cli.application import app
from sgvf_drake.cli.options import (
    FieldPath,
    Out,
    Overwrite,
    ReferenceColumns,
    ReferenceFile,
    columns_of,
)
from sgvf_drake.cli.tables import print_folder, print_singularities


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
