"""The commands that check a field: verify, certify and singularities."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

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
from sgvf_drake.cli.tables import print_columns, print_folder, print_messages, print_table
from sgvf_drake.exceptions import ConfigurationError

if TYPE_CHECKING:
    from sgvf_drake.fields import DirectedField


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
    from sgvf_drake.experiments import choose_reference, open_guiding_field, run_verify

    if starts < 1:
        raise ConfigurationError(f"the number of starts must be at least 1, not {starts}")
    loaded = open_guiding_field(field)
    chosen = columns_of(columns, reference, "--reference")
    path, kind = choose_reference(loaded, reference, chosen)
    print_messages(path.messages)
    with progress() as report:
        summary = run_verify(
            loaded.rescaled(scale),
            (path.rescaled(scale), kind),
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


@app.command()
def certify(
    field: FieldPath,
    out: Out,
    claimed: Annotated[
        Path | None,
        typer.Option("--check", help="A certificate to prove anew, without a search."),
    ] = None,
    levels: Annotated[
        bool, typer.Option("--levels", help="Prove levels of V too, of closed paths.")
    ] = False,
    speed: Annotated[
        float | None,
        typer.Option(help="Certify the field as sgvf fly flies it at this speed, m/s."),
    ] = None,
    scale: Annotated[
        float, typer.Option(help="With --speed: metres in one unit of the waypoints.")
    ] = 1.0,
    vehicle: Annotated[
        bool,
        typer.Option(
            "--vehicle",
            help="With --speed: prove the flight of a quadrotor with --jerk-feedforward too.",
        ),
    ] = False,
    approach_rate: Annotated[
        float | None,
        typer.Option(
            help="With --vehicle: how fast the field asks it to turn to the path, 1/s "
            "[default: the fastest that is proved]."
        ),
    ] = None,
    route: Annotated[
        str | None,
        typer.Option(
            help="Of paths that cross or branch: edges, as 1,2,-3, that are asked for."
        ),
    ] = None,
    reference: ReferenceFile = None,
    columns: ReferenceColumns = None,
    overwrite: Overwrite = False,
) -> None:
    """Prove that robots follow a field along its path; exit 1 where that is not proved."""
    from sgvf_drake.certificate import Certificate
    from sgvf_drake.experiments import (
        as_flown,
        choose_reference,
        open_field,
        run_certify,
    )
    from sgvf_drake.experiments.vehicle_search import VehicleQuestion
    from sgvf_drake.fields import DirectedField

    if levels and claimed is not None:
        raise ConfigurationError("--check proves what the certificate holds, not --levels")
    loaded = open_field(field)
    if isinstance(loaded, DirectedField):
        given = {"--levels": levels, "--speed": speed, "--reference": reference}
        _certify_network(loaded, route, out, claimed, given, overwrite=overwrite)
        return
    if route is not None:
        raise ConfigurationError("--route is for fields of paths that cross or branch")
    question = None
    if vehicle or approach_rate is not None:
        if not vehicle or speed is None or claimed is not None:
            raise ConfigurationError(
                "--vehicle needs --speed, --approach-rate needs --vehicle, and --check proves "
                "what the certificate holds of a vehicle without it"
            )
        question = VehicleQuestion(speed, scale, approach_rate)
    elif speed is not None:
        loaded = as_flown(loaded, speed, scale)
    path = choose_reference(loaded, reference, columns_of(columns, reference, "--reference"))
    print_messages(path[0].messages)
    certificate = None if claimed is None else Certificate.load(claimed)
    options: dict[str, Any] = {"claimed": certificate, "levels": levels, "vehicle": question}
    with progress() as report:
        summary = run_certify(
            loaded, path, out, **options, overwrite=overwrite, progress=report
        )
    _print_certificate(summary)
    print_folder(out)
    if not summary["certified"] or (summary["vehicle"] or {"proved": True})["proved"] is False:
        raise typer.Exit(FAILED)


def _certify_network(
    field: "DirectedField",
    route: str | None,
    out: Path,
    claimed: Path | None,
    given: Mapping[str, Any],
    *,
    overwrite: bool,
) -> None:
    """Certifies the network of a directed field; of `given` options none is for those."""
    from sgvf_drake.certificate import NetworkCertificate
    from sgvf_drake.experiments import run_certify_network
    from sgvf_drake.paths.itinerary import Itinerary

    for option in (name for name, value in given.items() if value not in (None, False)):
        raise ConfigurationError(f"{option} is not for fields of paths that cross or branch")
    if route is not None and claimed is not None:
        raise ConfigurationError("--check proves what the certificate holds, not --route")
    itinerary = None if route is None else Itinerary.parse(route, field.network)
    certificate = None if claimed is None else NetworkCertificate.load(claimed)
    with progress() as report:
        summary = run_certify_network(
            *(field, itinerary, out),
            claimed=certificate,
            overwrite=overwrite,
            progress=report,
        )
    _print_network(summary)
    print_folder(out)
    if not summary["certified"]:
        raise typer.Exit(FAILED)


def _print_network(summary: Mapping[str, Any]) -> None:
    """Prints the summary of the certificate of a network."""
    rows = {"certified": "yes" if summary["certified"] else "NO", "because": summary["reason"]}
    for name in ("sections", "turns", "ends"):
        proved = sum(own["proved"] for own in summary[name])
        rows[f"{name} proved"] = f"{proved} of {len(summary[name])}"
    route = summary["route"]
    if route is not None and route["time_low"] is not None:
        low, high = (route[name] / summary["unit_length"] for name in ("time_low", "time_high"))
        lap = "a lap" if route["closed"] else "the route"
        rows["time"] = f"{lap} as long as {low:.3g} to {high:.3g} U take"
    rows["patches, time"] = f"{summary['boxes']}, {summary['cpu_s']:.1f} s CPU"
    print_table("Certificate of the network", rows)
    columns = {
        "turn": lambda own: f"{own['from']} into {own['into']}",
        "not proved, because": lambda own: own["reason"],
        "at": lambda own: ", ".join(f"{x:.4g}" for x in own["where"] or ()),
    }
    failed = [own for own in summary["turns"] if not own["proved"]]
    if failed:
        print_columns("Turns that are not proved", columns, failed)


def _print_certificate(summary: Mapping[str, Any]) -> None:
    """Prints the summary of a certificate."""
    U = summary["unit_length"]
    rows = {"certified": "yes" if summary["certified"] else "NO", "because": summary["reason"]}
    if summary["area_fraction"] is not None:
        rows["robots from"] = (
            f"{summary['area_fraction']:.1%} of the box, almost all from "
            f"{summary['almost_fraction']:.1%}"
        )
    walls = [_walls(piece, U) for piece in summary["pieces"] if piece["e_star"]]
    if walls:
        rows |= {
            "walls": "; ".join(walls),
            "time to the tube": f"at most that for {summary['entry_time_bound'] / U:.3g} U",
        }
    if summary["pieces"]:
        rows["orbits"] = ", ".join(_orbit(piece, U) for piece in summary["pieces"])
    if summary["orbit_half_width"] is not None:
        rows["thin tubes"] = f"at most {summary['orbit_half_width'] / U:.3g} U from the path"
    if summary["c_in"] is not None:
        rows |= _levels(summary)
    if summary["vehicle"] is not None:
        rows["vehicle"] = summary["vehicle"]["sentence"]
    rows["squares, time"] = f"{summary['boxes']}, {summary['time_s']:.1f} s"
    print_table("Certificate", rows)


def _walls(piece: Mapping[str, Any], U: float) -> str:
    widths = [width / U for width in piece["wall_half_widths"]]
    return (
        f"{len(widths)} pairs, {widths[0]:.2g} to {widths[-1]:.2g} U from the orbit, tolerate "
        f"up to {max(piece['e_star']):.3g} of the speed"
    )


def _levels(summary: Mapping[str, Any]) -> dict[str, str]:
    """Returns the rows of what is proved of levels of V."""
    U, e_star = summary["unit_length"], summary["e_star"]["e_star"]
    return {
        "V falls from, to": (
            f"{summary['c_out']:.3g}, {summary['c_in']:.3g}, by {summary['alpha'] * U:.3g} in "
            f"each U; sigma {summary['sigma'] / U:.3g} U"
        ),
        "tube of V": (
            f"half-width at most {summary['tube_half_width'] / U:.3g} U, "
            f"|m| at least {summary['delta']:.3g}"
        ),
        "levels tolerate": f"{min(e_star):.3g} to {max(e_star):.3g} of the speed",
    }


def _orbit(piece: Mapping[str, Any], U: float) -> str:
    way = ""
    if piece["lap_time_low"] is not None:
        low, high = piece["lap_time_low"] / U, piece["lap_time_high"] / U
        way = f" as long as {low:.3g} to {high:.3g} U take"
    if piece["rest_radius"] is not None:
        return f"one to rest within {piece['rest_radius'] / U:.3g} U of its end,{way}"
    if not piece["orbit_exists"]:
        return "not proved"
    known = "one" if piece["orbit_unique"] else "at least one"
    return f"{known} closed, a lap{way}" if way else f"{known} closed"


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
    """Find all zeros of a field, its score and its tangent, and where they lie."""
    from sgvf_drake.experiments import choose_reference, open_guiding_field, run_singularities

    loaded = open_guiding_field(field)
    chosen = choose_reference(loaded, reference, columns_of(columns, reference, "--reference"))
    print_messages(chosen[0].messages)
    summary = run_singularities(loaded, chosen, out, prove=prove, overwrite=overwrite)
    _print_singularities(summary)
    print_folder(out)


def _print_singularities(summary: Mapping[str, Any]) -> None:
    """Prints the summary of the singularities."""
    prefixes = {"guiding": "", "score": "score_", "tangent": "tangent_"}
    rows = {
        f"zeros of the {name}{'' if name == 'score' else ' field'}": (
            f"{_kinds(summary['zeros'], name)}; indices sum up to "
            f"{summary[f'{prefix}index_sum']}{_turns(summary[f'{prefix}winding_number'])}"
        )
        for name, prefix in prefixes.items()
    }
    for name, proof in summary.get("proved", {}).items():
        rows[f"proved of the {name}"] = _proved(proof)
    rows["undecided places"] = str(summary["undecided"])
    claims = {
        "low_density": "score vanishes at low density",
        "low_density_off_path": "the same off the path",
        "high_curvature": "score vanishes at high curvature",
        "branches": "score vanishes near branches",
    }
    for claim, name in claims.items():
        rows[name] = _concentration(summary["vanishing"][claim])
    print_table("Singularities", rows)


def _proved(proof: Mapping[str, Any]) -> str:
    """Returns what is proved of the zeros of a field."""
    count, undecided = len(proof["zeros"]), proof["undecided"]
    planar, winding = len(proof["box"][0]) == 2, proof["winding_number"]
    parts = "squares" if planar else "cubes"
    others = "no others" if proof["complete"] else f"{undecided} {parts} undecided"
    turns = "winding number not proved" if winding is None else f"winding number {winding}"
    return f"{count} enclosed, {others}" + (f"; {turns}" if planar else "")


def _turns(winding_number: int | None) -> str:
    """Returns what is told of a winding number; in space there is none."""
    return "" if winding_number is None else f", winding number {winding_number}"


def _kinds(zeros: Sequence[Mapping[str, Any]], field: str) -> str:
    """Returns how many zeros of each kind a field has: "1 focus, 2 saddle"."""
    counts = Counter(_kind(zero) for zero in zeros if zero["field"] == field)
    return ", ".join(f"{count} {kind}" for kind, count in counts.items()) or "none"


def _kind(zero: Mapping[str, Any]) -> str:
    """Returns the kind of a zero; of a saddle in space also along how much it is left."""
    if zero["kind"] != "saddle" or len(zero["point"]) == 2:
        return str(zero["kind"])
    return f"saddle left along a {'line' if zero['unstable_directions'] == 1 else 'surface'}"


def _concentration(claim: Mapping[str, Any] | None) -> str:
    if claim is None:
        return "nothing to tell by"
    verdict = "yes" if claim["holds"] else "no"
    return f"{verdict} (probability {claim['probability']:.2f}; by chance 0.5)"
