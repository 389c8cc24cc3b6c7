"""Zeros of trained fields: complete against a dense search, and their indices sum up.

Run by `make bench`; the table is printed and saved in build/bench.
"""

from dataclasses import replace
import time

import numpy as np
import pandas as pd
import pytest
from scipy.optimize import root
from scipy.spatial import cKDTree

import sgvf_drake as sgvf
from sgvf_drake.experiments.clouds import make_cloud
from sgvf_drake.fields import PaperComposition, ScoreField, TangentField
from sgvf_drake.lyapunov import find_singularities

pytestmark = pytest.mark.benchmark

SEEDS = (0, 1, 2)
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
# Cells along each axis of the dense search.
DENSE = 400
# Two searches found the same zero within so many U.
SAME = 1e-6


def dense_zeros(field, box):
    """Roots from every cell of a fine grid in which neither component keeps its sign."""
    axes = [np.linspace(box[0][k], box[1][k], DENSE + 1) for k in range(2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = field(grid.reshape(-1, 2)).reshape(grid.shape)
    corners = np.stack([values[:-1, :-1], values[1:, :-1], values[1:, 1:], values[:-1, 1:]])
    crossing = (np.sign(corners).min(axis=0) != np.sign(corners).max(axis=0)).all(axis=-1)
    half = (box[1] - box[0]) / DENSE / 2
    roots = []
    for start in grid[:-1, :-1][crossing] + half:
        # In cells, so that one tolerance serves every unit of length.
        found = root(
            lambda u, x=start: field(x + u * half),
            np.zeros(2),
            jac=lambda u, x=start: field.value_and_jacobian(x + u * half)[1] * half,
            tol=1e-12,
        )
        x = start + found.x * half
        slope = np.abs(field.value_and_jacobian(x)[1]).max() * half.max()
        if np.abs(found.fun).max() < 1e-8 * slope and ((x >= box[0]) & (x <= box[1])).all():
            roots.append(x)
    return np.array(roots).reshape(-1, 2)


def run_case(path, sampling, seed):
    cloud, _ = make_cloud(path, sampling, seed)
    field = sgvf.train(cloud, sgvf.TrainingConfig(seed=seed)).field
    begin = time.process_time()
    found = find_singularities(field)
    elapsed = time.process_time() - begin
    unnormalised = replace(field, composition=PaperComposition(field.composition.gain))
    fields = {
        "guiding": field,
        "score": ScoreField(field),
        "tangent": TangentField(unnormalised),
    }
    missed = 0
    for name, zeros in found.by_field.items():
        dense = dense_zeros(fields[name], found.box)
        distance, _ = cKDTree(zeros.points).query(dense)
        missed += int((distance > SAME * cloud.unit_length).sum())
    parts = found.by_field.values()
    return {
        "shape": path,
        "sampling": sampling,
        "seed": seed,
        "sigma [U]": field.sigma,
        **{
            f"zeros {name}": len(zeros.zeros)
            for name, zeros in zip(("m", "S", "v"), parts, strict=True)
        },
        "winding": "/".join(str(zeros.winding_number) for zeros in parts),
        "index_sum": "/".join(str(zeros.index_sum) for zeros in parts),
        "undecided": sum(zeros.undecided for zeros in parts),
        "missed": missed,
        "cells": sum(zeros.cells for zeros in parts),
        "time [s]": round(elapsed, 2),
    }


def test_all_zeros_are_found_and_indices_sum_up(save):
    table = pd.DataFrame([run_case(*case) for case in CASES])
    save(table, "singularities")
    assert (table["winding"] == table["index_sum"]).all()
    assert (table["missed"] == 0).all()
    assert (table["undecided"] == 0).all()
