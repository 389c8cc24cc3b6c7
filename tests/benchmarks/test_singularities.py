"""Zeros of trained fields: complete against a dense search, and their indices sum up."""

from dataclasses import replace

import pytest
from scipy.spatial import cKDTree

import sgvf_drake as sgvf
from sgvf_drake.experiments.clouds import make_cloud
from sgvf_drake.fields import PaperComposition, ScoreField, TangentField
from sgvf_drake.lyapunov import find_singularities
from tests.sgvf_drake.lyapunov.dense import dense_zeros

from .measuring import SEEDS, timed

pytestmark = pytest.mark.benchmark

CLOUDS = (
    ("circle", "forty"),
    ("star", "random-noisy"),
    ("concentric-circles", "uneven"),
    ("square", "outliers"),
    ("hairpin", "fine"),
    ("near-touch", "uniform"),
    ("two-sizes", "uniform"),
    ("circuit-1", "fine"),
    ("millimetres", "uniform"),
    ("kilometres", "uniform"),
)
CASES = [(shape, "uniform", seed) for shape in sgvf.SHAPES for seed in SEEDS] + [
    (path, sampling, 0) for path, sampling in CLOUDS
]
# Cells along each axis of the dense search, and U within which a zero is the same.
DENSE, SAME = 400, 1e-6


def run_case(path, sampling, seed):
    cloud, _ = make_cloud(path, sampling, seed)
    field = sgvf.train(cloud, sgvf.TrainingConfig(seed=seed)).field
    found, elapsed = timed(lambda: find_singularities(field))
    unnormalised = replace(field, composition=PaperComposition(field.composition.gain))
    fields = {
        "guiding": field,
        "score": ScoreField(field),
        "tangent": TangentField(unnormalised),
    }
    missed = 0
    for name, zeros in found.by_field.items():
        dense = dense_zeros(fields[name], found.box, DENSE)
        distance, _ = cKDTree(zeros.points).query(dense)
        missed += int((distance > SAME * cloud.unit_length).sum())
    parts = found.by_field.values()
    return {
        **{"shape": path, "sampling": sampling, "seed": seed, "sigma [U]": field.sigma},
        **{
            f"zeros {name}": len(zeros.zeros)
            for name, zeros in zip(("m", "S", "v"), parts, strict=True)
        },
        "winding": "/".join(str(zeros.winding_number) for zeros in parts),
        "index_sum": "/".join(str(zeros.index_sum) for zeros in parts),
        "undecided": sum(zeros.undecided for zeros in parts),
        "missed": missed,
        "cells": sum(zeros.cells for zeros in parts),
        "time [s]": elapsed,
    }


def test_all_zeros_are_found_and_indices_sum_up(save):
    table = save([run_case(*case) for case in CASES], "singularities")
    assert (table["winding"] == table["index_sum"]).all()
    assert (table["missed"] == 0).all()
    assert (table["undecided"] == 0).all()
