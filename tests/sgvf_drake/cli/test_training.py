"""The command `train`: one training from end to end, what each option does, bad input."""

from matplotlib.figure import Figure
import numpy as np
import pandas as pd
import pytest

from sgvf_drake import PointCloud, load_field
from sgvf_drake.cli.options import DIRECTIONS as OFFERED
from sgvf_drake.experiments.figures import runs as figures
from sgvf_drake.paths import PathNetwork, make_shape
from sgvf_drake.paths.draft import DIRECTIONS
from tests.helpers import circle, ink, names_in, summary_of

FILES = {"summary.json", "field.safetensors", "losses.csv", "field.png"}
KEYS = {
    *("pieces", "ends", "open", "direction", "start", "spacing", "noise", "gap", "dropped"),
    *("resampled", "recipe", "seed", "num_points", "dim", "unit_length", "train_cpu_s"),
    *("train_wall_s", "self_check_passed", "restarts"),
}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """A folder of files that cannot be used, and of some that can."""
    folder = tmp_path_factory.mktemp("inputs")
    for name, text in {
        "empty.csv": "",
        "header.csv": "x,y\n",
        "nan.csv": "x,y\n0,0\n1,nan\n2,1\n",
        "unnamed.csv": "0 0 1\n1 0 2\n1 1 3\n",
        "text.csv": "x,y\n0,0\n1,here\n2,1\n",
        "ragged.csv": "x,y\n0,0\n1,1\n2,1,5\n",
        "one.csv": "x,y\n0,0\n",
        "bad_velocity.csv": "x,y,vx,vy\n0,0,1,0\n1,0,fast,0\n2,1,1,1\n",
        "same.csv": "x,y\n" + "1,2\n" * 9,
        "thin.csv": "1\n2\n3\n4\n",
    }.items():
        (folder / name).write_text(text)
    np.save(folder / "flat.npy", np.arange(8.0))
    angle = np.linspace(np.pi, 0, 60)
    arc = pd.DataFrame({"x": 2 * np.cos(angle), "y": 2 * np.sin(angle)})
    ring = pd.DataFrame(circle(3.0, 200), columns=["x", "y"])
    two, _ = make_shape("concentric-flight", 100)
    for name, table in {
        "arc": arc,
        # Recorded from the right to the left.
        "moving": arc.assign(vx=-arc["y"], vy=arc["x"]),
        "ring": ring,
        "strayed": pd.concat([ring, pd.DataFrame({"x": [0.3, -1.0], "y": [0.0, 1.0]})]),
        "two": pd.DataFrame(two.points, columns=["east", "north"]).assign(id=range(100)),
    }.items():
        table.to_csv(folder / f"{name}.csv", index=False)
    return folder


def test_a_training_from_end_to_end(run, inputs, tmp_path):
    """Circles of 2 m and 1 m, of 67 and 33 points, by name of the columns."""
    out = tmp_path / "deep" / "out"
    points = ("--points", inputs / "two.csv", "--columns", "east, north")
    # Few iterations, which are enough for the closed-form score of two circles.
    few = ("--recipe", "exact", "--tangent-iterations", 300, "--seed", 3)
    assert run("train", *points, *few, "--out", out) == 0
    assert names_in(out) == FILES
    summary = summary_of(out)
    assert set(summary) >= KEYS
    assert (summary["recipe"], summary["seed"], summary["shape"]) == ("exact", 3, None)
    assert (summary["num_points"], summary["dim"]) == (100, 2)
    assert summary["digest"] == make_shape("concentric-flight", 100)[0].digest
    assert summary["unit_length"] == pytest.approx(0.5, rel=1e-2)
    assert summary["self_check_passed"] is True
    assert summary["restarts"] == 0
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
    assert min(summary["train_cpu_s"], summary["train_wall_s"]) > 0.0
    field = load_field(out / "field.safetensors")
    assert (field.recipe, field.seed, field.cloud.digest) == ("exact", 3, summary["digest"])
    for radius in (1.0, 2.0):
        np.testing.assert_allclose(turning(field, radius), 1.0, atol=0.1)
    losses = pd.read_csv(out / "losses.csv")
    assert set(losses["stage"]) == {"tangent"}
    assert np.isfinite(losses["total"]).all()
    assert 0.005 < ink(out / "field.png") < 0.9


def turning(field, radius):
    """How much of m runs along a circle counter-clockwise."""
    x = circle(radius, 200)
    return (field(x) * circle(1.0, 200)[:, ::-1] * [-1, 1]).sum(axis=1)


@pytest.fixture
def quick(run, inputs, tmp_path, monkeypatch):
    """Trains on a file of inputs for a moment: (file, options) -> (summary, field)."""
    monkeypatch.setattr(figures, "training_figure", lambda field, history: Figure())

    def make(file, *options, recipe="exact"):
        few = ("--tangent-iterations", 1, "--max-restarts", 0, "--recipe", recipe)
        out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
        assert run("train", "--points", inputs / file, *few, *options, "--out", out) == 0
        return summary_of(out), load_field(out / "field.safetensors")

    return make


def test_the_options_of_an_open_path(quick, capsys):
    for file, options, end in (
        ("arc.csv", (), 2.0),
        ("arc.csv", ("--direction", "reverse"), -2.0),
        ("arc.csv", ("--start", "2.5, -1"), -2.0),
        ("moving.csv", (), -2.0),
        # A choice comes before the recorded velocities.
        ("moving.csv", ("--start", "-2,0"), 2.0),
    ):
        summary, field = quick(file, "--open", *options)
        assert [piece["closed"] for piece in summary["pieces"]] == [False]
        assert summary["pieces"][0]["length"] == pytest.approx(2 * np.pi, rel=0.02)
        np.testing.assert_allclose(field.ends, [[end, 0.0]], atol=0.05)
        np.testing.assert_allclose(summary["ends"], field.ends)
        given = {"--direction": summary["direction"], "--start": summary["start"]}
        chosen = {"--direction": "reverse"} if "reverse" in options else {}
        if "--start" in options:
            chosen["--start"] = [float(x) for x in options[1].split(",")]
        assert {name: value for name, value in given.items() if value is not None} == chosen
        # Waypoints of an open path are always resampled, and none of these was a stray.
        assert summary["open"] is summary["resampled"] is True
        shown = capsys.readouterr().out
        assert "1 open" in shown
        assert "resampled" in shown
        assert "closed" not in shown
        assert "left out" not in shown


def test_the_same_arc_can_be_closed_and_learned_with_other_settings(quick):
    summary, field = quick("arc.csv", "--closed", "--sigma", 0.25)
    assert field.sigma == summary["sigma"] == 0.25
    assert summary["settings"]["tangent_iterations"] == 1
    assert summary["settings"]["max_restarts"] == 0
    assert [piece["closed"] for piece in summary["pieces"]] == [True]
    assert summary["open"] is False
    assert len(field.ends) == 0


def test_what_was_done_to_the_waypoints_is_told(quick, capsys):
    for file, dropped, resampled in (("ring.csv", 0, False), ("strayed.csv", 2, True)):
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
    # The paper learns from the waypoints as they are.
    summary, _ = quick("strayed.csv", "--score-iterations", 5, recipe="paper")
    assert (summary["dropped"], summary["resampled"]) == (0, False)
    assert summary["settings"]["score_iterations"] == 5


def test_each_piece_has_its_direction(quick):
    named = ("two.csv", "--columns", "east,north", "--tangent-iterations", 200)
    summary, field = quick(*named, "--direction", "-,cw")
    assert summary["direction"] == [None, "cw"]
    assert turning(field, 2.0).mean() > 0.8
    assert turning(field, 1.0).mean() < -0.8
    summary, _ = quick(*named[:3], "--direction", "reverse, ccw")
    assert summary["direction"] == ["reverse", "ccw"]
    assert set(OFFERED) == set(DIRECTIONS)


def test_shapes_are_listed_and_sampled_as_asked(run, inputs, quick, tmp_path, capsys):
    assert run("shapes") == 0
    assert "concentric-flight" in capsys.readouterr().out.split()
    more = ("--num-points", 120, "--noise", 0.02, "--sampling", "random", "--seed", 4)
    few = ("--recipe", "exact", "--tangent-iterations", 1, "--max-restarts", 0)
    assert run("train", "--shape", "star", *more, *few, "--out", tmp_path / "out") == 0
    cloud = load_field(tmp_path / "out" / "field.safetensors").cloud
    expected, _ = make_shape("star", 120, noise=0.02, seed=4, sampling="random")
    assert (cloud.digest, cloud.shape) == (expected.digest, "star")
    assert PointCloud.read(inputs / "ring.csv").digest != cloud.digest


def test_a_network_that_was_found_is_trained_on_and_kept(run, inputs, tmp_path):
    """Backwards, as `sgvf paths` was asked to; and nothing else can be asked of it then."""
    found, out = tmp_path / "found", tmp_path / "out"
    points = inputs / "arc.csv"
    assert run("paths", points, "--direction", "reverse", "--out", found) == 0
    few = ("--recipe", "exact", "--tangent-iterations", 1, "--max-restarts", 0)
    assert run("train", "--network", found / "network.json", *few, "--out", out) == 0
    field = load_field(out / "field.safetensors")
    (line,) = field.network.path.pieces
    np.testing.assert_allclose(line.vertices[[0, -1]], [[2, 0], [-2, 0]], atol=0.05)
    np.testing.assert_allclose(field.ends, [[-2.0, 0.0]], atol=0.05)
    assert field.network.length == PathNetwork.load(found / "network.json").length


@pytest.fixture
def eight(tmp_path):
    angle = np.linspace(0, 2 * np.pi, 300, endpoint=False)
    eight = pd.DataFrame({"x": 3 * np.sin(angle), "y": 3 * np.sin(2 * angle) / 2})
    eight.to_csv(tmp_path / "eight.csv", index=False)
    return tmp_path / "eight.csv"


def test_paths_that_cross_get_a_directed_field(run, refused, eight, tmp_path):
    out = tmp_path / "out"
    command = ("train", "--points", eight, "--recipe", "exact", "--out", out)
    assert run(*command) == 0
    summary = summary_of(out)
    assert summary["directed"]
    assert summary["self_check_passed"]
    assert [piece["is"] for piece in summary["pieces"]] == [
        "closed path, length 18.29, with 1 crossing"
    ]
    assert run("follow", out, "--out", tmp_path / "follow", "--starts", 16) == 0
    followed = summary_of(tmp_path / "follow")
    assert followed["lap_fraction"] == followed["straight_fraction"] == 1
    assert followed["cross_track_rms"] < 0.01 * followed["unit_length"]
    # What knows no directed fields yet says so.
    for name in ("verify", "singularities"):
        line = refused(name, out, "--out", tmp_path / name)
        assert "directed field m(x, g)" in line
        assert not (tmp_path / name).exists()
    assert "no edge 7" in refused("follow", out, "--out", tmp_path / "no", "--route", "7")
    line = refused("follow", out, "--out", tmp_path / "no", "--reference", eight)
    assert "measured against its own network" in line


def test_paths_that_cross_are_refused_by_the_recipe_of_the_paper(run, refused, eight, tmp_path):
    few = ("--tangent-iterations", 1, "--score-iterations", 1, "--recipe", "paper")
    command = ("train", "--points", eight, *few, "--out", tmp_path / "out")
    line = refused(*command)
    assert "piece 1 is a closed path, length 18.29, with 1 crossing" in line
    assert "--anyway" in line
    assert not (tmp_path / "out").exists()
    assert run(*command, "--anyway") == 0
    assert load_field(tmp_path / "out" / "field.safetensors").network.count("crossing") == 1


# Bad input: arguments, and what the one line names.

BAD = [
    ("--shape cirle", "'cirle'", "did you mean 'circle'"),
    ("", "--points", "--shape"),
    ("--points ring.csv --shape circle", "--points", "--shape"),
    ("--points ring.csv --noise 0.1", "--noise is for --shape"),
    ("--points none.csv", "none.csv", "no such file"),
    ("--points .", "is a folder"),
    ("--points empty.csv", "empty.csv", "it is empty"),
    ("--points header.csv", "header.csv", "only a header"),
    ("--points nan.csv", "nan.csv, line 3", "y is missing"),
    ("--points unnamed.csv", "cannot tell which of its 3 columns", "--columns 0,1"),
    ("--points text.csv", "text.csv, line 3", "'here'"),
    ("--points ragged.csv", "ragged.csv, line 4", "3 fields"),
    ("--points ring.csv --columns x,q", "ring.csv", "no column 'q'", "'x', 'y'"),
    ("--points ring.csv --columns 0,7", "ring.csv", "no column 7"),
    ("--points ring.csv --network network.json", "give one of --points FILE, --shape NAME"),
    ("--network ring.csv", "ring.csv is no network"),
    ("--network none.json", "none.json", "no such file"),
    ("--shape circle --columns x,y", "--columns x,y", "--points"),
    ("--points one.csv", "one.csv", "at least 2 waypoints"),
    ("--points same.csv", "same.csv", "coincide"),
    ("--points thin.csv", "thin.csv", "two columns"),
    ("--points flat.npy", "flat.npy", "(8,)"),
    ("--points bad_velocity.csv", "line 3", "'fast'"),
    ("--shape circle --seed -1", "seed", "-1"),
    ("--shape circle --noise -0.1", "noise", "-0.1"),
    ("--shape circle --noise nan", "noise", "nan"),
    ("--shape circle --num-points 2", "num_points", "2"),
    ("--points arc.csv --direction left", "--direction", "'left'", "ccw, cw, reverse"),
    ("--points arc.csv --direction cw,-,cw", "direction has 3 entries", "1 piece"),
    (
        "--points arc.csv --open --direction cw",
        *("direction 'cw'", "closed paths in the plane"),
    ),
    ("--points arc.csv --start 1;2", "--start", "'1;2'"),
    ("--points arc.csv --start 1", "--start", "'1'"),
    ("--points arc.csv --start nan,0", "--start", "'nan,0'"),
    ("--points arc.csv --start 1,2,3", "start has 3 coordinates", "have 2"),
    ("--points arc.csv --recipe paper --direction ccw", "--direction", "paper"),
    ("--points arc.csv --recipe paper --closed", "--closed", "paper"),
    (
        "--points arc.csv --recipe exact --score-iterations 9",
        *("--score-iterations", "exact"),
    ),
    ("--points arc.csv --sigma -1", "sigma", "-1.0"),
    ("--points arc.csv --sigma nan", "sigma", "nan"),
    ("--points arc.csv --tangent-iterations 0", "tangent_iterations cannot be 0"),
    ("--points arc.csv --max-restarts -1", "max_restarts cannot be -1"),
]


@pytest.mark.parametrize("case", BAD, ids=[case[0] for case in BAD])
def test_bad_input_is_one_line(refused, inputs, tmp_path, monkeypatch, case):
    arguments, *words = case
    monkeypatch.chdir(inputs)
    line = refused("train", *arguments.split(), "--out", tmp_path / "deep" / "out")
    for text in words:
        assert text in line
    assert names_in(tmp_path) == set()
