"""The audit of the certificate's models on trained fields, in ball arithmetic.

Run by `make bench`; the table is printed and saved in build/bench.  A few squares of the same
audit are among the tests.
"""

import numpy as np
import pandas as pd
import pytest

import sgvf_drake as sgvf
from sgvf_drake.certificate.boxes import BoxSizes
from sgvf_drake.certificate.mixture_model import MixtureModel, lowest_of, mixture_of
from tests.sgvf_drake.certificate.audit import audit, random_boxes

pytestmark = pytest.mark.benchmark

CASES = (
    ("concentric-circles", "robust", 1.0),
    ("star", "robust", 1.4),
    ("square", "exact", 1.0),
    ("separated-circles", "paper", 0.7),
)
"""Shapes, recipes, and noise levels of V in those of the field."""

SQUARES = 40
"""Of each size, for each field."""


def audit_case(shape, recipe, ratio):
    cloud, _ = sgvf.make_shape(shape)
    field = sgvf.train(cloud, sgvf.TrainingConfig(recipe=recipe)).field
    mixture = mixture_of(field, ratio * field.sigma)
    levels = MixtureModel(mixture, lowest_of(mixture))
    squares, rng = BoxSizes.of(field), np.random.default_rng(0)
    halves = (squares.first, squares.ring, squares.unit / 16, squares.unit / 128, squares.last)
    rows = []
    for half in halves:
        boxes = random_boxes(field, half, SQUARES, rng)
        rows += [
            {
                "half-side": f"unit / {squares.unit / half:.0f}",
                "of": name,
                "values": count,
                "violations": violations,
                "largest part of the remainder": largest,
            }
            for name, (count, violations, largest) in audit(field, levels, boxes, rng).items()
        ]
    return rows


def test_models_hold_what_balls_say(save):
    rows = pd.DataFrame([row for case in CASES for row in audit_case(*case)])
    table = rows.groupby(["half-side", "of"], sort=False, as_index=False).agg(
        {"values": "sum", "violations": "sum", "largest part of the remainder": "max"}
    )
    save(table, "certificate_audit")
    assert (table["violations"] == 0).all()
    assert (table["largest part of the remainder"] <= 1).all()
