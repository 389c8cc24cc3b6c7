"""The robust recipe's ablation: claims both ways on planted rows, and a small run."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.outcome import Verdict
from sgvf_drake.experiments.paper.recipe_ablation import trials as recipe_ablation_trials
from sgvf_drake.experiments.paper.recipe_ablation.claims import (
    MEASURES,
    SPEED_ERROR,
    findings_of,
    recipe_claims,
    with_speed_error,
)
from sgvf_drake.experiments.paper.recipe_ablation.experiment import NAMES, RecipeAblation
from sgvf_drake.experiments.paper.recipe_ablation.trials import (
    COMPLETE,
    NO_FEATURES,
    NO_HINT,
    NO_PROJECTION,
    NOISY_TARGET,
    VARIANTS,
)
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.fields import load_field
from sgvf_drake.paper.running import run_scenario
from sgvf_drake.paper.scenario import Scenario

SHAPES = ("concentric-circles", "star")


def planted(changes, seeds=5):
    """Rows of a field table: a good recipe, and what a variant changes on a shape."""
    good = {
        "following.lap": 1.0,
        "following.rms_u": 0.01,
        "following.max_u": 0.03,
        "following.speed_min": 0.99,
        "following.speed_max": 1.005,
        "check.holds": True,
        "score.score_cosine": 0.99,
        "score.orthogonality": 0.1,
    }
    rng = np.random.default_rng(0)
    rows = []
    for shape in SHAPES:
        for seed in range(seeds):
            for variant in VARIANTS:
                values = {**good, **changes.get((shape, variant), {})}
                values["following.rms_u"] += 1e-3 * rng.random()
                rows.append({"shape": shape, "seed": seed, "variant": variant, **values})
    return with_speed_error(pd.DataFrame(rows))


def verdicts(table):
    keys = {f"robust-{variant}": variant for variant in VARIANTS}
    return {keys[claim.key]: claim.verdict for claim in recipe_claims(table)}


def test_the_speed_error_is_the_larger_of_both_sides():
    table = with_speed_error(
        pd.DataFrame({"following.speed_min": [0.9, 0.99], "following.speed_max": [1.0, 1.2]})
    )
    np.testing.assert_allclose(table[SPEED_ERROR], [0.1, 0.2])


def test_a_part_that_changes_nothing_is_not_worth_its_place():
    claims = recipe_claims(planted({}))
    assert len(claims) == 4
    assert {claim.verdict for claim in claims} == {Verdict.FAILS}
    assert {claim.evidence for claim in claims} == {
        "Worse without it: nothing measurable; better without it: nothing measurable."
    }


def test_one_shape_is_enough_if_agents_or_checks_feel_it():
    table = planted(
        {
            ("star", NO_HINT): {"following.lap": 0.0, "following.rms_u": np.nan},
            ("star", NO_PROJECTION): {"following.speed_min": 0.2},
            ("concentric-circles", NOISY_TARGET): {"score.score_cosine": 0.9},
        }
    )
    assert verdicts(table) == {
        NO_HINT: Verdict.HOLDS,
        NO_PROJECTION: Verdict.HOLDS,
        NOISY_TARGET: Verdict.PARTLY,
        NO_FEATURES: Verdict.FAILS,
    }
    (hint,) = findings_of(table, NO_HINT)
    assert (hint.shape, hint.is_worse) == ("star", True)
    assert str(hint).startswith("share of starts that lap on star 1 -> 0")


def test_the_scatter_of_seeds_seldom_speaks_for_a_part():
    repeats, chance = 60, 0.05
    table = planted({})
    measured = [measure.column for measure in MEASURES]
    found = 0
    for seed in range(repeats):
        rng = np.random.default_rng(seed)
        # Every change in the mean is larger than what would matter.
        scattered = table.assign(**{name: rng.normal(size=len(table)) for name in measured})
        found += len(findings_of(scattered, NO_HINT)) > 0
    assert found <= stats.binom.isf(1e-3, repeats, chance)


def test_what_is_better_without_a_part_is_said_and_does_not_speak_for_it():
    table = planted({("star", NO_FEATURES): {"score.score_cosine": 1.0}})
    claims = {claim.key: claim for claim in recipe_claims(table)}
    found = claims[f"robust-{NO_FEATURES}"]
    assert found.verdict == Verdict.FAILS
    assert "better without it: cosine of the score on star 0.99 -> 1" in found.evidence


def test_a_change_that_is_sure_but_small_does_not_count():
    table = planted({("star", NOISY_TARGET): {"following.max_u": 0.035}})
    assert findings_of(table, NOISY_TARGET) == []


def test_one_seed_of_five_that_fails_does_not_count():
    table = planted({})
    one = (table["shape"] == "star") & (table["variant"] == NO_HINT) & (table["seed"] == 3)
    table.loc[one, "following.lap"] = 0.0
    assert findings_of(table, NO_HINT) == []


def test_a_small_run_shares_the_score_where_it_may_and_trains_nothing_twice(
    tmp_path, monkeypatch
):
    check = {"holds": True, "reason": "", "slowest": 1.0, "falls": 0.9}
    monkeypatch.setattr(recipe_ablation_trials, "checked_row", lambda *_: dict(check))
    kind = RecipeAblation(
        shapes=["circle"], starts=4, score_iterations=20, tangent_iterations=20, seeds=[0]
    )
    scenario = Scenario("Recipe", "Fig. 4", kind)
    summary = run_scenario(scenario, tmp_path / "first", trials=tmp_path / "trials")
    assert [entry["file"] for entry in summary["exhibits"]] == [
        *("fields.png", "measures.png", "following.csv", "inside.csv")
    ]
    table = pd.read_csv(tmp_path / "first" / "inside.csv")
    assert table["variant"].tolist() == list(NAMES.values())

    (folder,) = (tmp_path / "trials").glob("measure_*")
    fields = {name: load_field(folder / f"{name}.safetensors") for name in VARIANTS}
    x = fields[COMPLETE].cloud.points
    same_score = {
        name: bool(np.array_equal(field.score(x), fields[COMPLETE].score(x)))
        for name, field in fields.items()
    }
    assert same_score == {
        COMPLETE: True,
        NOISY_TARGET: False,
        NO_FEATURES: False,
        NO_HINT: True,
        NO_PROJECTION: True,
    }
    # Without the projection nothing else differs, and m does.
    without = fields[NO_PROJECTION]
    np.testing.assert_array_equal(without.tangent(x), fields[COMPLETE].tangent(x))
    assert np.abs(without(x) - fields[COMPLETE](x)).max() > 1e-3

    def train_again(*_, **__):
        raise AssertionError("a finished trial was trained again")

    monkeypatch.setattr("sgvf_drake.learning.train", train_again)
    again = run_scenario(scenario, tmp_path / "second", trials=tmp_path / "trials")
    assert again["claims"] == summary["claims"]


def test_a_part_may_be_asked_for_alone(tmp_path, monkeypatch):
    check = {"holds": True, "reason": "", "slowest": 1.0, "falls": 0.9}
    monkeypatch.setattr(recipe_ablation_trials, "checked_row", lambda *_: dict(check))
    kind = RecipeAblation(
        shapes=["circle"],
        starts=4,
        variants=[NO_HINT],
        score_iterations=20,
        tangent_iterations=20,
        seeds=[0],
    )
    outcome = kind.run(Workbench(tmp_path))
    assert [claim.key for claim in outcome.claims] == [f"robust-{NO_HINT}"]
    assert outcome.logs["fields"]["variant"].tolist() == [COMPLETE, NO_HINT]


@pytest.mark.parametrize("variant", ["no-hope", COMPLETE])
def test_a_variant_that_is_none_is_an_error_before_anything_runs(tmp_path, variant):
    with pytest.raises(ConfigurationError, match=variant):
        RecipeAblation(variants=[variant]).run(Workbench(tmp_path))
    assert not list(tmp_path.iterdir())
