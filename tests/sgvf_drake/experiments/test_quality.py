"""The quality harness of learning: its clouds, its measures, and that it loses nothing."""

from dataclasses import replace
import io
import re
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from rich.console import Console
from scipy.spatial import cKDTree

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import clouds, workbench
from sgvf_drake.experiments.quality import (
    Case,
    Suite,
    measures,
    print_summary,
    run_suite,
    running,
    suite_cases,
)
from sgvf_drake.experiments.quality.__main__ import main
from sgvf_drake.experiments.quality.cases import RECIPES
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.paths import SHAPES, make_shape, shape_path

ALL = [case for suite in Suite for case in suite_cases(suite)]
CLOUDS = sorted({(case.cloud, case.sampling) for case in ALL})
# Trained on the closed-form score in about a second; good enough to be followed.
TINY = Case(
    "tiny",
    "circle",
    recipe="exact",
    starts=9,
    overrides=(("tangent_iterations", 300), ("max_restarts", 0)),
)
NOWHERE = Case("tiny", "nowhere")


def gap(piece, apart):
    """The smallest distance between points of a piece with this much arc in between."""
    count = round(piece.length / 0.02)
    points, step = piece.sample(count), piece.length / count
    first, second = cKDTree(points).query_pairs(1.0, output_type="ndarray").T
    along = np.abs(first - second) * step
    far = np.minimum(along, piece.length - along) > apart
    return np.linalg.norm(points[first[far]] - points[second[far]], axis=1).min()


# The clouds.


# Steps are the mean, at random up to 8 times that, where uneven 1 / (1 - 9 / 11).
WIDEST = {"uniform": 1.1, "random": 8.0, "uneven": 5.6, "vertices": 1.0}


def test_clouds_lie_on_their_path_and_cover_it():
    for path, sampling in CLOUDS:
        check_cloud(path, sampling)


def check_cloud(path, sampling):
    named = f"{path}, {sampling}"
    how = clouds.SAMPLINGS[sampling]
    cloud, reference = clouds.make_cloud(path, sampling, seed=0)
    distance = reference.project(cloud.points).distance
    tolerance = 1e-5 * cloud.unit_length
    on_path = distance <= 5.5 * how.noise + tolerance
    assert (~on_path).sum() <= round(how.outliers * cloud.num_points), named
    if how.spread != "vertices":
        assert cloud.num_points == how.copies * how.num_points, named
    if how.noise:
        rms = np.sqrt((distance**2).mean())
        # Of 40 waypoints the RMS is uncertain by 11 %, and the path bends.
        assert 0.6 * how.noise < rms < 1.4 * how.noise, named
    assert reference.dim == cloud.dim
    assert (reference.lengths > 0).all()
    assert reference.closed.all() == (path not in clouds.HANDWRITING), named
    path_points = np.concatenate([piece.sample(500) for piece in reference.pieces])
    nearest = cKDTree(cloud.points).query(path_points)[0]
    # Where an outlier was, the hole is a step wider on either side, or more.
    widest = WIDEST[how.spread] + 4 * (how.outliers > 0)
    spacing = reference.lengths.sum() / how.num_points
    assert nearest.max() <= widest / 2 * spacing + 5.5 * how.noise, named


def test_the_seed_decides_a_cloud_and_the_order_of_its_waypoints_says_nothing():
    for sampling in ("uniform", "random-noisy", "uneven", "outliers"):
        first, again, other = (
            clouds.make_cloud("square", sampling, seed)[0].points for seed in (3, 3, 4)
        )
        np.testing.assert_array_equal(first, again)
        assert not np.array_equal(first, other)
    for path, sampling in (("hairpin", "uniform"), ("Angle", "recorded")):
        cloud, reference = clouds.make_cloud(path, sampling, seed=0)
        arc = reference.project(cloud.points).arc
        assert abs(np.corrcoef(arc[:-1], arc[1:])[0, 1]) < 0.3


def test_samplings_are_what_they_say():
    # Those of named shapes are those of the command line.
    cloud, _ = clouds.make_cloud("star", "random-noisy", seed=5)
    expected, _ = make_shape("star", noise=0.05, seed=5, sampling="random")
    assert (cloud.digest, cloud.shape) == (expected.digest, "star")
    cloud, reference = clouds.make_cloud("circle", "uneven", seed=0)
    steps = np.diff(np.sort(reference.project(cloud.points).arc))
    assert steps.max() / steps.min() == pytest.approx(10, rel=0.02)
    cloud, _ = clouds.make_cloud("square", "duplicates", seed=0)
    _, counts = np.unique(cloud.points, axis=0, return_counts=True)
    assert counts.tolist() == [3] * 200
    # Outliers are anywhere in the box.
    cloud, reference = clouds.make_cloud("square", "outliers", seed=0)
    off = cloud.points[reference.project(cloud.points).distance > 1e-6]
    assert len(off) == 10
    assert np.abs(off).max() <= 3.0
    assert np.ptp(off, axis=0).min() > 2.0


def test_paths_are_what_they_say():
    rings = shape_path("concentric-flight")
    for path, factor in (("millimetres", 1e3), ("kilometres", 1e-3)):
        lengths = clouds.true_path(path).lengths
        np.testing.assert_allclose(lengths, factor * rings.lengths, rtol=1e-12)
    # The hairpin is long and thin.
    (piece,) = clouds.true_path("hairpin").pieces
    assert piece.length == pytest.approx(2 * 8.0 + np.pi * 0.3, rel=1e-5)
    assert gap(piece, apart=1.0) == pytest.approx(0.3, rel=1e-3)
    np.testing.assert_allclose(np.ptp(piece.vertices, axis=0), [8.3, 0.3], rtol=1e-5)


def test_circuits_differ_and_fold_without_crossing():
    pieces = [clouds.true_path(path).pieces[0] for path in clouds.CIRCUITS]
    assert len({round(piece.length, 3) for piece in pieces}) == len(clouds.CIRCUITS)
    for piece in pieces:
        assert gap(piece, apart=1.5) == pytest.approx(clouds.CIRCUIT_GAP, rel=0.02)
        # Smooth: between neighbouring vertices the heading turns by a few degrees at most.
        edges = np.diff(piece.vertices, axis=0, append=piece.vertices[:1])
        heading = np.arctan2(edges[:, 1], edges[:, 0])
        turn = np.diff(np.unwrap(np.append(heading, heading[0])))
        assert np.abs(turn).max() < np.radians(6)
        # Once around, to the left.
        assert turn.sum() == pytest.approx(2 * np.pi)


def write_track(file, radius=3.0):
    """A file as those of race tracks: centre line and widths, the start not repeated."""
    angle = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    rows = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), *[angle] * 2])
    np.savetxt(file, rows, delimiter=",", header="x_m,y_m,w_right_m,w_left_m")
    return rows[:, :2]


def test_files_are_measured_against_themselves_in_order(tmp_path):
    points = write_track(tmp_path / "track.csv")
    cloud, reference = clouds.make_cloud("track", "recorded", 0, str(tmp_path / "track.csv"))
    assert not np.array_equal(cloud.points, points)
    np.testing.assert_array_equal(
        cloud.points[np.lexsort(cloud.points.T)], points[np.lexsort(points.T)]
    )
    assert reference.closed.tolist() == [True]
    np.testing.assert_array_equal(reference.pieces[0].vertices, points)


# The suites.


def test_the_suites_are_what_they_say():
    cases = suite_cases(Suite.CLOSED)
    assert {case.cloud for case in cases} == set(SHAPES)
    assert len(cases) == 5 * len(SHAPES)
    assert {(case.recipe, case.starts) for case in cases} == {("robust", 400)}
    parts = (Suite.CLOSED, Suite.ROBUSTNESS, Suite.HANDWRITING)
    assert set(suite_cases(Suite.FULL)) == {
        case for part in parts for case in suite_cases(part)
    }
    # The recipes are compared on the same clouds.
    cases = suite_cases(Suite.RECIPES)
    assert set(cases) < set(suite_cases(Suite.ROBUSTNESS))
    assert len(cases) == 2 * 3 * 3
    same = {replace(case, recipe="") for case in cases}
    assert {replace(case, recipe=recipe) for case in same for recipe in RECIPES} == set(cases)
    for case in suite_cases(Suite.HANDWRITING):
        assert dict(case.overrides) == {"open": True}
        assert not clouds.true_path(case.cloud).closed.any()
    cases = suite_cases(Suite.CLOSED, seeds=2, starts=7)
    assert {(case.seed, case.starts) for case in cases} == {(0, 7), (1, 7)}


def test_keys_are_unique_and_safe_for_files(tmp_path):
    for name in ("own track.csv", "own_track.csv"):
        write_track(tmp_path / name)
    cases = {*ALL, *suite_cases(Suite.SMALL, circuits=tmp_path)}
    # Also where file names do not tell upper from lower case.
    keys = [case.key.lower() for case in cases]
    assert len(set(keys)) == len(keys)
    assert all(re.fullmatch(r"[a-z0-9_.-]+", key) for key in keys)


def test_unknown_clouds_and_bad_suites_are_refused(tmp_path):
    for path, sampling in (("nowhere", "uniform"), ("circle", "never")):
        with pytest.raises(ConfigurationError, match=r"there is no .*(nowhere|never)"):
            clouds.make_cloud(path, sampling, 0)
    for arguments in ((0,), (1, 0)):
        with pytest.raises(ConfigurationError, match="must be at least 1"):
            suite_cases(Suite.CLOSED, *arguments)
    with pytest.raises(ConfigurationError, match=r"no \.csv file"):
        suite_cases(Suite.SMALL, circuits=tmp_path)


# The measures of the score.


def rotation(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def test_the_score_is_compared_by_angle_and_curl():
    def score(x):
        return -x

    spiral = np.array([[-1.0, -0.5], [0.5, -1.0]])
    field = SimpleNamespace(
        dim=2,
        sigma=0.1,
        cloud=make_shape("circle")[0],
        score=score,
        mixture=SimpleNamespace(score=lambda x: 2 * score(x) @ rotation(np.pi / 6).T),
        tangent=lambda x: score(x) @ rotation(np.pi / 3).T,
        score_model=SimpleNamespace(
            score_and_jacobian=lambda z: (score(z), np.tile(spiral, (len(z), 1, 1)))
        ),
    )
    found = measures.measure_score(field, shape_path("circle"), seed=0)
    assert found["score_cosine"] == pytest.approx(np.cos(np.pi / 6))
    assert found["score_cosine_p5"] == pytest.approx(np.cos(np.pi / 6))
    assert found["orthogonality"] == pytest.approx(np.cos(np.pi / 3))
    # |dSx/dy - dSy/dx| = 1.
    assert found["score_curl"] == pytest.approx(1 / np.linalg.norm(spiral))


def test_the_bias_is_how_far_the_path_moves(make_field):
    # The ridge of a shifted mixture is shifted; what counts is the part across the circle,
    # whose mean is 2 / pi.
    shift = 0.01
    cloud, path = make_shape("circle")
    points = cloud.normalize(cloud.points) + np.array([shift, 0.0])
    field = replace(
        make_field("exact"), cloud=cloud, sigma=0.2, score_model=GaussianMixture(points, 0.2)
    )
    found = measures.measure_score(field, path, seed=0)["score_bias_u"]
    assert found == pytest.approx(2 / np.pi * shift, rel=0.05)


def test_points_near_the_path_are_near_every_strand_of_it(make_field):
    reference = clouds.true_path("hairpin")
    cloud = PointCloud(reference.pieces[0].sample(200))
    field = replace(make_field("exact"), cloud=cloud)
    x = measures._near_path(field, reference, np.random.default_rng(0))
    distance = reference.project(x).distance / cloud.unit_length
    assert len(x) > 500
    assert distance.min() >= 0.03
    assert distance.max() <= 0.3


# What counts as falling short.

GOOD = {
    **{"reach": 1.0, "lap": 1.0, "end": None, "stall": 0.0, "leave": 0.0},
    **{"self_check_passed": True, "self_check_message": "fine", "error": None},
}


def test_failures_are_in_words():
    for change, text in (
        ({}, None),
        ({"lap": None, "end": 1.0}, None),
        ({"lap": 0.965}, "lap 96.5%, self-check passed"),
        ({"lap": None, "end": 0.5}, "end 50.0%, self-check passed"),
        ({"stall": 0.1, "self_check_passed": False}, "stall 10.0%, self-check: fine"),
        ({"self_check_passed": False}, "self-check: fine"),
    ):
        assert measures.failure({**GOOD, **change}) == text


# Running, once in earnest.


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    folder = tmp_path_factory.mktemp("quality") / "deep" / "out"
    calls = []
    table = run_suite([NOWHERE, TINY], folder, lambda *call: calls.append(call))
    return SimpleNamespace(folder=folder, table=table, calls=calls)


def test_a_case_is_measured(measured):
    row = measured.table.iloc[0]
    assert row["key"] == TINY.key
    assert row["lap"] == row["reach"] == 1.0
    assert row["stall"] == row["leave"] == 0.0
    assert pd.isna(row["end"])
    assert 0 < row["rms_u"] <= row["max_u"] < 0.1
    assert 0.9 < row["speed_min"] <= row["speed_max"] < 1.1
    # The exact recipe is its own oracle.
    assert row["score_cosine"] == pytest.approx(1.0)
    assert max(row["score_bias_u"], row["score_curl"]) < 1e-9
    assert row["orthogonality"] < 0.1
    assert row["unit_length"] == pytest.approx(0.75, rel=1e-3)
    assert (row["num_points"], row["restarts"]) == (200, 0)
    assert row["train_cpu_s"] > 0
    assert row["wall_s"] > 0
    assert (measured.folder / row["folder"] / running.FIGURE).stat().st_size > 1000


def test_an_error_is_a_row_of_the_table(measured):
    row = measured.table.iloc[1]
    assert row["error"].startswith("ConfigurationError: there is no path 'nowhere'")
    assert row["failure"] == row["error"]
    assert pd.isna(row["lap"])


def test_the_tables_hold_what_is_returned_and_progress_tells_every_case(measured):
    names = {path.name for path in measured.folder.iterdir()}
    assert names == {"trials", "table.csv", "table.parquet"}
    assert [path.name for path in measured.folder.parent.iterdir()] == ["out"]
    parquet = pd.read_parquet(measured.folder / "table.parquet")
    pd.testing.assert_frame_equal(parquet, measured.table)
    csv = pd.read_csv(measured.folder / "table.csv")
    assert csv["key"].tolist() == measured.table["key"].tolist()
    np.testing.assert_allclose(csv["rms_u"], measured.table["rms_u"])
    assert measured.calls[0][0].startswith(f"{NOWHERE.key}: ConfigurationError")
    assert measured.calls[1][0].startswith(f"{TINY.key}: ")
    assert [call[1:] for call in measured.calls] == [(1, 2), (2, 2)]


# Running without the work, by the bench of the experiments.

FAILING, DONE = {}, []


def measure_fake(case, folder):
    """Stands in for `measure_case`: counts, and fails where told to."""
    if case.seed in FAILING:
        raise FAILING[case.seed]
    DONE.append(case.seed)
    figures = dict.fromkeys(running.MEASURES, 0.5) | {"restarts": 0, "num_points": 9}
    return {**figures, **GOOD, "failure": None}


@pytest.fixture
def work(monkeypatch):
    FAILING.clear()
    DONE.clear()
    monkeypatch.setattr(running, "measure_case", measure_fake)
    return SimpleNamespace(done=DONE, failing=FAILING)


CASES = [Case("fake", "circle", seed=seed) for seed in (2, 0, 1)]


def test_finished_cases_are_kept_and_those_that_failed_run_again(tmp_path, work):
    work.failing[0] = ValueError("of no use")
    table = run_suite(CASES, tmp_path)
    assert table["error"].tolist() == ["ValueError: of no use", pd.NA, pd.NA]
    del work.failing[0]
    table = run_suite(CASES, tmp_path)
    assert work.done == [2, 1, 0]
    assert table["error"].isna().all()
    assert table["seed"].tolist() == [0, 1, 2]
    calls = []
    again = run_suite(CASES, tmp_path, lambda *call: calls.append(call))
    pd.testing.assert_frame_equal(again, table)
    assert calls[-1] == (f"{CASES[-1].key}: ok", 3, 3)
    run_suite([replace(CASES[0], starts=5), *CASES[1:]], tmp_path)
    assert work.done == [2, 1, 0, 2]


def test_a_changed_source_is_run_again(tmp_path, work):
    def circuits():
        cases = suite_cases(Suite.SMALL, seeds=1, circuits=tmp_path)
        return [case for case in cases if case.name == "circuits"]

    write_track(tmp_path / "track.csv")
    for _ in range(2):
        run_suite(circuits(), tmp_path / "out")
    assert work.done == [0]
    write_track(tmp_path / "track.csv", radius=2.0)
    run_suite(circuits(), tmp_path / "out")
    assert work.done == [0, 0]


def test_results_of_other_code_are_reused_only_if_asked(tmp_path, work, monkeypatch):
    run_suite(CASES, tmp_path)
    monkeypatch.setattr(workbench, "code_digest", lambda *roots: "other")
    kept = run_suite(CASES, tmp_path, any_code=True)
    assert len(work.done) == 3
    assert "other" not in kept["code"].tolist()
    fresh = run_suite(CASES, tmp_path)
    assert len(work.done) == 6
    assert fresh["code"].tolist() == ["other"] * 3


def test_the_same_key_twice_is_refused(tmp_path, work):
    with pytest.raises(ConfigurationError, match="fake-circle-uniform-robust-seed0"):
        run_suite([*CASES, replace(CASES[1], starts=5)], tmp_path)
    with pytest.raises(ConfigurationError, match="jobs must be at least 1"):
        run_suite(CASES, tmp_path, jobs=0)
    assert work.done == []


# The command line.


def printed(table, width=80):
    out = io.StringIO()
    print_summary(table, Console(file=out, width=width))
    return out.getvalue().splitlines()


def test_failures_are_printed_first(tmp_path, work):
    work.failing[1] = ValueError("of [no] use")
    table = run_suite(CASES, tmp_path)
    lines = printed(table)
    assert lines[0] == "1 of 3 cases fall short"
    assert lines[1].strip() == f"{CASES[2].key}: ValueError: of [no] use"
    (group,) = [line.split() for line in lines if line.startswith("circle uniform")]
    assert group[2:6] == ["robust", "2/3", "100.0%", "-"]
    table.loc[0, "code"] = "other"
    assert "these are results of several versions of the code" in printed(table)


def test_the_summary_fits_in_a_terminal(tmp_path, work):
    cases = [
        Case("fake", "concentric-circles", "random-noisy"),
        *suite_cases(Suite.HANDWRITING),
    ]
    lines = printed(run_suite(cases, tmp_path))
    assert not any("\N{HORIZONTAL ELLIPSIS}" in line for line in lines)
    assert max(map(len, lines)) <= 80


@pytest.mark.parametrize(("failing", "status"), [({}, 0), ({0: ValueError("no")}, 1)])
def test_the_command_runs_a_suite_and_adds_circuits(tmp_path, work, capsys, failing, status):
    work.failing.update(failing)
    write_track(tmp_path / "track.csv")
    more = ["--starts", "4", "--circuits", str(tmp_path), "--seeds", "2"]
    with pytest.raises(SystemExit) as stop:
        main(["--out", str(tmp_path / "out"), "--suite", "small", *more])
    assert stop.value.code == status
    table = pd.read_csv(tmp_path / "out" / "table.csv")
    small = {case.key for case in suite_cases(Suite.SMALL, seeds=2)}
    assert small < set(table["key"])
    assert set(table["starts"]) == {4}
    assert table.loc[table["name"] == "circuits", "shape"].tolist() == ["track", "track"]
    assert "[16/16]" in capsys.readouterr().out


def test_bad_input_is_one_line(tmp_path, work, capsys):
    with pytest.raises(SystemExit) as stop:
        main(["--out", str(tmp_path), "--circuits", str(tmp_path)])
    assert stop.value.code == 2
    assert capsys.readouterr().err.startswith("error: ")
    assert work.done == []
