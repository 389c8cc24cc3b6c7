"""The comparison of fields: its clouds, its measures, its verdicts, and a small run."""

from dataclasses import replace
from itertools import pairwise, product
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments import follow
from sgvf_drake.experiments.clouds import STROKE_HEIGHT, true_path
from sgvf_drake.fields import FourierCurve, ParametricField
from sgvf_drake.paper.baselines import TRAJECTORIES, BaselineComparison
from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.methods import CASES, LEARNED, METHODS, make_case
from sgvf_drake.paper.ways import (
    Ways,
    coverage,
    crossing_ways,
    effort,
    errors,
    find_ways,
)
from sgvf_drake.paths import Piece, ReferencePath
from sgvf_drake.paths.finding import find_paths
from tests.helpers import circle

UNIT = 0.5
# Of clouds; what others than the first repeat is for `make test-full`.
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in (1, 2))]


def run_of(*tracks, errors=None):
    """Agents that are at given positions, a sample every 0.05 U of time."""
    positions = np.stack(tracks, axis=1)
    times = 0.05 * UNIT * np.arange(len(positions))
    return SimpleNamespace(times=times, positions=positions, errors=errors)


def everything(run):
    """Ways on which all agents succeed, from the first to the last sample."""
    steps, agents = run.positions.shape[:2]
    return Ways(np.ones(agents, bool), np.zeros(agents, int), np.full(agents, steps - 1))


# The clouds.


def test_the_cases_are_the_same_waypoints_in_their_order_shuffled_and_noisy():
    ordered, path = make_case(CASES["ordered"], 0)
    shuffled, _ = make_case(CASES["shuffled"], 0)
    steps = np.linalg.norm(np.diff(ordered.points, axis=0), axis=1)
    np.testing.assert_allclose(steps, path.longest / 200, rtol=0.01)
    np.testing.assert_array_equal(make_case(CASES["ordered"], 1)[0].points, ordered.points)
    assert not np.array_equal(make_case(CASES["shuffled"], 1)[0].points, shuffled.points)
    np.testing.assert_array_equal(
        np.sort(shuffled.points, axis=0), np.sort(ordered.points, axis=0)
    )
    clouds = [make_case(CASES["noisy"], seed)[0] for seed in range(4)]
    squares = [(path.project(cloud.points).distance ** 2).mean() for cloud in clouds]
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.05 * ordered.unit_length, rel=0.1)


def test_pieces_come_one_after_the_other():
    for case, ways in (("branching", 3), ("pieces", 2)):
        cloud, path = make_case(CASES[case], 0)
        piece = path.project(cloud.points).piece
        assert len(path.pieces) == ways
        # The middle of the fork belongs to all arms.
        middle = np.linalg.norm(cloud.points, axis=1) < 1e-9
        assert np.all(np.diff(piece[~middle]) >= 0)


def test_demonstrations_are_the_path_shifted_as_a_whole():
    path = make_case(CASES["demonstrations"], 0)[1]
    squares = []
    for seed in range(6):
        cloud, _ = make_case(CASES["demonstrations"], seed)
        shifts = cloud.points.reshape(5, 80, 2) - path.pieces[0].sample(80)
        np.testing.assert_allclose(shifts, shifts[:, :1] + np.zeros((5, 80, 2)), atol=1e-9)
        squares.append((shifts[:, 0] ** 2).mean())
    unit = PointCloud(path.pieces[0].vertices).unit_length
    assert np.sqrt(np.mean(squares)) == pytest.approx(0.1 * unit, rel=0.2)


@pytest.mark.parametrize(
    ("case", "what"),
    [
        ("eight", "closed path, with 1 crossing"),
        ("course", "closed path, with 1 crossing"),
        ("demonstrations", "open path, with 1 crossing"),
        ("streets", "network, with 5 junctions, 1 crossing, 1 end"),
        ("space", "closed path"),
    ],
)
@pytest.mark.parametrize("seed", SEEDS)
def test_the_network_of_every_case_is_found(case, what, seed):
    network = find_paths(make_case(CASES[case], seed)[0])
    kind, _, *nodes = network.describe(0).split(", ")
    assert (", ".join([kind, *nodes]), network.num_pieces) == (what, 1)


def test_what_takes_no_order_gives_the_same_field_for_any():
    clouds = [make_case(CASES[case], 0)[0] for case in ("ordered", "shuffled")]
    x = np.random.default_rng(0).uniform(-4, 4, (50, 2))
    for name, method in METHODS.items():
        if name in LEARNED:
            continue
        fields = [method.build(cloud, 0) for cloud in clouds]
        at = [field.lift(x) if isinstance(field, ParametricField) else x for field in fields]
        m, other = (field(y)[:, :2] for field, y in zip(fields, at, strict=True))
        assert (np.abs(m - other).max() > 1e-6) == method.takes_order, name


@pytest.mark.parametrize(
    ("case", "count"), [("ordered", 1), ("noisy", 1), ("pieces", 2), ("branching", 3)]
)
def test_sorting_finds_every_piece_and_arm(case, count):
    for method, seed in product(("sorted", "smoothed"), range(2)):
        cloud, path = make_case(CASES[case], seed)
        shuffled = PointCloud(np.random.default_rng(seed).permutation(cloud.points))
        curves = METHODS[method].build(shuffled, 0).curves
        assert [curve.closed for curve in curves] == count * [path.closed.all()]
        x = np.concatenate([piece.sample(200) for piece in path.pieces])
        distance = np.min([curve.distance(cloud.normalize(x)) for curve in curves], axis=0)
        assert distance.max() < 0.3


# The measures.


@pytest.mark.parametrize("speed", [1.0, 0.3])
def test_the_effort_on_a_circle_is_its_curvature(speed):
    angle = speed * 0.05 / 2.0 * np.arange(600)
    track = 2.0 * UNIT * np.column_stack([np.cos(angle), np.sin(angle)])
    run = run_of(track, track + 1.0)
    assert effort(run, everything(run), UNIT) == pytest.approx(1 / 2.0, rel=1e-9)


def test_a_way_has_its_first_sample_and_its_last():
    values = np.arange(10)[:, None] + 100 * np.arange(3)
    good = np.array([True, False, True])
    ways = Ways(good, begin=np.array([2, 0, 9]), until=np.array([4, 9, 9]))
    assert [own.tolist() for own in ways.each(values)] == [[2, 3, 4], [209]]


def test_without_success_there_is_neither_error_nor_effort():
    run = run_of(np.zeros((100, 2)), errors=np.zeros((100, 1)))
    ways = replace(everything(run), good=np.zeros(1, bool))
    assert effort(run, ways, UNIT) is None
    assert errors(run, ways, UNIT) == {"rms_u": None, "max_u": None}
    cloud = PointCloud(np.array([[0.0, 0.0], [4.0, 0.0]]))
    assert coverage(run, ways, cloud) == 0.0
    assert coverage(run, everything(run), cloud) == 0.5


def test_errors_are_those_of_the_ways_in_units():
    distance = np.zeros((10, 2))
    distance[:, 0], distance[7:, 0], distance[:, 1] = 0.2, 5.0, 9.0
    run = run_of(np.zeros((10, 2)), np.zeros((10, 2)), errors=distance)
    ways = Ways(np.array([True, False]), np.array([2, 0]), np.array([6, 9]))
    assert errors(run, ways, UNIT) == {
        "rms_u": pytest.approx(0.4),
        "max_u": pytest.approx(0.4),
    }


@pytest.fixture
def arms():
    """Two arms of 4 U from the middle, along x and along y."""
    tips = 4 * UNIT * np.eye(2)
    return ReferencePath(
        tuple(Piece(np.stack([np.zeros(2), tip]), closed=False) for tip in tips)
    )


def along_x(at, height=0.0):
    """A track through the values of x, in U, each 0.05 U from the next."""
    x = np.concatenate(
        [np.arange(a, b, 0.05 * np.sign(b - a)) for a, b in pairwise(at) if a != b]
    )
    return UNIT * np.column_stack([x, np.full(len(x), height)])


def resting(track, steps=600):
    """The track, and rest at its end, to a common number of samples."""
    return np.concatenate([track, np.repeat(track[-1:], steps - len(track), axis=0)])


@pytest.mark.parametrize(
    ("track", "good"),
    [
        (resting(along_x([0, 4])), True),
        (resting(along_x([0, 2])), False),
        (resting(along_x([1, 4], 0.2)), False),
        (along_x([0, 4, 0, 4, 0, 4, 0, 4, 0])[:600], True),
        (along_x([0, 4, 0, 4, 0, 4, 0, 30])[:600], False),
        (resting(along_x([1, 4], 0.4)), False),
    ],
    ids=["rests at a tip", "stalls", "stays beside", "moves", "leaves", "is not near"],
)
def test_who_succeeds_on_branches(arms, track, good):
    run = run_of(track)
    run.errors = arms.project(track).distance[:, None]
    ways = find_ways(run, arms, UNIT)
    assert ways.good.tolist() == [good]


def test_the_way_is_that_from_the_path_to_the_tip(arms):
    inward = UNIT * np.column_stack([np.ones(40), np.linspace(2.0, 0.05, 40)])
    track = resting(np.concatenate([inward, along_x([1, 4])]))
    run = run_of(track)
    run.errors = arms.project(track).distance[:, None]
    ways = find_ways(run, arms, UNIT)
    begin, until = int(ways.begin[0]), int(ways.until[0])
    assert run.errors[begin, 0] <= 0.1 * UNIT < run.errors[begin - 1, 0]
    from_tip = np.linalg.norm(track - [4 * UNIT, 0], axis=1)
    assert from_tip[until - 1] > 0.1 * UNIT > from_tip[-1]
    assert errors(run, ways, UNIT)["max_u"] <= 0.1


@pytest.mark.parametrize(("tip", "good"), [((-4, 0), True), ((0, -4), True), ((0, 0), False)])
def test_a_tip_is_an_end_that_lies_on_no_other_piece(tip, good):
    street, stem = UNIT * np.array([[[-4, 0], [4, 0]], [[0, 0], [0, -4]]])
    path = ReferencePath((Piece(street, closed=False), Piece(stem, closed=False)))
    end = UNIT * np.array(tip, float)
    run = run_of(np.repeat(end[None], 600, axis=0))
    run.errors = path.project(end[None]).distance + np.zeros((600, 1))
    assert find_ways(run, path, UNIT).good.tolist() == [good]


@pytest.mark.parametrize("case", ["eight", "demonstrations"])
def test_who_goes_straight_over_a_crossing(case):
    """On the eight around one half for ever, on the stroke from arm to arm, is no success."""
    path = true_path(CASES[case].path)
    (piece,) = path.pieces
    cloud = PointCloud(piece.sample(400))
    arc = np.arange(0, (2.2 if piece.closed else 1) * piece.length, 0.05 * cloud.unit_length)
    straight = piece.at(arc % piece.length if piece.closed else arc)
    if piece.closed:
        turning = piece.at(arc % (piece.length / 2))
    else:
        side = np.linalg.norm(straight - [0.0, STROKE_HEIGHT], axis=1)
        loop = (side < 0.03 * cloud.unit_length).nonzero()[0][[0, -1]]
        turning = np.concatenate([straight[: loop[0]], straight[loop[1] :]])
    tracks = [resting(track, 1200) for track in (straight, straight[::-1], turning)]
    run = run_of(*tracks)
    run.times = run.times / UNIT * cloud.unit_length
    run.errors = path.project(run.positions.reshape(-1, 2)).distance.reshape(1200, 3)
    field = SimpleNamespace(cloud=cloud, ends=np.empty((0, 2)))
    ways = crossing_ways(run, path, field)
    assert ways.good.tolist() == [True, True, False]
    assert coverage(run, ways, cloud) == 1.0


# Following a field whose state has one more dimension.


@pytest.fixture(scope="module")
def ring():
    """Waypoints of a circle of radius 4, and the circle."""
    piece = Piece(circle(4.0, 4096), closed=True)
    return PointCloud(piece.sample(64)), ReferencePath((piece,))


def test_a_parametric_field_is_followed_in_the_plane(ring):
    cloud, path = ring
    field = ParametricField(cloud, FourierCurve.through(cloud))
    run = follow(field, path, starts=9)
    assert run.positions.shape[1:] == (9, 2)
    assert run.metrics.lapped.all()
    summary = run.summary()
    assert summary["cross_track_rms"] < 1e-3
    assert summary["speed_on_path_min"] == pytest.approx(1.0, abs=1e-3)
    start = field.lift(run.positions[0])[0]
    solution = solve_ivp(
        lambda _, state: field(state), (0, run.times[-1]), start, "DOP853", run.times, rtol=1e-9
    )
    # Nearly all of it along the path, gathered in the way in.
    np.testing.assert_allclose(run.positions[:, 0], solution.y[:2].T, atol=2e-3)


# The verdicts.

GOOD, BAD, THIN, HALF = (1.0, 1.0), (0.0, 0.0), (1.0, 0.8), (0.5, 1.0)
HOLDS, PARTLY, FAILS = Verdict.HOLDS, Verdict.PARTLY, Verdict.FAILS


def findings(means):
    """What a comparison of these cases and methods finds, by success and coverage."""
    cases, methods = (list(dict.fromkeys(names)) for names in zip(*means, strict=True))
    cells = pd.DataFrame(
        {"case": case, "method": method, "success": success, "coverage": covered}
        for (case, method), (success, covered) in means.items()
    )
    return {
        one.key: one for one in BaselineComparison(cases, methods).findings({"cells": cells})
    }


@pytest.mark.parametrize(
    ("key", "means", "verdict"),
    [
        ("branching", {("branching", "sorted"): GOOD, ("streets", "sorted"): BAD}, PARTLY),
        ("directed", {("streets", "directed"): GOOD, ("eight", "directed"): GOOD}, HOLDS),
        ("directed", {("streets", "directed"): GOOD, ("eight", "directed"): HALF}, PARTLY),
        ("directed-advantage", {("eight", "strands"): GOOD, ("eight", "guided"): GOOD}, FAILS),
        ("directed-advantage", {("eight", "strands"): GOOD, ("eight", "sorted"): HALF}, HOLDS),
        # What knows its heading does not speak for what does not.
        (
            "advantage",
            {
                (case, name): GOOD if name == "directed" else BAD
                for case in ["streets"]
                for name in ("directed", "robust", "sorted")
            },
            FAILS,
        ),
        ("ordered", {("ordered", "fourier"): GOOD}, HOLDS),
        ("ordered", {("ordered", "fourier"): GOOD, ("ordered", "lagrange"): BAD}, PARTLY),
        ("ordered", {("ordered", "parametric"): THIN}, FAILS),
        ("shuffled", {("shuffled", "pursuit"): BAD, ("shuffled", "implicit"): GOOD}, HOLDS),
        ("shuffled", {("shuffled", "pursuit"): BAD, ("shuffled", "fourier"): HALF}, PARTLY),
        # Waypoints that are left out are no broken curve.
        ("shuffled", {("shuffled", "pursuit"): (1.0, 0.0)}, FAILS),
        ("unordered", {("shuffled", "sorted"): HALF, ("noisy", "sorted"): BAD}, HOLDS),
        ("unordered", {("shuffled", "sorted"): GOOD, ("noisy", "sorted"): BAD}, PARTLY),
        ("unordered", {("shuffled", "sorted"): GOOD, ("noisy", "sorted"): GOOD}, FAILS),
        ("branching", {("branching", "sorted"): THIN}, HOLDS),
        ("corners", {("corners", "fourier"): GOOD}, FAILS),
        ("sgvf", {("noisy", "paper"): GOOD, ("pieces", "paper"): HALF}, PARTLY),
        ("advantage", {("pieces", "robust"): GOOD, ("pieces", "sorted"): GOOD}, FAILS),
        ("advantage", {("pieces", "robust"): GOOD, ("pieces", "sorted"): (0.95, 1)}, FAILS),
        ("advantage", {("pieces", "robust"): GOOD, ("pieces", "sorted"): THIN}, HOLDS),
        ("advantage", {("pieces", "robust"): HALF, ("pieces", "sorted"): THIN}, PARTLY),
        ("advantage", {("pieces", "robust"): (0.4, 1), ("pieces", "sorted"): THIN}, FAILS),
    ],
)
def test_verdicts_follow_from_the_numbers(key, means, verdict):
    assert findings(means)[f"baselines-{key}"].verdict is verdict


def test_what_was_not_run_is_not_judged():
    assert findings({("ordered", "robust"): GOOD}) == {}
    (found,) = findings({("branching", "sorted"): THIN}).values()
    assert "Fourier (sorted first) 100 % on 80 % of it" in found.evidence


# The run.


@pytest.fixture(scope="module")
def outcome(tmp_path_factory, run_kind):
    folder = tmp_path_factory.mktemp("bench")
    methods = ["implicit", "parametric"]
    comparison = BaselineComparison(["ordered", "shuffled"], methods, starts=4, seeds=[3, 4])
    return run_kind(comparison, folder), folder


def test_a_small_run_tells_order_from_disorder(outcome):
    found, _ = outcome
    rows = found.logs["baselines"].set_index(["case", "method", "seed"]).sort_index()
    assert (rows.loc[("ordered", "parametric"), "success"] == 1).all()
    assert (rows.loc[("shuffled", "parametric"), "success"] == 0).all()
    assert rows.loc[("ordered", "parametric", 3), "rms_u"] < 1e-3
    assert (rows["evaluation_us"] > 0).all()
    assert [*found.verdicts.values()][:2] == [HOLDS, HOLDS]


def test_what_cannot_differ_is_run_once(outcome):
    _, folder = outcome
    # Of eight cells: one fit for all, one curve in order, and two out of order.
    assert len(list(folder.rglob(TRAJECTORIES))) == 1 + 1 + 2


def test_what_is_left_out_is_not_run():
    names = ["space", "pieces", "eight"], ["implicit", "strands", "robust"]
    assert BaselineComparison(*names)._cells() == [
        ("space", "robust"),
        *(("pieces", name) for name in ("implicit", "robust")),
        *(("eight", name) for name in ("implicit", "strands", "robust")),
    ]


def test_a_field_that_knows_its_heading_is_followed_straight_over_a_crossing(
    tmp_path, run_kind
):
    found = run_kind(BaselineComparison(["eight"], ["strands"], starts=4, seeds=[0]), tmp_path)
    (row,) = found.rows["cells"].to_dict("records")
    assert row["success"] == row["coverage"] == 1
    assert row["rms_u"] < 0.01
    assert row["evaluation_us"] > 0
    assert found.verdicts == {"baselines-directed": HOLDS}


def test_tables_and_figure(outcome):
    found, _ = outcome
    assert [*found.tables] == ["baselines_ordered", "baselines_shuffled"]
    table = found.tables["baselines_ordered"].set_index("method")
    assert list(table.index) == [METHODS[name].label for name in ("implicit", "parametric")]
    line = table.loc["parametric"]
    assert line["success mean"] == 1.0
    # A formula on waypoints without noise is measured once, and has no interval.
    assert np.isnan(line["success low"])
    assert np.isnan(line["success high"])
    assert 0 < line["RMS, U mean"] <= line["max, U"] < 0.01
    # One row of panels: of the methods that ran, the figure shows the implicit curve.
    assert len(found.figures["baselines"].axes) == 2
