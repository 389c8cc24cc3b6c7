"""The command that checks the Lyapunov conditions of a field: verify."""

from collections.abc import Mapping
from typing import Annotated, Any

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
from sgvf_drake.cli.tables import print_folder, print_table
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
    _print_verification(summary)
    if not summary["holds"]:
        errors.print("warning: the conditions do not hold", style="bold red")
    print_folder(out)


def _print_verification(summary: Mapping[str, Any]) -> None:
    """Prints the summary of a verification."""
    U, eps = summary["unit_length"], summary["assumptions"]["a2_cosine"]
    rows = {
        "sampled conditions": "hold" if summary["holds"] else "do NOT hold",
        "because": summary["reason"],
        "|cos(s, v)|": f"mean {eps['mean']:.3g}, 95 % {eps['q95']:.3g}, max {eps['max']:.3g}",
        "V decreases on": f"{summary['decrease_fraction']:.1%} of the box",
    }
    if summary["c_in"] is not None:
        rows |= {
            "sigma of V": f"{summary['sigma'] / U:.3g} U",
            "band of V": f"{summary['c_in']:.3g} to {summary['c_out']:.3g}",
            "tube, basin": (
                f"half-width {summary['tube_half_width'] / U:.3g} U, "
                f"{summary['area_fraction']:.0%} of the box"
            ),
            "tolerated disturbance": (
                f"{summary['e_star_min']:.3g} to {summary['e_star_max']:.3g} of the speed, "
                "by the level"
            ),
            "followed": _followed(summary["theorem"]["decrease"]),
        }
    for name, bound in summary["bounds"].items():
        rows[f"bound, {name}"] = f"holds on {bound['holds_fraction']:.1%} of the box"
    if summary["flight"] is not None:
        rows["velocity error in flight"] = _tracking(summary["flight"])
    print_table("Verification", rows)


def _followed(decrease: Mapping[str, Any]) -> str:
    if decrease["exit"] is not None:
        return str(decrease["exit"])
    entered, stayed = decrease["entered_fraction"], decrease["stayed_fraction"]
    return f"of {decrease['starts']} starts {entered:.0%} enter the tube, {stayed:.0%} stay"


def _tracking(flight: Mapping[str, Any]) -> str:
    if flight["band"] is None:
        return "V decreases on no band along the field as it is flown"
    exits = [piece["exit"] for piece in flight["pieces"] if piece["exit"] is not None]
    if exits:
        return str(exits[0])
    error, tolerated = flight["tracking_error_max_m_s"], flight["tolerated_error_m_s"]
    if error is None:
        return "not every flight settled in the tube"
    verdict = "within" if flight["covered"] else "NOT within"
    return f"{error:.3g} m/s, {verdict} the {tolerated:.3g} m/s that V tolerates"
