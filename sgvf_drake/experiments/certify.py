"""Certify a field: the proof, its file, its figure, and the check of a certificate."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from os import PathLike
from typing import Any, TypeVar

from matplotlib.figure import Figure

from sgvf_drake.certificate import Certificate, NetworkCertificate, certify, check
from sgvf_drake.certificate.certification import with_vehicle
from sgvf_drake.compiling import timed
from sgvf_drake.experiments.certified import CERTIFICATE, CERTIFICATE_FIGURE
from sgvf_drake.experiments.figures.certificate import certificate_figure
from sgvf_drake.experiments.reference import choose_reference
from sgvf_drake.experiments.results import (
    SUMMARY,
    origin,
    result_folder,
    save_figure,
    write_summary,
)
from sgvf_drake.experiments.vehicle_search import VehicleQuestion, propose_flight
from sgvf_drake.experiments.vehicle_search import told as told_of_vehicle
from sgvf_drake.fields import DirectedField, GuidingField
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress

AnyField = TypeVar("AnyField", GuidingField, DirectedField)
AnyProof = TypeVar("AnyProof", Certificate, NetworkCertificate)

FLOWN_FIELD = "flown.safetensors"
CERTIFY_FILES = (SUMMARY, CERTIFICATE, CERTIFICATE_FIGURE, FLOWN_FIELD)
# Of a certificate's levels, by their names in the summary.
OF_LEVELS = (
    *("sigma", "alpha", "delta", "tube_half_width", "decrease_fraction", "step_bound"),
)


def run_certify(
    field: GuidingField,
    reference: tuple[ReferencePath, str] | None,
    out: str | PathLike[str],
    *,
    claimed: Certificate | None = None,
    levels: bool = False,
    vehicle: VehicleQuestion | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Certifies a field; leaves the certificate, its figure and the summary.

    With a question of a `vehicle`, its flight along the field is proved too, if it can be; the
    folder then holds the field that flies as well, which may be wider.

    A `claimed` certificate of the field is proved anew; without one, one is searched for, with
    `levels` of V too.  `time_s` is without what numba compiles on the first run.

    Raises:
        ConfigurationError: Nothing bounds the field, or what is claimed is claimed of another
            field.
    """
    path, kind = reference or choose_reference(field)
    asked = None if vehicle is None else propose_flight(field, path, vehicle, progress)
    flown = field if asked is None else asked.field

    def prove() -> Certificate:
        if claimed is not None:
            return check(claimed, field, path, progress=progress)
        found = certify(flown, path, levels=levels, progress=progress)
        if asked is None or vehicle is None:
            return found
        of_flight = (asked.proposals, asked.law, vehicle.scale, asked.disturbance)
        return with_vehicle(found, flown, *of_flight)

    def told(found: Certificate) -> dict[str, Any]:
        flight = None if found.vehicle is None else told_of_vehicle(found.vehicle, asked)
        return {**certificate_summary(found), "reference": kind, "vehicle": flight}

    return leave_proof(
        *(flown, out, prove, certificate_figure, told),
        checked=claimed is not None,
        keeps=asked is not None,
        overwrite=overwrite,
    )


def leave_proof(
    field: AnyField,
    out: str | PathLike[str],
    prove: Callable[[], AnyProof],
    draw: Callable[[AnyField, AnyProof], Figure],
    told: Callable[[AnyProof], Mapping[str, Any]],
    *,
    checked: bool,
    overwrite: bool,
    keeps: bool = False,
) -> dict[str, Any]:
    """Proves something of a field; leaves the certificate, its figure and the summary.

    Args:
        field: The field.
        out: The folder of the results.
        prove: Returns the certificate.
        draw: Returns its figure.
        told: Returns what the summary tells of it.
        checked: Whether it was claimed before.
        overwrite: Whether results that are there are replaced.
        keeps: Whether the field is kept beside it.
    """
    with result_folder(out, CERTIFY_FILES, overwrite=overwrite) as folder:
        with timed() as watch:
            found = prove()
        found.save(folder / CERTIFICATE)
        if keeps:
            field.save(folder / FLOWN_FIELD)
        save_figure(draw(field, found), folder / CERTIFICATE_FIGURE)
        summary = {
            **told(found),
            "checked": checked,
            "time_s": watch.wall_s,
            "cpu_s": watch.cpu_s,
            "unit_length": field.cloud.unit_length,
            **origin(field),
        }
        write_summary(folder, summary)
    return summary


def certificate_summary(found: Certificate) -> dict[str, Any]:
    """Returns what was proved, by the names of `summary.json`."""
    levels = found.levels
    return {
        "certified": found.certified,
        "reason": found.reason,
        "method": "proved",
        "area_fraction": found.area_fraction,
        "almost_fraction": found.almost_fraction,
        "excluded": [asdict(one) for one in found.excluded],
        "entry_time_bound": found.entry_time_bound,
        "e_star_max": found.e_star_max,
        "orbit_half_width": found.orbit_half_width,
        "pieces": [asdict(piece) for piece in found.pieces],
        "counterexample": found.counterexample,
        "boxes": found.boxes,
        **{name: getattr(levels, name, None) for name in OF_LEVELS},
        "c_in": levels and levels.conditions.c_in,
        "c_out": levels and levels.conditions.c_out,
        "e_star": levels and {"levels": levels.levels, "e_star": levels.e_star},
    }
