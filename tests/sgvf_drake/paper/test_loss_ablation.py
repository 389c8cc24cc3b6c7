"""Fig. 4: claims both ways on planted rows, and a small run."""

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.fields import load_field
from sgvf_drake.paper import ablation
from sgvf_drake.paper.ablation import COMPLETE, FIELDS
from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.experiment import FOLDER
from sgvf_drake.paper.loss_ablation import LossAblation

NETWORKS = ("[2,128,2]", "[2,64,64,64,64,2]")
OF_LOSSES = (COMPLETE, "no-unit", "no-orthogonality", "no-direction")
GOOD = {
    "following.followable": True,
    "following.lap": 1.0,
    "lengths.v_box_max": 0.1,
    "lengths.fading": 2.0,
    "lengths.leads_away": 0.0,
    "drift.drift_u": 0.1,
    "drift.outward": 0.0,
    "tangent.conflicted": 0.0,
    "tangent.sources": 0.0,
}
PAPER_SAYS = {
    "no-unit": {"lengths.v_box_max": 0.3, "lengths.fading": 0.8, "lengths.leads_away": 0.9},
    "no-orthogonality": {"drift.drift_u": 1.0, "drift.outward": 0.3, "following.lap": 0.2},
    "no-direction": {"tangent.conflicted": 1.0, "tangent.sources": 1.0},
}
OPPOSITE = {
    "no-unit": {"lengths.v_box_max": 0.05, "lengths.fading": 3.0},
    "no-orthogonality": {"drift.drift_u": 0.05, "drift.outward": -0.3},
}
# A complete recipe whose tangent has conflicts, and does not fade.
FAULTY = {"tangent.conflicted": 0.5, "tangent.sources": 0.5, "lengths.fading": 0.9}
TWO_LINES = {"tangent.conflicted": 1.0, "tangent.sources": 2.0}


def planted(changes, seeds=5, networks=NETWORKS):
    """One row a field: a good recipe, and what each variant changes."""
    rng = np.random.default_rng(0)
    rows = []
    for network in networks:
        for seed in range(seeds):
            for variant in OF_LOSSES:
                values = {**GOOD, **changes.get(variant, {})}
                # A scatter that the variants of a seed share, and a little of their own.
                values["lengths.v_box_max"] += 0.05 * seed + 0.001 * rng.random()
                values["drift.outward"] += 1e-4 * rng.standard_normal()
                rows.append({"network": network, "seed": seed, "variant": variant, **values})
    return pd.DataFrame(rows)


def findings(table):
    return {found.key: found for found in LossAblation().findings({FIELDS: table})}


HOLDS, PARTLY, FAILS = Verdict.HOLDS, Verdict.PARTLY, Verdict.FAILS


@pytest.mark.parametrize(
    ("table", "unit_length", "orthogonality", "direction"),
    [
        (planted(PAPER_SAYS), HOLDS, HOLDS, HOLDS),
        (planted({}), FAILS, FAILS, FAILS),
        (planted(OPPOSITE), FAILS, FAILS, FAILS),
        (planted({**PAPER_SAYS, COMPLETE: FAULTY}), PARTLY, HOLDS, PARTLY),
        (planted({**PAPER_SAYS, "no-direction": TWO_LINES}), HOLDS, HOLDS, PARTLY),
        # One network alone is a part; a single seed shows nothing.
        (
            pd.concat([planted(PAPER_SAYS, 5, NETWORKS[:1]), planted({}, 5, NETWORKS[1:])]),
            *(PARTLY, PARTLY, PARTLY),
        ),
        (planted(PAPER_SAYS, seeds=1), FAILS, FAILS, FAILS),
    ],
)
def test_a_verdict_follows_from_the_effects(table, unit_length, orthogonality, direction):
    verdicts = {key: found.verdict for key, found in findings(table).items()}
    assert verdicts == {
        "all-losses": HOLDS,
        "unit-length": unit_length,
        "orthogonality": orthogonality,
        "directional-consistency": direction,
    }


def test_complete_recipes_that_fail_are_said_and_effects_are_told():
    table = planted(PAPER_SAYS)
    found = findings(table)
    assert "[2,128,2] no-unit: 5 of 5" in found["all-losses"].evidence
    assert "not found" not in found["unit-length"].evidence
    assert "share of agents that lap: 1 -> 0.2, change -0.8" in found["orthogonality"].evidence
    table.loc[table["network"] == NETWORKS[0], "following.followable"] = False
    assert findings(table)["all-losses"].verdict == PARTLY
    table["following.followable"] = False
    assert findings(table)["all-losses"].verdict == FAILS


@pytest.fixture(scope="module")
def small_run(tmp_path_factory, run_kind):
    """A small run, without the sublevel checks."""
    check = {"reason": "not checked"}
    check |= dict.fromkeys(("holds", "band", "zeros", "slowest", "falls", "cosine"), 0)
    check["length_error"] = 0
    few = {"starts": 4, "patience": 0.1, "score_iterations": 30, "tangent_iterations": 30}
    kind = LossAblation(networks=[[6, 6]], seeds=[0], **few)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation, "checked_row", lambda *_: dict(check))
        return run_kind(kind, tmp_path_factory.mktemp("losses"))


def test_the_variants_share_the_score_and_differ_by_one_weight(small_run):
    table = small_run.rows[FIELDS]
    assert table["variant"].tolist() == list(OF_LOSSES)
    folder = table[FOLDER][0]
    complete = load_field(folder / f"{COMPLETE}.safetensors")
    x = complete.cloud.points
    for loss in ("unit", "orthogonality", "direction"):
        field = load_field(folder / f"no-{loss}.safetensors")
        np.testing.assert_array_equal(field.score(x), complete.score(x))
        assert (field.tangent(x) != complete.tangent(x)).all()
        before, after = (each.provenance["training"] for each in (complete, field))
        assert before == after | {f"{loss}_weight": 1.0}
        assert after[f"{loss}_weight"] == 0


def test_a_run_draws_and_tells(small_run):
    assert [*small_run.figures] == ["fields", "measures"]
    # Four panels of arrows and waypoints, and where the four agents stopped.
    for panel in small_run.figures["fields"].axes[:4]:
        assert len(panel.collections) == 2
        assert len(panel.lines[0].get_xdata()) == 4
    following, claims, checks = small_run.tables.values()
    assert following["followable seeds"].tolist() == 4 * ["0 of 1"]
    assert claims["network"].unique().tolist() == ["[2,6,6,2]"]
    assert checks["first seed"].tolist() == 4 * ["not checked"]
    assert [*small_run.logs] == ["fields"]
