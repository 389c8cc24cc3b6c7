"""The command `singularities`: what it prints and leaves, and what it refuses."""

from dataclasses import replace
import json

import numpy as np
import pytest

from sgvf_drake.fields import GaussianMixture, Perceptron
from sgvf_drake.paths import PointCloud

TURN = np.array([[0.0, -1.0], [1.0, 0.0]])


def ring_field(make_field, num_points):
    """The closed-form score of a ring of equal waypoints, and the rotation."""
    angle = 2 * np.pi * np.arange(num_points) / num_points
    cloud = PointCloud(3 * np.column_stack([np.cos(angle), np.sin(angle)]))
    return replace(
        make_field("exact", sigma=0.15),
        cloud=cloud,
        score_model=GaussianMixture(cloud.normalize(cloud.points), 0.15),
        tangent_network=Perceptron((TURN,), (np.zeros(2),)),
    )


@pytest.fixture(scope="module")
def fields(tmp_path_factory, make_field):
    """Files of a sparse ring, a dense ring and a spatial field, and the ring as a polyline."""
    folder = tmp_path_factory.mktemp("fields")
    sparse = ring_field(make_field, 100)
    learned = replace(
        make_field("paper"),
        cloud=sparse.cloud,
        tangent_network=Perceptron((TURN - 0.2 * np.eye(2),), (np.zeros(2),)),
    )
    for name, field in (
        ("sparse", sparse),
        ("dense", ring_field(make_field, 400)),
        ("learned", learned),
        ("open", make_field("robust", ends=1)),
        ("spatial", replace(make_field("robust", dim=3), seed=1)),
    ):
        field = replace(field, cloud=PointCloud(field.cloud.points))
        field.save(folder / f"{name}.safetensors")
    np.savetxt(
        folder / "ring.csv", sparse.cloud.points, delimiter=",", header="x,y", comments=""
    )
    (folder / "broken.safetensors").write_bytes(b"no field")
    return folder


def test_a_ring(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    ring = ("--reference", fields / "ring.csv", "--columns", "x,y")
    assert run("singularities", fields / "sparse.safetensors", *ring, "--out", out) == 0
    printed = capsys.readouterr()
    words = " ".join(printed.out.replace("│", " ").split())
    assert "zeros of the guiding field 1 focus" in words
    assert "100 sink" in words
    assert "100 saddle" in words
    assert "1 centre; indices sum up to 1, winding number 1" in words
    assert "undecided places 0" in words
    assert "score vanishes at low density no (" in words
    assert "score vanishes near branches nothing to tell by" in words
    assert printed.err == ""
    summary = json.loads((out / "summary.json").read_text())
    assert summary["reference"] == "file"
    assert summary["index_sum"] == summary["winding_number"] == 1


def test_a_line_of_zeros_is_told(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    out.mkdir()
    (out / "zeros.csv").write_text("old\n")
    file = fields / "dense.safetensors"
    assert run("singularities", file, "--out", out, "--overwrite") == 0
    assert (out / "zeros.csv").read_text().startswith("x,y,")
    words = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "1 degenerate" in words
    assert "undecided places 1" in words
    summary = json.loads((out / "summary.json").read_text())
    assert summary["undecided_by_field"] == {"guiding": 0, "score": 1, "tangent": 0}
    assert summary["reference"] == "cloud"


def test_zeros_are_proved_on_request(run, fields, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("singularities", fields / "learned.safetensors", "--prove", "--out", out) == 0
    words = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "proved of the tangent 1 enclosed, no others; winding number 1" in words
    proved = json.loads((out / "summary.json").read_text())["proved"]
    assert list(proved) == ["guiding", "score", "tangent"]
    for part in proved.values():
        assert part["complete"]
        assert part["undecided"] == 0
        assert part["winding_number"] == part["index_sum"]
        assert part["boxes"] > 1_000
    (zero,) = proved["tangent"]["zeros"]
    assert zero["index"] == 1
    assert (zero["kind"], zero["stable"]) == ("focus", True)
    assert np.abs([zero["x"], zero["y"]]).max() <= zero["radius"] < 1e-9


BAD = [
    (("open", "--prove"), "zeros are enclosed of smooth fields of closed paths only"),
    (("spatial",), "singularities are found of planar fields, not in 3 dimensions"),
    (("sparse", "--columns", "x,y"), "--columns x,y chooses columns of --reference; give both"),
    (("sparse", "--reference", "no.csv"), "no.csv"),
    (("broken",), "broken.safetensors: not a whole safetensors file"),
    (("missing",), "missing.safetensors: no such file"),
]


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=[words for _, words in BAD])
def test_bad_input_is_one_line(fields, tmp_path, refused, arguments, words):
    name, *options = arguments
    out = tmp_path / "out"
    assert words in refused(
        "singularities", fields / f"{name}.safetensors", *options, "--out", out
    )
    assert not out.exists()


def test_results_are_replaced_only_on_request(run, fields, tmp_path, capsys):
    (tmp_path / "zeros.csv").write_text("mine\n")
    assert run("singularities", fields / "sparse.safetensors", "--out", tmp_path) == 2
    assert "pass --overwrite" in capsys.readouterr().err
    assert (tmp_path / "zeros.csv").read_text() == "mine\n"


def test_help_names_it(run, capsys):
    assert run("--help") == 0
    assert "singularities" in capsys.readouterr().out
