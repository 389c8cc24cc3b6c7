"""Verification with its trajectories and flights: what it leaves behind."""

from dataclasses import replace

import numpy as np
import pytest

from sgvf_drake.experiments import run_verify
from sgvf_drake.experiments.verify import verification_summary
from sgvf_drake.fields import PaperComposition, Perceptron
from sgvf_drake.lyapunov import verify
from sgvf_drake.paths import Piece, ReferencePath
from tests.fields import tilted_circle
from tests.helpers import circle as circle_of
from tests.helpers import ink, names_in, summary_of

KEYS = {
    *("holds", "reason", "method", "sigma", "c_in", "c_out", "alpha", "delta"),
    *("tube_half_width", "area_fraction", "decrease_fraction", "compact", "components"),
    *("e_star_max", "e_star_min", "e_star", "undecided", "violations", "assumptions", "lemma"),
    *("bounds", "theorem", "flight", "time_s", "unit_length", "reference", "recipe", "seed"),
    "digest",
}


pytestmark = pytest.mark.usefixtures("coarse_grid")


@pytest.fixture(scope="module")
def circle(ring_field):
    """A field around a circle of 1 m, and the circle."""
    field = ring_field.rescaled(0.25)
    return field, (ReferencePath((Piece(circle_of(1.0, 400), closed=True),)), "file")


@pytest.fixture(scope="module")
def flown(tmp_path_factory, circle, coarse_grid):
    """The folder of a verification with a flight."""
    field, path = circle
    out = tmp_path_factory.mktemp("verify") / "flown"
    run_verify(field, path, out, starts=36, speed=0.45)
    return out


def test_everything_is_there(flown):
    assert names_in(flown) == {"summary.json", "verify.png", "theorem.png", "tracking.png"}
    summary = summary_of(flown)
    assert set(summary) == KEYS
    for name in names_in(flown) - {"summary.json"}:
        assert 0.01 < ink(flown / name) < 0.95


def test_the_ring_holds(flown):
    summary = summary_of(flown)
    assert (summary["holds"], summary["method"]) == (True, "sampled")
    assert summary["components"] == [{"pieces": [0], "holes": 1}]
    assert summary["compact"] is True
    assert 0 < summary["c_in"] < summary["c_out"]
    assert summary["alpha"] > 0
    assert 0 < summary["e_star_min"] < summary["e_star_max"] < 1.01
    assert summary["undecided"] == 0
    assert summary["delta"] > 0.95
    assert 0 < summary["tube_half_width"] < 0.1
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
    assert theorem["modes"]["speed_min"] > 0.95


def test_the_flight_is_within_what_its_own_field_tolerates(flown):
    flight = summary_of(flown)["flight"]
    assert flight["covered"] is True
    assert flight["stayed"] is True
    assert 0 < flight["tracking_error_max_m_s"] < flight["tolerated_error_m_s"] < 0.45
    assert [piece["piece"] for piece in flight["pieces"]] == [0]


def test_without_a_band_nobody_follows(tmp_path, circle):
    field, path = circle
    # Without the robust composition, in which a tangent that points outward is taken out.
    outward = replace(
        field,
        tangent_network=Perceptron((np.eye(2),), (np.zeros(2),)),
        composition=PaperComposition(0.2),
    )
    summary = run_verify(outward, path, tmp_path / "out", starts=16)
    assert summary["holds"] is False
    assert summary["theorem"] is summary["flight"] is summary["c_in"] is None
    assert names_in(tmp_path / "out") == {"summary.json", "verify.png"}
    stored = summary_of(tmp_path / "out")
    assert stored["violations"][0]["counts"] is True
    assert stored["assumptions"]["a3"]["remained_fraction"] is None


@pytest.fixture(scope="module")
def found(circle, coarse_grid):
    """The verification of that field with one noise level of V."""
    field, (path, _) = circle
    return verify(field, path, ratios=(1.0,))


def test_a_flow_outwards_at_one_level_is_told(circle, found):
    for least, inward in ((1e-3, True), (-1e-3, False)):
        e_star = found.margins.e_star.copy()
        e_star[3] = least
        planted = replace(found, margins=replace(found.margins, e_star=e_star))
        summary = verification_summary(circle[0], planted)
        assert summary["e_star_min"] == least
        assert summary["assumptions"]["a3"]["inward"] is inward


def test_an_agent_that_leaves_ends_the_claim(tmp_path, monkeypatch, circle, found):
    """The samples are made to say that V falls on levels where it does not."""
    field, path = circle

    def outward(self, x):
        return 1.0 * x

    monkeypatch.setitem(run_verify.__globals__, "verify", lambda *_, **__: found)
    monkeypatch.setattr(type(field), "_value", outward)
    summary = run_verify(field, path, tmp_path / "out", starts=36)
    assert found.holds
    assert summary["holds"] is False
    assert "left the sublevel set" in summary["reason"]
    assert summary["assumptions"]["a3"]["remained_fraction"] < 1


@pytest.mark.full
def test_in_space_the_same_is_left(tmp_path):
    field, _ = tilted_circle()
    summary = run_verify(field, None, tmp_path / "out", starts=16)
    assert set(summary) == KEYS
    assert summary["holds"], summary["reason"]
    assert summary["components"] == [{"pieces": (0,), "holes": 1}]
    decrease = summary["theorem"]["decrease"]
    assert decrease["starts"] >= 8
    assert decrease["stayed_fraction"] == 1.0
    assert names_in(tmp_path / "out") == {"summary.json", "verify.png", "theorem.png"}
    assert 0.01 < ink(tmp_path / "out" / "verify.png") < 0.95
