from dataclasses import replace
import json
import os
import pickle
import struct
import subprocess
import sys

import numpy as np
import pytest
from safetensors.numpy import load, save
import torch

from sgvf_drake.exceptions import FieldFileError, OutputExistsError
from sgvf_drake.fields import (
    GaussianMixture,
    NormalisedComposition,
    PaperComposition,
    RobustComposition,
    load_field,
    save_field,
)
from sgvf_drake.fields.activation import ACTIVATIONS

# The one entry of the metadata, part of the format.
HEADER_KEY = "sgvf_drake.field"


@pytest.fixture
def whole(make_field, tmp_path):
    """The bytes of a good file."""
    path = tmp_path / "whole.safetensors"
    save_field(make_field("robust"), path)
    return path.read_bytes()


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


def bits(network):
    features = network.features
    arrays = [*network.weights, *network.biases]
    if features is not None:
        arrays += [features.frequencies, features.phases]
    return [array.tobytes() for array in arrays]


def test_round_trip_is_exact_to_the_bit(field, tmp_path):
    path = tmp_path / "field.safetensors"
    field.save(path)
    loaded = load_field(str(path))
    x = np.random.default_rng(0).uniform(-2, 8, (20, 2))
    np.testing.assert_array_equal(loaded(x), field(x))
    np.testing.assert_array_equal(
        loaded.value_and_jacobian(x)[1], field.value_and_jacobian(x)[1]
    )
    np.testing.assert_array_equal(loaded.hessian(x), field.hessian(x))
    assert bits(loaded.tangent_network) == bits(field.tangent_network)
    if isinstance(field.score_model, GaussianMixture):
        np.testing.assert_array_equal(loaded.score_model.points, field.score_model.points)
    else:
        assert bits(loaded.score_model.network) == bits(field.score_model.network)
        assert loaded.score_model.scale == field.score_model.scale
    assert loaded.composition == field.composition
    assert loaded.cloud.digest == field.cloud.digest
    for name in ("sigma", "recipe", "seed", "provenance"):
        assert getattr(loaded, name) == getattr(field, name)
    assert loaded.cloud.shape == field.cloud.shape


def test_a_field_in_space_and_one_of_no_shape(make_field, tmp_path):
    field = make_field("paper", dim=3).rescaled(2.5)
    assert field.cloud.shape is None
    field.save(tmp_path / "field")
    loaded = load_field(tmp_path / "field")
    x = np.random.default_rng(0).uniform(-2, 8, (20, 3))
    np.testing.assert_array_equal(loaded(x), field(x))
    assert loaded.cloud.shape is None
    assert isinstance(loaded.composition, PaperComposition)


@pytest.mark.parametrize("recipe", ["robust", "exact"])
@pytest.mark.parametrize(("support", "ends"), [(12, 2), (12, 0), (0, 1)])
def test_support_and_ends_are_kept_to_the_bit(make_field, tmp_path, recipe, support, ends):
    field = make_field(recipe, support=support, ends=ends)
    field.save(tmp_path / "field")
    loaded = load_field(tmp_path / "field")
    assert (loaded.support is None) == (support == 0)
    assert (loaded.end_points is None) == (ends == 0)
    for name in ("support", "end_points"):
        if getattr(field, name) is not None:
            assert getattr(loaded, name).tobytes() == getattr(field, name).tobytes()
    x = np.random.default_rng(0).uniform(1, 5, (50, 2))
    np.testing.assert_array_equal(loaded(x), field(x))
    np.testing.assert_array_equal(
        loaded.value_and_jacobian(x)[1], field.value_and_jacobian(x)[1]
    )
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "field").read_bytes()


@pytest.mark.parametrize(
    "tensor",
    [
        np.zeros(2),
        np.array(1.0),
        np.zeros((4, 3)),
        np.zeros((4, 1)),
        np.zeros((1, 4, 2)),
        np.zeros((0, 3)),
        np.full((3, 2), np.nan),
        np.zeros((3, 2), dtype=np.float32),
    ],
    ids=["flat", "scalar", "space", "line", "deep", "none-in-space", "nan", "float32"],
)
@pytest.mark.parametrize("key", ["support.points", "ends.points"])
@pytest.mark.parametrize("recipe", ["robust", "exact"])
def test_bad_support_and_bad_ends_are_refused(make_field, tmp_path, recipe, key, tensor):
    path = tmp_path / "bad.safetensors"
    make_field(recipe, support=12, ends=2).save(path)
    path.write_bytes(rewrite(path.read_bytes(), tensors={key: tensor}))
    with pytest.raises(FieldFileError, match=rf"bad\.safetensors: .*{key}"):
        load_field(path)


def test_no_ends_are_fine_but_a_support_of_no_points_is_not(make_field, tmp_path):
    path = tmp_path / "bad.safetensors"
    make_field("exact", support=12).save(path)
    data, empty = path.read_bytes(), np.zeros((0, 2))
    path.write_bytes(rewrite(data, tensors={"ends.points": empty}))
    assert load_field(path).ends.shape == (0, 2)
    path.write_bytes(rewrite(data, tensors={"support.points": empty}))
    with pytest.raises(FieldFileError, match=r"support.points has shape \(0, 2\)"):
        load_field(path)


@pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda activation: activation.name)
def test_activations_are_kept_each_with_its_network(make_field, tmp_path, activation):
    field = make_field("paper")
    tangent = replace(field.tangent_network, activation=activation)
    field = replace(field, tangent_network=tangent)
    field.save(tmp_path / "field")
    loaded = load_field(tmp_path / "field")
    assert loaded.tangent_network.activation is activation
    assert loaded.score_model.network.activation.name == "SiLU"
    x = np.random.default_rng(0).uniform(-2, 8, (20, 2))
    np.testing.assert_array_equal(loaded.hessian(x), field.hessian(x))
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "field").read_bytes()


def test_a_normalised_field_stays_one(make_field, tmp_path):
    field = replace(make_field("paper"), composition=NormalisedComposition(0.3))
    field.save(tmp_path / "field")
    loaded = load_field(tmp_path / "field")
    assert loaded.composition == NormalisedComposition(0.3)
    x = np.random.default_rng(0).uniform(-2, 8, (20, 2))
    np.testing.assert_array_equal(loaded(x), field(x))


@pytest.mark.parametrize("ends", [0, 2])
@pytest.mark.parametrize("recipe", ["robust", "exact"])
def test_a_field_without_the_projection_stays_one(make_field, tmp_path, recipe, ends):
    projected = make_field(recipe, ends=ends)
    bare = replace(projected, composition=RobustComposition(0.8, 0.4, projects=False))
    bare.save(tmp_path / "field")
    # Those who know no such field find a composition that they do not know.
    assert read_header((tmp_path / "field").read_bytes())["composition"] == "unprojected"
    loaded = load_field(tmp_path / "field")
    assert loaded.composition == bare.composition
    x = np.random.default_rng(0).uniform(1, 5, (20, 2))
    np.testing.assert_array_equal(loaded.hessian(x), bare.hessian(x))
    assert np.abs(projected(x) - loaded(x)).max() > 1e-3
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "field").read_bytes()


def test_files_of_version_1_are_read(field, tmp_path):
    """They had no activations, and every network was one of SiLU."""
    path = tmp_path / "field.safetensors"
    field.save(path)
    new = path.read_bytes()
    old = rewrite(new, {"version": 1}, drop=["score_activation", "tangent_activation"])
    path.write_bytes(old)
    loaded = load_field(path)
    x = np.random.default_rng(0).uniform(-2, 8, (20, 2))
    np.testing.assert_array_equal(loaded.hessian(x), field.hessian(x))
    # Written anew, it is of this version.
    loaded.save(path, overwrite=True)
    assert path.read_bytes() == new


def test_equal_fields_are_equal_files(field, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    field.save(first)
    load_field(first).save(second)
    assert second.read_bytes() == first.read_bytes()


def test_the_header_tells_how_it_was_made(field, tmp_path):
    path = tmp_path / "field.safetensors"
    field.save(path)
    header = read_header(path.read_bytes())
    cloud = field.cloud
    assert header == {
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
        "digest": cloud.digest,
        "center": cloud.center.tolist(),
        "unit_length": cloud.unit_length,
        "provenance": {"training": {"iterations": 7, "hidden": [9, 8]}},
    }


def test_the_header_of_a_trained_field_has_the_training_settings(robust_result, tmp_path):
    path = tmp_path / "field.safetensors"
    robust_result.field.save(path)
    training = read_header(path.read_bytes())["provenance"]["training"]
    settings = robust_result.settings
    assert training["score_iterations"] == settings.score_iterations == 1500
    assert training["tangent_hidden"] == list(settings.tangent_hidden)
    assert training["sigma_min"] == settings.sigma_min == robust_result.field.sigma
    assert (training["recipe"], training["seed"]) == ("robust", 0)


def test_a_file_is_never_replaced_unasked(make_field, tmp_path):
    path = tmp_path / "field.safetensors"
    path.write_text("precious")
    with pytest.raises(OutputExistsError, match=r"field\.safetensors exists; pass overwrite"):
        make_field("robust").save(path)
    assert path.read_text() == "precious"
    make_field("robust", seed=4).save(path, overwrite=True)
    assert load_field(path).seed == 4
    assert os.listdir(tmp_path) == ["field.safetensors"]


@pytest.mark.parametrize("step", ["replace", "chmod"])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(
    make_field, tmp_path, monkeypatch, step
):
    path = tmp_path / "field.safetensors"
    make_field("robust", seed=1).save(path)
    before = path.read_bytes()

    def fail(*_):
        raise OSError("the disk is full")

    monkeypatch.setattr(os, step, fail)
    with pytest.raises(OSError, match="the disk is full"):
        make_field("robust", seed=2).save(path, overwrite=True)
    monkeypatch.undo()
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["field.safetensors"]


def test_writing_to_a_missing_folder_names_it(make_field, tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        make_field("robust").save(tmp_path / "nowhere" / "field")


@pytest.mark.parametrize("module", ["sgvf_drake", "systems"])
def test_a_field_is_read_and_evaluated_without_torch_and_without_pickle(
    make_field, tmp_path, module
):
    path = tmp_path / "field.safetensors"
    field = make_field("robust")
    field.save(path)
    program = f"""
import sys
import numpy, pickle
def refuse(*args, **kwargs):
    raise AssertionError("a pickle was read")
pickle.load = pickle.loads = pickle.Unpickler = refuse
import {module}
import sgvf_drake
field = sgvf_drake.load_field({str(path)!r})
field.hessian([1.0, 2.0])
print(*field([1.0, 2.0]))
assert "torch" not in sys.modules, "torch was imported"
"""
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60
    )
    assert run.returncode == 0, run.stderr
    printed = np.array(run.stdout.split()[-2:], dtype=float)
    np.testing.assert_allclose(printed, field([1.0, 2.0]), rtol=1e-14)


def test_a_missing_file_and_a_folder_are_named(tmp_path):
    with pytest.raises(FieldFileError, match=r"absent\.safetensors: no such file"):
        load_field(tmp_path / "absent.safetensors")
    with pytest.raises(FieldFileError, match="no such file"):
        load_field(tmp_path)


@pytest.mark.parametrize("kept", [0, 1, 7, 8, 9, 100, 0.3, 0.5, 0.9, -1])
def test_a_truncated_file_is_refused(tmp_path, whole, kept):
    length = int(kept * len(whole)) if isinstance(kept, float) else kept
    path = tmp_path / "short.safetensors"
    path.write_bytes(whole[:length])
    with pytest.raises(
        FieldFileError, match=r"short\.safetensors: not a whole safetensors file"
    ):
        load_field(path)


def test_trailing_bytes_are_refused(tmp_path, whole):
    path = tmp_path / "long.safetensors"
    path.write_bytes(whole + b"\0")
    with pytest.raises(FieldFileError, match="not a whole safetensors file"):
        load_field(path)


class Trap:
    """Unpickling it would fail the test."""

    def __reduce__(self):
        return (pytest.fail, ("a pickle was executed",))


@pytest.mark.parametrize("kind", ["pickle", "torch", "npy", "text"])
def test_other_kinds_of_files_are_refused(tmp_path, kind):
    path = tmp_path / "field.pth"
    if kind == "pickle":
        path.write_bytes(pickle.dumps(Trap()))
    elif kind == "torch":
        torch.save({"weight": torch.zeros(3, 3), "trap": Trap()}, path)
    elif kind == "npy":
        path = tmp_path / "field.npy"
        np.save(path, np.zeros((3, 2)))
    else:
        path.write_text("x,y\n1,2\n" * 20)
    with pytest.raises(FieldFileError, match="not a whole safetensors file"):
        load_field(path)


@pytest.mark.parametrize(
    ("tensor", "metadata"),
    [
        (torch.zeros(3, 2), None),
        (torch.zeros(3, 2), {"format": "pt"}),
        # Types that NumPy has not.
        (torch.zeros(3, 2, dtype=torch.bfloat16), {"format": "pt"}),
        (torch.zeros(3, 2).to(torch.float8_e4m3fn), None),
    ],
    ids=["plain", "pt", "bfloat16", "float8"],
)
def test_foreign_safetensors_are_refused(tmp_path, tensor, metadata):
    from safetensors.torch import save_file

    path = tmp_path / "foreign.safetensors"
    save_file({"weight": tensor}, path, metadata)
    with pytest.raises(
        FieldFileError, match="a safetensors file, but not a field of sgvf_drake"
    ):
        load_field(path)


@pytest.mark.parametrize(
    ("header", "match"),
    [
        ({"version": 3}, "version 3 of the format; this reads 1 and 2"),
        ({"version": [1]}, r"version \[1\] of the format"),
        ({"version": None}, "version None of the format"),
        ({"digest": "0" * 64}, "not those of the header's digest"),
        ({"digest": None}, "not those of the header's digest"),
        ({"unit_length": 7.0}, "the normalisation is not that of the waypoints"),
        ({"center": [0.0, 0.0]}, "the normalisation is not that of the waypoints"),
        ({"composition": "vectorial"}, "unknown composition 'vectorial'"),
        ({"composition": ["robust"]}, "unknown composition"),
        ({"sigma": float("nan")}, "sigma cannot be nan"),
        ({"sigma": -0.1}, "sigma cannot be -0.1"),
        ({"sigma": "0.1"}, "sigma cannot be '0.1'"),
        ({"gain": 0}, "gain cannot be 0"),
        ({"gain": float("inf")}, "gain cannot be inf"),
        ({"gain": None}, "gain cannot be None"),
        ({"gain": 10**400}, "too large"),
        ({"score_scale": 0.0}, "score_scale cannot be 0"),
        ({"score_scale": [1]}, r"score_scale cannot be \[1\]"),
        ({"score_activation": "Mish"}, "unknown activation 'Mish'"),
        ({"tangent_activation": "cos"}, "unknown activation 'cos'"),
        ({"tangent_activation": None}, "tangent_activation cannot be None"),
        ({"seed": "zero"}, "seed cannot be 'zero'"),
        ({"recipe": 3}, "recipe cannot be 3"),
        ({"shape": ["star"]}, r"shape cannot be \['star'\]"),
        ({"provenance": [1, 2]}, r"provenance cannot be \[1, 2\]"),
    ],
)
def test_a_bad_header_is_refused(tmp_path, whole, header, match):
    path = tmp_path / "bad.safetensors"
    path.write_bytes(rewrite(whole, header))
    with pytest.raises(FieldFileError, match=rf"bad\.safetensors: .*{match}"):
        load_field(path)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "Expecting value"),
        ('{"version": 1', "delimiter"),
        ("[1, 2]", "not a JSON object"),
        ("null", "not a JSON object"),
        ('"field"', "not a JSON object"),
        ("[" * 100_000, "recursion"),
        ("1" * 10_000, "digits"),
    ],
    ids=["empty", "cut", "list", "null", "string", "nested", "long"],
)
def test_a_header_that_is_no_json_object_is_refused(tmp_path, whole, text, match):
    path = tmp_path / "bad.safetensors"
    path.write_bytes(save(load(whole), {HEADER_KEY: text}))
    with pytest.raises(FieldFileError, match=match):
        load_field(path)


@pytest.mark.parametrize(
    "key",
    [
        *("version", "recipe", "seed", "sigma", "composition", "gain", "score_scale", "shape"),
        *("digest", "center", "unit_length", "provenance", "cloud.points", "tangent.0.weight"),
        *("tangent.1.bias", "score.0.weight", "score.2.bias", "tangent.phases"),
        *("score_activation", "tangent_activation"),
    ],
)
def test_a_missing_entry_is_named(tmp_path, whole, key):
    path = tmp_path / "bad.safetensors"
    path.write_bytes(rewrite(whole, drop=[key]))
    # One weight fewer is one layer fewer: its neighbours are then misnumbered.
    match = key.replace(".0.weight", r".\d.weight")
    with pytest.raises(FieldFileError, match=f"{match} is missing"):
        load_field(path)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("key", ["cloud.points", "score.1.weight", "tangent.phases"])
def test_values_that_are_not_finite_are_refused(tmp_path, whole, key, value):
    tensor = load(whole)[key].copy()
    tensor.flat[3] = value
    path = tmp_path / "bad.safetensors"
    path.write_bytes(rewrite(whole, tensors={key: tensor}))
    with pytest.raises(FieldFileError, match=f"tensor {key} is not all finite float64"):
        load_field(path)


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.int64, np.bool_])
def test_other_types_of_numbers_are_refused(tmp_path, whole, dtype):
    key = "tangent.0.weight"
    path = tmp_path / "bad.safetensors"
    path.write_bytes(rewrite(whole, tensors={key: load(whole)[key].astype(dtype)}))
    with pytest.raises(FieldFileError, match=f"tensor {key} is not all finite float64"):
        load_field(path)


@pytest.mark.parametrize(
    ("key", "change", "match"),
    [
        ("cloud.points", lambda a: a + 1e-12, "not those of the header's digest"),
        ("cloud.points", lambda a: a[::-1], "not those of the header's digest"),
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
    ],
)
def test_tensors_that_do_not_fit_are_refused(tmp_path, whole, key, change, match):
    tensor = np.ascontiguousarray(change(load(whole)[key]))
    path = tmp_path / "bad.safetensors"
    path.write_bytes(rewrite(whole, tensors={key: tensor}))
    with pytest.raises(FieldFileError, match=match):
        load_field(path)


@pytest.mark.parametrize("part", ["header", "anywhere"])
def test_random_damage_is_either_harmless_or_told(tmp_path, whole, part):
    """Flipped bytes may pass in a weight or in a name; else the error is ours."""
    size = 8 + struct.unpack("<Q", whole[:8])[0]
    end = size if part == "header" else len(whole)
    path = tmp_path / "damaged.safetensors"
    rng = np.random.default_rng(6)
    messages = []
    for _ in range(400):
        data = bytearray(whole)
        for position in rng.integers(end, size=rng.integers(1, 4)):
            data[position] = rng.integers(256)
        path.write_bytes(data)
        try:
            load_field(path)
        except FieldFileError as error:
            messages.append(str(error))
    assert all("damaged.safetensors: " in message for message in messages)
    assert len(messages) > (360 if part == "header" else 40)
