"""Certify a field: the proof, its file, its figure, and the check of a certificate."""

from dataclasses import asdict
from os import PathLike
import time
from typing import Any

from sgvf_drake.certificate import Certificate, certify, check
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
from sgvf_drake.fields import GuidingField
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress

CERTIFY_FILES = (SUMMARY, CERTIFICATE, CERTIFICATE_FIGURE)


def run_certify(
    field: GuidingField,
    reference: tuple[ReferencePath, str] | None,
    out: str | PathLike[str],
    *,
    claimed: Certificate | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Certifies a field; leaves the certificate, its figure and the summary.

    A `claimed` certificate of the field is proved anew; without one, one is searched for.

    Raises:
        ConfigurationError: Nothing bounds the field, or what is claimed is claimed of another
            field.
    """
    path, kind = reference or choose_reference(field)
    begin, cpu = time.perf_counter(), time.process_time()
    with result_folder(out, CERTIFY_FILES, overwrite=overwrite) as folder:
        if claimed is None:
            found = certify(field, path, progress=progress)
        else:
            found = check(claimed, field, path)
        elapsed, cpu_time = time.perf_counter() - begin, time.process_time() - cpu
        found.save(folder / CERTIFICATE)
        save_figure(certificate_figure(field, found), folder / CERTIFICATE_FIGURE)
        summary = {
            **certificate_summary(found),
            "checked": claimed is not None,
            "time_s": elapsed,
            "cpu_s": cpu_time,
            "unit_length": field.cloud.unit_length,
            "reference": kind,
            **origin(field),
        }
        write_summary(folder, summary)
    return summary


def certificate_summary(found: Certificate) -> dict[str, Any]:
    """Returns what was proved, by the names of `summary.json`."""
    conditions = found.conditions
    return {
        "certified": found.certified,
        "reason": found.reason,
        "method": "proved",
        "sigma": found.sigma,
        "c_in": conditions and conditions.c_in,
        "c_out": conditions and conditions.c_out,
        "alpha": found.alpha,
        "delta": found.delta,
        "tube_half_width": found.tube_half_width,
        "orbit_half_width": found.orbit_half_width,
        "area_fraction": found.area_fraction,
        "decrease_fraction": found.decrease_fraction,
        "boxes": found.boxes,
        "undecided": found.undecided,
        "entry_time_bound": found.entry_time_bound,
        "e_star_max": found.e_star_max,
        "e_star": {"levels": found.levels, "e_star": found.e_star},
        "step_bound": found.step_bound,
        "counterexample": found.counterexample,
        "pieces": [asdict(piece) for piece in found.pieces],
    }
