"""The command that proves path following: certify."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

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
from sgvf_drake.cli.tables import print_folder, print_table


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
    _print_certificate(summary)
    print_folder(out)
    if not summary["certified"]:
        raise typer.Exit(FAILED)


def _print_certificate(summary: Mapping[str, Any]) -> None:
    """Prints the summary of a certificate."""
    U = summary["unit_length"]
    rows = {"certified": "yes" if summary["certified"] else "NO", "because": summary["reason"]}
    if summary["c_in"] is not None:
        rows["band of V"] = f"{summary['c_in']:.3g} to {summary['c_out']:.3g}"
    if summary["sigma"] is not None:
        pieces = summary["pieces"]
        rows |= {
            "sigma of V": f"{summary['sigma'] / U:.3g} U",
            "tube, basin": (
                f"half-width at most {summary['tube_half_width'] / U:.3g} U, "
                f"at least {summary['area_fraction']:.0%} of the box"
            ),
            "closed orbits": ", ".join(_orbit(piece, U) for piece in pieces),
            "V falls, |m|": (
                f"by {summary['alpha'] * U:.3g} in each U, at least {summary['delta']:.3g}"
            ),
            "time to the tube": f"at most that for {summary['entry_time_bound'] / U:.3g} U",
            "tolerated disturbance": f"up to {summary['e_star_max']:.3g} of the speed",
        }
    rows["squares, time"] = f"{summary['boxes']}, {summary['cpu_s']:.1f} s CPU"
    print_table("Certificate", rows)


def _orbit(piece: Mapping[str, Any], U: float) -> str:
    if not piece["orbit_exists"]:
        return "not proved"
    known = "one" if piece["orbit_unique"] else "at least one"
    if piece["lap_time_low"] is None:
        return known
    low, high = piece["lap_time_low"] / U, piece["lap_time_high"] / U
    return f"{known}, a lap as long as {low:.3g} to {high:.3g} U take"
