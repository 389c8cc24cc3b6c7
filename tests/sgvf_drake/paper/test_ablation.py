"""What both ablations share: effects paired by seed, and how fields are followed and checked."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.paper import ablation
from sgvf_drake.paper.ablation import (
    COMPLETE,
    NO_UNIT,
    SPEED_ERROR,
    checked_row,
    effect_of,
    fields_table,
    followed_row,
    widths,
)
from sgvf_drake.paper.loss_ablation import LossAblation
from sgvf_drake.paths import PointCloud, shape_path


def table_of(complete, removed):
    """The values of a measure, one a seed."""
    values = {COMPLETE: complete, NO_UNIT: removed}
    return pd.DataFrame(
        {"variant": variant, "seed": seed, "length": value}
        for variant, own in values.items()
        for seed, value in enumerate(own)
    )


def test_effects_are_paired_by_seed():
    # The seeds scatter by 0.2, their differences by a thousandth.
    complete = 0.1 + 0.05 * np.arange(5)
    removed = complete + 0.2 + 1e-3 * np.array([0.1, -0.5, 0.3, 0.4, -0.2])
    effect = effect_of(table_of(complete, removed), "length", NO_UNIT)
    assert (effect.rises, effect.falls) == (True, False)
    assert effect.change[0] == pytest.approx(0.2, abs=2e-3)
    assert effect.change[2] - effect.change[1] < 2e-3 < effect.complete[2] - effect.complete[1]
    assert str(effect).startswith("0.2 -> 0.4, change +0.2 [+0.2")
    # A seed that is missing on one side has no change, and a single seed shows nothing.
    assert effect_of(table_of(complete, [*removed[:4], np.nan]), "length", NO_UNIT).rises
    single = effect_of(table_of(complete[:1], removed[:1]), "length", NO_UNIT)
    assert (single.rises, single.falls, str(single)) == (False, False, "0.1 -> 0.3")


def test_a_factor_does_not_mind_how_far_a_length_runs_off():
    table = table_of([0.1] * 5, [0.2, 0.4, 0.8, 1.6, 30.0])
    assert not effect_of(table, "length", NO_UNIT).rises
    effect = effect_of(table, "length", NO_UNIT, factor=True)
    assert effect.rises
    assert np.exp(effect.change[0]) == pytest.approx(np.prod([2, 4, 8, 16, 300]) ** 0.2)
    assert "a factor of 13" in str(effect)


def test_a_followed_ring_is_followable_and_a_source_on_it_is_not(
    tmp_path, make_linear_field, quarter_turn
):
    path = shape_path("circle")
    cloud = PointCloud(path.pieces[0].sample(200))
    field = make_linear_field(cloud, quarter_turn())
    good = followed_row(field, path, 9, 1.0, tmp_path / "good.npz")
    assert good["followable"]
    assert good["lap"] == good["settle"] == 1.0
    assert np.load(tmp_path / "good.npz")["followed"].all()
    # Without a tangent, agents stop on the ring.
    still = make_linear_field(cloud, 0 * quarter_turn())
    assert not followed_row(still, path, 9, 1.0, tmp_path / "bad.npz")["followable"]
    run = np.load(tmp_path / "bad.npz")
    assert not run["followed"].any()
    assert run["ends"].shape == (9, 2)


def test_of_the_violations_only_zeros_that_count_are_counted(monkeypatch):
    violations = [
        SimpleNamespace(counts=counts, kind=kind)
        for counts, kind in ((True, "zero"), (True, "zero"), (False, "zero"), (True, "slow"))
    ]
    found = SimpleNamespace(
        holds=False,
        reason="m vanishes",
        band=None,
        violations=violations,
        slowest=0.0,
        decrease_fraction=0.9,
        assumptions=SimpleNamespace(
            cosine=SimpleNamespace(mean=0.2), length=SimpleNamespace(mean=0.3)
        ),
    )
    monkeypatch.setattr(ablation, "verify", lambda field, reference, ratios: found)
    row = checked_row(None, None, (1.0,))
    assert (row["holds"], row["band"], row["zeros"]) == (False, False, 2)


def test_a_table_has_a_row_a_field_and_the_larger_error_of_the_speed():
    def measures(slow, fast):
        return {"following": {"speed_min": slow, "speed_max": fast}, "passed": True}

    trials = pd.DataFrame(
        {
            "shape": "circle",
            "seed": seed,
            "hidden": (128,),
            "variants": (NO_UNIT,),
            "folder": "there",
            COMPLETE: measures(0.9, 1.0),
            NO_UNIT: measures(0.99, 1.2),
        }
        for seed in (3, 4)
    )
    fields = fields_table(trials)
    assert fields["seed"].tolist() == [3, 3, 4, 4]
    assert fields["variant"].tolist() == 2 * [COMPLETE, NO_UNIT]
    assert fields["network"].unique().tolist() == ["[2,128,2]"]
    np.testing.assert_allclose(fields[SPEED_ERROR], 2 * [0.1, 0.2])
    assert widths([64] * 4) == "[2,64,64,64,64,2]"


def test_a_failing_trial_leaves_no_record(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("no network today")

    monkeypatch.setattr("sgvf_drake.learning.train", fail)
    with pytest.raises(Exception, match="no network today"):
        LossAblation(seeds=[0]).run(Workbench(tmp_path))
    assert not list(tmp_path.glob("measure_*"))
