"""Fig. 4: measures on closed-form fields, claims both ways on planted rows, a small run."""

from matplotlib.image import imread
import numpy as np
import pandas as pd
import pytest

from sgvf_drake.experiments.outcome import Verdict
from sgvf_drake.experiments.paper.ablation.along_path import sample_path
from sgvf_drake.experiments.paper.ablation.effects import effect_of
from sgvf_drake.experiments.paper.ablation.measures import checked_row, followed_row
from sgvf_drake.experiments.paper.loss_ablation import trials as loss_ablation_trials
from sgvf_drake.experiments.paper.loss_ablation.claims import loss_claims
from sgvf_drake.experiments.paper.loss_ablation.experiment import NAMES, LossAblation, widths
from sgvf_drake.experiments.paper.loss_ablation.measures import drift_row, lengths_row
from sgvf_drake.experiments.paper.loss_ablation.trials import (
    COMPLETE,
    NO_DIRECTION,
    NO_ORTHOGONALITY,
    NO_UNIT,
    VARIANTS,
)
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.fields import (
    GaussianMixture,
    GuidingField,
    PaperComposition,
    Perceptron,
    load_field,
)
from sgvf_drake.paper.running import run_scenario
from sgvf_drake.paper.scenario import Scenario
from sgvf_drake.paths import PointCloud, shape_path

RADIUS = 3.0
UNIT = RADIUS / 4
SIGMA = 0.1
NETWORKS = ("[2,128,2]", "[2,64,64,64,64,2]")


def ring_field(matrix, gain=0.2):
    """m = s + v on a circle, v = A x / R; its one layer is linear in normalised units."""
    cloud = PointCloud(shape_path("circle").pieces[0].sample(200))
    half_extent = 4.0
    tangent = Perceptron((np.asarray(matrix, dtype=float) / half_extent,), (np.zeros(2),), None)
    return GuidingField(
        cloud=cloud,
        sigma=SIGMA,
        score_model=GaussianMixture(cloud.normalize(cloud.points), SIGMA),
        tangent_network=tangent,
        composition=PaperComposition(gain),
        recipe="paper",
        seed=0,
    )


def turning(angle):
    """A quarter turn, tilted outward by an angle: v is of length |x| / R."""
    return np.array(
        [[np.sin(angle), -np.cos(angle)], [np.cos(angle), np.sin(angle)]], dtype=float
    )


@pytest.fixture(scope="module")
def circle():
    path = shape_path("circle")
    return path, sample_path(path, UNIT)


@pytest.fixture(scope="module")
def good_check():
    """What the sublevel checks say of a field around the ring."""
    return checked_row(ring_field(turning(0.0)), shape_path("circle"), (1.0,))


# The measures.


def test_lengths_are_those_of_a_linear_tangent(circle):
    row = lengths_row(ring_field(turning(0.0)), *circle)
    # On the circle |v| = 1; over the box of half-size 5 U = 1.25 R it is |x| / R.
    assert row["v_path_min"] == pytest.approx(1.0, abs=1e-6)
    assert row["v_path_max"] == pytest.approx(1.0, abs=1e-6)
    assert row["v_near"] == pytest.approx(1.0, abs=2e-3)
    assert row["v_box_max"] == pytest.approx(1.25 * np.sqrt(2), rel=1e-6)
    assert row["v_box_min"] == pytest.approx(0.0, abs=1e-12)
    # The mean distance from the centre of a square of half-size h is 0.7652 h.
    assert row["v_box"] == pytest.approx(0.7652 * 1.25, rel=0.02)
    assert row["fading"] == pytest.approx(row["v_near"] / row["v_away"])


def test_twice_the_tangent_is_twice_as_long_and_misses_the_unit_length(circle):
    once, twice = (lengths_row(ring_field(k * turning(0.0)), *circle) for k in (1, 2))
    for name in ("v_path", "v_box", "v_box_sd", "v_near", "v_away"):
        assert twice[name] == pytest.approx(2 * once[name])
    assert twice["fading"] == pytest.approx(once["fading"])
    # Without a score, |m| - 1 is |v| - 1.
    silent = ring_field(turning(0.0), gain=1e-12)
    row = lengths_row(silent, *circle)
    expected = np.sqrt(row["v_box_sd"] ** 2 + (row["v_box"] - 1) ** 2)
    assert row["m_error"] == pytest.approx(expected)
    assert row["leads_near"] == row["leads_away"] == 1.0


def test_a_tangent_along_the_ring_neither_drifts_nor_leans(circle):
    row = drift_row(ring_field(turning(0.0)), *circle)
    # The score of the waypoints is radial up to what lies between them.
    assert row["beside_cosine"] < 1e-3
    assert row["outward"] == pytest.approx(0.0, abs=1e-3)
    assert row["kept"] == 1.0
    assert row["drift_u"] < 1e-3


def test_a_known_outward_part_is_found_with_its_angle_and_its_drift(circle):
    angle = 0.05
    row = drift_row(ring_field(turning(angle)), *circle)
    assert row["beside_cosine"] == pytest.approx(np.sin(angle), abs=1e-3)
    # Inside the ring the same lean is toward it: away and toward cancel.
    assert row["outward"] == pytest.approx(0.0, abs=1e-3)
    # A logarithmic spiral: the distance grows by sin(angle) a unit of way.
    assert row["drift_u"] == pytest.approx(3.0 * np.sin(angle), rel=0.01)
    assert row["kept"] == 1.0
    assert drift_row(ring_field(turning(0.2)), *circle)["kept"] == 0.0


def test_away_from_the_ring_on_both_sides_is_outward(circle):
    # v along x - c with c far on one side is outward on half of the path and inward on half;
    # the score backwards is outward everywhere.
    field = ring_field(turning(0.0))

    class Fleeing(GuidingField):
        def components(self, x):
            s, _ = super().components(x)
            return s, -s

    fleeing = Fleeing(**{name: getattr(field, name) for name in field.__dataclass_fields__})
    row = drift_row(fleeing, *circle)
    assert row["outward"] == pytest.approx(1.0, abs=1e-3)
    assert row["beside_cosine"] == pytest.approx(1.0, abs=1e-9)


def test_a_followed_ring_is_followable_and_a_source_on_it_is_not(tmp_path, circle):
    path, _ = circle
    good = followed_row(ring_field(turning(0.0)), path, 9, 1.0, tmp_path / "good.npz")
    assert good["followable"]
    assert good["lap"] == good["settle"] == 1.0
    assert np.load(tmp_path / "good.npz")["followed"].all()
    # A wind: agents collect where it meets the ring.
    bad = followed_row(ring_field(0.0 * turning(0.0)), path, 9, 1.0, tmp_path / "bad.npz")
    assert not bad["followable"]
    run = np.load(tmp_path / "bad.npz")
    assert not run["followed"].any()
    assert run["ends"].shape == (9, 2)


def test_checks_hold_on_the_ring_and_not_on_one_that_leads_off(circle, good_check):
    assert good_check["holds"]
    assert good_check["band"]
    assert good_check["zeros"] == 0
    assert good_check["cosine"] < 0.01
    wind = ring_field(turning(np.pi / 2))
    bad = checked_row(wind, circle[0], (1.0,))
    assert not bad["holds"]
    assert bad["cosine"] > 0.9


# The claims.


def planted(changes, seeds=5, networks=NETWORKS):
    """Rows of a field table: a good recipe, and what each variant changes."""
    good = {
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
    rng = np.random.default_rng(0)
    rows = []
    for network in networks:
        for seed in range(seeds):
            for variant in VARIANTS:
                values = {**good, **changes.get(variant, {})}
                # A scatter that the variants of a seed share, and a little of their own.
                values["lengths.v_box_max"] += 0.05 * seed + 0.001 * rng.random()
                values["drift.outward"] += 1e-4 * rng.standard_normal()
                rows.append({"network": network, "seed": seed, "variant": variant, **values})
    return pd.DataFrame(rows)


PAPER_SAYS = {
    NO_UNIT: {"lengths.v_box_max": 0.3, "lengths.fading": 0.8, "lengths.leads_away": 0.9},
    NO_ORTHOGONALITY: {"drift.drift_u": 1.0, "drift.outward": 0.3, "following.lap": 0.2},
    NO_DIRECTION: {"tangent.conflicted": 1.0, "tangent.sources": 1.0},
}


def verdicts(table):
    return {claim.key: claim.verdict for claim in loss_claims(table)}


def test_all_claims_hold_where_everything_is_as_the_paper_says():
    claims = loss_claims(planted(PAPER_SAYS))
    assert {claim.verdict for claim in claims} == {Verdict.HOLDS}
    evidence = {claim.key: claim.evidence for claim in claims}
    assert "[2,128,2]: complete 5 of 5, no-unit 5 of 5" in evidence["all-losses"]
    assert "not found" not in evidence["unit-length"]
    assert "share of agents that lap 1 -> 0.2, change -0.8" in evidence["orthogonality"]


def test_no_claim_of_a_loss_holds_where_nothing_changes():
    found = verdicts(planted({}))
    assert found.pop("all-losses") == Verdict.HOLDS
    assert set(found.values()) == {Verdict.FAILS}


def test_the_same_change_the_other_way_is_no_effect():
    opposite = {
        NO_UNIT: {"lengths.v_box_max": 0.05, "lengths.fading": 3.0},
        NO_ORTHOGONALITY: {"drift.drift_u": 0.05, "drift.outward": -0.3},
    }
    found = verdicts(planted(opposite))
    assert found["unit-length"] == found["orthogonality"] == Verdict.FAILS


def test_one_network_alone_is_a_part():
    table = pd.concat(
        [
            planted(PAPER_SAYS, networks=NETWORKS[:1]),
            planted({}, networks=NETWORKS[1:]),
        ]
    )
    found = verdicts(table)
    assert found.pop("all-losses") == Verdict.HOLDS
    assert set(found.values()) == {Verdict.PARTLY}


def test_conflicts_of_the_complete_recipe_take_the_claim_of_direction_away():
    confounded = {**PAPER_SAYS, COMPLETE: {"tangent.conflicted": 0.5, "tangent.sources": 0.5}}
    claims = {claim.key: claim for claim in loss_claims(planted(confounded))}
    assert claims["directional-consistency"].verdict == Verdict.PARTLY
    assert "with two directions 0.5 -> 1" in claims["directional-consistency"].evidence


def test_a_tangent_that_does_not_fade_in_the_complete_recipe_cannot_be_disrupted():
    flat = {**PAPER_SAYS, COMPLETE: {"lengths.fading": 0.9}}
    assert verdicts(planted(flat))["unit-length"] == Verdict.PARTLY


def test_complete_recipes_that_fail_are_said():
    table = planted(PAPER_SAYS)
    table.loc[table["network"] == NETWORKS[0], "following.followable"] = False
    assert verdicts(table)["all-losses"] == Verdict.PARTLY
    table["following.followable"] = False
    assert verdicts(table)["all-losses"] == Verdict.FAILS


def test_effects_are_paired_by_seed():
    # The seeds scatter by 0.2, their differences by a thousandth.
    effect = effect_of(planted(PAPER_SAYS, networks=NETWORKS[:1]), "lengths.v_box_max", NO_UNIT)
    assert effect.rises
    assert not effect.falls
    assert effect.change[0] == pytest.approx(0.2, abs=2e-3)
    assert effect.change[2] - effect.change[1] < 2e-3 < effect.complete[2] - effect.complete[1]


def test_a_factor_is_paired_too_and_does_not_mind_how_far_a_length_runs_off():
    table = planted(PAPER_SAYS, networks=NETWORKS[:1])
    table["lengths.v_box_max"] = 0.1
    removed = table["variant"] == NO_UNIT
    table.loc[removed, "lengths.v_box_max"] = [0.2, 0.4, 0.8, 1.6, 30.0]
    assert not effect_of(table, "lengths.v_box_max", NO_UNIT).rises
    effect = effect_of(table, "lengths.v_box_max", NO_UNIT, factor=True)
    assert effect.rises
    factors = np.array([2, 4, 8, 16, 300])
    assert np.exp(effect.change[0]) == pytest.approx(factors.prod() ** 0.2)
    assert "a factor of 13" in str(effect)


def test_a_single_seed_shows_nothing():
    found = verdicts(planted(PAPER_SAYS, seeds=1))
    del found["all-losses"]
    assert set(found.values()) == {Verdict.FAILS}


# The run.


@pytest.fixture
def one_check(monkeypatch, good_check):
    """The sublevel checks, made once: they are not what the run of a scenario is about."""
    monkeypatch.setattr(loss_ablation_trials, "checked_row", lambda *_: dict(good_check))


def test_a_small_run_leaves_everything_and_trains_nothing_twice(
    tmp_path, monkeypatch, one_check
):
    kind = LossAblation(
        networks=[[6, 6]],
        starts=4,
        patience=0.5,
        score_iterations=30,
        tangent_iterations=30,
        seeds=[0],
    )
    scenario = Scenario("Losses", "Fig. 4", kind)
    summary = run_scenario(scenario, tmp_path / "first", trials=tmp_path / "trials")
    assert [entry["file"] for entry in summary["exhibits"]] == [
        *("fields.png", "measures.png", "following.csv", "claims.csv", "checks.csv")
    ]
    for name in ("fields.png", "measures.png"):
        assert np.ptp(imread(tmp_path / "first" / name)[..., :3]) > 0.5
    table = pd.read_csv(tmp_path / "first" / "claims.csv")
    assert table["network"].unique().tolist() == ["[2,6,6,2]"]
    assert table["variant"].tolist() == list(NAMES.values())
    fields = pd.read_parquet(tmp_path / "first" / "fields.parquet")
    assert len(fields) == 4
    check_variants(tmp_path / "trials")

    def train_again(*_, **__):
        raise AssertionError("a finished trial was trained again")

    monkeypatch.setattr("sgvf_drake.learning.train", train_again)
    again = run_scenario(scenario, tmp_path / "second", trials=tmp_path / "trials")
    assert again["claims"] == summary["claims"]
    pd.testing.assert_frame_equal(pd.read_csv(tmp_path / "second" / "claims.csv"), table)


def check_variants(trials):
    """The variants of a trial share the score and differ in the tangent, by one weight."""
    folders = [folder for folder in trials.iterdir() if folder.name.startswith("measure_")]
    assert len(folders) == 1
    for folder in folders:
        fields = {name: load_field(folder / f"{name}.safetensors") for name in VARIANTS}
        x = fields[COMPLETE].cloud.points
        for name, field in fields.items():
            np.testing.assert_array_equal(field.score(x), fields[COMPLETE].score(x))
            weights = field.provenance["training"]
            for loss in ("unit", "orthogonality", "direction"):
                removed = VARIANTS[name].get(f"{loss}_weight") == 0
                assert weights[f"{loss}_weight"] == (0 if removed else 1)
            if name != COMPLETE:
                assert (field.tangent(x) != fields[COMPLETE].tangent(x)).all()


def test_a_failing_trial_leaves_no_record(tmp_path, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("no network today")

    monkeypatch.setattr("sgvf_drake.learning.train", fail)
    with pytest.raises(Exception, match="no network today"):
        LossAblation(seeds=[0]).run(Workbench(tmp_path))
    assert not list(tmp_path.glob("measure_*"))


def test_networks_are_called_as_in_the_paper():
    assert widths([128]) == NETWORKS[0]
    assert widths([64] * 4) == NETWORKS[1]
