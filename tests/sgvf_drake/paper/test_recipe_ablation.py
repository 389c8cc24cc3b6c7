"""The robust recipe's ablation: claims both ways on planted rows, and a small run."""

import numpy as np
import pandas as pd
from scipy import stats

from sgvf_drake.fields import load_field
from sgvf_drake.paper import ablation
from sgvf_drake.paper.ablation import COMPLETE, FIELDS, SPEED_ERROR
from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.recipe_ablation import MEASURES, RecipeAblation, changes_of

SHAPES = ("concentric-circles", "star")
OF_RECIPE = (COMPLETE, "noisy-target", "no-features", "no-hint", "no-projection")
GOOD = {
    "following.lap": 1.0,
    "following.rms_u": 0.01,
    "following.max_u": 0.03,
    SPEED_ERROR: 0.01,
    "check.holds": True,
    "score.score_cosine": 0.99,
    "score.orthogonality": 0.1,
}


def planted(changes):
    """One row a field: a good recipe, and what a variant changes on a shape."""
    rng = np.random.default_rng(0)
    rows = []
    for shape in SHAPES:
        for seed in range(5):
            for variant in OF_RECIPE:
                values = {**GOOD, **changes.get((shape, variant), {})}
                values["following.rms_u"] += 1e-3 * rng.random()
                rows.append({"shape": shape, "seed": seed, "variant": variant, **values})
    return pd.DataFrame(rows)


def findings(table):
    found = RecipeAblation().findings({FIELDS: table})
    return {finding.key.removeprefix("robust-"): finding for finding in found}


def test_a_part_is_worth_what_agents_and_checks_lose_without_it_on_any_shape():
    table = planted(
        {
            ("star", "no-hint"): {"following.lap": 0.0, "following.rms_u": np.nan},
            ("star", "no-projection"): {SPEED_ERROR: 0.8},
            ("concentric-circles", "noisy-target"): {"score.score_cosine": 0.9},
            # Better without it, which does not speak for the part.
            ("star", "no-features"): {"score.score_cosine": 1.0},
        }
    )
    found = findings(table)
    assert {variant: finding.verdict for variant, finding in found.items()} == {
        "no-hint": Verdict.HOLDS,
        "no-projection": Verdict.HOLDS,
        "noisy-target": Verdict.PARTLY,
        "no-features": Verdict.FAILS,
    }
    both = planted({("star", "no-hint"): {"following.lap": 0.5, SPEED_ERROR: -0.5}})
    assert findings(both)["no-hint"].verdict == Verdict.PARTLY
    hint, features = found["no-hint"].evidence, found["no-features"].evidence
    assert hint.startswith("worse without it: share of starts that lap on star 1 -> 0")
    assert "better without it: cosine of the score on star 0.99 -> 1" in features


def test_a_part_that_changes_nothing_sure_and_large_is_not_worth_its_place():
    # The one is sure but small, the other large in one seed of five.
    table = planted({("star", "noisy-target"): {"following.max_u": 0.035}})
    one = (table["shape"] == "star") & (table["variant"] == "no-hint") & (table["seed"] == 3)
    table.loc[one, "following.lap"] = 0.0
    found = findings(table)
    assert len(found) == 4
    assert {finding.verdict for finding in found.values()} == {Verdict.FAILS}
    assert {finding.evidence for finding in found.values()} == {
        "worse without it: nothing measurable; better without it: nothing measurable; "
        "worse of agents and checks: 0; better of agents and checks: 0."
    }


def test_the_scatter_of_seeds_seldom_speaks_for_a_part():
    repeats, chance = 30, 0.05
    table = planted({})
    found = 0
    for seed in range(repeats):
        rng = np.random.default_rng(seed)
        # Every change in the mean is larger than what would matter.
        scattered = {each.column: rng.normal(size=len(table)) for each in MEASURES}
        found += len(changes_of(table.assign(**scattered), "no-hint")) > 0
    assert found <= stats.binom.isf(1e-3, repeats, chance)


def test_a_small_run_shares_the_score_where_it_may(tmp_path, monkeypatch, run_kind):
    check = {"holds": True, "reason": "", "slowest": 1.0, "falls": 0.9}
    monkeypatch.setattr(ablation, "checked_row", lambda *_: dict(check))
    monkeypatch.setattr(ablation, "default_duration", lambda path, unit: 4 * unit)
    variants = ["noisy-target", "no-features", "no-projection"]
    few = {"starts": 4, "score_iterations": 20, "tangent_iterations": 20}
    kind = RecipeAblation(shapes=["circle"], variants=variants, seeds=[0], **few)
    found = run_kind(kind, tmp_path)
    assert [len(figure.axes) for figure in found.figures.values()] == [5, 6]
    assert [*found.tables] == ["following", "inside"]
    assert [*found.verdicts] == [f"robust-{name}" for name in variants]
    assert found.logs["fields"]["variant"].tolist() == [COMPLETE, *variants]

    (folder,) = tmp_path.glob("measure_*")
    complete, noisy, plain, without = (
        load_field(folder / f"{name}.safetensors") for name in (COMPLETE, *variants)
    )
    x = complete.cloud.points
    assert (noisy.score(x) != complete.score(x)).any()
    assert (plain.score(x) != complete.score(x)).any()
    # Without the projection nothing else differs, and m does.
    np.testing.assert_array_equal(without.score(x), complete.score(x))
    np.testing.assert_array_equal(without.tangent(x), complete.tangent(x))
    assert np.abs(without(x) - complete(x)).max() > 1e-3
