"""Corners: places and traps on planted fields, who pauses, verdicts both ways, small runs."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from sgvf_drake import learning
from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import GuidingField, Perceptron, RobustComposition, ScoreNetwork
from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.corners import NETWORKS, POLYGONS, Corners, CornerTrial, polygon_cloud
from sgvf_drake.paper.traps import (
    RADIUS,
    even_share,
    examine,
    find_traps,
    paused,
    places,
    polygon,
    slow_down,
    slowest_corner,
    ways,
)

HOLDS, PARTLY, FAILS = Verdict.HOLDS, Verdict.PARTLY, Verdict.FAILS
# Half the side of the square, whose half-extent is 4 U.
HALF = RADIUS / np.sqrt(2)
UNIT = HALF / 4


def in_square(*points):
    """Points in U, in the unit of the waypoints."""
    return UNIT * np.array(points, dtype=float)


# Where things are.


def test_places_are_seen_from_the_nearest_corner():
    # The sides run (-4, -4), (4, -4), (4, 4), (-4, 4).
    points = in_square((3.7, -4.0), (4.1, -3.8), (-3.9, 3.9), (0.5, -3.0))
    found = places(points, 4, UNIT)
    for name, expected in {
        "corner": [1, 1, 3, 1],
        "offset": [-0.3, 0.2, 0.1, -3.5],
        "distance": [0.3, np.hypot(0.1, 0.2), np.hypot(0.1, 0.1), np.hypot(3.5, 1)],
        "near": [True, True, True, False],
        "outside": [0, 0.1, -0.1, -1],
        "from_path": [0, 0.1, 0.1, 1],
    }.items():
        np.testing.assert_allclose(found[name], expected, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("corners", [3, 4, 5, 8, 12])
def test_places_on_any_polygon(corners):
    path = polygon(corners)
    side = path.longest / corners
    shift = np.linspace(-0.4, 0.4, 5) * side
    arc = np.add.outer(np.arange(corners) * side, shift).ravel() % path.longest
    found = places(path.pieces[0].at(arc), corners, 0.7)
    assert found["corner"].tolist() == np.repeat(np.arange(corners), 5).tolist()
    np.testing.assert_allclose(found["offset"], np.tile(shift / 0.7, corners), atol=1e-9)
    assert found["outside"].abs().max() < 1e-9
    # The share of points drawn evenly.
    unit = PointCloud(path.pieces[0].vertices).unit_length
    even = places(path.pieces[0].sample(20_000), corners, unit)["offset"].abs() <= 0.5
    assert even_share(corners, unit) == pytest.approx(even.mean(), abs=2e-3)


def test_the_least_speed_is_read_near_corners_and_on_the_middle_of_sides():
    speed = np.full((4, 100), 0.9)
    # 0.4 U before corner 2 (side 1 ends there), and past the window of corner 0.
    speed[1, 95] = 0.1
    # And after it, which is the same corner.
    speed[2, 3] = 0.2
    speed[0, 8] = 0.2
    # Inside the middle of side 3, and outside of it.
    speed[3, 52] = 0.5
    speed[2, 35] = 0.3
    corner, side = slow_down(speed, side=8.0)
    assert corner == pytest.approx((0.1 + 3 * 0.9) / 4)
    assert side == pytest.approx((0.5 + 3 * 0.9) / 4)
    np.testing.assert_allclose(slowest_corner(speed), in_square(4, 4))


# Traps.


def row_with(*points, **others):
    """A field with stable zeros at points of the square, in U."""
    count = len(points)
    row = {"unit": UNIT, "undecided": 0, "zeros": in_square(*points)}
    row |= {"zeros_stable": [True] * count, "zeros_score": np.linspace(0.1, 0.2, count)}
    return row | others


def test_traps_are_the_stable_zeros_on_the_path_seen_in_the_direction_of_travel():
    points = ((3.8, -4.0), (-4.0, -3.7), (0.0, 0.0), (4.0, 3.9), (1.0, 4.0))
    row = row_with(*points, zeros_stable=[True, True, True, False, True])
    progress = np.ones((4, 100))
    traps = find_traps(row, progress)
    assert traps["corner"].tolist() == [1, 0, 2]
    assert traps["near"].tolist() == [True, True, False]
    # The side after (-4, 4) ends at (-4, -4): 0.3 U from there is before it.
    np.testing.assert_allclose(traps["along"], [-0.2, -0.3, 3.0], atol=1e-9)
    np.testing.assert_allclose(traps["score"], [0.1, 0.125, 0.2])
    np.testing.assert_allclose(find_traps(row, -progress)["along"], -traps["along"])
    # Only the middle of a side says which way it runs.
    progress[1] = -1.0
    progress[1, :30] = progress[2, 70:] = 1.0
    assert ways(progress).tolist() == [1, -1, 1, 1]
    traps = find_traps(row, progress)
    assert traps["clash"].tolist() == traps["along"].isna().tolist() == [True, False, True]


def test_a_field_is_examined():
    row = row_with(
        *((4, 3.9), (-4.0, 3.9), (-4.1, 4)),
        final=in_square((4, 3.9), (4, 3.9), (0, 4), (-4, 2), (-4, -4)),
        stalled=[True, True, True, False, False],
        lapped=[False, False, False, True, True],
        paused=[False, False, False, False, True],
        rms=None,
        max=2 * UNIT,
    )
    along = {"speed": np.full((4, 100), 0.5), "progress": np.ones((4, 100))}
    examined = examine(row, along, 4)
    # Two of the three traps share a corner.
    expected = {
        **{"even": 4 / 32, "stalled": 0.6, "stalled_near": 0.4, "near": 2 / 3},
        **{"lapped": 0.4, "paused": 0.2, "trapped": 0.5, "trapped_locally": 0.5},
        **{"undecided": 0, "turns": 0, "speed_corner": 0.5, "speed_side": 0.5},
        **{"rms": np.nan, "max": 2.0},
    }
    assert examined["figures"] == pytest.approx(expected, nan_ok=True)
    assert [trap["corner"] for trap in examined["traps"]] == [2, 3, 3]
    along["progress"][2] = -1.0
    against = examine(row, along, 4)["figures"]
    assert (against["turns"], against["trapped"], against["trapped_locally"]) == (2, 0.5, 0.0)


def test_the_waypoints_are_the_same_in_another_order():
    trials = [CornerTrial(6, seed, 240, 1, 1.0, 1.0) for seed in (0, 1)]
    first, other = (polygon_cloud(trial).points for trial in trials)
    assert not np.array_equal(first, other)
    np.testing.assert_array_equal(np.unique(first, axis=0), np.unique(other, axis=0))
    # Every corner is one.
    gaps = np.linalg.norm(first[:, None] - polygon(6).pieces[0].vertices, axis=2).min(axis=0)
    assert gaps.max() < 1e-9


def planted_run(*ways_along, off=0.0):
    """Agents that move along a line by so many U of way at each time, sample by sample."""
    positions = np.stack([np.column_stack([way, 0 * way]) for way in ways_along], axis=1)
    stalled = np.array([np.ptp(way[-161:]) == 0 for way in ways_along])
    return SimpleNamespace(
        times=0.05 * UNIT * np.arange(len(positions)),
        positions=UNIT * positions,
        errors=np.full(positions.shape[:2], off * UNIT),
        metrics=SimpleNamespace(stalled=stalled),
    )


def test_who_stands_still_and_goes_on_has_paused():
    time = 0.05 * np.arange(800)
    still = np.interp(time, [0, 10, 20, 40], [0, 10, 10, 30])
    for way, expected in (
        (still, True),
        (np.interp(time, [0, 10, 20, 40], [0, 10, 10.4, 30]), True),
        # Slow all the time is not still: 1.6 U in the time for 8.
        (0.2 * time, False),
        # Too short a stop, one for good, and one after another.
        (np.interp(time, [0, 10, 16, 40], [0, 10, 10, 34]), False),
        (np.interp(time, [0, 10, 40], [0, 10, 10]), False),
        (np.interp(time, [0, 8, 18, 25, 40], [0, 8, 8, 15, 15]), False),
        # In half of the time for 8 U nobody can be seen to stand still.
        (0 * time[:80], False),
    ):
        assert paused(planted_run(way), UNIT).tolist() == [expected]
    assert not paused(planted_run(still, off=0.4), UNIT).any()


# Verdicts.

QUIET = {
    **{"stalled": 0.0, "stalled_near": 0.0, "near": None, "lapped": 1.0, "paused": 0.0},
    **{"trapped": 0.0, "trapped_locally": 0.0, "undecided": 0, "turns": 0},
    **{"speed_corner": 0.6, "speed_side": 0.6, "rms": 0.05, "max": 0.1},
}
MOST, SOME = [0.5, 0.75, 0.5, 1.0, 0.75], [0.3, 0.2, 0.3, 0.2, 0.2]
AS_THE_PAPER_SAYS = {
    **{"shallow_4_stalled_near": [0.8, 0.9, 0.7, 0.9, 0.8], "shallow_4_near": 0.9},
    **{"shallow_4_trapped": MOST, "shallow_4_trapped_locally": MOST},
    **{"shallow_6_trapped": SOME, "shallow_6_trapped_locally": SOME},
    "shallow_6_stalled_near": [0.1, 0.2, 0.3, 0.0, 0.2],
    "shallow_4_speed_corner": [0.2, 0.1, 0.3, 0.2, 0.1],
    **{"shallow_6_speed_corner": [0.3, 0.4, 0.3, 0.2, 0.4], "shallow_4_paused": 0.1},
}


def planted_trial(corners, seed, changes, norms):
    """A row of the trials; `changes` has the figures by `network_corners_figure`."""
    trial = {"corners": corners, "seed": seed}
    for network in NETWORKS:
        figures = {"even": 0.125 if corners == 4 else 0.25, **QUIET}
        for name, values in changes.items():
            of_network, of_corners, figure = name.split("_", 2)
            if (of_network, int(of_corners)) == (network, corners):
                figures[figure] = values[seed] if isinstance(values, list) else values
        trial[network] = {"figures": figures, "traps": [], "restarts": 0}
    place = {"along": None, "outside": 0.1, "distance": 0.2}
    trial["shallow"]["traps"] = [{**place, "score": norm} for norm in norms]
    return trial


def verdicts(changes=None, norms=(0.01, 0.02), seeds=5):
    """Verdicts on fields that do what the paper says, but for some changes."""
    trials = [
        planted_trial(corners, seed, AS_THE_PAPER_SAYS | (changes or {}), norms)
        for corners in (4, 6, 12)
        for seed in range(seeds)
    ]
    findings = Corners().findings({POLYGONS: pd.DataFrame(trials)})
    assert not any("nan" in finding.evidence for finding in findings)
    return {finding.key.removeprefix("corners-"): finding.verdict for finding in findings}


def test_verdicts_follow_from_the_figures():
    found = verdicts()
    assert len(found) == 6
    assert set(found.values()) == {HOLDS}
    by_chance = {
        "shallow_4_trapped": [0, 0.5, 0, 0.25, 0.5],
        "shallow_6_trapped": [0, 0.5, 0, 0.5, 0.3],
        "shallow_12_trapped": [0, 0, 0.5, 0.2, 0.2],
    }
    as_many = {"deep_4_trapped_locally": 0.75, "deep_6_trapped_locally": 0.25}
    no_slower = {"shallow_4_speed_corner": 0.6, "shallow_6_speed_corner": 0.7}
    for key, changes, verdict in (
        ("shallow-square", {"shallow_4_near": 0.1}, PARTLY),
        ("shallow-square", {"shallow_4_stalled_near": 0.0, "shallow_4_near": None}, FAILS),
        ("hexagon-less", {"shallow_6_stalled_near": 0.9}, FAILS),
        ("hexagon-less", {"shallow_6_stalled_near": [1.0, 0.2, 1.0, 0.9, 0.3]}, FAILS),
        ("deep-eliminates", {"deep_6_undecided": 1}, PARTLY),
        ("deep-eliminates", {"deep_6_trapped_locally": [0, 0, 0.5, 0, 0]}, PARTLY),
        ("deep-eliminates", {"deep_4_stalled_near": 0.3}, PARTLY),
        ("deep-eliminates", as_many, FAILS),
        ("pauses", {"shallow_4_paused": 0.0}, PARTLY),
        ("pauses", {"shallow_6_stalled": 0.2}, PARTLY),
        ("pauses", no_slower, FAILS),
        ("sharper", {"shallow_12_trapped": 1.0}, FAILS),
        ("sharper", by_chance, FAILS),
    ):
        assert verdicts(changes)[key] is verdict, (key, changes)
    for norms, verdict in (((0.01, 0.3), PARTLY), ((0.2, 0.3), FAILS), ((), FAILS)):
        assert verdicts(norms=norms)["tangent-attractor"] is verdict, norms
    # One seed proves nothing.
    found = verdicts(seeds=1)
    assert (found["shallow-square"], found["hexagon-less"]) == (PARTLY, FAILS)


def test_tables_tell_where_agents_stall_and_where_traps_sit():
    trials = [planted_trial(corners, 0, {"shallow_4_stalled": 0.25}, []) for corners in (6, 4)]
    places = zip((-0.3, -0.1, 0.2, None), (0.1, 0.0, -0.1, -0.2), strict=True)
    trials[1]["shallow"]["traps"] = [
        {"along": along, "outside": outside, "distance": 0.2, "score": 0.01}
        for along, outside in places
    ]
    stalls, traps = (
        each.content for each in Corners().tables({POLYGONS: pd.DataFrame(trials)})
    )
    assert stalls["angle, degrees"].tolist() == 3 * [90.0] + 3 * [120.0]
    assert stalls["stalled, % mean"].tolist() == [25, 0, 0, 0, 0, 0]
    assert stalls["near, of the path, %"].tolist() == 3 * [12.5] + 3 * [25.0]
    assert traps["before / after / clash"].tolist() == ["2 / 1 / 1", *5 * ["0 / 0 / 0"]]
    assert traps["traps"].tolist() == [4, 0, 0, 0, 0, 0]
    assert traps["outside"].tolist() == [1, 0, 0, 0, 0, 0]
    assert traps["distance, U"].iloc[0] == pytest.approx(0.2)


# The whole of it.


def planted_field(cloud, sink):
    """A field that leads to one place from everywhere."""
    # A score so weak that the tangent decides alone.
    weak = Perceptron((np.column_stack([-1e-3 * np.eye(2), np.zeros(2)]),), (np.zeros(2),))
    return GuidingField(
        cloud=cloud,
        sigma=0.1,
        score_model=ScoreNetwork(weak, 1.0),
        tangent_network=Perceptron((-np.eye(2),), (cloud.normalize(sink),)),
        composition=RobustComposition(0.2, 0.1),
        recipe="robust",
        seed=0,
    )


@pytest.mark.full
def test_agents_on_fields_with_a_sink_near_a_corner_are_found_there(
    monkeypatch, run_kind, tmp_path
):
    # 0.3 U past the corner (4, 4), on the side that follows.
    sink = in_square(3.7, 4.0)
    asked, scores = [], []

    def plant(cloud, config, score=None):
        asked.append(config)
        scores.append(score)
        check = SimpleNamespace(passed=False)
        field = planted_field(cloud, sink)
        return SimpleNamespace(guiding_field=field, self_check=check, restarts=0)

    monkeypatch.setattr(learning, "train", plant)
    kind = Corners([], num_points=80, starts=9, patience=0.5, effort=0.5, seeds=[0])
    found = run_kind(kind, tmp_path)
    shallow, deep, robust = asked[:3]
    assert (shallow.tangent_hidden, deep.tangent_hidden) == ((128,), (64, 64, 64, 64))
    assert shallow.score_iterations == deep.tangent_iterations == 5_000
    assert (robust.recipe, robust.score_iterations) == ("robust", 750)
    # Both tangents are learned around one score.
    assert [isinstance(score, ScoreNetwork) for score in scores[:3]] == [False, True, False]
    assert [*found.figures] == ["corners", "corners_near", "corner_angles"]
    stalls, traps = found.tables["corner_stalls"], found.tables["corner_traps"]
    assert stalls["network"].tolist() == [*NETWORKS, *NETWORKS]
    assert stalls["angle, degrees"].tolist() == [90.0] * 3 + [120.0] * 3
    assert traps["before / after / clash"].tolist()[:3] == ["0 / 0 / 1"] * 3
    square = found.logs["corner_fields"].iloc[:3]
    assert (square[["stalled", "stalled_near", "near"]] == 1).all(axis=None)
    assert (square[["lapped", "trapped_locally", "undecided"]] == 0).all(axis=None)
    assert (square["trapped"] == 0.25).all()
    for name in NETWORKS:
        (trap,) = found.rows[POLYGONS].iloc[0][name]["traps"]
        assert trap["offset"] == pytest.approx(0.3, abs=0.02)
