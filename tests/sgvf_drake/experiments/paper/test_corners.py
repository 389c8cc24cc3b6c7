"""Corners: places and traps on planted fields, who pauses, verdicts both ways, a small run."""

from dataclasses import replace
import json
from types import SimpleNamespace

from matplotlib.image import imread
import numpy as np
import pandas as pd
import pytest

from sgvf_drake import learning
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.outcome import Verdict
from sgvf_drake.experiments.paper.corners import trials as corners_trials
from sgvf_drake.experiments.paper.corners.claims import corner_claims
from sgvf_drake.experiments.paper.corners.experiment import Corners
from sgvf_drake.experiments.paper.corners.traps import (
    Places,
    Traps,
    even_share,
    examine,
    slow_down,
    slowest_corner,
    ways,
)
from sgvf_drake.experiments.paper.corners.trials import (
    RADIUS,
    CornerTrial,
    measure_corners,
    paused,
    polygon_cloud,
)
from sgvf_drake.experiments.results import plain
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.fields import GuidingField, Perceptron, RobustComposition, ScoreNetwork
from sgvf_drake.paper import load_scenario, run_scenario
from sgvf_drake.paths import PointCloud
from sgvf_drake.paths.shapes import regular_polygon

# Half the side of the square, whose half-extent is 4 U.
HALF = RADIUS / np.sqrt(2)
UNIT = HALF / 4
NETWORKS = ("shallow", "deep", "robust")
FIGURES = ("corners.png", "corners_near.png", "corner_angles.png")


def in_square(*points):
    """Points in U, in the unit of the waypoints."""
    return UNIT * np.array(points, dtype=float)


# Where things are.


def test_places_are_seen_from_the_nearest_corner():
    # The sides run (-4, -4), (4, -4), (4, 4), (-4, 4).
    points = in_square((3.7, -4.0), (4.1, -3.8), (-3.9, 3.9), (0.5, -3.0))
    places = Places.of(points, 4, UNIT)
    assert places.corner.tolist() == [1, 1, 3, 1]
    np.testing.assert_allclose(places.offset, [-0.3, 0.2, 0.1, -3.5], atol=1e-9)
    np.testing.assert_allclose(
        places.distance, [0.3, np.hypot(0.1, 0.2), np.hypot(0.1, 0.1), np.hypot(3.5, 1)]
    )
    np.testing.assert_allclose(places.outside, [0, 0.1, -0.1, -1], atol=1e-9)
    np.testing.assert_allclose(places.from_path, [0, 0.1, 0.1, 1], atol=1e-9)
    assert places.near.tolist() == [True, True, True, False]


@pytest.mark.parametrize("corners", [3, 5, 8, 12])
def test_places_on_any_polygon(corners):
    path = regular_polygon(corners, RADIUS)
    side = path.longest / corners
    shift = np.linspace(-0.4, 0.4, 5) * side
    arc = np.add.outer(np.arange(corners) * side, shift).ravel() % path.longest
    places = Places.of(path.pieces[0].at(arc), corners, 0.7)
    assert places.corner.tolist() == np.repeat(np.arange(corners), 5).tolist()
    np.testing.assert_allclose(places.offset, np.tile(shift / 0.7, corners), atol=1e-9)
    assert np.abs(places.outside).max() < 1e-9


@pytest.mark.parametrize("corners", [3, 4, 12])
def test_the_even_share_is_that_of_points_drawn_evenly(corners):
    path = regular_polygon(corners, RADIUS)
    unit = PointCloud(path.pieces[0].vertices).unit_length
    points = path.pieces[0].sample(60_000)
    share = (np.abs(Places.of(points, corners, unit).offset) <= 0.5).mean()
    assert even_share(corners, unit) == pytest.approx(share, abs=1e-3)


def test_the_least_speed_is_read_near_corners_and_on_the_middle_of_sides():
    speed = np.full((4, 100), 0.9)
    # 0.4 U before corner 2 (side 1 ends there), and past the window of corner 0.
    speed[1, 95] = 0.1
    speed[0, 8] = 0.2
    # Inside the middle of side 3, and outside of it.
    speed[3, 52] = 0.5
    speed[2, 35] = 0.3
    corner, side = slow_down(speed, side=8.0)
    assert corner == pytest.approx((0.1 + 3 * 0.9) / 4)
    assert side == pytest.approx((0.5 + 3 * 0.9) / 4)
    np.testing.assert_allclose(slowest_corner(speed), in_square(4, 4))


# Traps.


def row_with(points, stable, **others):
    count = len(points)
    return {
        "unit": UNIT,
        "zeros": points,
        "zeros_stable": stable,
        "undecided": 0,
        "zeros_score": np.linspace(0.1, 0.2, count),
        **others,
    }


def test_traps_are_the_stable_zeros_on_the_path_seen_in_the_direction_of_travel():
    points = in_square((3.8, -4.0), (-4.0, -3.7), (0.0, 0.0), (4.0, 3.9), (1.0, 4.0))
    row = row_with(points, [True, True, True, False, True])
    counter_clockwise = np.ones((4, 100))
    traps = Traps.of(row, counter_clockwise)
    assert traps.places.corner.tolist() == [1, 0, 2]
    # The side after (-4, 4) ends at (-4, -4): 0.3 U from there is before it.
    np.testing.assert_allclose(traps.along, [-0.2, -0.3, 3.0], atol=1e-9)
    np.testing.assert_allclose(traps.score, [0.1, 0.125, 0.2])
    np.testing.assert_allclose(Traps.of(row, -counter_clockwise).along, -traps.along)
    np.testing.assert_allclose(traps.at_corners, [[-0.2, 0, 0.2], [-0.3, 0, 0.3]], atol=1e-9)


def test_a_trap_between_sides_that_run_against_each_other_is_told_apart():
    progress = np.ones((4, 100))
    progress[1] = -1.0
    # Only the middle of a side counts.
    progress[1, :30] = progress[2, 70:] = 1.0
    assert ways(progress).tolist() == [1, -1, 1, 1]
    row = row_with(in_square((3.9, -4.0), (-4.0, 4.0)), [True, True])
    traps = Traps.of(row, progress)
    assert traps.clash.tolist() == [True, False]
    assert np.isnan(traps.along).tolist() == [True, False]


def test_a_field_is_examined():
    final = in_square((4, 3.9), (4, 3.9), (0, 4), (-4, 2), (-4, -4))
    row = row_with(
        in_square((4, 3.9), (-4.0, 3.9), (-4.1, 4)),
        [True, True, True],
        final=final,
        stalled=[True, True, True, False, False],
        lapped=[False, False, False, True, True],
        paused=[False, False, False, False, True],
        rms=None,
        max=2 * UNIT,
    )
    along = {"speed": np.full((4, 100), 0.5), "progress": np.ones((4, 100))}
    found = examine(row, along, 4)
    assert found["stalled"] == pytest.approx(0.6)
    assert found["stalled_near"] == pytest.approx(0.4)
    assert found["near"] == pytest.approx(2 / 3)
    assert (found["lapped"], found["paused"]) == (pytest.approx(0.4), pytest.approx(0.2))
    # Two of the three traps share a corner.
    assert found["trapped"] == found["trapped_locally"] == 0.5
    assert (found["turns"], found["max"]) == (0, pytest.approx(2))
    assert np.isnan(found["rms"])
    along["progress"][2] = -1.0
    against = examine(row, along, 4)
    assert (against["turns"], against["trapped"]) == (2, 0.5)
    assert against["trapped_locally"] == 0.0


class PlantedResult:
    """Stands for a training whose field leads to one place from everywhere."""

    def __init__(self, cloud, sink):
        # A score so weak that the tangent decides alone.
        weak = Perceptron((np.column_stack([-1e-3 * np.eye(2), np.zeros(2)]),), (np.zeros(2),))
        self.field = GuidingField(
            cloud=cloud,
            sigma=0.1,
            score_model=ScoreNetwork(weak, 1.0),
            tangent_network=Perceptron((-np.eye(2),), (cloud.normalize(sink),)),
            composition=RobustComposition(0.2, 0.1),
            recipe="robust",
            seed=0,
        )
        self.self_check = SimpleNamespace(passed=False)
        self.restarts = 0


def test_agents_on_a_field_with_a_sink_near_a_corner_are_found_there(monkeypatch, tmp_path):
    # 0.3 U past the corner (4, 4), on the side that follows.
    sink = in_square(3.7, 4.0)
    asked = []

    def plant(cloud, config, score=None):
        asked.append((config, score))
        return PlantedResult(cloud, sink)

    monkeypatch.setattr(learning, "train", plant)
    trial = CornerTrial(4, 3, num_points=80, starts=16, patience=1.0, effort=0.5)
    row = json.loads(json.dumps(plain(measure_corners(trial, tmp_path))))
    shallow, deep, robust = (config for config, _ in asked)
    assert shallow.tangent_hidden == (128,)
    assert deep.tangent_hidden == (64, 64, 64, 64)
    assert shallow.score_iterations == deep.tangent_iterations == 5_000
    assert (robust.recipe, robust.score_iterations) == ("robust", 750)
    scores = [score for _, score in asked]
    assert (scores[0], scores[2]) == (None, None)
    assert isinstance(scores[1], ScoreNetwork)
    for name in NETWORKS:
        along = dict(np.load(tmp_path / f"{name}.npz"))
        found = examine(row[name], along, 4)
        assert found["stalled"] == found["stalled_near"] == 1.0
        assert (found["near"], found["lapped"], found["trapped"]) == (1.0, 0.0, 0.25)
        traps = Traps.of(row[name], along["progress"])
        np.testing.assert_allclose(traps.places.offset, [0.3], atol=0.02)
        # Both sides lead to the corner.
        assert traps.clash.tolist() == [True]
        assert (tmp_path / f"{name}.safetensors").is_file()
        assert along["speed"].shape == (4, corners_trials.SIDE_SAMPLES)


def test_the_waypoints_are_the_same_in_another_order():
    path = regular_polygon(6, RADIUS)
    trials = [CornerTrial(6, seed, 240, 1, 1.0, 1.0) for seed in (0, 1)]
    first, other = (polygon_cloud(path, trial).points for trial in trials)
    assert not np.array_equal(first, other)
    np.testing.assert_array_equal(np.unique(first, axis=0), np.unique(other, axis=0))
    # Every corner is one.
    gaps = np.linalg.norm(first[:, None] - path.pieces[0].vertices, axis=2).min(axis=0)
    assert gaps.max() < 1e-9


# Pauses.


def planted_run(ways_along, off=0.0):
    """Agents that move along a line by so many U of way at each time, sample by sample."""
    positions = np.stack([np.column_stack([way, 0 * way]) for way in ways_along], axis=1)
    steps, agents, _ = positions.shape
    return SimpleNamespace(
        times=0.05 * UNIT * np.arange(steps),
        positions=UNIT * positions,
        errors=np.full((steps, agents), off * UNIT),
        metrics=SimpleNamespace(
            stalled=np.array([np.ptp(way[-161:]) == 0 for way in ways_along])
        ),
    )


def test_who_stands_still_and_goes_on_has_paused():
    time = 0.05 * np.arange(800)
    moving = 0.2 * time
    still = np.interp(time, [0, 10, 20, 40], [0, 10, 10, 30])
    crawling = np.interp(time, [0, 10, 20, 40], [0, 10, 10.4, 30])
    short = np.interp(time, [0, 10, 16, 40], [0, 10, 10, 34])
    for_good = np.interp(time, [0, 10, 40], [0, 10, 10])
    twice = np.interp(time, [0, 8, 18, 25, 40], [0, 8, 8, 15, 15])
    run = planted_run([moving, still, crawling, short, for_good, twice])
    # Slow all the time is not still: 1.6 U in the time for 8.
    assert paused(run, UNIT).tolist() == [False, True, True, False, False, False]
    away = planted_run([moving, still], off=0.4)
    assert not paused(away, UNIT).any()
    # In half of the time for 8 U nobody can be seen to stand still.
    assert not paused(planted_run([0 * time[:80]]), UNIT).any()


# Verdicts.


def table_of(**changes):
    """Fields that do what the paper says; `network_corners_column` changes one column."""
    rows = [
        {
            "corners": corners,
            "angle": 180 - 360 / corners,
            "network": network,
            "seed": seed,
            "even": 0.125 if corners == 4 else 0.25,
            "stalled": 0.0,
            "stalled_near": 0.0,
            "near": np.nan,
            "trapped": 0.0,
            "trapped_locally": 0.0,
            "undecided": 0,
            "turns": 0,
            "paused": 0.0,
            "speed_corner": 0.6,
            "speed_side": 0.6,
        }
        for corners in (4, 6, 12)
        for network in NETWORKS
        for seed in range(5)
    ]
    table = pd.DataFrame(rows)
    defaults = {
        "shallow_4_stalled_near": [0.8, 0.9, 0.7, 0.9, 0.8],
        "shallow_4_near": 0.9,
        "shallow_4_trapped": [0.5, 0.75, 0.5, 1.0, 0.75],
        "shallow_4_trapped_locally": [0.5, 0.75, 0.5, 1.0, 0.75],
        "shallow_6_stalled_near": [0.1, 0.2, 0.3, 0.0, 0.2],
        "shallow_6_trapped": [0.3, 0.2, 0.3, 0.2, 0.2],
        "shallow_6_trapped_locally": [0.3, 0.2, 0.3, 0.2, 0.2],
        "shallow_4_speed_corner": [0.2, 0.1, 0.3, 0.2, 0.1],
        "shallow_6_speed_corner": [0.3, 0.4, 0.3, 0.2, 0.4],
        "shallow_4_paused": 0.1,
    }
    for name, values in {**defaults, **changes}.items():
        network, corners, column = name.split("_", 2)
        chosen = (table["network"] == network) & (table["corners"] == int(corners))
        table.loc[chosen, column] = values
    return table


def verdicts(table, norms=(0.01, 0.02)):
    return {claim.key: claim.verdict for claim in corner_claims(table, norms)}


def test_all_claims_hold_where_fields_do_what_the_paper_says():
    claims = corner_claims(table_of(), (0.01, 0.02))
    assert {claim.verdict for claim in claims} == {Verdict.HOLDS}
    assert len({claim.key for claim in claims}) == len(claims) == 6
    assert not any("nan" in claim.evidence for claim in claims)


@pytest.mark.parametrize(
    ("key", "changes", "verdict"),
    [
        ("corners-shallow-square", {"shallow_4_near": 0.1}, Verdict.PARTLY),
        (
            "corners-shallow-square",
            {"shallow_4_stalled_near": 0.0, "shallow_4_near": np.nan},
            Verdict.FAILS,
        ),
        ("corners-hexagon-less", {"shallow_6_stalled_near": 0.9}, Verdict.FAILS),
        (
            "corners-hexagon-less",
            {"shallow_6_stalled_near": [1.0, 0.2, 1.0, 0.9, 0.3]},
            Verdict.FAILS,
        ),
        ("corners-deep-eliminates", {"deep_6_undecided": 1}, Verdict.PARTLY),
        (
            "corners-deep-eliminates",
            {"deep_6_trapped_locally": [0, 0, 0.5, 0, 0]},
            Verdict.PARTLY,
        ),
        ("corners-deep-eliminates", {"deep_4_stalled_near": 0.3}, Verdict.PARTLY),
        (
            "corners-deep-eliminates",
            {"deep_4_trapped_locally": 0.75, "deep_6_trapped_locally": 0.25},
            Verdict.FAILS,
        ),
        ("corners-pauses", {"shallow_4_paused": 0.0}, Verdict.PARTLY),
        ("corners-pauses", {"shallow_6_stalled": 0.2}, Verdict.PARTLY),
        (
            "corners-pauses",
            {"shallow_4_speed_corner": 0.6, "shallow_6_speed_corner": 0.7},
            Verdict.FAILS,
        ),
        ("corners-sharper", {"shallow_12_trapped": 1.0}, Verdict.FAILS),
        (
            "corners-sharper",
            {
                "shallow_4_trapped": [0, 0.5, 0, 0.25, 0.5],
                "shallow_6_trapped": [0, 0.5, 0, 0.5, 0.3],
                "shallow_12_trapped": [0, 0, 0.5, 0.2, 0.2],
            },
            Verdict.FAILS,
        ),
    ],
)
def test_claims_fall_with_what_they_rest_on(key, changes, verdict):
    found = verdicts(table_of(**changes))
    assert found[key] is verdict


@pytest.mark.parametrize(
    ("norms", "verdict"),
    [((0.01, 0.3), Verdict.PARTLY), ((0.2, 0.3), Verdict.FAILS), ((), Verdict.FAILS)],
)
def test_traps_at_which_the_tangent_goes_on_are_not_its_attractors(norms, verdict):
    assert verdicts(table_of(), norms)["corners-tangent-attractor"] is verdict


def test_one_seed_proves_nothing():
    table = table_of()
    found = verdicts(table[table["seed"] == 0])
    assert found["corners-shallow-square"] is Verdict.PARTLY
    assert found["corners-hexagon-less"] is Verdict.FAILS


# The whole of it.


def test_square_and_hexagon_are_not_asked_for_twice(tmp_path):
    with pytest.raises(ConfigurationError, match=r"not \[3, 6\]"):
        Corners(angle_polygons=[3, 6]).run(Workbench(tmp_path))


def test_the_quick_scenario_runs(tmp_path):
    scenario = load_scenario("fig6_corners", ["quick"])
    scenario.experiment = replace(scenario.experiment, angle_polygons=[], starts=4)
    summary = run_scenario(scenario, tmp_path / "out")
    assert [exhibit["file"] for exhibit in summary["exhibits"]] == [
        *FIGURES,
        "corner_stalls.csv",
        "corner_traps.csv",
    ]
    for name in FIGURES:
        drawn = np.any(imread(tmp_path / "out" / name)[..., :3] < 0.9, axis=2)
        assert 0.02 < drawn.mean() < 0.9
    stalls = pd.read_csv(tmp_path / "out" / "corner_stalls.csv")
    assert stalls["network"].tolist() == [*NETWORKS, *NETWORKS]
    assert stalls["angle, degrees"].tolist() == [90.0] * 3 + [120.0] * 3
    fields = pd.read_parquet(tmp_path / "out" / "corner_fields.parquet")
    assert (fields["stalled"] >= fields["stalled_near"]).all()
    assert len(summary["claims"]) == 6
