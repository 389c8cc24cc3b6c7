"""The command that writes a field for other programs: export."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from sgvf_drake.cli.application import FAILED, app, progress
from sgvf_drake.cli.options import FieldPath, Out, Overwrite
from sgvf_drake.cli.tables import print_columns, print_folder, print_table
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.export import C_FILES, export_c

if TYPE_CHECKING:
    from sgvf_drake.fields import DirectedField, GuidingField


class Target(NamedTuple):
    """A form in which a field can be written.

    Attributes:
        write: Writes a field into a folder and returns a summary; takes the options of
            `export_c`.
        show: Prints a summary.
        files: What it leaves there.
        precision: The one that is meant where none is told.
    """

    write: Callable[..., dict[str, Any]]
    show: Callable[[Mapping[str, Any]], None]
    files: tuple[str, ...]
    precision: str


def _write_onnx(
    field: "GuidingField | DirectedField",
    folder: Path,
    precision: str,
    *,
    routes: list[str] | None,
    certificate: str | None,
) -> dict[str, Any]:
    try:
        from sgvf_drake.export.onnx import export_onnx
    except ImportError:
        raise ConfigurationError(
            "--to onnx needs ONNX: pip install 'sgvf-drake[onnx]'"
        ) from None
    if routes is not None:
        raise ConfigurationError("--route is for --to c: a graph has no automaton")
    return export_onnx(field, folder, precision, certificate=certificate)


def _show_c(summary: Mapping[str, Any]) -> None:
    rows = {
        "field": f"m(x{', g' if summary['directed'] else ''}) in {summary['dim']}-D",
        "digest": summary["digest"][:16],
        "precision": summary["precision"],
        "numbers": f"{summary['stored_bytes'] / 1000:.0f} kB",
    }
    for number, edges in enumerate(summary["routes"]):
        rows[f"route {number}"] = f"edges {edges}"
    print_table("Export", rows)


def _show_onnx(summary: Mapping[str, Any]) -> None:
    print_columns(
        "Export",
        {
            "file": lambda own: own[0],
            "kB": lambda own: f"{own[1]['bytes'] / 1000:.0f}",
            "differs from NumPy by": lambda own: _differences(own[1]["largest_difference"]),
        },
        list(summary["files"].items()),
    )


TARGETS = {
    "c": Target(export_c, _show_c, C_FILES, "mixed"),
    "onnx": Target(_write_onnx, _show_onnx, ("field.onnx", "field_jacobian.onnx"), "double"),
}


@app.command()
def export(
    field: FieldPath,
    to: Annotated[str, typer.Option(help="What to write.", metavar=f"[{'|'.join(TARGETS)}]")],
    out: Out,
    precision: Annotated[
        str | None,
        typer.Option(
            metavar="[mixed|double|float|int8]",
            help="How numbers are stored and computed; mixed, of C alone: in double, stored as "
            "float what that leaves exact; int8, of ONNX alone  "
            "\\[default: mixed of C, double of ONNX].",
        ),
    ] = None,
    route: Annotated[
        list[str] | None,
        typer.Option(
            help="Of paths that cross or branch, in C: edges, as 1,2,-3, of a route to write; "
            "may be given several times  \\[default: one over each piece].",
        ),
    ] = None,
    certificate: Annotated[
        Path | None,
        typer.Option(
            help="Of the field: what it still says with the errors of the export's numbers is "
            "proved and told; exit 1 where that is nothing.",
        ),
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(help="Write the field as sgvf fly flies it at this speed, m/s."),
    ] = None,
    scale: Annotated[
        float, typer.Option(help="With --speed: metres in one unit of the waypoints.")
    ] = 1.0,
    overwrite: Overwrite = False,
) -> None:
    """Write a field for programs without this package: as C, or as ONNX."""
    if to not in TARGETS:
        raise ConfigurationError(f"--to cannot be {to!r}; it is one of {', '.join(TARGETS)}")
    # Slow to import, so only once the options are read.
    from sgvf_drake.experiments import as_flown, open_field
    from sgvf_drake.experiments.results import SUMMARY, origin, result_folder, write_summary

    loaded = open_field(field)
    if speed is not None:
        loaded = as_flown(loaded, speed, scale)
    target, found = TARGETS[to], dict[str, Any]()
    precision = precision or target.precision
    with result_folder(out, (SUMMARY, *target.files), overwrite=overwrite) as folder:
        if certificate is not None:
            found = _proved(loaded, certificate, precision)
        told = found.get("reason")
        facts = target.write(loaded, folder, precision, routes=route, certificate=told)
        if found and "error" not in found and "files" in facts:
            found["reason"] += _sampled(facts, found["e_star"])
        summary = {"to": to, **origin(loaded), "speed": speed, **facts}
        write_summary(folder, {**summary, "certificate": found or None})
    target.show(facts)
    if certificate is not None:
        print_table("Certificate as exported", _certificate_rows(found))
    print_folder(out)
    if certificate is not None and not found["certified"]:
        raise typer.Exit(FAILED)


def _proved(field: Any, certificate: Path, precision: str) -> dict[str, Any]:
    """Returns what a certificate says of a field as it is exported."""
    from sgvf_drake.certificate import ARITHMETICS, Certificate, check_exported
    from sgvf_drake.experiments.certified import certificate_file
    from sgvf_drake.fields import GuidingField

    if not isinstance(field, GuidingField):
        raise ConfigurationError(
            "--certificate is not for fields of paths that cross or branch"
        )
    file = certificate_file(certificate)
    if file is None:
        raise ConfigurationError(f"there is no certificate in {certificate}")
    known = Certificate.load(file)
    if precision not in ARITHMETICS:
        return {
            "certified": False,
            "reason": f"NOT certified as exported: nothing bounds the errors of {precision}",
            "e_star": [piece.e_star for piece in known.pieces],
        }
    with progress() as report:
        return asdict(check_exported(known, field, precision, progress=report))


def _sampled(facts: Mapping[str, Any], e_star: Sequence[Sequence[float]]) -> str:
    """Returns how errors that were sampled compare with what walls tolerate, in words."""
    off = max(own["largest_difference"]["m"] for own in facts["files"].values())
    walls = [value for own in e_star for value in own]
    tolerated = f" where walls tolerate {min(walls):.3g} to {max(walls):.3g}" if walls else ""
    return f"; over sampled points m is off by up to {off:.2g} in a coordinate{tolerated}"


def _certificate_rows(found: Mapping[str, Any]) -> dict[str, str]:
    from sgvf_drake.certificate.exported import ceiling

    rows = {"certified": "yes" if found["certified"] else "NO", "because": found["reason"]}
    if "error" not in found:
        return rows
    rows["error of m"] = f"at most {ceiling(found['error'])} over tubes and walls" + (
        "" if found["box_error"] is None else f", {ceiling(found['box_error'])} outside of them"
    )
    return rows


def _differences(found: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.1g}" for name, value in found.items())
