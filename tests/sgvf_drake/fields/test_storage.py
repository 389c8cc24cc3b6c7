"""Field files: exact to the bit, whole or not at all, and no foreign or damaged one is read."""

from dataclasses import replace
from itertools import product
import json
import os
import pickle
import struct
import subprocess
import sys

import numpy as np
import pytest
from safetensors.numpy import load, save
from safetensors.torch import save_file
import torch

from sgvf_drake.exceptions import FieldFileError, OutputExistsError
from sgvf_drake.fields import (
    RobustComposition,
    load_field,
    save_field,
)

# The one entry of the metadata, part of the format.
HEADER_KEY = "sgvf_drake.field"
X = np.random.default_rng(0).uniform(-2, 8, (20, 2))


@pytest.fixture
def whole(make_field, tmp_path):
    """The bytes of a good file."""
    path = tmp_path / "whole.safetensors"
    save_field(make_field("robust", support=12, ends=2), path)
    return path.read_bytes()


@pytest.fixture
def refuses(tmp_path):
    """Holds that a file of these bytes is refused, by an error that names it."""

    def check(data, match, name="bad.safetensors"):
        path = tmp_path / name
        path.write_bytes(data)
        with pytest.raises(FieldFileError, match=match) as error:
            load_field(path)
        assert str(error.value).startswith(f"{path}: ")

    return check


def read_header(data):
    size = struct.unpack("<Q", data[:8])[0]
    return json.loads(json.loads(data[8 : 8 + size])["__metadata__"][HEADER_KEY])


def rewrite(data, header=None, tensors=None, drop=()):
    """The file with other entries of the header and other tensors."""
    entries = read_header(data) | (header or {})
    arrays = load(data) | (tensors or {})
    kept = {key: value for key, value in entries.items() if key not in drop}
    arrays = {key: value for key, value in arrays.items() if key not in drop}
    return save(arrays, {HEADER_KEY: json.dumps(kept)})


def test_files_of_version_1_are_read(field, tmp_path):
    """They had no activations, and every network was one of SiLU."""
    path = tmp_path / "field.safetensors"
    field.save(path)
    new = path.read_bytes()
    path.write_bytes(
        rewrite(new, {"version": 1}, drop=["score_activation", "tangent_activation"])
    )
    loaded = load_field(path)
    np.testing.assert_array_equal(loaded.hessian(X), field.hessian(X))
    # Written anew, it is of this version.
    loaded.save(path, overwrite=True)
    assert path.read_bytes() == new


def test_the_header_tells_how_it_was_made(field, tmp_path):
    path = tmp_path / "field.safetensors"
    # Those who know no field without the projection find a composition that they do not know.
    bare = replace(field, composition=RobustComposition(0.8, 0.4, projects=False))
    bare.save(path)
    assert read_header(path.read_bytes())["composition"] == "unprojected"
    field.save(path, overwrite=True)
    assert read_header(path.read_bytes()) == {
        "version": 2,
        "recipe": field.recipe,
        "seed": 0,
        "sigma": 0.4,
        "composition": "paper" if field.recipe == "paper" else "robust",
        "gain": 0.8,
        "score_scale": {"robust": 0.4, "exact": None, "paper": 1.0}[field.recipe],
        "score_activation": None if field.recipe == "exact" else "SiLU",
        "tangent_activation": "SiLU",
        "shape": "random",
        "digest": field.cloud.digest,
        "center": field.cloud.center.tolist(),
        "unit_length": field.cloud.unit_length,
        "provenance": {"training": {"iterations": 7, "hidden": [9, 8]}},
    }


def test_a_file_is_written_whole_or_not_at_all(make_field, tmp_path, monkeypatch):
    path = tmp_path / "field.safetensors"
    path.write_text("precious")
    with pytest.raises(OutputExistsError, match=r"field\.safetensors exists; pass overwrite"):
        make_field("robust").save(path)
    assert path.read_text() == "precious"
    make_field("robust", seed=4).save(path, overwrite=True)
    assert load_field(path).seed == 4
    before = path.read_bytes()

    def fail(*_):
        raise OSError("the disk is full")

    for step in ("replace", "chmod"):
        with monkeypatch.context() as patch:
            patch.setattr(os, step, fail)
            with pytest.raises(OSError, match="the disk is full"):
                make_field("robust", seed=2).save(path, overwrite=True)
        assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["field.safetensors"]
    with pytest.raises(FileNotFoundError, match="nowhere"):
        make_field("robust").save(tmp_path / "nowhere" / "field")


PROGRAM = """
import pickle, sys
import numpy
def refuse(*args, **kwargs):
    raise AssertionError("a pickle was read")
whole = pickle.load, pickle.loads, pickle.Unpickler
pickle.load = pickle.loads = pickle.Unpickler = refuse
import sgvf_drake
field = sgvf_drake.load_field("field.safetensors")
field.hessian([1.0, 2.0])
print(*field([1.0, 2.0]))
assert not {"torch", "pydrake", "numba"} & set(sys.modules)
# The cache of numba is one of pickles.
pickle.load, pickle.loads, pickle.Unpickler = whole
flat = field.compiled().evaluate((1.0, 2.0))
from sgvf_drake.fields.compiled.evaluation import evaluate
print(*flat, sum(evaluate.stats.cache_hits.values()))
"""


def test_another_process_needs_no_torch_drake_or_pickle_and_finds_the_compiled_code(
    make_field, tmp_path
):
    field = make_field("robust")
    # At the latest now it is compiled, and cached.
    expected = field.compiled().evaluate((1.0, 2.0))
    field.save(tmp_path / "field.safetensors")
    run = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        capture_output=True,
        text=True,
        timeout=120,
        cwd=tmp_path,
    )
    assert run.returncode == 0, run.stderr
    x, y, *flat, hits = run.stdout.split()
    np.testing.assert_allclose([float(x), float(y)], field([1.0, 2.0]), rtol=1e-14)
    np.testing.assert_array_equal([float(number) for number in flat], expected)
    assert hits == "1"


class Trap:
    """Unpickling it would fail the test."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was executed",))


def test_other_kinds_of_files_are_refused(tmp_path, whole, refuses):
    with pytest.raises(FieldFileError, match=r"absent\.safetensors: no such file"):
        load_field(tmp_path / "absent.safetensors")
    with pytest.raises(FieldFileError, match="no such file"):
        load_field(tmp_path)
    sizes = [0, 1, 7, 8, 9, 100, len(whole) // 3, len(whole) // 2, len(whole) - 1]
    torch.save({"weight": torch.zeros(3, 3), "trap": Trap()}, tmp_path / "torch")
    np.save(tmp_path / "array.npy", np.zeros((3, 2)))
    others = [(tmp_path / name).read_bytes() for name in ("torch", "array.npy")]
    others += [pickle.dumps(Trap()), b"x,y\n1,2\n" * 20, whole + b"\0"]
    for data in (*(whole[:size] for size in sizes), *others):
        refuses(data, "not a whole safetensors file")
    plain = torch.zeros(3, 2)
    for tensor, metadata in (
        (plain, None),
        (plain, {"format": "pt"}),
        # Types that NumPy has not.
        (plain.bfloat16(), {"format": "pt"}),
        (plain.to(torch.float8_e4m3fn), None),
    ):
        save_file({"weight": tensor}, tmp_path / "foreign", metadata)
        data = (tmp_path / "foreign").read_bytes()
        refuses(data, "a safetensors file, but not a field of sgvf_drake")


def test_a_bad_header_is_refused(whole, refuses):
    digest = "not those of the header's digest"
    normalisation = "the normalisation is not that of the waypoints"
    for key, value, match in (
        ("version", 4, "version 4 of the format; this reads 1, 2, 3"),
        ("version", 3, "network is missing"),
        ("version", [1], r"version \[1\] of the format"),
        ("version", None, "version None of the format"),
        ("digest", "0" * 64, digest),
        ("digest", None, digest),
        ("unit_length", 7.0, normalisation),
        ("center", [0.0, 0.0], normalisation),
        ("composition", "vectorial", "unknown composition 'vectorial'"),
        ("composition", ["robust"], "unknown composition"),
        ("sigma", float("nan"), "sigma cannot be nan"),
        ("sigma", -0.1, "sigma cannot be -0.1"),
        ("sigma", "0.1", "sigma cannot be '0.1'"),
        ("gain", 0, "gain cannot be 0"),
        ("gain", float("inf"), "gain cannot be inf"),
        ("gain", None, "gain cannot be None"),
        ("gain", 10**400, "too large"),
        ("score_scale", 0.0, "score_scale cannot be 0"),
        ("score_scale", [1], r"score_scale cannot be \[1\]"),
        ("score_activation", "Mish", "unknown activation 'Mish'"),
        ("tangent_activation", "cos", "unknown activation 'cos'"),
        ("tangent_activation", None, "tangent_activation cannot be None"),
        ("seed", "zero", "seed cannot be 'zero'"),
        ("recipe", 3, "recipe cannot be 3"),
        ("shape", ["star"], r"shape cannot be \['star'\]"),
        ("provenance", [1, 2], r"provenance cannot be \[1, 2\]"),
    ):
        refuses(rewrite(whole, {key: value}), match)
    tensors = load(whole)
    for text, match in (
        ("", "Expecting value"),
        ('{"version": 1', "delimiter"),
        ("[1, 2]", "not a JSON object"),
        ("null", "not a JSON object"),
        ('"field"', "not a JSON object"),
        ("[" * 100_000, "recursion"),
        ("1" * 10_000, "digits"),
    ):
        refuses(save(tensors, {HEADER_KEY: text}), match)


def test_a_missing_entry_is_named(whole, refuses):
    for key in (
        *("version", "recipe", "seed", "sigma", "composition", "gain", "score_scale", "shape"),
        *("digest", "center", "unit_length", "provenance", "cloud.points", "tangent.0.weight"),
        *("tangent.1.bias", "score.0.weight", "score.2.bias", "tangent.phases"),
        *("score_activation", "tangent_activation"),
    ):
        # One weight fewer is one layer fewer: its neighbours are then misnumbered.
        refuses(
            rewrite(whole, drop=[key]), key.replace(".0.weight", r".\d.weight") + " is missing"
        )


def test_values_that_are_not_finite_or_no_float64_are_refused(whole, refuses):
    keys = ("cloud.points", "score.1.weight", "tangent.phases", "support.points", "ends.points")
    for key, value in product(keys, (np.nan, np.inf, -np.inf)):
        tensor = load(whole)[key].copy()
        tensor.flat[3] = value
        refuses(rewrite(whole, tensors={key: tensor}), f"{key} is not all finite float64")
    for dtype in (np.float32, np.float16, np.int64, np.bool_):
        for key in ("tangent.0.weight", "support.points"):
            tensor = load(whole)[key].astype(dtype)
            refuses(rewrite(whole, tensors={key: tensor}), f"{key} is not all finite float64")


def test_tensors_that_do_not_fit_are_refused(whole, refuses):
    digest = "not those of the header's digest"
    for key, change, match in (
        ("cloud.points", lambda a: a + 1e-12, digest),
        ("cloud.points", lambda a: a[::-1], digest),
        ("cloud.points", lambda a: a[:1], "at least 2 waypoints"),
        ("cloud.points", lambda a: a.ravel(), r"must be an array \(N, d\)"),
        ("tangent.0.weight", lambda a: a[:, 1:], r"tangent.0.weight has shape \(7, 11\)"),
        ("tangent.0.weight", lambda a: a.T, "tangent.0.weight has shape"),
        ("tangent.0.bias", lambda a: a[:-1], r"tangent.0.bias has shape \(6,\)"),
        ("tangent.1.weight", lambda a: np.vstack([a, a]), "tangent.1.weight has shape"),
        ("tangent.frequencies", lambda a: a[:, :1], "tangent.frequencies has shape"),
        ("score.frequencies", lambda a: a[:-1], "score.phases has shape"),
        ("score.2.bias", lambda a: a[None], r"score.2.bias has shape \(1, 2\)"),
        ("score.1.weight", lambda a: np.array(1.0), "bad.safetensors"),
        ("support.points", lambda a: a[:0], r"support.points has shape \(0, 2\)"),
    ):
        tensor = np.ascontiguousarray(change(load(whole)[key]))
        refuses(rewrite(whole, tensors={key: tensor}), match)
    shapes = [(2,), (), (4, 3), (4, 1), (1, 4, 2), (0, 3)]
    for key, shape in product(("support.points", "ends.points"), shapes):
        refuses(rewrite(whole, tensors={key: np.zeros(shape)}), f"{key} has shape")


@pytest.mark.parametrize("part", ["header", "anywhere"])
def test_random_damage_is_either_harmless_or_told(tmp_path, whole, part):
    """Flipped bytes may pass in a weight or in a name; else the error is ours."""
    size = 8 + struct.unpack("<Q", whole[:8])[0]
    end = size if part == "header" else len(whole)
    path = tmp_path / "damaged.safetensors"
    rng = np.random.default_rng(6)
    messages = []
    for _ in range(200):
        data = bytearray(whole)
        for position in rng.integers(end, size=rng.integers(1, 4)):
            data[position] = rng.integers(256)
        path.write_bytes(data)
        try:
            load_field(path)
        except FieldFileError as error:
            messages.append(str(error))
    assert all("damaged.safetensors: " in message for message in messages)
    assert len(messages) > (180 if part == "header" else 20)
