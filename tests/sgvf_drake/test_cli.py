"""The command line: what it leaves behind, and what it says to bad input."""

import json
from pathlib import Path
import pickle
import re
import subprocess
import sys

from matplotlib.image import imread
import numpy as np
import pandas as pd
import pytest
from safetensors.numpy import save_file

from sgvf_drake import __version__, load_field
from sgvf_drake.cli import main
from sgvf_drake.cli.training import DirectionName
from sgvf_drake.learning.direction import DIRECTIONS

SHAPE = ("--shape", "concentric-flight", "--num-points", "100")
# Few iterations, which are enough for the closed-form score of two circles.
FEW = ("--recipe", "exact", "--tangent-iterations", 600)
TRAIN = ("train", *FEW, *SHAPE)
TRAIN_FILES = {"summary.json", "field.safetensors", "losses.csv", "field.png"}
FOLLOW_FILES = {"summary.json", "trajectories.parquet", "follow.png"}
FLY_FILES = {"summary.json"} | {
    f"flight_{n}.{kind}" for n in (1, 2) for kind in ("png", "parquet")
}
ARC = ("--points", "{inputs}/arc.csv")
TRAIN_KEYS = {
    *("pieces", "ends", "open", "direction", "start", "spacing", "noise", "gap", "dropped"),
    "resampled",
    *("recipe", "seed", "num_points", "dim", "unit_length", "train_cpu_s", "train_wall_s"),
    *("self_check_passed", "restarts"),
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


def run(*arguments):
    """Runs a command in this process; returns its exit status."""
    with pytest.raises(SystemExit) as end:
        main([str(argument) for argument in arguments])
    return end.value.code or 0


def run_process(*arguments, **options):
    return subprocess.run(arguments, capture_output=True, text=True, **options)


def names_in(folder):
    return {path.name for path in Path(folder).iterdir()}


def summary_of(folder):
    return json.loads((Path(folder) / "summary.json").read_text())


def check_picture(path):
    pixels = imread(path)[..., :3]
    assert 0.005 < np.any(pixels < 0.9, axis=2).mean() < 0.9


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """The folder of a training, made by the command."""
    out = tmp_path_factory.mktemp("cli") / "train"
    assert run(*TRAIN, "--seed", 3, "--out", out) == 0
    return out


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, trained):
    """A folder of files that cannot be used, and one that can."""
    folder = tmp_path_factory.mktemp("inputs")
    points = load_field(trained / "field.safetensors").cloud.points
    texts = {
        "empty.csv": "",
        "header.csv": "x,y\n",
        "nan.csv": "x,y\n0,0\n1,nan\n2,1\n",
        "text.csv": "x,y\n0,0\n1,here\n2,1\n",
        "ragged.csv": "x,y\n0,0\n1,1\n2,1,5\n",
        "one.csv": "x,y\n0,0\n",
        "bad_velocity.csv": "x,y,vx,vy\n0,0,1,0\n1,0,fast,0\n2,1,1,1\n",
        "same.csv": "x,y\n" + "1,2\n" * 9,
        "thin.csv": "1\n2\n3\n4\n",
        "spatial.csv": "x y z\n0 0 0\n1 0 0\n1 1 1\n",
        "unnamed.csv": "0 0 1\n1 0 2\n1 1 3\n",
        "short.csv": "0 0\n0 0.001\n",
        "a_file": "not a folder\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    np.savetxt(folder / "good.csv", points, delimiter=",", header="x,y", comments="")
    angle = np.linspace(np.pi, 0, 60)
    arc = pd.DataFrame({"x": 2 * np.cos(angle), "y": 2 * np.sin(angle)})
    arc.to_csv(folder / "arc.csv", index=False)
    angle = 2 * np.pi * np.arange(200) / 200
    ring = pd.DataFrame({"x": 3 * np.cos(angle), "y": 3 * np.sin(angle)})
    ring.to_csv(folder / "ring.csv", index=False)
    strayed = pd.concat([ring, pd.DataFrame({"x": [0.3, -1.0], "y": [0.0, 1.0]})])
    strayed.to_csv(folder / "strayed.csv", index=False)
    # Recorded from the right to the left.
    moving = arc.assign(vx=-arc["y"], vy=arc["x"])
    moving.to_csv(folder / "moving.csv", index=False)
    np.save(folder / "flat.npy", np.arange(8.0))
    whole = (trained / "field.safetensors").read_bytes()
    (folder / "damaged.safetensors").write_bytes(whole[: len(whole) // 2])
    (folder / "pickle.safetensors").write_bytes(pickle.dumps({"weights": [1.0, 2.0]}))
    save_file({"weights": np.ones(3)}, folder / "foreign.safetensors")
    (folder / "taken").mkdir()
    for name in ("summary.json", "notes.txt"):
        (folder / "taken" / name).write_text("mine\n")
    return folder


# What the commands leave.


def check_pieces(summary):
    """Circles of 2 m and 1 m, of 67 and 33 points, in the unit of the waypoints."""
    pieces = summary["pieces"]
    assert [piece["closed"] for piece in pieces] == [True, True]
    assert pieces[0]["points"] == pytest.approx(2 * pieces[1]["points"], rel=0.02)
    lengths = [piece["length"] for piece in pieces]
    assert lengths == pytest.approx([4 * np.pi, 2 * np.pi], rel=0.01)
    assert summary["spacing"] == pytest.approx(6 * np.pi / 100, rel=0.02)
    assert summary["noise"] < 0.01
    assert summary["gap"] > 0.0
    # So few waypoints are resampled.
    assert (summary["dropped"], summary["resampled"], summary["ends"]) == (0, True, [])
    assert summary["open"] is summary["direction"] is summary["start"] is None


def test_train(trained):
    assert names_in(trained) == TRAIN_FILES
    summary = summary_of(trained)
    assert set(summary) >= TRAIN_KEYS
    assert (summary["recipe"], summary["seed"]) == ("exact", 3)
    assert (summary["num_points"], summary["dim"]) == (100, 2)
    assert summary["unit_length"] == pytest.approx(0.5, rel=1e-2)
    assert summary["self_check_passed"] is True
    assert summary["restarts"] == 0
    check_pieces(summary)
    assert summary["train_cpu_s"] > 0.0
    assert summary["train_wall_s"] > 0.0
    field = load_field(trained / "field.safetensors")
    assert (field.recipe, field.seed, field.cloud.num_points) == ("exact", 3, 100)
    losses = pd.read_csv(trained / "losses.csv")
    assert set(losses["stage"]) == {"tangent"}
    assert np.isfinite(losses["total"]).all()
    check_picture(trained / "field.png")


def test_train_from_a_file_with_other_columns(tmp_path, trained):
    cloud = load_field(trained / "field.safetensors").cloud
    table = pd.DataFrame(cloud.points, columns=["east", "north"])
    table.insert(0, "id", range(len(table)))
    table.to_csv(tmp_path / "w.csv", index=False)
    out = tmp_path / "out"
    arguments = ("train", "--points", tmp_path / "w.csv", "--columns", "east, north")
    assert run(*arguments, *FEW, "--seed", 3, "--out", out) == 0
    assert summary_of(out)["digest"] == cloud.digest
    # The same field as from the shape, but for the name of the shape.
    found = load_field(out / "field.safetensors")
    np.testing.assert_array_equal(
        found(cloud.points), load_field(trained / "field.safetensors")(cloud.points)
    )
    assert summary_of(out)["shape"] is None
    # And it can be flown: the cloud itself is the reference, in any unit.
    fly = ("fly", out, "--scale", 0.5, "--speed", 1, "--laps", 1.2, "--out", tmp_path / "fly")
    assert run(*fly) == 0
    assert summary_of(tmp_path / "fly")["reference"] == "cloud"
    assert summary_of(tmp_path / "fly")["laps"] >= 1.0


@pytest.fixture(scope="module")
def quick(inputs, tmp_path_factory):
    """Trains on a file of inputs, briefly: (file, options) -> (summary, field)."""

    def make(file, *options):
        out = tmp_path_factory.mktemp("quick") / "out"
        few = ("--tangent-iterations", 60, "--max-restarts", 0, "--recipe", "exact")
        assert run("train", "--points", inputs / file, *few, *options, "--out", out) == 0
        return summary_of(out), load_field(out / "field.safetensors")

    return make


def test_an_open_path_ends_at_the_larger_x(quick, capsys):
    summary, field = quick("arc.csv", "--open")
    assert [piece["closed"] for piece in summary["pieces"]] == [False]
    assert summary["pieces"][0]["length"] == pytest.approx(2 * np.pi, rel=0.02)
    assert summary["open"] is True
    np.testing.assert_allclose(field.ends, [[2.0, 0.0]], atol=0.05)
    np.testing.assert_allclose(summary["ends"], field.ends)
    shown = capsys.readouterr().out
    assert "1 open" in shown
    assert "closed" not in shown
    # Waypoints of an open path are always resampled, and none of these was a stray.
    assert summary["resampled"] is True
    assert "resampled" in shown
    assert "left out" not in shown


@pytest.mark.parametrize(
    ("options", "end"),
    [(("--direction", "reverse"), -2.0), (("--start", "2.5, -1"), -2.0)],
)
def test_the_direction_of_an_open_path(quick, options, end):
    summary, field = quick("arc.csv", "--open", *options)
    np.testing.assert_allclose(field.ends, [[end, 0.0]], atol=0.05)
    chosen = {"--direction": ("reverse", None), "--start": (None, [2.5, -1.0])}
    assert (summary["direction"], summary["start"]) == chosen[options[0]]


@pytest.mark.parametrize(
    ("file", "dropped", "resampled"), [("ring.csv", 0, False), ("strayed.csv", 2, True)]
)
def test_what_was_done_to_the_waypoints_is_told(quick, capsys, file, dropped, resampled):
    summary, field = quick(file)
    (piece,) = summary["pieces"]
    assert piece["closed"] is True
    assert piece["points"] == len(field.support)
    assert (piece["points"] == 200) == (not resampled)
    assert (summary["dropped"], summary["resampled"]) == (dropped, resampled)
    shown = capsys.readouterr().out
    assert "1 closed" in shown
    assert ("strays left out │ 2" in shown) == (dropped == 2)
    assert ("resampled" in shown) == resampled


def test_the_paper_learns_from_the_waypoints_as_they_are(inputs, tmp_path):
    few = ("--score-iterations", 5, "--tangent-iterations", 5, "--recipe", "paper")
    points = ("--points", inputs / "strayed.csv")
    assert run("train", *points, *few, "--out", tmp_path / "out") == 0
    summary = summary_of(tmp_path / "out")
    assert (summary["dropped"], summary["resampled"]) == (0, False)
    assert summary["settings"]["score_iterations"] == 5


def test_the_flight_of_an_open_path(quick, inputs, tmp_path, capsys):
    _, field = quick("arc.csv", "--open", "--tangent-iterations", 600)
    field.save(tmp_path / "arc.safetensors")
    capsys.readouterr()
    # As wide as it has to be for the field to be flown as it is.
    fly = ("fly", tmp_path / "arc.safetensors", "--scale", 10, "--speed", 0.9)
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


def test_recorded_velocities_set_the_direction(quick):
    _, field = quick("moving.csv", "--open")
    np.testing.assert_allclose(field.ends, [[-2.0, 0.0]], atol=0.05)
    # A choice comes before them: the file was recorded from the right.
    _, field = quick("moving.csv", "--open", "--start", "-2,0")
    np.testing.assert_allclose(field.ends, [[2.0, 0.0]], atol=0.05)


def test_the_same_arc_can_be_closed_and_learned_with_other_settings(quick):
    summary, field = quick("arc.csv", "--closed", "--sigma", 0.25)
    assert field.sigma == summary["sigma"] == 0.25
    assert summary["settings"]["tangent_iterations"] == 60
    assert summary["settings"]["max_restarts"] == 0
    assert [piece["closed"] for piece in summary["pieces"]] == [True]
    assert summary["open"] is False
    assert len(field.ends) == 0


def turning(field, radius):
    """The share of a circle that the field runs along counter-clockwise."""
    angle = np.linspace(0, 2 * np.pi, 200)
    x = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    return float((field(x) @ np.array([[0, 1], [-1, 0]]) * x).sum(axis=1).__lt__(0).mean())


@pytest.mark.parametrize(
    ("direction", "outer", "inner"),
    [("-,cw", 1, 0), ("reverse, ccw", 0, 1)],
)
def test_each_piece_has_its_direction(quick, direction, outer, inner):
    more = ("--tangent-iterations", 300, "--direction", direction)
    _, field = quick("good.csv", *more)
    assert turning(field, 2.0) == pytest.approx(outer, abs=0.1)
    assert turning(field, 1.0) == pytest.approx(inner, abs=0.1)


def test_the_names_of_directions_are_those_of_the_training():
    assert set(DirectionName) == set(DIRECTIONS)


def test_follow(trained, tmp_path, capsys):
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
    check_picture(out / "follow.png")
    shown = capsys.readouterr().out
    assert "100.0%, 100.0%" in shown
    assert f"results in {out}" in shown


def test_follow_against_a_file(trained, tmp_path):
    angle = np.linspace(0, 2 * np.pi, 400)
    np.savetxt(tmp_path / "ring.txt", 2 * np.column_stack([np.cos(angle), np.sin(angle)]))
    out = tmp_path / "follow"
    field = trained / "field.safetensors"
    reference = ("--reference", tmp_path / "ring.txt", "--duration", 8)
    assert run("follow", field, "--starts", 4, *reference, "--out", out) == 0
    summary = summary_of(out)
    assert summary["reference"] == "file"
    assert summary["duration"] == pytest.approx(8.0, abs=0.05)


def test_fly(trained, tmp_path, capsys):
    out = tmp_path / "fly"
    assert run("fly", trained, "--speed", 1.5, "--laps", 1.2, "--out", out) == 0
    assert names_in(out) == FLY_FILES
    summary = summary_of(out)
    assert set(summary) >= FLY_KEYS
    assert len(summary["pieces"]) == 2
    assert summary["cross_track_rms_m"] <= 0.02
    assert summary["laps"] >= 1.0
    for piece in (1, 2):
        log = pd.read_parquet(out / f"flight_{piece}.parquet")
        duration = summary["pieces"][piece - 1]["duration_s"]
        assert log["time"].iloc[-1] == pytest.approx(duration)
        check_picture(out / f"flight_{piece}.png")
    shown = capsys.readouterr().out
    assert "feasible" in shown
    # Brackets are markup to Rich, which would swallow the units.
    assert "[m/s]" in shown
    assert "[m]" in shown


@pytest.mark.full
def test_demo(tmp_path):
    """The main job as it stands: the default recipe, from waypoints to flights."""
    out = tmp_path / "demo"
    assert run("demo", "--out", out) == 0
    assert names_in(out) == {"summary.json", "waypoints.csv", "train", "follow", "fly"}
    files = {"train": TRAIN_FILES, "follow": FOLLOW_FILES, "fly": FLY_FILES}
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


def test_overwrite_replaces(trained, tmp_path):
    out = tmp_path / "out"
    command = ("follow", trained, "--duration", 2, "--out", out)
    assert run(*command, "--starts", 4) == 0
    (out / "notes.txt").write_text("mine")
    assert run(*command, "--starts", 5) == 2
    assert summary_of(out)["starts"] == 4
    assert run(*command, "--starts", 5, "--overwrite") == 0
    assert summary_of(out)["starts"] == 5
    assert names_in(out) == {*FOLLOW_FILES, "notes.txt"}


def test_shapes_are_listed(capsys):
    assert run("shapes") == 0
    assert "concentric-flight" in capsys.readouterr().out.split()


# Bad input: status 2, one line that names what is wrong, and nothing written.

BAD_TRAINING = {
    "unknown shape": (["--shape", "cirle"], ["'cirle'", "did you mean 'circle'"]),
    "neither points nor shape": ([], ["--points", "--shape"]),
    "both points and shape": (
        ["--points", "{inputs}/good.csv", "--shape", "circle"],
        ["--points", "--shape"],
    ),
    "missing file": (["--points", "{inputs}/none.csv"], ["none.csv", "no such file"]),
    "folder as file": (["--points", "{inputs}"], ["is a folder"]),
    "empty file": (["--points", "{inputs}/empty.csv"], ["empty.csv", "it is empty"]),
    "header only": (["--points", "{inputs}/header.csv"], ["header.csv", "only a header"]),
    "three unnamed columns": (
        ["--points", "{inputs}/unnamed.csv"],
        ["unnamed.csv: cannot tell which of its 3 columns", "--columns 0,1"],
    ),
    "NaN": (["--points", "{inputs}/nan.csv"], ["nan.csv, line 3", "y is missing"]),
    "text": (["--points", "{inputs}/text.csv"], ["text.csv, line 3", "'here'"]),
    "ragged row": (["--points", "{inputs}/ragged.csv"], ["ragged.csv, line 4", "3 fields"]),
    "unknown column": (
        ["--points", "{inputs}/good.csv", "--columns", "x,q"],
        ["good.csv", "no column 'q'", "'x', 'y'"],
    ),
    "column number": (
        ["--points", "{inputs}/good.csv", "--columns", "0,7"],
        ["good.csv", "no column 7"],
    ),
    "columns of nothing": (
        ["--shape", "circle", "--columns", "x,y"],
        ["--columns x,y", "--points"],
    ),
    "one point": (["--points", "{inputs}/one.csv"], ["one.csv", "at least 2 waypoints"]),
    "identical points": (["--points", "{inputs}/same.csv"], ["same.csv", "coincide"]),
    "one column": (["--points", "{inputs}/thin.csv"], ["thin.csv", "two columns"]),
    "one dimension": (["--points", "{inputs}/flat.npy"], ["flat.npy", "(8,)"]),
    "negative seed": (["--shape", "circle", "--seed", "-1"], ["seed", "-1"]),
    "negative noise": (["--shape", "circle", "--noise", "-0.1"], ["noise", "-0.1"]),
    "NaN noise": (["--shape", "circle", "--noise", "nan"], ["noise", "nan"]),
    "unknown direction": (
        [*ARC, "--direction", "left"],
        ["--direction", "'left'", "ccw, cw, reverse"],
    ),
    "one direction too many": (
        ["--points", "{inputs}/good.csv", "--direction", "cw,-,cw"],
        ["direction has 3 entries", "2 pieces"],
    ),
    "an open path that turns": (
        [*ARC, "--open", "--direction", "cw"],
        ["direction 'cw'", "closed pieces in the plane"],
    ),
    "start is no point": ([*ARC, "--start", "1;2"], ["--start", "'1;2'"]),
    "start of one number": ([*ARC, "--start", "1"], ["--start", "'1'"]),
    "NaN start": ([*ARC, "--start", "nan,0"], ["--start", "'nan,0'"]),
    "start in another dimension": (
        [*ARC, "--start", "1,2,3"],
        ["start has 3 coordinates", "have 2"],
    ),
    "direction of the paper": (
        [*ARC, "--recipe", "paper", "--direction", "ccw"],
        ["--direction", "paper"],
    ),
    "closed for the paper": ([*ARC, "--recipe", "paper", "--closed"], ["--closed", "paper"]),
    "no score network": (
        [*ARC, "--recipe", "exact", "--score-iterations", "9"],
        ["--score-iterations", "exact"],
    ),
    "negative sigma": ([*ARC, "--sigma", "-1"], ["sigma", "-1.0"]),
    "NaN sigma": ([*ARC, "--sigma", "nan"], ["sigma", "nan"]),
    "no iterations": (
        [*ARC, "--tangent-iterations", "0"],
        ["tangent_iterations cannot be 0"],
    ),
    "negative restarts": ([*ARC, "--max-restarts", "-1"], ["max_restarts cannot be -1"]),
    "bad velocity": (["--points", "{inputs}/bad_velocity.csv"], ["line 3", "'fast'"]),
    "too few points": (["--shape", "circle", "--num-points", "2"], ["num_points", "2"]),
}
BAD_FOLLOWING = {
    "no starts": (["{field}", "--starts", "0"], ["starts", "0"]),
    "NaN duration": (["{field}", "--duration", "nan"], ["duration", "nan"]),
    "negative duration": (["{field}", "--duration", "-3"], ["duration", "-3"]),
    "tiny duration": (["{field}", "--duration", "1e-9"], ["duration", "1e-09"]),
    "missing field": (["{inputs}/none"], ["none: no such file"]),
    "folder without field": (["{inputs}"], ["field.safetensors: no such file"]),
    "damaged field": (
        ["{inputs}/damaged.safetensors"],
        ["damaged.safetensors", "not a whole safetensors file"],
    ),
    "foreign field": (
        ["{inputs}/foreign.safetensors"],
        ["foreign.safetensors", "not a field of sgvf_drake"],
    ),
    "pickle": (
        ["{inputs}/pickle.safetensors"],
        ["pickle.safetensors", "not a whole safetensors file"],
    ),
    "text as field": (["{inputs}/good.csv"], ["good.csv", "not a whole safetensors file"]),
    "spatial reference": (
        ["{field}", "--reference", "{inputs}/spatial.csv"],
        ["spatial.csv", "3 coordinates, the field 2"],
    ),
    "missing reference": (
        ["{field}", "--reference", "{inputs}/none.csv"],
        ["none.csv", "no such file"],
    ),
    "columns of nothing": (["{field}", "--columns", "0,1"], ["--columns 0,1", "--reference"]),
}
BAD_FLYING = {
    "zero speed": (["{field}", "--speed", "0"], ["speed", "0.0"]),
    "NaN speed": (["{field}", "--speed", "nan"], ["speed", "nan"]),
    "zero laps": (["{field}", "--laps", "0"], ["laps", "0.0"]),
    "negative scale": (["{field}", "--scale", "-1"], ["scale", "-1.0"]),
    "infinite scale": (["{field}", "--scale", "inf"], ["scale", "inf"]),
    "NaN altitude": (["{field}", "--altitude", "nan"], ["altitude", "nan"]),
    "short reference": (
        ["{field}", "--reference", "{inputs}/short.csv"],
        ["nothing to fly", "0.001 m"],
    ),
}
CASES = [
    pytest.param(command, arguments, expected, id=f"{command}: {name}")
    for command, cases in (
        ("train", BAD_TRAINING),
        ("follow", BAD_FOLLOWING),
        ("fly", BAD_FLYING),
    )
    for name, (arguments, expected) in cases.items()
]


def check_one_error_line(capsys, expected):
    shown = capsys.readouterr()
    assert shown.err.count("\n") == 1, shown.err
    assert shown.err.startswith("error: ")
    for text in expected:
        assert text in shown.err
    # At most what was read.
    assert re.fullmatch(r"(\w+\.csv: .*\n)*", shown.out)


@pytest.mark.parametrize(("command", "arguments", "expected"), CASES)
def test_bad_input(command, arguments, expected, inputs, trained, tmp_path, capsys):
    places = {"inputs": inputs, "field": trained}
    filled = [argument.format(**places) for argument in arguments]
    capsys.readouterr()
    assert run(command, *filled, "--out", tmp_path / "deep" / "out") == 2
    check_one_error_line(capsys, expected)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("command", ["train", "follow", "fly", "demo"])
def test_existing_results_stay(command, inputs, trained, capsys):
    arguments = {"train": TRAIN[1:], "demo": ()}.get(command, (trained,))
    capsys.readouterr()
    assert run(command, *arguments, "--out", inputs / "taken") == 2
    check_one_error_line(capsys, ["taken already holds summary.json", "--overwrite"])
    assert names_in(inputs / "taken") == {"summary.json", "notes.txt"}
    assert (inputs / "taken" / "summary.json").read_text() == "mine\n"


@pytest.mark.parametrize("out", ["a_file", "a_file/inner"])
def test_a_file_as_folder(out, inputs, trained, capsys):
    before = names_in(inputs)
    capsys.readouterr()
    assert run("follow", trained, "--out", inputs / out) == 2
    check_one_error_line(capsys, [f"cannot write to {inputs / out}", "not a folder"])
    assert names_in(inputs) == before


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        (["train", "--shape", "circle", "--recipe", "best", "--out", "out"], "best"),
        (["train", "--shape", "circle", "--seed", "half", "--out", "x"], "--seed"),
        (["train", "--shape", "circle"], "--out"),
        (["follow", "--out", "out"], "FIELD"),
        (["fly", "field", "--spede", "1", "--out", "out"], "--spede"),
        (["flly"], "flly"),
    ],
)
def test_usage_errors(arguments, culprit, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == 2
    shown = capsys.readouterr()
    assert culprit in shown.err
    assert "Traceback" not in shown.err
    assert list(tmp_path.iterdir()) == []


# The program as users start it.


def test_the_program_reports_bad_input(tmp_path):
    program = Path(sys.executable).with_name("sgvf")
    done = run_process(program, "train", "--points", "none.csv", "--out", "x", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: none.csv: there is no such file\n"
    assert list(tmp_path.iterdir()) == []


def modules_after(arguments, folder):
    """Runs a command in a fresh process: its exit status, and the modules it imported."""
    code = (
        "import sys\n"
        "from sgvf_drake.cli import main\n"
        "try:\n"
        "    main(sys.argv[1:])\n"
        "except SystemExit as end:\n"
        "    print(end.code or 0, *sys.modules, file=sys.stderr)\n"
    )
    done = run_process(sys.executable, "-c", code, *arguments, cwd=folder, check=True)
    status, *modules = done.stderr.splitlines()[-1].split()
    return int(status), set(modules), done.stdout


@pytest.mark.parametrize(
    ("option", "shown"), [("--version", __version__), ("--help", "Usage:")]
)
def test_version_and_help_import_little(option, shown, tmp_path):
    status, modules, out = modules_after([option], tmp_path)
    assert status == 0
    assert shown in out
    assert not modules & {"torch", "pydrake", "matplotlib", "systems"}


def test_the_help_shows_the_defaults(capsys):
    # Brackets are markup to Rich, which would swallow them.
    for command, default in (("train", "[default: 200]"), ("follow", "laps + 15 U]")):
        assert run(command, "--help") == 0
        words = capsys.readouterr().out.replace("│", " ").split()
        assert default in " ".join(words)


def test_follow_does_without_torch(trained, tmp_path):
    command = ["follow", str(trained), "--starts", "1", "--duration", "1", "--out", "out"]
    status, modules, _ = modules_after(command, tmp_path)
    assert status == 0
    assert "pydrake" in modules
    assert "torch" not in modules
    assert names_in(tmp_path / "out") == FOLLOW_FILES


def test_python_dash_m(tmp_path):
    done = run_process(sys.executable, "-m", "sgvf_drake", "--version", cwd=tmp_path)
    assert done.stdout == f"sgvf_drake {__version__}\n"
