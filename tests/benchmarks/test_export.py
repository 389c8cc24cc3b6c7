"""Exported fields: how near they are to NumPy, what compilers make of C, and what it costs."""

from dataclasses import replace
from functools import partial
from itertools import product
import re
import shutil
import subprocess
import time
import timeit

import numpy as np
import pytest

from sgvf_drake.export import export_c
from sgvf_drake.export.c_numbers import PRECISIONS
from sgvf_drake.export.onnx import PRECISIONS as GRAPHS
from sgvf_drake.export.onnx import Session, make_model
from sgvf_drake.fields import (
    DirectedField,
    NormalisedComposition,
    PaperComposition,
    RobustComposition,
    ScoreNetwork,
)
from sgvf_drake.fields.activation import ACTIVATIONS, SILU
from tests.c_code import STRICT, CField
from tests.fields import random_field
from tests.sgvf_drake.fields.test_directed import KINDS, field_of

pytestmark = pytest.mark.benchmark

POINTS = 20_000
FAR = 10.0
"""Of boxes, as far as points lie."""

SIGMA, GAIN = 0.1, 0.2
COMPOSITIONS = {
    "paper": PaperComposition(GAIN),
    "normalised": NormalisedComposition(GAIN),
    "robust": RobustComposition(GAIN, SIGMA),
    "unprojected": RobustComposition(GAIN, SIGMA, projects=False),
}
TIMED = 1_000
"""Points of which the time is taken."""


def learned(composition, activation, dim, recipe="robust", ends=0):
    """A field of random networks."""
    field = random_field(recipe, dim, sigma=SIGMA, gain=GAIN, ends=ends)
    score = field.score_model
    if isinstance(score, ScoreNetwork):
        score = replace(score, network=replace(score.network, activation=activation))
    return replace(
        field,
        score_model=score,
        tangent_network=replace(field.tangent_network, activation=activation),
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
    """Of the processor, which others that run beside it do not lengthen by much."""
    times = timeit.repeat(function, number=1, repeat=7, timer=time.process_time)
    return 1e6 * min(times) / count


def readable(table):
    """The table with its errors as text, of which rounding would leave nothing."""
    texts = {name: table[name].map("{:.1e}".format) for name in ("value", "jacobian")}
    return table.assign(**texts)


def directions_for(field, x):
    """Unit vectors where a field takes an intended direction, in a list of one; else none."""
    if not isinstance(field, DirectedField):
        return []
    g = np.random.default_rng(6).standard_normal(x.shape)
    return [g / np.linalg.norm(g, axis=1, keepdims=True)]


def compared(names, precision, found, expected):
    """A row of a table: how far values and Jacobians are from the right ones, which is near."""
    (m, J), (right_m, right_J) = found, expected
    row = {
        **dict(zip(("kind", "composition", "activation", "dim"), names, strict=True)),
        "precision": precision,
        "value": errors(m, right_m),
        "jacobian": errors(J, right_J),
    }
    # The slope of ReLU jumps: of so many points, float sees a few on the other side.
    jumps = precision == "float" and row["activation"] == "ReLU"
    limit = 1e-3 if precision == "float" else 1e-11
    assert max(row["value"], 0 if jumps else row["jacobian"]) < limit, row
    return row


def test_errors(save, tmp_path):
    rows = []
    for number, (names, field) in enumerate(fields()):
        x = points_of(field)
        g = directions_for(field, x)
        expected = field.value_and_jacobian(x, *g)
        options = {"routes": ()} if g else {}
        for precision in PRECISIONS:
            folder = tmp_path / f"{number}-{precision}"
            code = CField(field, folder, precision, "-O2", **options)
            found = code(x, *g), code.jacobian(x, *g)
            rows.append(compared(names, precision, found, expected))
    table = save(rows, "export_errors")
    worst = table.groupby(["kind", "composition", "dim", "precision"])
    save(readable(worst.max(numeric_only=True).reset_index()), "export_by_composition")


def test_errors_of_onnx(save):
    """Of the same fields and points, but for GELU in double, which ONNX Runtime has not."""
    rows = []
    for names, field in fields():
        x = points_of(field)
        inputs = (x, *directions_for(field, x))
        expected = field.value_and_jacobian(*inputs)
        for precision in ("double", "float"):
            if precision == "double" and "GELU" in names:
                continue
            model = make_model(field, GRAPHS[precision], jacobian=True)
            outputs = [part.name for part in model.graph.output]
            found = dict(zip(outputs, Session(model)(*inputs), strict=True))
            rows.append(compared(names, precision, (found["m"], found["jacobian"]), expected))
    table = save(rows, "onnx_errors")
    worst = table.groupby(["kind", "composition", "dim", "precision"])
    save(readable(worst.max(numeric_only=True).reset_index()), "onnx_by_composition")


def test_what_trained_fields_cost(
    save, tmp_path, tee_field, robust_field, paper_field, exact_field
):
    """Of one point, by gcc; NumPy takes all of them as a batch, and one by one."""
    kinds = {"robust": robust_field, "paper": paper_field, "exact": exact_field}
    rows = []
    for kind, field in {**kinds, "directed": tee_field}.items():
        x = np.random.default_rng(7).uniform(*field.cloud.box, (TIMED, field.dim))
        g = directions_for(field, x)
        few = [points[:20] for points in (x, *g)]
        python = {
            "NumPy batch": microseconds(partial(field.value_and_jacobian, x, *g), TIMED),
            "NumPy one": microseconds(
                partial(all_of, field.value_and_jacobian, *few), len(few[0])
            ),
        }
        if not g:
            python["numba"] = microseconds(partial(all_of, field.compiled().evaluate, x), TIMED)
        for precision, optimisation in product(PRECISIONS, ("-O2", "-O3")):
            folder = tmp_path / f"{kind}-{precision}{optimisation}"
            code = CField(field, folder, precision, optimisation)
            command = ["gcc", optimisation, "-c", "field.c"]
            subprocess.run(command, cwd=folder, check=True)
            size = subprocess.check_output(["size", "field.o"], cwd=folder, text=True)
            row = {
                "field": kind,
                "precision": precision,
                "gcc": optimisation,
                "object_kB": sum(map(int, size.splitlines()[1].split()[:2])) / 1000,
                "value_us": microseconds(partial(code, x, *g), TIMED),
                "product_us": microseconds(partial(code.product, x, x, *g), TIMED),
                "jacobian_us": microseconds(partial(code.jacobian, x, *g), TIMED),
                **python,
            }
            rows.append(row)
    save(rows, "export_costs")


def all_of(function, *points):
    """Calls a function of a point for each."""
    for one in zip(*points, strict=True):
        function(*one)


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
    save(readable(worst.max().reset_index()), "export_by_compiler")
