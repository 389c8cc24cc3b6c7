"""What order decides: curves, fields, and verdicts that can go the other way."""

from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import load_field
from sgvf_drake.learning import train
from sgvf_drake.paper import baselines
from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.indexing import (
    CurveTrial,
    Indexing,
    field_changes,
    make_waypoints,
    measure_curve,
)

HOLDS, PARTLY, FAILS = Verdict.HOLDS, Verdict.PARTLY, Verdict.FAILS


def test_ordered_and_shuffled_waypoints_are_the_same_points():
    ordered, path = make_waypoints(CurveTrial("ordered", "fourier", 8, 0))
    shuffled, _ = make_waypoints(CurveTrial("shuffled", "fourier", 8, 0))
    assert ordered.num_points == 25
    assert path.project(ordered.points).distance.max() < 1e-9
    assert not np.array_equal(ordered.points, shuffled.points)
    np.testing.assert_array_equal(*(np.unique(c.points, axis=0) for c in (ordered, shuffled)))
    again, _ = make_waypoints(CurveTrial("shuffled", "lagrange", 8, 1))
    assert not np.array_equal(again.points, shuffled.points)


def test_order_decides_the_curve(tmp_path):
    ordered, shuffled, polynomial = (
        measure_curve(CurveTrial(case, curve, 8, 0), tmp_path)
        for case, curve in (
            ("ordered", "fourier"),
            ("shuffled", "fourier"),
            ("ordered", "lagrange"),
        )
    )
    assert ordered["waypoints"] == 25
    assert ordered["length_ratio"] == pytest.approx(1.0, abs=0.01)
    assert ordered["farthest_u"] < 0.1
    # Shuffled, a closed curve goes from one place to any other each time.  Two of the 25 are
    # about as far apart as the path is wide, and it is about 24 U around and 7 U wide.
    assert 0.5 * 25 * 7 / 24 < shuffled["length_ratio"] < 2 * 25 * 7 / 24
    # Equally spaced, a polynomial swings (Runge).
    assert polynomial["farthest_u"] > 100


def test_changes_of_fields_are_their_differences(exact_field, concentric):
    field = exact_field
    other = replace(field, composition=replace(field.composition, gain=1e-9))
    changes = field_changes([field, other], [field]).set_index("change")
    assert set(changes.loc["another order"]) == {0.0}
    # Without a score, m is v alone; with it, most of the box goes straight to the path.
    x, change = field.cloud.points, changes.loc["another seed"]
    expected = np.sqrt((np.linalg.norm(field(x) - field.tangent(x), axis=1) ** 2).mean())
    assert change["m, waypoints"] == pytest.approx(expected, rel=1e-6)
    assert 1.0 < change["m, box"] < 2.0
    # The exact score does not know the order of its waypoints.
    shuffled = PointCloud(np.random.default_rng(5).permutation(concentric[0].points))
    again = field_changes([field, field], [replace(field, cloud=shuffled)])
    assert again["exact score, box"].max() < 1e-9


def test_the_kind_runs_on_fields_that_are_hardly_trained(tmp_path, monkeypatch, run_kind):
    short = partial(replace, tangent_iterations=10, max_restarts=0)
    monkeypatch.setattr(
        "sgvf_drake.learning.train", lambda cloud, config: train(cloud, short(config))
    )
    # Nor is it of interest how far the agents would come.
    monkeypatch.setattr(baselines, "default_duration", lambda path, unit: 4 * unit)
    kind = Indexing(recipe="exact", thinning=[8], starts=4, seeds=[0])
    found = run_kind(kind, tmp_path)
    assert len(found.figures["indexing"].axes) == 9
    curves, agents, order = found.tables.values()
    assert len(curves) == 6
    assert agents["field"].tolist() == 3 * ["Fourier", "Lagrange"] + 3 * ["SGVF, exact"]
    assert order["change"].tolist() == ["another order", "another seed"]
    assert set(found.rows["agents"]["seed"]) == {0}
    # One seed more is trained on the ordered waypoints, to compare with.
    fields = [load_field(file) for file in tmp_path.rglob("field.safetensors")]
    assert sorted(field.seed for field in fields) == [0, 0, 0, 1]


def verdicts(curves=(), learned=1.0, coverage=1.0, order=0.01):
    """The verdicts of one good curve a case, with others besides."""
    given = [
        ("ordered", 0.01, 1.0),
        ("shuffled", 3.0, 10.0),
        ("branching", 1.0, 2.0),
        *curves,
    ]
    rows = {
        "curves": pd.DataFrame(
            [(case, "fourier", 25, far, ratio) for case, far, ratio in given],
            columns=["case", "curve", "waypoints", "farthest_u", "length_ratio"],
        ),
        "agents": pd.DataFrame(
            {"case": case, "field": field, "success": success, "coverage": coverage}
            for case in ("ordered", "shuffled", "branching")
            for field, success in (("fourier", 0.1), ("robust", learned))
        ),
        "changes": pd.DataFrame(
            {"change": ["another order", "another seed"], "m, box": [order, 0.01]}
        ),
    }
    found = Indexing().findings(rows)
    return {finding.key.removeprefix("indexing-"): finding.verdict for finding in found}


def test_verdicts_follow_from_the_figures():
    all_hold = dict.fromkeys(("ordered", "shuffled", "branching", "free", "branches"), HOLDS)
    for changes, expected in (
        ({}, {}),
        ({"curves": [("ordered", 5.0, 1.0)]}, {"ordered": PARTLY}),
        ({"curves": [("ordered", 0.0, 1.2)]}, {"ordered": PARTLY}),
        ({"curves": [("shuffled", 0.1, 1.0)]}, {"shuffled": PARTLY}),
        ({"curves": [("branching", 0.1, 1.0)]}, {"branching": PARTLY}),
        ({"order": 0.05}, {"free": PARTLY}),
        ({"coverage": 0.7}, {"branches": PARTLY}),
        ({"coverage": 0.3}, {"branches": FAILS}),
        ({"learned": 0.3, "order": 0.05}, {"free": FAILS, "branches": FAILS}),
    ):
        assert verdicts(**changes) == all_hold | expected, changes
