"""The commands `follow` and `fly`, and the demo: what they leave, print and refuse."""

from dataclasses import replace
import pickle

import numpy as np
import pandas as pd
import pytest
from safetensors.numpy import save_file

from sgvf_drake import PointCloud
from tests.helpers import circle, ink, names_in, summary_of

FOLLOW_FILES = {"summary.json", "trajectories.parquet", "follow.png"}
FLY_FILES = {"summary.json"} | {
    f"flight_{n}.{kind}" for n in (1, 2) for kind in ("png", "parquet")
}
FOLLOW_KEYS = {
    *("starts", "reach_fraction", "lap_fraction", "stall_fraction", "leave_fraction"),
    *("cross_track_rms", "cross_track_max", "speed_on_path_min", "speed_on_path_max"),
    *("unit_length", "reference"),
}
FLY_KEYS = {
    *("cross_track_rms_m", "cross_track_max_m", "speed_mean_m_s", "altitude_rms_m"),
    *("motor_force_max_n", "saturated_fraction", "laps", "real_time_factor", "reference"),
    *("pieces", "ended"),
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, trained, flight_field):
    """A folder of files that cannot be used, and of some that can."""
    folder = tmp_path_factory.mktemp("inputs")
    whole = (trained / "field.safetensors").read_bytes()
    (folder / "field.safetensors").write_bytes(whole)
    (folder / "none").mkdir()
    (folder / "damaged.safetensors").write_bytes(whole[: len(whole) // 2])
    (folder / "pickle.safetensors").write_bytes(pickle.dumps({"weights": [1.0, 2.0]}))
    save_file({"weights": np.ones(3)}, folder / "foreign.safetensors")
    # The cloud has no shape that a reference could be made of.
    nameless = replace(flight_field, cloud=PointCloud(flight_field.cloud.points))
    nameless.save(folder / "nameless.safetensors")
    (folder / "spatial.csv").write_text("x y z\n0 0 0\n1 0 0\n1 1 1\n")
    (folder / "short.csv").write_text("0 0\n0 0.001\n")
    np.savetxt(folder / "ring.txt", circle(2.0, 400))
    return folder


def test_follow(run, trained, tmp_path, capsys):
    out = tmp_path / "follow"
    assert run("follow", trained, "--starts", 9, "--out", out) == 0
    assert names_in(out) == FOLLOW_FILES
    summary = summary_of(out)
    assert set(summary) >= FOLLOW_KEYS
    assert summary["starts"] == 9
    assert summary["reference"] == "shape"
    assert summary["lap_fraction"] == 1.0
    table = pd.read_parquet(out / "trajectories.parquet")
    assert table["agent"].nunique() == 9
    assert table["time"].max() == pytest.approx(summary["duration"])
    assert 0.005 < ink(out / "follow.png") < 0.9
    shown = capsys.readouterr().out
    assert "100.0%, 100.0%" in shown
    assert f"results in {out}" in shown


def test_follow_against_a_file_and_again(run, trained, inputs, tmp_path):
    out = tmp_path / "follow"
    reference = ("--reference", inputs / "ring.txt", "--duration", 2)
    command = ("follow", trained / "field.safetensors", *reference, "--out", out)
    assert run(*command, "--starts", 4) == 0
    summary = summary_of(out)
    assert (summary["reference"], summary["starts"]) == ("file", 4)
    assert summary["duration"] == pytest.approx(2.0, abs=0.05)
    # Results are replaced only when asked, and nothing else.
    (out / "notes.txt").write_text("mine")
    assert run(*command, "--starts", 5) == 2
    assert summary_of(out)["starts"] == 4
    assert run(*command, "--starts", 5, "--overwrite") == 0
    assert summary_of(out)["starts"] == 5
    assert names_in(out) == {*FOLLOW_FILES, "notes.txt"}


def test_fly(run, inputs, tmp_path, capsys):
    out = tmp_path / "fly"
    options = ("--scale", 0.5, "--speed", 1.5, "--laps", 1.2)
    assert run("fly", inputs / "nameless.safetensors", *options, "--out", out) == 0
    assert names_in(out) == FLY_FILES
    summary = summary_of(out)
    assert set(summary) >= FLY_KEYS
    assert len(summary["pieces"]) == 2
    assert summary["reference"] == "cloud"
    assert summary["cross_track_rms_m"] <= 0.02
    assert summary["laps"] >= 1.0
    for piece in (1, 2):
        log = pd.read_parquet(out / f"flight_{piece}.parquet")
        duration = summary["pieces"][piece - 1]["duration_s"]
        assert log["time"].iloc[-1] == pytest.approx(duration)
        assert 0.005 < ink(out / f"flight_{piece}.png") < 0.9
    shown = capsys.readouterr().out
    assert "feasible" in shown
    # Brackets are markup to Rich, which would swallow the units.
    assert "[m/s]" in shown
    assert "[m]" in shown
    rows = [line.split("│") for line in shown.splitlines() if line.startswith("│")]
    assert [row[1].strip() for row in rows] == ["1", "2"]


def test_the_flight_of_an_open_path(run, half_circle_field, tmp_path, capsys):
    half_circle_field.save(tmp_path / "arc.safetensors")
    fly = ("fly", tmp_path / "arc.safetensors", "--speed", 0.3)
    assert run(*fly, "--out", tmp_path / "fly") == 0
    summary = summary_of(tmp_path / "fly")
    assert summary["ended"] is True
    assert summary["laps"] is None
    assert [piece["laps"] for piece in summary["pieces"]] == [None]
    shown = capsys.readouterr().out
    assert " end " in shown
    assert " yes " in shown
    assert "laps" not in shown
    # It fits in 80 columns.
    assert max(map(len, shown.splitlines()[:-1])) <= 80


@pytest.mark.full
def test_demo(run, tmp_path):
    """The main job as it stands: the default recipe, from waypoints to flights."""
    out = tmp_path / "demo"
    assert run("demo", "--out", out) == 0
    assert names_in(out) == {"summary.json", "waypoints.csv", "train", "follow", "fly"}
    files = {"follow": FOLLOW_FILES, "fly": FLY_FILES}
    files["train"] = {"summary.json", "field.safetensors", "losses.csv", "field.png"}
    summary = summary_of(out)
    for part, expected in files.items():
        assert names_in(out / part) == expected
        assert summary_of(out / part) == summary[part]
    assert summary["train"]["recipe"] == "robust"
    assert summary["train"]["self_check_passed"] is True
    follow, fly = summary["follow"], summary["fly"]
    assert follow["starts"] == 100
    assert follow["lap_fraction"] == 1.0
    assert follow["stall_fraction"] == follow["leave_fraction"] == 0.0
    assert follow["cross_track_rms"] <= 0.02 * follow["unit_length"]
    assert fly["cross_track_rms_m"] <= 0.02
    assert len(pd.read_csv(out / "waypoints.csv")) == summary["train"]["num_points"]


# Bad input: the command, and what the one line names.

NO_FIELD = "not a whole safetensors file"
BAD = [
    ("follow . --starts 0", "starts", "0"),
    ("follow . --duration nan", "duration", "nan"),
    ("follow . --duration -3", "duration", "-3"),
    ("follow . --duration 1e-9", "duration", "1e-09"),
    ("follow missing", "missing: no such file"),
    ("follow none", "field.safetensors: no such file"),
    ("follow damaged.safetensors", "damaged.safetensors", NO_FIELD),
    ("follow foreign.safetensors", "foreign.safetensors", "not a field of sgvf_drake"),
    ("follow pickle.safetensors", "pickle.safetensors", NO_FIELD),
    ("follow ring.txt", "ring.txt", NO_FIELD),
    ("follow . --reference spatial.csv", "spatial.csv", "3 coordinates, the field 2"),
    ("follow . --reference none.csv", "none.csv", "no such file"),
    ("follow . --columns 0,1", "--columns 0,1", "--reference"),
    ("fly . --speed 0", "speed", "0.0"),
    ("fly . --speed nan", "speed", "nan"),
    ("fly . --laps 0", "laps", "0.0"),
    ("fly . --scale -1", "scale", "-1.0"),
    ("fly . --scale inf", "scale", "inf"),
    ("fly . --altitude nan", "altitude", "nan"),
    ("fly . --reference short.csv", "nothing to fly", "0.001 m"),
]


@pytest.mark.parametrize("case", BAD, ids=[case[0] for case in BAD])
def test_bad_input_is_one_line(refused, inputs, tmp_path, monkeypatch, case):
    arguments, *words = case
    monkeypatch.chdir(inputs)
    line = refused(*arguments.split(), "--out", tmp_path / "deep" / "out")
    for text in words:
        assert text in line
    assert names_in(tmp_path) == set()
