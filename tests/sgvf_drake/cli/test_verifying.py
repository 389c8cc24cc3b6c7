"""The command `verify`: what it prints of good and bad fields, and what it refuses."""

from dataclasses import replace
import json

import numpy as np
import pytest

from sgvf_drake.fields import Perceptron
from sgvf_drake.paths import PointCloud


@pytest.fixture(scope="module")
def fields(tmp_path_factory, exact_result, make_field):
    """Files of a good field, one with a planted sink on its path, and a spatial one."""
    folder = tmp_path_factory.mktemp("fields")
    good = exact_result.field
    sink = good.cloud.normalize([0.0, 2.0])
    bad = replace(good, tangent_network=Perceptron((-np.eye(2),), (-np.eye(2) @ -sink,)))
    spatial = make_field("robust", 3)
    spatial = replace(spatial, cloud=PointCloud(spatial.cloud.points))
    for name, field in (("good", good), ("bad", bad), ("spatial", spatial)):
        field.save(folder / f"{name}.safetensors")
    (folder / "broken.safetensors").write_bytes(b"no field")
    return folder


def test_a_good_field(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("verify", fields / "good.safetensors", "--starts", 16, "--out", out) == 0
    printed = capsys.readouterr()
    for words in ("sampled conditions", "hold", "band of V", "|cos(s, v)|", "bound, gradient"):
        assert words in printed.out
    assert printed.err == ""
    assert json.loads((out / "summary.json").read_text())["holds"] is True


def test_a_planted_sink_is_named_with_its_place(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("verify", fields / "bad.safetensors", "--out", out) == 0
    printed = capsys.readouterr()
    assert "do NOT hold" in printed.out
    assert "warning: the conditions do not hold" in printed.err
    violations = json.loads((out / "summary.json").read_text())["violations"]
    zeros = [v for v in violations if v["counts"] and v["kind"] == "zero"]
    at = np.array([zero["point"] for zero in zeros])
    nearest = int(np.linalg.norm(at - [0.0, 2.0], axis=1).argmin())
    np.testing.assert_allclose(at[nearest], [0.0, 2.0], atol=0.05)
    assert zeros[nearest]["detail"] == "sink"


BAD = [
    (("spatial",), "only planar fields are checked, not one of 3-D"),
    (("good", "--starts", 0), "the number of starts must be at least 1, not 0"),
    (("good", "--fly", "--speed", -1), "the speed must be a positive number, not -1.0"),
    (("good", "--scale", 0), "the scale must be a positive number, not 0.0"),
    (("good", "--columns", "x,y"), "--columns x,y chooses columns of --reference; give both"),
    (("good", "--reference", "no.csv"), "no.csv"),
    (("broken",), "broken.safetensors: not a whole safetensors file"),
    (("missing",), "missing.safetensors: no such file"),
]


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=[words for _, words in BAD])
def test_bad_input_is_one_line(fields, tmp_path, refused, arguments, words):
    name, *options = arguments
    out = tmp_path / "out"
    assert words in refused("verify", fields / f"{name}.safetensors", *options, "--out", out)
    assert not out.exists()
