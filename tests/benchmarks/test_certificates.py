"""An audit in ball arithmetic of the models of fields, over squares and over all other patches.

A few patches of it are among the tests.
"""

import numpy as np
import pandas as pd
import pytest

from sgvf_drake import load_field
from sgvf_drake.certificate.boxes import BoxSizes
from sgvf_drake.certificate.mixture_model import MixtureModel, lowest_of, mixture_of
from tests.data.make import field_file
from tests.fields import random_field
from tests.sgvf_drake.certificate.audit import audit, random_patches
from tests.sgvf_drake.fields.test_directed import KINDS, field_of

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
# Patches of each kind and size of each field: the dimension of space, and parameters; and the
# largest half-sides.
PATCHES = 4
KINDS_OF_PATCHES = {
    "segments": (2, 1),
    "turned squares": (2, 2),
    "cells": (2, 3),
    "segments in space": (3, 1),
    "faces in space": (3, 2),
    "cubes": (3, 3),
    "cells in space": (3, 5),
}
HALVES = (2.0**-5, 2.0**-9, 2.0**-13)
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


def fields_in(dim):
    """Fields of every kind, by name: with and without ends, and directed ones that are held."""
    if dim == 2:
        for name in ("robust", "exact", "paper", "open"):
            yield name, load_field(field_file(name))
    else:
        for recipe in ("robust", "exact", "paper"):
            yield recipe, random_field(recipe, dim=3)
        yield "open", random_field("robust", dim=3, ends=2)
    g = np.random.default_rng(3).standard_normal(dim)
    for kind in KINDS:
        yield (
            f"directed, {kind}",
            field_of(kind, dim, ends=True).heading(0.9 * g / np.linalg.norm(g)),
        )


def audited_patches(kind):
    dim, k = KINDS_OF_PATCHES[kind]
    for name, field in fields_in(dim):
        rng = np.random.default_rng(0)
        for half in HALVES:
            patches = random_patches(field, half, k, PATCHES, rng)
            for of, found in audit(field, None, patches, rng).items():
                values = dict(zip(FOUND, found, strict=True))
                yield {"patches": kind, "field": name, "of": of} | values


def assert_held(table):
    assert (table["violations"] == 0).all()
    assert (table["largest part of the remainder"] <= 1).all()


def test_models_hold_what_balls_say(save):
    rows = pd.DataFrame([row for case in AUDITED for row in audited(*case)])
    by_size = rows.groupby(["half-side", "of"], sort=False, as_index=False)
    assert_held(save(by_size.agg(FOUND), "certificate_audit"))


@pytest.mark.parametrize("kind", KINDS_OF_PATCHES)
def test_models_over_patches_hold_what_balls_say(save, kind):
    rows = pd.DataFrame(list(audited_patches(kind)))
    for by in ("of", "field"):
        table = rows.groupby(["patches", by], sort=False, as_index=False).agg(FOUND)
        assert_held(save(table, f"certificate_audit_{kind}_by_{by}".replace(" ", "_")))
