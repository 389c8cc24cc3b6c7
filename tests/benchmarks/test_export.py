"""Exported fields: how near C is to NumPy, what compilers make of it, and what it costs."""

from dataclasses import replace
from functools import partial
from itertools import product
import re
import shutil
import subprocess
import timeit

import numpy as np
import pytest

from sgvf_drake.export import export_c
from sgvf_drake.export.c_numbers import PRECISIONS
from sgvf_drake.fields import (
    DirectedField,
    NormalisedComposition,
    PaperComposition,
    Perceptron,
    RobustComposition,
    ScoreNetwork,
)
from sgvf_drake.fields.activation import ACTIVATIONS, SILU
from tests.c_code import STRICT, CField
from tests.fields import random_field, random_perceptron
from tests.sgvf_drake.fields.test_directed import KINDS, field_of

pytestmark = pytest.mark.benchmark

POINTS = 20_000
FAR = 10.0
"""Of boxes, as far as points lie."""

SIGMA = 0.1
COMPOSITIONS = {
    "paper": PaperComposition(0.2),
    "normalised": NormalisedComposition(0.2),
    "robust": RobustComposition(0.2, SIGMA),
    "unprojected": RobustComposition(0.2, SIGMA, projects=False),
}
TIMED = 1_000


def as_trained(network):
    """A network whose numbers are those of float32, as training leaves them."""
    features = network.features
    if features is not None:
        frequencies, phases = (
            np.float64(np.float32(a)) for a in (features.frequencies, features.phases)
        )
        features = replace(features, frequencies=frequencies, phases=phases)
    weights, biases = (
        tuple(np.float64(np.float32(a)) for a in arrays)
        for arrays in (network.weights, network.biases)
    )
    return Perceptron(weights, biases, features, network.activation)


def learned(composition, activation, dim, recipe="robust", ends=0):
    """A field of networks of two hidden layers of 64."""
    field = random_field(recipe, dim, sigma=SIGMA, ends=ends)
    rng = np.random.default_rng(1)
    make = partial(random_perceptron, rng, hidden=(64, 64), outputs=dim, num_frequencies=32)
    score, tangent = (
        replace(as_trained(make(inputs=inputs)), activation=activation)
        for inputs in (dim + 1, dim)
    )
    model = field.score_model if recipe == "exact" else ScoreNetwork(score, SIGMA)
    return replace(
        field,
        score_model=model,
        tangent_network=tangent,
        composition=COMPOSITIONS[composition],
    )


def fields():
    """What is measured, by its name: every composition, activation and dimension."""
    for composition, activation, dim in product(COMPOSITIONS, ACTIVATIONS, (2, 3)):
        names = ("network", composition, activation.name, dim)
        yield names, learned(composition, activation, dim)
    for composition, dim in product(COMPOSITIONS, (2, 3)):
        yield ("mixture", composition, "SiLU", dim), learned(composition, SILU, dim, "exact")
    for recipe, dim in product(("robust", "exact"), (2, 3)):
        names = ("with ends, " + recipe, "robust", "SiLU", dim)
        yield names, learned("robust", SILU, dim, recipe, 2)
    for kind, dim in product(KINDS, (2, 3)):
        yield ("strands, " + kind, "robust", "SiLU", dim), field_of(kind, dim, ends=True)


def points_of(field):
    """Half over the box, the others beside waypoints, on them and far away."""
    rng, cloud = np.random.default_rng(5), field.cloud
    low, high = cloud.box
    quarter = POINTS // 4
    box = rng.uniform(low, high, (2 * quarter, field.dim))
    beside = cloud.points[rng.integers(cloud.num_points, size=quarter)]
    on = beside[: quarter // 2]
    scale = field.sigma * cloud.unit_length
    beside = beside + scale * rng.standard_normal(beside.shape)
    far = rng.uniform(-1, 1, (quarter - len(on), field.dim))
    return np.concatenate([box, beside, on, cloud.center + FAR * (high - low) * far])


def errors(found, expected):
    """The largest difference, relative to the largest number beyond 1."""
    return np.abs(found - expected).max() / max(1.0, np.abs(expected).max())


def microseconds(function, count):
    return 1e6 * min(timeit.repeat(function, number=1, repeat=5)) / count


def test_errors_and_times(save, tmp_path):
    rows = []
    for (kind, composition, activation, dim), field in fields():
        x = points_of(field)
        g = np.random.default_rng(6).standard_normal(x.shape)
        g = [g / np.linalg.norm(g, axis=1, keepdims=True)]
        if not isinstance(field, DirectedField):
            g = []
        m, J = field.value_and_jacobian(x, *g)
        few, few_g = x[:TIMED], [one[:TIMED] for one in g]
        shown = {"kind": kind, "composition": composition, "activation": activation}
        python = {
            "numpy_J_us": microseconds(lambda: field.value_and_jacobian(few, *few_g), TIMED),
        }
        if not g:
            one = field.compiled().evaluate
            python["numba_J_us"] = microseconds(lambda: [one(p) for p in few], TIMED)
        for precision in PRECISIONS:
            folder = tmp_path / "field"
            shutil.rmtree(folder, ignore_errors=True)
            code = CField(field, folder, precision, "-O3", **({"routes": ()} if g else {}))
            subprocess.run(["gcc", "-O3", "-c", "field.c"], cwd=folder, check=True)
            size = subprocess.check_output(["size", "field.o"], cwd=folder, text=True)
            row = shown | {
                "dim": dim,
                "precision": precision,
                "value": errors(code(x, *g), m),
                "jacobian": errors(code.jacobian(x, *g), J),
                "object_kB": sum(map(int, size.splitlines()[1].split()[:2])) / 1000,
                "C_us": microseconds(partial(code, few, *few_g), TIMED),
                "C_J_us": microseconds(partial(code.jacobian, few, *few_g), TIMED),
                **python,
            }
            rows.append(row)
            shutil.move(folder, tmp_path / f"{len(rows)}")
            limit = 1e-3 if precision == "float" else 1e-11
            assert max(row["value"], row["jacobian"]) < limit, row
    table = save(rows, "export")
    worst = table.groupby(["kind", "composition", "dim", "precision"])
    save(worst.max(numeric_only=True).reset_index(), "export_by_composition")


COMPILERS = {
    "gcc -O0": ["gcc", "-O0"],
    "gcc -O3": ["gcc", "-O3"],
    "gcc -Os": ["gcc", "-Os"],
    "gcc, sanitized": ["gcc", "-O1", "-g", "-fsanitize=address,undefined"],
    "clang -O0": ["clang", "-O0"],
    "clang -O3": ["clang", "-O3"],
    "clang, sanitized": ["clang", "-O1", "-g", "-fsanitize=address,undefined"],
    "ARM -O0": ["aarch64-linux-gnu-gcc", "-O0", "-static"],
    "ARM -O3": ["aarch64-linux-gnu-gcc", "-O3", "-static"],
}
EMULATOR = "qemu-aarch64"


def test_compilers(save, tmp_path, tee_field, robust_field, paper_field, open_field):
    """The written test passes with every compiler that is there; others have no row."""
    kinds = {"robust": robust_field, "paper": paper_field, "open": open_field}
    kinds |= {"directed": tee_field, "learned strands": field_of("learned two-way", 3, True)}
    rows = []
    for (kind, field), precision in product(kinds.items(), PRECISIONS):
        folder = tmp_path / f"{kind}-{precision}"
        options = {"routes": ()} if kind == "learned strands" else {}
        export_c(field, folder, precision, **options)
        for name, command in COMPILERS.items():
            runner = [EMULATOR] if name.startswith("ARM") else []
            if not all(map(shutil.which, (command[0], *runner))):
                continue
            sources = ["field.c", "laws.c", "field_test.c", "-lm", "-o", "field_test"]
            subprocess.run([*command, *STRICT, *sources], cwd=folder, check=True)
            done = subprocess.run(
                [*runner, folder / "field_test"], capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, (kind, precision, name, done.stdout, done.stderr)
            found = dict(re.findall(r"(\w+) +largest error (.+)", done.stdout))
            elsewhere = sum(map(int, re.findall(r"steps, (\d+) in another", done.stdout)))
            rows.append(
                {
                    "field": kind,
                    "precision": precision,
                    "compiler": name,
                    "value": float(found["value"]),
                    "jacobian": float(found["Jacobian"]),
                    "other_sections": elsewhere,
                }
            )
    table = save(rows, "export_compilers")
    worst = table.groupby(["compiler", "precision"])[["value", "jacobian", "other_sections"]]
    save(worst.max().reset_index(), "export_by_compiler")
