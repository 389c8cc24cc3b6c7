"""Verification of every closed shape, and of the paper's recipe: one table and the maps."""

import time

import pytest

import sgvf_drake as sgvf
from sgvf_drake import plotting
from sgvf_drake.experiments import check_theorem, verification_figure

from .measuring import timed, trained

pytestmark = pytest.mark.benchmark

PAPER_SHAPES = ("concentric-circles", "separated-circles", "square")
PAPER_SEEDS = (0, 1)
STARTS = 100


def verify_case(out, shape, recipe, seed):
    result, path = trained(shape, seed, recipe)
    field = result.field
    found, time_s = timed(lambda: sgvf.verify(field, path), time.perf_counter)
    figure = verification_figure(field, found)
    figure.savefig(out / f"verify-{shape}-{recipe}-{seed}.png", dpi=plotting.DPI)
    U, band, margins = field.cloud.unit_length, found.band, found.margins
    lower, upper = field.cloud.box
    row = {
        "shape": shape,
        "recipe": recipe,
        "seed": seed,
        "holds": found.holds,
        "eps": found.assumptions["a2_cosine"]["mean"],
        "eps_95": found.assumptions["a2_cosine"]["q95"],
        "eps_gradient": found.assumptions["a2_cosine_gradient"]["mean"],
        "length_error": found.assumptions["a2_length_error"]["mean"],
        "decrease": found.decrease_fraction,
        "delta": found.slowest,
        "violations": sum(violation.counts for violation in found.violations),
        **{bound.name: bound.holds.mean() for bound in found.bounds},
        "gradient_nearly": found.bounds[2].summary()["nearly_holds_fraction"],
        "time_s": time_s,
        "reason": found.reason,
    }
    if band is not None and margins is not None:
        decrease, level_sets, modes = check_theorem(field, path, found, STARTS)
        row |= {
            "sigma": band.function.sigma / U,
            "c_in": band.c_in,
            "c_out": band.c_out,
            "alpha": band.decrease * U,
            "tube": band.tube.half_width / U,
            "area": band.basin.area / float((upper - lower).prod()),
            "e_star": margins.largest,
            "entered": decrease.summary()["entered_fraction"],
            "stayed": decrease.summary()["stayed_fraction"],
            "drift": float(level_sets.drift.max()),
            "mode_speed_min": float(modes.speeds.min()),
        }
    return row


def test_verification_table(save, out):
    cases = [(shape, "robust", 0) for shape in sgvf.SHAPES]
    cases += [(shape, "paper", seed) for shape in PAPER_SHAPES for seed in PAPER_SEEDS]
    table = save([verify_case(out, *case) for case in cases], "verify")
    robust = table[table["recipe"] == "robust"]
    assert robust["holds"].all()
    assert (robust[["entered", "stayed"]] == 1).all(axis=None)
    # Cauchy and Schwarz: the corrected form cannot fail, whatever the field.
    assert (table["squashed"] == 1).all()
    assert (table["paper"] < 1).all()
