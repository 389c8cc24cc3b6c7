"""An audit in ball arithmetic of the models of trained fields.

A few squares of it are among the tests.
"""

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.certificate.boxes import BoxSizes
from sgvf_drake.certificate.mixture_model import MixtureModel, lowest_of, mixture_of
from tests.sgvf_drake.certificate.audit import audit, random_patches

from .measuring import trained

pytestmark = pytest.mark.benchmark

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
