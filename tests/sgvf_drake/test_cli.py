"""The command line: what it leaves behind, and what it says to bad input."""

import json
from pathlib import Path
import pickle
import subprocess
import sys

from matplotlib.image import imread
import numpy as np
import pandas as pd
import pytest
from safetensors.numpy import save_file

from sgvf_drake import __version__, load_field
from sgvf_drake.cli import main

SHAPE = ("--shape", "concentric-flight", "--num-points", "100")
TRAIN = ("train", "--recipe", "exact", *SHAPE)
TRAIN_FILES = {"summary.json", "field.safetensors", "losses.csv", "field.png"}
FOLLOW_FILES = {"summary.json", "trajectories.parquet", "follow.png"}
FLY_FILES = {"summary.json"} | {
    f"flight_{n}.{kind}" for n in (1, 2) for kind in ("png", "parquet")
}
TRAIN_KEYS = {
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
    "pieces",
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
        "same.csv": "x,y\n" + "1,2\n" * 9,
        "thin.csv": "1\n2\n3\n4\n",
        "spatial.csv": "0 0 0\n1 0 0\n1 1 1\n",
        "short.csv": "0 0\n0 0.001\n",
        "a_file": "not a folder\n",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    np.savetxt(folder / "good.csv", points, delimiter=",", header="x,y", comments="")
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


def test_train(trained):
    assert names_in(trained) == TRAIN_FILES
    summary = summary_of(trained)
    assert set(summary) >= TRAIN_KEYS
    assert (summary["recipe"], summary["seed"]) == ("exact", 3)
    assert (summary["num_points"], summary["dim"]) == (100, 2)
    assert summary["unit_length"] == pytest.approx(0.5, rel=1e-2)
    assert summary["self_check_passed"] is True
    assert summary["restarts"] == 0
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
    assert run(*arguments, "--recipe", "exact", "--seed", 3, "--out", out) == 0
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
    "NaN": (["--points", "{inputs}/nan.csv"], ["nan.csv, line 3", "'nan' is not finite"]),
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
    assert shown.out == ""


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
