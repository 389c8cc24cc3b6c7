"""The command `import`: what it leaves, what it prints, and what it says to bad input."""

import re

import numpy as np
import pytest
import torch

from sgvf_drake import PointCloud
from sgvf_drake.experiments import choose_reference, fly, follow, open_field
from tests.helpers import Trap, circle, ink, names_in, summary_of


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, ring_networks, make_sequential):
    """Networks that lap a ring, others that cannot be used, and waypoints."""
    folder = tmp_path_factory.mktemp("inputs")
    score, tangent = ring_networks
    for name, content in {
        "score": {"state_dict": score.state_dict(), "hiddens": [200], "activation": "Tanh"},
        "tangent": {f"net.{key}": tensor for key, tensor in tangent.state_dict().items()},
        "untrained": {
            "state_dict": make_sequential([3, 8, 2]).state_dict(),
            "activation": "SiLU",
        },
        "untold": make_sequential([3, 8, 2], "ReLU").state_dict(),
        "both": {
            "epoch": 9,
            "score_state_dict": score.state_dict(),
            "tangent_state_dict": tangent.state_dict(),
        },
        "spatial_score": make_sequential([4, 8, 3]).state_dict(),
        "spatial_tangent": make_sequential([3, 8, 3]).state_dict(),
        "no_bias": {"net.0.weight": torch.zeros(2, 3)},
        "trap": Trap(),
    }.items():
        torch.save(content, folder / f"{name}.pth")
    (folder / "text.pth").write_text("x,y\n1,2\n")
    points = circle(3.0, 100)
    np.savetxt(folder / "ring.csv", points, delimiter=",", header="x,y", comments="")
    spatial = np.random.default_rng(0).uniform(-1, 1, (30, 3))
    np.savetxt(folder / "spatial.txt", spatial, header="x y z")
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


FILES = {"summary.json", "field.safetensors", "field.png"}


@pytest.mark.parametrize(("option", "more"), [("--k-s", ["--normalise"]), ("--gain", [])])
def test_waypoints_of_a_file(
    command, inputs, tmp_path, capsys, ring_networks, largest_difference, option, more
):
    out = tmp_path / "out"
    points = ("--points", inputs / "ring.csv", "--columns", "x, y")
    assert command("score.pth", "tangent.pth", *points, option, 0.7, *more, "--out", out) == 0
    assert names_in(out) == FILES
    summary = summary_of(out)
    assert (summary["points"], summary["num_points"]) == ("file", 100)
    assert (summary["gain"], summary["normalised"]) == (0.7, bool(more))
    # The noise level of the ring's score.
    assert summary["sigma"] * summary["unit_length"] == pytest.approx(0.3, rel=1e-4)
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "score │ 3-200-2, Tanh" in re.sub(" +", " ", shown.out)
    assert shown.out.endswith(f"results in {out}\n")
    field = open_field(out)
    assert field.cloud.digest == PointCloud.read(inputs / "ring.csv").digest
    assert largest_difference(field, *ring_networks, gain=0.7, normalise=bool(more)) < 1e-6
    # Followed like any other: on the circle the score is zero, and the tangent along it.
    found = follow(field, choose_reference(field)[0], starts=4).summary()
    assert found["reach_fraction"] == found["lap_fraction"] == 1.0
    assert found["cross_track_rms"] < 2e-3
    assert found["speed_on_path_min"] == pytest.approx(1.0, abs=1e-3)


def test_waypoints_are_recovered(command, tmp_path, capsys, ring_networks, largest_difference):
    assert command("score.pth", "tangent.pth", "--out", tmp_path) == 0
    shown = capsys.readouterr()
    assert "as the score shows them" in shown.out
    assert shown.err == ""
    field = open_field(tmp_path)
    assert largest_difference(field, *ring_networks) < 1e-9
    np.testing.assert_allclose(np.linalg.norm(field.cloud.points, axis=1), 3.0, atol=1e-4)
    summary = summary_of(tmp_path)
    assert summary == {
        "recipe": "imported",
        "seed": 0,
        "num_points": field.cloud.num_points,
        "dim": 2,
        "unit_length": field.cloud.unit_length,
        "digest": field.cloud.digest,
        "sigma": field.sigma,
        "gain": 0.2,
        "normalised": False,
        "files": {"score": "score.pth", "tangent": "tangent.pth"},
        "points": "score",
        "messages": [],
        "score_layers": [3, 200, 2],
        "score_activation": "Tanh",
        "tangent_layers": [2, 2],
        "tangent_activation": "SiLU",
    }
    assert field.provenance["import"]["files"] == summary["files"]
    assert 0.005 < ink(tmp_path / "field.png") < 0.9
    # Flown along a circle of 3 m; the field is widened for the vehicle, as any other.
    (flight,) = fly(field, choose_reference(field)[0], speed=1.0, laps=1.0).flights
    assert flight.summary["laps"] >= 1.0
    assert flight.summary["cross_track_rms_m"] < 0.02


def test_waypoints_that_are_not_seen_are_asked_for(command, tmp_path, capsys):
    assert command("untrained.pth", "tangent.pth", "--out", tmp_path) == 0
    summary = summary_of(tmp_path)
    assert (summary["points"], summary["unit_length"]) == ("box", 1.0)
    shown = capsys.readouterr()
    assert "a square in their place" in shown.out
    assert shown.err == "warning: the score shows no path; give its waypoints with --points\n"


def test_networks_of_space(command, inputs, tmp_path):
    networks = ("spatial_score.pth", "spatial_tangent.pth", "--activation", "ReLU")
    assert command(*networks, "--points", inputs / "spatial.txt", "--out", tmp_path) == 0
    summary = summary_of(tmp_path)
    # One name is that of both.
    assert (summary["score_activation"], summary["tangent_activation"]) == ("ReLU", "ReLU")
    assert open_field(tmp_path)(np.zeros(3)).shape == (3,)
    # There is nothing to draw.
    assert names_in(tmp_path) == FILES - {"field.png"}


def test_one_file_of_both_networks(command, tmp_path, ring_networks, largest_difference):
    chosen = ("--key", "score_state_dict,tangent_state_dict", "--activation", "Tanh,SiLU")
    assert command("both.pth", "both.pth", *chosen, "--out", tmp_path) == 0
    assert largest_difference(open_field(tmp_path), *ring_networks) < 1e-9


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
    assert summary_of(tmp_path)["gain"] == 0.4


BAD = {
    "missing": (["absent.pth", "tangent.pth"], ["absent.pth: no such file"]),
    "text": (["text.pth", "tangent.pth"], ["text.pth", "not a whole file"]),
    "pickle": (["trap.pth", "tangent.pth"], ["trap.pth", "nothing else is unpickled"]),
    "missing key": (["no_bias.pth", "tangent.pth"], ["no_bias.pth: net.0.bias is missing"]),
    "swapped": (["tangent.pth", "score.pth"], ["tangent.pth: a score network", "2 and 2"]),
    "twice": (["score.pth", "score.pth"], ["score.pth: a tangent network", "3 and 2"]),
    "unlike": (
        ["score.pth", "spatial_tangent.pth", "--activation", "Tanh"],
        ["tangent network is of 3 dimensions, the score network of 2"],
    ),
    "no points": (
        ["spatial_score.pth", "spatial_tangent.pth", "--activation", "SiLU"],
        ["recovered in the plane only", "3 dimensions", "--points"],
    ),
    "dimensions": (
        ["score.pth", "tangent.pth", "--points", "{inputs}/spatial.txt"],
        ["spatial.txt", "3 coordinates", "score network 2"],
    ),
    "activation": (["untold.pth", "tangent.pth"], ["untold.pth: ", "--activation", "ReLU"]),
    "three activations": (
        ["score.pth", "tangent.pth", "--activation", "Tanh,Tanh,Tanh"],
        ["--activation takes one name", "'Tanh,Tanh,Tanh'"],
    ),
    "several": (
        ["both.pth", "tangent.pth"],
        ["both.pth: ", "score_state_dict, tangent_state_dict", "--key"],
    ),
    "missing points": (
        ["score.pth", "tangent.pth", "--points", "none.csv"],
        ["none.csv: there is no such file"],
    ),
    "columns of nothing": (
        ["score.pth", "tangent.pth", "--columns", "x,y"],
        ["--columns x,y", "--points"],
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
    assert names_in(tmp_path) == set()
