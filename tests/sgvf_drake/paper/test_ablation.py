"""What both ablations share: effects paired by seed; how fields are followed and checked."""

from unittest.mock import MagicMock, Mock

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.paper import ablation
from sgvf_drake.paper.ablation import COMPLETE, SPEED_ERROR, effect_of
from sgvf_drake.paths import shape_path


def table_of(complete, removed):
    """The values of a measure, one a seed."""
    values = {COMPLETE: complete, "no-unit": removed}
    return pd.DataFrame(
        {"variant": variant, "seed": seed, "length": value}
        for variant, own in values.items()
        for seed, value in enumerate(own)
    )


def test_effects_are_paired_by_seed():
    # The seeds scatter by 0.2, their differences by a thousandth.
    complete = 0.1 + 0.05 * np.arange(5)
    removed = complete + 0.2 + 1e-3 * np.array([0.1, -0.5, 0.3, 0.4, -0.2])
    effect = effect_of(table_of(complete, removed), "length", "no-unit")
    assert (effect.rises(), effect.falls()) == (True, False)
    assert effect.change[0] == pytest.approx(0.2, abs=2e-3)
    assert effect.change[2] - effect.change[1] < 2e-3 < effect.complete[2] - effect.complete[1]
    assert str(effect).startswith("0.2 -> 0.4, change +0.2 [+0.2")
    # A seed that is missing on one side has no change, and a single seed shows nothing.
    assert effect_of(table_of(complete, [*removed[:4], np.nan]), "length", "no-unit").rises()
    single = effect_of(table_of(complete[:1], removed[:1]), "length", "no-unit")
    assert (single.rises(), single.falls(), str(single)) == (False, False, "0.1 -> 0.3")


def test_a_factor_does_not_mind_how_far_a_length_runs_off():
    table = table_of([0.1] * 5, [0.2, 0.4, 0.8, 1.6, 30.0])
    assert not effect_of(table, "length", "no-unit").rises()
    effect = effect_of(table, "length", "no-unit", factor=True)
    assert effect.rises()
    assert np.exp(effect.change[0]) == pytest.approx(np.prod([2, 4, 8, 16, 300]) ** 0.2)
    assert "a factor of 13" in str(effect)


@pytest.mark.parametrize(("size", "good"), [(1.0, True), (0.0, False)])
def test_a_ring_is_followable_and_without_a_tangent_it_is_not(
    tmp_path, turning_field, size, good
):
    path = shape_path("circle")
    field = turning_field(PointCloud(path.pieces[0].sample(200)), size=size)
    row = ablation.followed_row(field, path, 9, 1.0, tmp_path / "run.npz")
    assert (row["followable"], row["lap"]) == (good, float(good))
    run = np.load(tmp_path / "run.npz")
    assert (run["followed"] == good).all()
    assert run["ends"].shape == (9, 2)


def test_of_the_violations_only_zeros_that_count_are_counted(monkeypatch):
    kinds = ((True, "zero"), (True, "zero"), (False, "zero"), (True, "slow"))
    violations = [Mock(counts=counts, kind=kind) for counts, kind in kinds]
    found = MagicMock(band=None, violations=violations)
    monkeypatch.setattr(ablation, "verify", lambda field, reference, ratios: found)
    row = ablation.checked_row(None, None, (1.0,))
    assert (row["band"], row["zeros"]) == (False, 2)


def test_a_table_has_a_row_a_field_and_the_larger_error_of_the_speed():
    def measures(slow, fast):
        return {"following": {"speed_min": slow, "speed_max": fast}}

    labels = {"shape": "circle", "hidden": (128,), "variants": ("no-unit",), "folder": "there"}
    trials = pd.DataFrame(
        {"seed": seed, **labels, COMPLETE: measures(0.9, 1.0), "no-unit": measures(0.99, 1.2)}
        for seed in (3, 4)
    )
    fields = ablation.fields_table(trials)
    assert fields["seed"].tolist() == [3, 3, 4, 4]
    assert fields["variant"].tolist() == 2 * [COMPLETE, "no-unit"]
    np.testing.assert_allclose(fields[SPEED_ERROR], 2 * [0.1, 0.2])
    assert fields["network"].unique().tolist() == ["[2,128,2]"]
