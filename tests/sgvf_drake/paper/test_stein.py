"""Stein's identity against closed forms, and verdicts that can go the other way."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad

from sgvf_drake import learning
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.paper import stein
from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.moments import CHUNK, FORMS, SQUASHED, Probe, collect, make_probes
from sgvf_drake.paper.stein import (
    SCORES,
    SteinIdentity,
    SteinTrial,
    findings,
    measure_stein,
    z_limit,
)

HOLDS, PARTLY, FAILS = Verdict.HOLDS, Verdict.PARTLY, Verdict.FAILS
SIGMA = 0.5
DRAWS = 5 * CHUNK


class Altered:
    """A score that is not that of the mixture."""

    def __init__(self, mixture, change):
        self.mixture = mixture
        self.change = change

    def score(self, x):
        return self.change(self.mixture.score(x))


@pytest.fixture(scope="module")
def mixture():
    """Three waypoints that no turn leaves as they are."""
    return GaussianMixture(np.array([[0.0, 0.0], [1.0, 0.5], [-0.5, 1.5]]), SIGMA)


@pytest.fixture(scope="module")
def probes(mixture):
    return make_probes(mixture.points[1:2])


@pytest.fixture(scope="module")
def exact(mixture, probes):
    return collect(mixture, mixture, probes, DRAWS, seed=0)


def standard_errors(blocks):
    return blocks.std(axis=0, ddof=1) / np.sqrt(len(blocks))


@pytest.mark.parametrize("form", FORMS)
def test_a_test_field_is_smooth_and_vanishes_outside_of_its_support(form):
    probe = Probe(form, np.array([0.5, -1.0]), 2.0)
    x = probe.centre + np.random.default_rng(0).uniform(-1.3, 1.3, (200, 2))
    _, gradient = probe.value_and_gradient(x)
    for i, step in enumerate(1e-6 * np.eye(2)):
        ahead, behind = (probe.value_and_gradient(x + s * step)[0] for s in (1, -1))
        np.testing.assert_allclose(gradient[:, i], (ahead - behind) / 2e-6, atol=1e-7)
    border = 2.0 * np.array([[0.6, 0.8]])
    for part in probe.value_and_gradient(probe.centre + np.concatenate([border, 1.5 * border])):
        assert np.abs(part).max() < 1e-100
    value, gradient = probe.value_and_gradient(probe.centre + 0.999 * border)
    assert 0 < np.abs(value).max() < 1e-100
    assert np.abs(gradient).max() < 1e-100


def test_one_gaussian_gives_the_closed_form():
    # S = -x / sigma^2 and f = b(|x| / R) x / R, so E[S f^T] = -E[b |x|^2] / (2 sigma^2 R) I,
    # an integral over the radius alone.
    radius = 2.0
    one = GaussianMixture(np.zeros((1, 2)), SIGMA)
    moments = collect(one, one, [Probe("radial", np.zeros(2), radius)], 2 * DRAWS, seed=1)

    def integrand(r):
        bump = np.exp(1 - 1 / (1 - (r / radius) ** 2))
        return bump * r**2 * r / SIGMA**2 * np.exp(-0.5 * (r / SIGMA) ** 2)

    expected = quad(integrand, 0, radius)[0] / (2 * SIGMA**2 * radius) * np.eye(2)
    for blocks, sign in ((moments.products[:, 0, 0], -1), (moments.gradients[:, 0], 1)):
        errors = standard_errors(blocks)
        assert errors.max() < 0.01 * expected.max()
        np.testing.assert_array_less(np.abs(blocks.mean(axis=0) - sign * expected), 4 * errors)


def test_the_exact_score_keeps_the_identity(exact, probes):
    found = exact.departures()
    assert len(found["residuals"]) == len(probes)
    assert found["z"] <= z_limit(4 * len(probes))
    assert max(found["mean_z"], found["log_z"]) <= z_limit(2)
    assert found["score_error"] == 0.0
    # The residual falls as one over the root of the draws, to the standard error of all.
    draws, curve = np.array(found["draws"]), np.array(found["curve"])
    assert draws[-1] == DRAWS
    slope = np.polyfit(np.log(draws[:-1]), np.log(curve[:-1]), 1)[0]
    assert slope == pytest.approx(-0.5, abs=0.05)
    mean_error = np.sqrt((found["errors"] ** 2).mean())
    assert curve[0] == pytest.approx(mean_error * np.sqrt(DRAWS / draws[0]), rel=0.1)


def test_a_score_that_is_altered_departs_by_as_much(mixture, probes):
    found = collect(Altered(mixture, lambda S: 3 * S), mixture, probes, DRAWS, 0).departures()
    (share,) = findings(rows_of({"robust recipe": found}))["share"]
    assert share == pytest.approx(2.0, abs=0.05)
    assert found["z"] > z_limit(4 * len(probes))
    assert found["mean_z"] <= z_limit(2)
    assert found["score_error"] == pytest.approx(2.0, rel=1e-6)
    # A shifted score has a mean.
    shifted = Altered(mixture, lambda S: S + np.array([0.3, -0.4]))
    moments = collect(shifted, mixture, probes, DRAWS, seed=0)
    found, size = moments.departures(), np.sqrt(moments.squares[:, 0].mean())
    error = np.linalg.norm(standard_errors(moments.means[:, 0])) / size
    assert found["mean"] == pytest.approx(0.5 / size, abs=3 * error)
    assert found["mean_z"] > z_limit(2)
    # The identity cannot depart by more than the score does (Cauchy and Schwarz).
    departure = np.sqrt(moments.error_squares.mean()) / size
    assert departure == pytest.approx(0.5 / size)
    assert np.all(found["residuals"] <= departure + 4 * found["errors"])


def test_the_best_scale_of_a_squashed_score_that_is_hardly_squashed(probes):
    # With k_s |S| small, s = k_s S, and 1 / k_s = 5 makes it the score again.
    wide = GaussianMixture(np.array([[0.0, 0.0], [30.0, 10.0]]), 100.0)
    far = [replace(probe, radius=100 * probe.radius) for probe in probes]
    moments = collect(wide, wide, far, CHUNK, seed=0)
    assert moments.best_scale() == pytest.approx(5.0, rel=0.1)
    squashed, scaled = (moments.departures(SQUASHED, k)["z"] for k in (1.0, 5.0))
    assert squashed > 10
    assert scaled < z_limit(4 * len(probes))


def test_a_learned_score_is_tested_on_its_own_density(tmp_path, monkeypatch, robust_field):
    drawn = []

    def stored(cloud, config):
        return SimpleNamespace(guiding_field=robust_field)

    def collected(*arguments):
        drawn.append(collect(*arguments))
        return drawn[0]

    monkeypatch.setattr(learning, "train", stored)
    monkeypatch.setattr(stein, "collect", collected)
    trial = SteinTrial("concentric-circles", "uniform", "robust", 0, 2 * CHUNK)
    row = measure_stein(trial, tmp_path)
    assert [probe["form"] for probe in row["probes"][:3]] == list(FORMS)
    assert not list(tmp_path.iterdir())
    assert 0.01 < row["found"]["robust recipe"]["score_error"] < 0.2
    # Across a path of dense waypoints the score is that of one Gaussian, along it zero.
    size = np.sqrt(drawn[0].exact_squares.mean())
    assert size == pytest.approx(1 / robust_field.sigma, rel=0.03)


def test_the_kind_runs_on_exact_scores(run_kind, tmp_path):
    found = run_kind(SteinIdentity(recipes=[], draws=2 * CHUNK, seeds=[0]), tmp_path)
    assert [*found.figures] == ["stein"]
    assert [len(table) for table in found.tables.values()] == [6, 9]
    assert [*found.verdicts] == [
        *("stein-identity", "stein-log-density"),
        *("stein-squashed-identity", "stein-squashed-mean"),
    ]


@pytest.mark.parametrize("draws", [0, CHUNK - 1, CHUNK + 1])
def test_draws_that_do_not_fill_their_chunks_are_refused(draws):
    with pytest.raises(ConfigurationError, match=f"multiple of {CHUNK}, not {draws}"):
        SteinIdentity(draws=draws).measure(None)


# Verdicts.

DRAWN = [1_000, 2_000, 4_000, 8_000]
KEPT = {
    **{name: [0.001] * 3 for name in ("residuals", "errors")},
    "signals": [0.02] * 3,
    **{"z": 1.0, "mean": 0.001, "mean_z": 1.0, "log": 0.001, "log_z": 1.0},
    **{"score_error": 0.0, "scale": 1.0},
    **{"draws": DRAWN, "curve": [draws**-0.5 for draws in DRAWN]},
}
EXPECTED = {
    "exact": KEPT,
    "exact, squashed": KEPT | {"z": 100.0, "mean_z": 9.0},
    "exact, squashed and rescaled": KEPT | {"scale": 13.0},
    "robust recipe": KEPT | {"z": 9.0},
    "paper's recipe": KEPT | {"z": 40.0, "residuals": [0.015] * 3},
}


def rows_of(found, seeds=1):
    """Rows of trials that found so in each seed, of some scores."""
    trial = {"cloud": "circle", "sampling": "uniform", "found": found}
    return {SCORES: pd.DataFrame([{**trial, "seed": seed} for seed in range(seeds)])}


@pytest.mark.parametrize(("error", "share"), [(0.0, 0.25), (0.003, 0.2), (0.009, 0.0)])
def test_the_noise_of_the_draws_is_no_departure_from_the_identity(error, share):
    found = {"residuals": [0.005] * 3, "errors": [error] * 3, "signals": [0.02] * 3}
    (one,) = findings(rows_of({"exact": KEPT | found}, seeds=2)).to_dict("records")
    assert one["share"] == pytest.approx(share)


def verdicts(name="exact", **change):
    """The verdicts on what is expected, where one score is changed."""
    rows = rows_of(EXPECTED | {name: EXPECTED[name] | change}, seeds=2)
    found = SteinIdentity().findings(rows)
    return {finding.key.removeprefix("stein-"): finding.verdict for finding in found}


def test_verdicts_follow_from_the_figures():
    expected = {
        "identity": HOLDS,
        "log-density": HOLDS,
        "learned-robust": PARTLY,
        "learned-paper": FAILS,
        "squashed-identity": HOLDS,
        "squashed-mean": HOLDS,
    }
    assert verdicts() == expected
    for key, name, change, verdict in (
        ("identity", "exact", {"z": 5.0}, FAILS),
        # A residual that does not fall is a departure.
        ("identity", "exact", {"curve": [0.01] * 4}, FAILS),
        ("log-density", "exact", {"log_z": 5.0}, FAILS),
        ("log-density", "exact", {"mean_z": 5.0}, FAILS),
        ("learned-robust", "robust recipe", {"z": 1.0}, HOLDS),
        ("learned-robust", "robust recipe", {"residuals": [0.01] * 3}, FAILS),
        ("learned-paper", "paper's recipe", {"residuals": [0.002] * 3}, PARTLY),
        ("squashed-identity", "exact, squashed", {"z": 1.0}, FAILS),
        ("squashed-mean", "exact, squashed", {"mean_z": 1.0}, FAILS),
    ):
        assert verdicts(name, **change) == expected | {key: verdict}, (key, change)
    of_paper = {f.key: f.of_paper for f in SteinIdentity().findings(rows_of(EXPECTED))}
    assert [key for key, paper in of_paper.items() if not paper] == ["stein-learned-robust"]
