"""Stein's identity against closed forms, and verdicts that can go the other way."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.integrate import quad

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.outcome import Verdict
from sgvf_drake.experiments.paper.stein.claims import stein_claims
from sgvf_drake.experiments.paper.stein.experiment import SteinIdentity
from sgvf_drake.experiments.paper.stein.findings import Finding, find
from sgvf_drake.experiments.paper.stein.statistics import (
    best_scale,
    convergence,
    identity,
    log_density,
    score_error,
    slope,
    z_limit,
    zero_mean,
)
from sgvf_drake.experiments.paper.stein.trials import (
    CHUNK,
    FORMS,
    Moments,
    Probe,
    SteinTrial,
    collect,
    make_probes,
    measure_stein,
)
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.fields import GaussianMixture

SIGMA = 0.5
DRAWS = 10 * CHUNK


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
    return make_probes(mixture.points[1])


@pytest.fixture(scope="module")
def exact(mixture, probes):
    return collect(mixture, mixture, probes, DRAWS, seed=0)


@pytest.mark.parametrize("form", FORMS)
def test_the_gradient_of_a_test_field_is_its_derivative(form):
    probe = Probe(form, np.array([0.5, -1.0]), 2.0)
    x = probe.centre + np.random.default_rng(0).uniform(-1.3, 1.3, (200, 2))
    _, gradient = probe.value_and_gradient(x)
    for i, step in enumerate(1e-6 * np.eye(2)):
        ahead, behind = (probe.value_and_gradient(x + s * step)[0] for s in (1, -1))
        np.testing.assert_allclose(gradient[:, i], (ahead - behind) / 2e-6, atol=1e-7)


@pytest.mark.parametrize("form", FORMS)
def test_a_test_field_vanishes_smoothly_outside_of_its_support(form):
    probe = Probe(form, np.zeros(2), 2.0)
    border = 2.0 * np.array([[0.6, 0.8]])
    value, gradient = probe.value_and_gradient(np.concatenate([border, 1.5 * border]))
    assert not value.any()
    assert not gradient.any()
    near = probe.value_and_gradient(0.999 * border)
    assert 0 < np.abs(near[0]).max() < 1e-100
    assert np.abs(near[1]).max() < 1e-100


def test_one_gaussian_gives_the_closed_form():
    # S = -x / sigma^2 and f = b(|x| / R) x / R, so E[S f^T] = -E[b |x|^2] / (2 sigma^2 R) I,
    # an integral over the radius alone.
    radius = 2.0
    one = GaussianMixture(np.zeros((1, 2)), SIGMA)
    moments = collect(one, one, [Probe("radial", np.zeros(2), radius)], DRAWS, seed=1)

    def integrand(r):
        bump = np.exp(1 - 1 / (1 - (r / radius) ** 2))
        return bump * r**2 * r / SIGMA**2 * np.exp(-0.5 * (r / SIGMA) ** 2)

    expected = quad(integrand, 0, radius)[0] / (2 * SIGMA**2 * radius) * np.eye(2)
    for blocks, sign in ((moments.products[:, 0, 0], -1), (moments.gradients[:, 0], 1)):
        errors = blocks.std(axis=0, ddof=1) / np.sqrt(len(blocks))
        assert errors.max() < 0.01 * expected.max()
        np.testing.assert_array_less(np.abs(blocks.mean(axis=0) - sign * expected), 4 * errors)


def test_the_exact_score_keeps_the_identity(exact, probes):
    departures = identity(exact)
    assert len(departures) == len(probes)
    assert max(departure.z for departure in departures) <= z_limit(4 * len(probes))
    assert zero_mean(exact).z <= z_limit(2)
    assert log_density(exact).z <= z_limit(2)
    assert score_error(exact) == 0.0


def test_the_residual_falls_as_one_over_the_root_of_the_draws(exact):
    curve = convergence(exact)
    assert slope(curve) == pytest.approx(-0.5, abs=0.05)
    assert curve["draws"].iloc[-1] == DRAWS
    # The standard error of all draws is what a sample of them has.
    errors = np.array([departure.error for departure in identity(exact)])
    mean_error = np.sqrt((errors**2).mean())
    first = curve.iloc[0]
    assert first["residual"] == pytest.approx(
        mean_error * np.sqrt(DRAWS / first["draws"]), rel=0.1
    )


def test_a_multiple_of_the_score_is_off_by_what_it_is_more(mixture, probes):
    score = Altered(mixture, lambda S: 3 * S)
    moments = collect(score, mixture, probes, DRAWS, seed=0)
    (finding,) = find("three points", "robust", [moments])
    assert finding.share == pytest.approx(2.0, abs=0.05)
    assert finding.z > z_limit(finding.entries)
    assert zero_mean(moments).z <= z_limit(2)
    assert score_error(moments) == pytest.approx(2.0, rel=1e-6)


def test_a_shifted_score_has_a_mean(mixture, probes):
    shift = np.array([0.3, -0.4])
    moments = collect(Altered(mixture, lambda S: S + shift), mixture, probes, DRAWS, seed=0)
    size = np.sqrt(moments.squares[:, 0].mean())
    mean = zero_mean(moments)
    assert mean.residual == pytest.approx(0.5 / size, abs=3 * mean.error)
    assert mean.z > z_limit(2)
    # The identity cannot depart by more than the score does (Cauchy and Schwarz).
    errors = np.sqrt(moments.error_squares.mean() / moments.squares[:, 0].mean())
    assert errors == pytest.approx(0.5 / size)
    assert all(d.residual <= errors + 4 * d.error for d in identity(moments))


def test_the_best_scale_of_a_squashed_score_that_is_hardly_squashed(probes):
    # With k_s |S| small, s = k_s S, and 1 / k_s = 5 makes it the score again.
    wide = GaussianMixture(np.array([[0.0, 0.0], [30.0, 10.0]]), 100.0)
    far = [replace(probe, radius=100 * probe.radius) for probe in probes]
    moments = collect(wide, wide, far, CHUNK, seed=0)
    assert best_scale(moments) == pytest.approx(5.0, rel=0.1)


def test_moments_are_read_as_they_were_saved(exact, tmp_path):
    exact.save(tmp_path)
    read = Moments.load(tmp_path)
    for name, value in vars(exact).items():
        np.testing.assert_allclose(getattr(read, name), value, rtol=1e-6, atol=1e-30)


def test_a_learned_score_is_tested_on_its_own_density(tmp_path, monkeypatch, robust_result):
    monkeypatch.setattr("sgvf_drake.learning.train", lambda cloud, config: robust_result)
    trial = SteinTrial("concentric-circles", "uniform", "robust", 0, 2 * CHUNK)
    row = measure_stein(trial, tmp_path)
    assert [probe["form"] for probe in row["probes"][:3]] == list(FORMS)
    moments = Moments.load(tmp_path)
    assert 0.01 < score_error(moments) < 0.2
    # Across a path of dense waypoints the score is that of one Gaussian, along it zero.
    size = np.sqrt(moments.exact_squares.mean())
    assert size == pytest.approx(1 / robust_result.field.sigma, rel=0.03)


def test_the_kind_runs_on_exact_scores(tmp_path):
    outcome = SteinIdentity(recipes=[], draws=2 * CHUNK, seeds=[0]).run(Workbench(tmp_path))
    names = [exhibit.name for exhibit in outcome.exhibits]
    assert names == ["stein", "stein_scores", "stein_test_fields"]
    assert len(outcome.exhibits[1].content) == 6
    assert len(outcome.exhibits[2].content) == 9
    assert [claim.key for claim in outcome.claims] == [
        "stein-identity",
        "stein-log-density",
        "stein-squashed-identity",
        "stein-squashed-mean",
    ]


@pytest.mark.parametrize("draws", [0, CHUNK - 1, CHUNK + 1])
def test_draws_that_do_not_fill_their_chunks_are_an_error(draws, tmp_path):
    with pytest.raises(ConfigurationError, match=f"a positive multiple of 20000, not {draws}"):
        SteinIdentity(draws=draws).run(Workbench(tmp_path))


def planted(score, density="even", **changes):
    """A finding that keeps the identity within its errors."""
    draws = np.array([1_000, 2_000, 4_000, 8_000])
    finding = Finding(
        density=density,
        score=score,
        residuals=np.full((2, 3), 0.001),
        errors=np.full((2, 3), 0.001),
        signals=np.full((2, 3), 0.02),
        z=1.0,
        entries=24,
        means=np.full(2, 0.001),
        mean_z=1.0,
        logs=np.full(2, 0.001),
        log_z=1.0,
        score_errors=np.zeros(2),
        curve=pd.DataFrame({"draws": draws, "residual": draws**-0.5}),
        scale=1.0,
    )
    return replace(finding, **changes)


def verdicts(**changes):
    """The verdicts of five findings, some of them changed."""
    findings = {
        "exact": planted("exact"),
        "squashed": planted("exact, squashed", z=100.0, mean_z=9.0),
        "rescaled": planted("exact, squashed and rescaled", scale=13.0),
        "robust": planted("robust recipe", z=9.0),
        "paper": planted("paper's recipe", z=40.0, residuals=np.full((2, 3), 0.015)),
    }
    for name, change in changes.items():
        findings[name] = replace(findings[name], **change)
    claims = stein_claims(list(findings.values()))
    return {claim.key.removeprefix("stein-"): claim.verdict for claim in claims}


def test_what_was_expected_holds():
    assert verdicts() == {
        "identity": Verdict.HOLDS,
        "log-density": Verdict.HOLDS,
        "learned-robust": Verdict.PARTLY,
        "learned-paper": Verdict.FAILS,
        "squashed-identity": Verdict.HOLDS,
        "squashed-mean": Verdict.HOLDS,
    }


@pytest.mark.parametrize(
    ("key", "name", "change", "verdict"),
    [
        ("identity", "exact", {"z": 5.0}, Verdict.FAILS),
        ("log-density", "exact", {"log_z": 5.0}, Verdict.FAILS),
        ("log-density", "exact", {"mean_z": 5.0}, Verdict.FAILS),
        ("learned-robust", "robust", {"z": 1.0}, Verdict.HOLDS),
        ("learned-robust", "robust", {"residuals": np.full((2, 3), 0.01)}, Verdict.FAILS),
        ("learned-paper", "paper", {"residuals": np.full((2, 3), 0.002)}, Verdict.PARTLY),
        ("squashed-identity", "squashed", {"z": 1.0}, Verdict.FAILS),
        ("squashed-mean", "squashed", {"mean_z": 1.0}, Verdict.FAILS),
    ],
)
def test_a_verdict_follows_from_its_figures(key, name, change, verdict):
    changed = verdicts(**{name: change})
    assert changed[key] == verdict
    others = verdicts()
    del changed[key], others[key]
    assert changed == others


def test_a_residual_that_does_not_fall_is_a_departure():
    flat = pd.DataFrame({"draws": [1_000, 2_000, 4_000, 8_000], "residual": 4 * [0.01]})
    assert verdicts(exact={"curve": flat})["identity"] == Verdict.FAILS
