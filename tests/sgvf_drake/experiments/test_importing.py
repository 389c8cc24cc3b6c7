import json

from matplotlib.image import imread
import numpy as np
import pytest
import torch

from sgvf_drake import PointCloud
from sgvf_drake.experiments import choose_reference, fly, follow, open_field
from sgvf_drake.experiments.importing import run_import

RADIUS = 3.0


@pytest.fixture(scope="module")
def files(tmp_path_factory, ring_networks, make_sequential):
    """Networks and waypoints in files."""
    folder = tmp_path_factory.mktemp("networks")
    score, tangent = ring_networks
    told = {"state_dict": score.state_dict(), "hidden": 200, "activation": "Tanh"}
    torch.save(told, folder / "score.pth")
    torch.save(tangent.state_dict(), folder / "tangent.pth")
    torch.save(make_sequential([4, 8, 3]).state_dict(), folder / "spatial_score.pth")
    torch.save(make_sequential([3, 8, 3]).state_dict(), folder / "spatial_tangent.pth")
    angle = 2 * np.pi * np.arange(100) / 100
    ring = np.column_stack([angle, RADIUS * np.cos(angle), RADIUS * np.sin(angle)])
    np.savetxt(folder / "ring.csv", ring, delimiter=",", header="time,east,north", comments="")
    np.savetxt(folder / "spatial.txt", np.random.default_rng(0).uniform(-1, 1, (30, 3)))
    return folder


def run(files, out, score="score.pth", tangent="tangent.pth", **options):
    if "points" in options:
        options["points"] = files / options["points"]
    return run_import(files / score, files / tangent, out, **options)


@pytest.fixture(scope="module")
def imported(files, tmp_path_factory):
    """The ring without its waypoints: the folder and the summary."""
    out = tmp_path_factory.mktemp("import") / "out"
    return out, run(files, out)


def test_what_is_left(imported, ring_networks, largest_difference):
    out, summary = imported
    names = {path.name for path in out.iterdir()}
    assert names == {"summary.json", "field.safetensors", "field.png"}
    assert json.loads((out / "summary.json").read_text()) == summary
    field = open_field(out)
    assert largest_difference(field, *ring_networks) < 1e-9
    cloud = field.cloud
    assert summary == {
        "recipe": "imported",
        "seed": 0,
        "num_points": cloud.num_points,
        "dim": 2,
        "unit_length": cloud.unit_length,
        "digest": cloud.digest,
        "sigma": field.sigma,
        "gain": 0.2,
        "normalised": False,
        "files": {"score": "score.pth", "tangent": "tangent.pth"},
        "points": "score",
        "score_layers": [3, 200, 2],
        "score_activation": "Tanh",
        "tangent_layers": [2, 2],
        "tangent_activation": "SiLU",
    }
    assert field.provenance["import"]["files"] == summary["files"]
    np.testing.assert_allclose(np.linalg.norm(cloud.points, axis=1), RADIUS, atol=1e-4)
    pixels = imread(out / "field.png")[..., :3]
    assert 0.005 < np.any(pixels < 0.9, axis=2).mean() < 0.9


@pytest.mark.parametrize("normalise", [False, True])
def test_the_waypoints_of_a_file(files, tmp_path, ring_networks, largest_difference, normalise):
    options = {"gain": 0.5, "normalise": normalise}
    columns = ["east", "north"]
    summary = run(files, tmp_path, points="ring.csv", columns=columns, **options)
    assert (summary["points"], summary["num_points"]) == ("file", 100)
    assert (summary["gain"], summary["normalised"]) == (0.5, normalise)
    field = open_field(tmp_path)
    assert field.cloud.digest == PointCloud.read(files / "ring.csv", columns).digest
    assert largest_difference(field, *ring_networks, **options) < 1e-6
    # The noise level of the ring's score.
    assert summary["sigma"] * summary["unit_length"] == pytest.approx(0.3, rel=1e-4)
    # Followed like any other: on the circle the score is zero, and the tangent along it.
    result = follow(field, choose_reference(field)[0], starts=4).summary()
    assert result["reach_fraction"] == result["lap_fraction"] == 1.0
    assert result["stall_fraction"] == result["leave_fraction"] == 0.0
    assert result["cross_track_rms"] < 2e-3
    assert result["speed_on_path_min"] == pytest.approx(1.0, abs=1e-3)


def test_it_is_flown_like_any_other(imported):
    """Along a circle of 3 m; the field is widened for the vehicle, as any other."""
    field = open_field(imported[0])
    result = fly(field, choose_reference(field)[0], speed=1.0, laps=1.0)
    (flight,) = result.summary()["pieces"]
    assert flight["laps"] >= 1.0
    assert flight["cross_track_rms_m"] < 0.02


def test_networks_of_space(files, tmp_path):
    networks = ("spatial_score.pth", "spatial_tangent.pth")
    summary = run(files, tmp_path, *networks, points="spatial.txt")
    assert summary["dim"] == 3
    assert open_field(tmp_path)(np.zeros(3)).shape == (3,)
    # There is nothing to draw.
    assert {path.name for path in tmp_path.iterdir()} == {"summary.json", "field.safetensors"}
