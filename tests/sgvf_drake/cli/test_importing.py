"""The command `import`: what it leaves, what it prints, and what it says to bad input."""

import json
import os
import re

import numpy as np
import pytest
import torch

from sgvf_drake import load_field


class Trap:
    """Unpickling it leaves a trace."""

    def __reduce__(self):
        return os.mkdir, ("sprung",)


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, ring_networks, make_sequential):
    """Networks that lap a ring, others that cannot be used, and waypoints."""
    folder = tmp_path_factory.mktemp("inputs")
    score, tangent = ring_networks
    ring = {"state_dict": score.state_dict(), "hiddens": [200], "activation": "Tanh"}
    contents = {
        "score.pth": ring,
        "tangent.pth": {f"net.{key}": tensor for key, tensor in tangent.state_dict().items()},
        "untrained.pth": make_sequential([3, 8, 2]).state_dict(),
        "spatial_score.pth": make_sequential([4, 8, 3]).state_dict(),
        "spatial_tangent.pth": make_sequential([3, 8, 3]).state_dict(),
        "wrong_width.pth": {**ring, "hiddens": [64]},
        "mish.pth": {**ring, "activation": "Mish"},
        "nan.pth": {"0.weight": torch.full((2, 3), torch.nan), "0.bias": torch.zeros(2)},
        "no_bias.pth": {"net.0.weight": torch.zeros(2, 3)},
        "norm.pth": make_sequential([3, 2]).state_dict() | {"1.weight": torch.ones(2)},
        "tensor.pth": torch.zeros(3),
        "trap.pth": Trap(),
    }
    for name, content in contents.items():
        torch.save(content, folder / name)
    whole = (folder / "score.pth").read_bytes()
    (folder / "short.pth").write_bytes(whole[: len(whole) // 2])
    (folder / "text.pth").write_text("x,y\n1,2\n")
    angle = 2 * np.pi * np.arange(100) / 100
    points = 3 * np.column_stack([np.cos(angle), np.sin(angle)])
    np.savetxt(folder / "ring.csv", points, delimiter=",", header="x,y", comments="")
    np.savetxt(folder / "spatial.txt", np.eye(3))
    (folder / "taken").mkdir()
    (folder / "taken" / "field.safetensors").write_text("mine")
    return folder


@pytest.fixture
def command(run, inputs):
    """Runs the command on files of the inputs: (score, tangent, *more) -> status."""

    def call(score, tangent, *more):
        networks = ("--score", inputs / score, "--tangent", inputs / tangent)
        return run("import", *networks, *more)

    return call


@pytest.mark.parametrize("option", ["--k-s", "--gain"])
def test_import(command, inputs, tmp_path, capsys, ring_networks, largest_difference, option):
    out = tmp_path / "out"
    more = ("--points", inputs / "ring.csv", "--columns", "x, y", option, 0.7, "--normalise")
    assert command("score.pth", "tangent.pth", *more, "--out", out) == 0
    names = {path.name for path in out.iterdir()}
    assert names == {"summary.json", "field.safetensors", "field.png"}
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["points"], summary["num_points"]) == ("file", 100)
    assert (summary["gain"], summary["normalised"]) == (0.7, True)
    field = load_field(out / "field.safetensors")
    assert largest_difference(field, *ring_networks, gain=0.7, normalise=True) < 1e-6
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "score │ 3-200-2, Tanh" in re.sub(" +", " ", shown.out)
    assert shown.out.endswith(f"results in {out}\n")


@pytest.mark.parametrize(
    ("score", "origin", "told", "warning"),
    [
        ("score.pth", "score", "as the score shows them", ""),
        (
            "untrained.pth",
            "box",
            "a square in their place",
            "warning: the score shows no path; give its waypoints with --points\n",
        ),
    ],
)
def test_waypoints_may_be_recovered(command, tmp_path, capsys, score, origin, told, warning):
    assert command(score, "tangent.pth", "--out", tmp_path) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["points"], summary["gain"], summary["normalised"]) == (origin, 0.2, False)
    assert origin == "score" or summary["unit_length"] == 1.0
    shown = capsys.readouterr()
    assert told in shown.out
    assert shown.err == warning


def test_results_are_replaced_only_when_asked(command, inputs, tmp_path, refused):
    networks = ("--score", inputs / "score.pth", "--tangent", inputs / "tangent.pth")
    points = ("--points", inputs / "ring.csv")
    line = refused("import", *networks, *points, "--out", inputs / "taken")
    assert "taken already holds field.safetensors" in line
    (mine,) = (inputs / "taken").iterdir()
    assert mine.read_text() == "mine"
    (tmp_path / "field.safetensors").write_text("mine")
    more = (*points, "--k-s", 0.4, "--overwrite", "--out", tmp_path)
    assert command("score.pth", "tangent.pth", *more) == 0
    assert json.loads((tmp_path / "summary.json").read_text())["gain"] == 0.4


BAD = {
    "missing": (["absent.pth", "tangent.pth"], ["absent.pth: no such file"]),
    "missing tangent": (["score.pth", "absent.pth"], ["absent.pth: no such file"]),
    "folder": (["taken", "tangent.pth"], ["taken: is a folder"]),
    "truncated": (["short.pth", "tangent.pth"], ["short.pth", "not a whole file"]),
    "text": (["text.pth", "tangent.pth"], ["text.pth", "not a whole file"]),
    "pickle": (["trap.pth", "tangent.pth"], ["trap.pth", "nothing else is unpickled"]),
    "no dict": (["tensor.pth", "tangent.pth"], ["tensor.pth", "not Tensor"]),
    "missing key": (["no_bias.pth", "tangent.pth"], ["no_bias.pth: net.0.bias is missing"]),
    "norm": (["norm.pth", "tangent.pth"], ["norm.pth: 1.bias is missing"]),
    "NaN": (["nan.pth", "tangent.pth"], ["nan.pth: 0.weight is not all finite"]),
    "activation": (["mish.pth", "tangent.pth"], ["mish.pth", "'Mish'", "SiLU, Tanh"]),
    "widths": (["wrong_width.pth", "tangent.pth"], ["hiddens is [64]", "[200]"]),
    "swapped": (["tangent.pth", "score.pth"], ["tangent.pth: a score network", "2 and 2"]),
    "twice": (["score.pth", "score.pth"], ["score.pth: a tangent network", "3 and 2"]),
    "unlike": (
        ["score.pth", "spatial_tangent.pth"],
        ["tangent network is of 3 dimensions, the score network of 2"],
    ),
    "no points": (
        ["spatial_score.pth", "spatial_tangent.pth"],
        ["recovered in the plane only", "3 dimensions", "--points"],
    ),
    "dimensions": (
        ["score.pth", "tangent.pth", "--points", "{inputs}/spatial.txt"],
        ["spatial.txt", "3 coordinates", "score network 2"],
    ),
    "missing points": (
        ["score.pth", "tangent.pth", "--points", "none.csv"],
        ["none.csv: there is no such file"],
    ),
    "columns of nothing": (
        ["score.pth", "tangent.pth", "--columns", "x,y"],
        ["--columns x,y", "--points"],
    ),
    "zero k_s": (
        ["score.pth", "tangent.pth", "--points", "{inputs}/ring.csv", "--k-s", "0"],
        ["k_s", "0.0"],
    ),
    "NaN k_s": (
        ["score.pth", "tangent.pth", "--points", "{inputs}/ring.csv", "--k-s", "nan"],
        ["k_s", "nan"],
    ),
}


@pytest.mark.parametrize(("arguments", "expected"), BAD.values(), ids=BAD)
def test_bad_input(refused, inputs, tmp_path, monkeypatch, arguments, expected):
    monkeypatch.chdir(tmp_path)
    score, tangent, *more = (argument.format(inputs=inputs) for argument in arguments)
    out = tmp_path / "deep" / "out"
    networks = ("--score", inputs / score, "--tangent", inputs / tangent)
    line = refused("import", *networks, *more, "--out", out)
    for text in expected:
        assert text in line
    # Neither results, nor the trace of a pickle that was executed.
    assert list(tmp_path.iterdir()) == []


def test_the_help_lists_it_after_training(run, capsys):
    assert run("--help") == 0
    listed = re.findall(r"│ (\w+) ", capsys.readouterr().out)
    assert listed.index("train") < listed.index("import") < listed.index("follow")
