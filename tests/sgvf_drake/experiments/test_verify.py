"""Verification with its trajectories and flights: what it leaves behind."""

from dataclasses import replace
import json

from matplotlib.image import imread
import numpy as np
import pytest

from sgvf_drake.exceptions import OutputExistsError
from sgvf_drake.experiments import run_verify
from sgvf_drake.fields import Perceptron
from sgvf_drake.paths import shape_path

KEYS = {
    *("holds", "reason", "method", "sigma", "c_in", "c_out", "alpha", "delta"),
    *("tube_half_width", "area_fraction", "decrease_fraction", "compact", "components"),
    *(
        "e_star_max",
        "e_star_min",
        "e_star",
        "undecided",
        "violations",
        "assumptions",
        "lemma",
        "bounds",
        "theorem",
    ),
    *("flight", "time_s", "unit_length", "reference", "recipe", "seed", "digest"),
}


def summary_of(folder):
    return json.loads((folder / "summary.json").read_text())


def names_in(folder):
    return {path.name for path in folder.iterdir()}


@pytest.fixture(scope="module")
def flown(tmp_path_factory, flight_field):
    """The folder of a verification with a flight, of two circles of 1 m and 2 m."""
    out = tmp_path_factory.mktemp("verify") / "flown"
    run_verify(flight_field, None, out, starts=36, speed=0.45)
    return out


def test_everything_is_there(flown):
    assert names_in(flown) == {"summary.json", "verify.png", "theorem.png", "tracking.png"}
    summary = summary_of(flown)
    assert set(summary) == KEYS
    for name in names_in(flown) - {"summary.json"}:
        drawn = np.any(imread(flown / name)[..., :3] < 0.9, axis=2)
        assert 0.01 < drawn.mean() < 0.95


def test_the_rings_hold(flown):
    summary = summary_of(flown)
    assert summary["holds"] is True
    assert summary["method"] == "sampled"
    assert sorted(part["pieces"] for part in summary["components"]) == [[0], [1]]
    assert [part["holes"] for part in summary["components"]] == [1, 1]
    assert summary["compact"] is True
    assert 0 < summary["c_in"] < summary["c_out"]
    assert summary["alpha"] > 0
    assert 0 < summary["e_star_min"] < summary["e_star_max"] < 1.01
    assert summary["undecided"] == 0
    assert summary["delta"] > 0.98
    assert 0 < summary["tube_half_width"] < 0.05
    levels = summary["e_star"]
    assert summary["e_star_max"] == max(levels["e_star"])
    assert len(levels["levels"]) == len(levels["e_star"]) == len(levels["weakest"])
    third = summary["assumptions"]["a3"]
    assert third == {"compact": True, "inward": True, "remained_fraction": 1.0}


def test_the_theorem_is_followed_in_drake(flown):
    theorem = summary_of(flown)["theorem"]
    decrease = theorem["decrease"]
    assert decrease["starts"] >= 8
    assert decrease["entered_fraction"] == decrease["stayed_fraction"] == 1.0
    assert decrease["exit"] is None
    assert decrease["V_dot_max"] < 0
    assert len(theorem["level_sets"]["levels"]) == 5
    assert theorem["modes"]["speed_min"] > 0.98


def test_the_flight_is_within_what_its_own_field_tolerates(flown):
    flight = summary_of(flown)["flight"]
    assert flight["covered"] is True
    assert flight["stayed"] is True
    assert 0 < flight["tracking_error_max_m_s"] < flight["tolerated_error_m_s"] < 0.45
    assert [piece["piece"] for piece in flight["pieces"]] == [0, 1]


def test_without_a_band_nobody_follows(tmp_path, flight_field):
    eye = np.eye(2)
    outward = replace(flight_field, tangent_network=Perceptron((eye,), (np.zeros(2),)))
    # Without the robust composition, in which a tangent that points outward is taken out.
    from sgvf_drake.fields import PaperComposition

    outward = replace(outward, composition=PaperComposition(0.2))
    summary = run_verify(outward, None, tmp_path / "out", starts=16)
    assert summary["holds"] is False
    assert summary["theorem"] is summary["flight"] is summary["c_in"] is None
    assert names_in(tmp_path / "out") == {"summary.json", "verify.png"}
    stored = summary_of(tmp_path / "out")
    assert stored["violations"][0]["counts"] is True
    assert stored["assumptions"]["a3"]["remained_fraction"] is None


def test_an_agent_that_leaves_ends_the_claim(tmp_path, monkeypatch, flight_field):
    """The samples are made to say that V falls on levels where it does not."""
    from sgvf_drake.lyapunov import verification

    def outward(self, x):
        return 1.0 * x

    found = verification.verify(flight_field, shape_path("concentric-flight"), ratios=(1.0,))
    monkeypatch.setitem(run_verify.__globals__, "verify", lambda *_, **__: found)
    monkeypatch.setattr(type(flight_field), "_value", outward)
    summary = run_verify(flight_field, None, tmp_path / "out", starts=36)
    assert found.holds
    assert summary["holds"] is False
    assert "left the sublevel set" in summary["reason"]
    assert summary["assumptions"]["a3"]["remained_fraction"] < 1


def test_results_are_not_replaced_unasked(flown, flight_field):
    before = (flown / "summary.json").read_bytes()
    with pytest.raises(OutputExistsError, match=r"already holds summary\.json"):
        run_verify(flight_field, None, flown)
    assert (flown / "summary.json").read_bytes() == before
