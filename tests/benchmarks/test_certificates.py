"""Certificates of trained fields: what is proved, its cost, laps, and an audit of the models.

The audit is in ball arithmetic; a few squares of it are among the tests.
"""

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

import sgvf_drake as sgvf
from sgvf_drake.certificate import check
from sgvf_drake.certificate.boxes import BoxSizes
from sgvf_drake.certificate.mixture_model import MixtureModel, lowest_of, mixture_of
from tests.sgvf_drake.certificate.audit import audit, random_patches

from .measuring import SEEDS, timed, trained

pytestmark = pytest.mark.benchmark

SHAPES = (
    *("concentric-circles", "separated-circles", "concentric-flight", "separated-flight"),
    *("square", "hexagon", "octagon", "triangle", "star"),
)
# Shapes, recipes, and noise levels of V in those of the field; and squares of each size.
AUDITED = (
    ("concentric-circles", "robust", 1.0),
    ("star", "robust", 1.4),
    ("square", "exact", 1.0),
    ("separated-circles", "paper", 0.7),
)
SQUARES = 40
# What the audit tells of a model, and how that is put together over the fields.
FOUND = {"values": "sum", "violations": "sum", "largest part of the remainder": "max"}


def lap_time(field, center, start):
    """The time of the second lap about a point, by SciPy; as of the field, in its own unit."""

    def rate(_, state):
        p, m = state[:2] - center, field(state[None, :2])[0]
        return np.array([*m, (p[0] * m[1] - p[1] * m[0]) / (p @ p)])

    def first(_, state):
        return float(abs(state[2]) - 2 * np.pi)

    def second(_, state):
        return float(abs(state[2]) - 4 * np.pi)

    second.terminal = True  # type: ignore[attr-defined]
    precision = {"rtol": 1e-9, "atol": 1e-11}
    start = [*start, 0.0]
    run = solve_ivp(rate, (0, 1e4), start, "LSODA", events=[first, second], **precision)
    return float(run.t_events[1][0] - run.t_events[0][0])


def laps_of(field, found):
    """What is proved of each piece, beside the lap that is simulated."""
    rows = []
    for piece, tube in zip(found.pieces, found.tubes, strict=True):
        assert tube is not None
        middles = field.cloud.denormalize(tube.rows[:, 0])
        center, start = middles[:-1].mean(axis=0), middles[0]
        low, high = piece.lap_time_low, piece.lap_time_high
        lap = lap_time(field, center, start)
        assert low <= lap <= high
        unique = piece.orbit_unique
        rows.append({"unique": unique, "low": low / lap - 1, "high": high / lap - 1})
    return rows


def test_certificates_of_trained_fields(save):
    rows, laps = [], []
    for shape, seed in [(shape, seed) for shape in SHAPES for seed in SEEDS]:
        result, path = trained(shape, seed, order=seed)
        field, unit = result.field, result.field.cloud.unit_length
        found, search_s = timed(lambda f=field, p=path: sgvf.certify(f, p))
        assert found.certified, (shape, seed, found.reason, found.counterexample)
        again, proof_s = timed(lambda c=found, f=field, p=path: check(c, f, p))
        assert again.certified
        of = {"shape": shape, "seed": seed}
        names = ("sigma", "tube_half_width", "orbit_half_width", "entry_time_bound")
        lengths = {name: getattr(found, name) / unit for name in names}
        shares = ("area_fraction", "decrease_fraction", "e_star_max", "delta", "boxes")
        rows.append(
            of
            | {"c_in": found.conditions.c_in, "c_out": found.conditions.c_out}
            | lengths
            | {name: getattr(found, name) for name in shares}
            | {"search and proof, s": search_s, "proof, s": proof_s}
        )
        laps += [of | row for row in laps_of(field, found)]
    save(rows, "certificates")
    save(laps, "certificate_laps")


def audited(shape, recipe, ratio):
    field = trained(shape, recipe=recipe)[0].field
    mixture = mixture_of(field, ratio * field.sigma)
    levels = MixtureModel(mixture, lowest_of(mixture))
    squares, rng = BoxSizes.of(field), np.random.default_rng(0)
    halves = (squares.first, squares.ring, squares.unit / 16, squares.unit / 128, squares.last)
    for half in halves:
        patches = random_patches(field, half, 2, SQUARES, rng)
        for name, found in audit(field, levels, patches, rng).items():
            size = f"unit / {squares.unit / half:.0f}"
            yield {"half-side": size, "of": name} | dict(zip(FOUND, found, strict=True))


def test_models_hold_what_balls_say(save):
    rows = pd.DataFrame([row for case in AUDITED for row in audited(*case)])
    by_size = rows.groupby(["half-side", "of"], sort=False, as_index=False)
    table = save(by_size.agg(FOUND), "certificate_audit")
    assert (table["violations"] == 0).all()
    assert (table["largest part of the remainder"] <= 1).all()
