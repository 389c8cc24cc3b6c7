"""Check the Lyapunov conditions of a field: on samples, along trajectories, and in flight."""

from dataclasses import asdict
from os import PathLike
from pathlib import Path
import time
from typing import Any

import numpy as np

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.figures.tracking import tracking_figure
from sgvf_drake.experiments.figures.verification import theorem_figure, verification_figure
from sgvf_drake.experiments.reference import choose_reference
from sgvf_drake.experiments.results import (
    SUMMARY,
    origin,
    result_folder,
    save_figure,
    write_summary,
)
from sgvf_drake.experiments.theorem import check_theorem
from sgvf_drake.experiments.velocity_error import flight_tracking
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov import Verification, verify
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress
from systems import FieldForSpeed

VERIFY_FILES = (SUMMARY, "verify.png", "theorem.png", "tracking.png")


def run_verify(
    field: GuidingField,
    reference: tuple[ReferencePath, str] | None,
    out: str | PathLike[str],
    *,
    starts: int = 64,
    speed: float | None = None,
    altitude: float = 1.0,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Verifies a field; leaves the maps, the trajectories' figure and the summary.

    The field is in metres where it is to be flown.  `starts` agents follow it from a grid over
    the box, of which those inside count.  With a `speed` in m/s the quadrotor flies along every
    piece too, at the `altitude` in m.

    Raises:
        ConfigurationError: The field is neither planar nor spatial, or a value cannot be used.
    """
    if speed is not None and not (np.isfinite(speed) and speed > 0):
        raise ConfigurationError(f"the speed must be a positive number, not {speed}")
    path, kind = reference or choose_reference(field)
    begin = time.perf_counter()
    with result_folder(out, VERIFY_FILES, overwrite=overwrite) as folder:
        found = verify(field, path, progress=progress)
        save_figure(verification_figure(field, found), folder / "verify.png")
        summary = {**verification_summary(field, found), "theorem": None, "flight": None}
        if found.band is not None:
            checks = check_theorem(field, path, found, starts, progress)
            save_figure(theorem_figure(*checks), folder / "theorem.png")
            decrease, level_sets, modes = (check.summary() for check in checks)
            summary["theorem"] = {
                "decrease": decrease,
                "level_sets": level_sets,
                "modes": modes,
            }
            summary["assumptions"]["a3"]["remained_fraction"] = decrease["stayed_fraction"]
            # The verdict as the trajectories leave it: one that leaves the set ends it.
            if not decrease["entered_fraction"] == decrease["stayed_fraction"] == 1.0:
                seen = decrease["exit"] or "not every agent entered the tube and stayed there"
                reasons = [seen] if found.holds else [found.reason, seen]
                summary |= {"holds": False, "reason": "; ".join(reasons)}
        if speed is not None:
            summary["flight"] = _fly(field, path, speed, altitude, folder, progress)
        summary |= {
            "time_s": time.perf_counter() - begin,
            "unit_length": field.cloud.unit_length,
            "reference": kind,
            **origin(field),
        }
        write_summary(folder, summary)
    return summary


def verification_summary(field: GuidingField, found: Verification) -> dict[str, Any]:
    """Returns what the samples showed, by the names of `summary.json`."""
    band, margins = found.band, found.margins
    lower, upper = field.cloud.box
    compact = band and band.basin.compact
    e_star_min = margins and float(margins.e_star.min())
    inward = margins and bool(margins.e_star.min() > 0)
    a3 = {"compact": compact, "inward": inward, "remained_fraction": None}
    return {
        "holds": found.holds,
        "reason": found.reason,
        "method": "sampled",
        "sigma": found.function.sigma,
        "c_in": band and band.c_in,
        "c_out": band and band.c_out,
        "alpha": found.alpha,
        "delta": found.slowest,
        "tube_half_width": band and band.tube.half_width,
        "area_fraction": band and band.basin.area / float(np.prod(upper - lower)),
        "decrease_fraction": found.decrease_fraction,
        "compact": compact,
        "components": band
        and [{"pieces": c.pieces, "holes": c.holes} for c in band.tube.components],
        "e_star_max": margins and margins.largest,
        "e_star_min": e_star_min,
        "e_star": margins
        and {"levels": margins.levels, "e_star": margins.e_star, "weakest": margins.weakest},
        "undecided": found.zeros.undecided,
        "violations": [asdict(violation) for violation in found.violations],
        "assumptions": {**found.assumptions, "a3": a3},
        "lemma": found.lemma,
        "bounds": {bound.name: bound.summary() for bound in found.bounds},
    }


def _fly(
    field: GuidingField,
    reference: ReferencePath,
    speed: float,
    altitude: float,
    folder: Path,
    progress: Progress,
) -> dict[str, Any]:
    """Compares the velocity error of a flight with the inward flow of the field it follows.

    A flight follows a field that is widened for its speed, which has a band of its own.
    """
    flown = FieldForSpeed(field, speed)
    assert isinstance(flown, GuidingField)
    found = verify(flown, reference, progress=progress)
    band, margins = found.band, found.margins
    if band is None or margins is None:
        return {"band": None}
    # The set that tolerates most is the one that a flight is to stay in.
    level = float(margins.levels[margins.e_star.argmax()])
    result = flight_tracking(
        field,
        reference,
        speed,
        band.function,
        margins,
        c_in=band.c_in,
        level=level,
        altitude=altitude,
        progress=progress,
    )
    save_figure(tracking_figure(result), folder / "tracking.png")
    return {
        "band": [band.c_in, band.c_out],
        "sigma": band.function.sigma,
        "tube_half_width": band.tube.half_width,
        "e_star_max": margins.largest,
        **result.summary(),
    }
