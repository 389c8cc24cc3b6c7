"""Assumptions, lemma and bounds, on fields where each of them is known."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.lyapunov import (
    LyapunovFunction,
    Samples,
    check_assumptions,
    check_lemma,
    robustness_bounds,
    take_samples,
)
from sgvf_drake.lyapunov.conditions import _along_level_sets
from tests.fields import exact_field, linear_network

GRID = 81
QUARTER_TURN = np.array([[0.0, -0.25], [0.25, 0.0]])
GAIN = 0.2


@pytest.fixture(scope="module")
def turning(ring_field, linear):
    """m = s + v around a ring, v a rotation of length one on it; V, and the samples."""
    field, _ = ring_field(tangent=linear(QUARTER_TURN), composition="paper", spacing=0.05)
    return field, LyapunovFunction.of(field), take_samples(field, grid_size=GRID)


@pytest.fixture(scope="module")
def assumptions(turning):
    return check_assumptions(*turning)


def test_an_exact_score_is_a_gradient(assumptions):
    assert assumptions["a1_score_curl"] < 1e-12
    # The learned score is the exact one here.
    assert assumptions["a1_score_lipschitz"] == pytest.approx(assumptions["a1_exact_lipschitz"])
    # At least the curvature across the ring.
    assert assumptions["a1_exact_lipschitz"] >= 0.99 / 0.1**2
    summary = assumptions
    assert set(summary) >= {"a1_score_lipschitz", "a2_cosine", "a2_length_error"}
    assert set(summary["a2_cosine"]) == {"mean", "q50", "q90", "q95", "q99", "max", "where"}


def test_a_rotation_is_orthogonal_to_the_score_of_a_ring(assumptions):
    # Not at the centre, where the waypoints show.
    assert assumptions["a2_cosine"]["mean"] < 1e-3
    assert assumptions["a2_cosine_networks"]["mean"] == pytest.approx(
        assumptions["a2_cosine"]["mean"]
    )
    assert assumptions["a2_cosine_gradient"]["mean"] == pytest.approx(
        assumptions["a2_cosine"]["mean"]
    )
    assert np.linalg.norm(assumptions["a2_cosine"]["where"]) < 0.5


def test_the_length_of_m_is_that_of_its_parts(turning, assumptions):
    _, _, samples = turning
    x = samples.x[samples.on_grid]
    radius = np.linalg.norm(x, axis=1)
    # |v| = r / 4, and |s| = tanh(k |S|) with |S| ~ |r - 4| / sigma^2, away from the centre.
    far = (radius > 0.5) & (np.abs(radius - 4) > 0.1)
    expected = np.hypot(np.tanh(GAIN * np.abs(radius - 4) / 0.1**2), radius / 4)
    m = np.linalg.norm(samples.m[samples.on_grid], axis=1)
    np.testing.assert_allclose(m[far], expected[far], rtol=1e-3)
    error = np.abs(m - 1)
    assert assumptions["a2_length_error"]["mean"] == pytest.approx(error.mean())
    assert assumptions["a2_length_error"]["max"] == pytest.approx(error.max())


def test_a_rotation_has_the_slope_a_quarter(turning, assumptions):
    # v(x) - v(y) is x - y turned, over four.
    slope = 0.25 / turning[0].cloud.unit_length
    spread = assumptions["a2_lipschitz_along_level_sets"]
    assert spread["mean"] == pytest.approx(slope, rel=1e-9)
    assert spread["max"] == pytest.approx(slope, rel=1e-9)
    assert assumptions["a2_lipschitz_between_points"] == pytest.approx(slope, rel=1e-9)


def test_the_lemma_holds_where_v_is_orthogonal(turning):
    field, function, samples = turning
    lemma = check_lemma(function, samples)
    assert lemma["paper_error"]["mean"] < 1e-3
    x, s = samples.x[samples.on_grid], samples.s[samples.on_grid]
    # The paper's V_dot is -|s|^2, the true one -|S| |s|: of one sign.
    V_dot = function.along(field, x)
    clear = np.abs(V_dot) > 1e-3
    S = function.gradient(x)
    true = -np.linalg.norm(S, axis=1) * np.linalg.norm(s, axis=1)
    np.testing.assert_allclose(V_dot[clear], true[clear], rtol=0.05, atol=0.05)
    assert lemma["sign_agreement"] > 0.999
    assert lemma["falling_fraction"] > 0.999
    assert lemma["v_dot"]["max"] == pytest.approx(V_dot.max())


def test_a_field_that_flows_out_breaks_the_lemma(ring_field, linear):
    # v = x points out of the ring where it is outside, with up to five times the speed of s.
    field, _ = ring_field(tangent=linear(np.eye(2)), composition="paper")
    function, samples = LyapunovFunction.of(field), take_samples(field, grid_size=GRID)
    lemma = check_lemma(function, samples)
    radius = np.linalg.norm(samples.x[samples.on_grid], axis=1)
    assert lemma["falling_fraction"] == pytest.approx((radius < 4).mean(), abs=0.02)
    assert np.linalg.norm(lemma["v_dot"]["where"]) > 4


def samples_of(s, v):
    """Samples of which only the parts of m matter: a grid of as many points as there are."""
    x = np.column_stack([np.linspace(0.1, 1, len(s)), np.zeros(len(s))])
    return Samples((x[:, 0], np.zeros(1)), x, s, v)


class Slope:
    """A function of which only the gradient -S is asked."""

    def __init__(self, S):
        self.S = S

    def gradient(self, x):
        return -self.S


@pytest.mark.parametrize("dim", [2, 3])
def test_the_slope_along_a_level_set_is_that_across_its_normal(dim):
    """Of a linear v, the largest size of J v tau among unit vectors tau with n . tau = 0."""
    rng = np.random.default_rng(dim)
    A, n = rng.normal(size=(dim, dim)), rng.normal(size=dim)
    points = rng.uniform(-4, 4, (20, dim))
    tangent = linear_network(A, np.zeros(dim))
    field = exact_field(points, tangent, composition="paper")
    found = _along_level_sets(field, points, np.tile(n, (20, 1)))
    across = np.eye(dim) - np.outer(n, n) / (n @ n)
    slope = np.linalg.norm(A @ across, 2) / field.cloud.unit_length
    assert found["max"] == pytest.approx(slope, rel=1e-9)
    assert found["mean"] == pytest.approx(slope, rel=1e-9)


@given(st.integers(0, 10_000))
@settings(max_examples=60)
def test_which_bounds_follow(seed):
    rng = np.random.default_rng(seed)
    direction = rng.standard_normal((50, 2))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    S = rng.exponential(10, (50, 1)) * direction
    s = np.tanh(0.2 * np.linalg.norm(S, axis=1, keepdims=True)) * direction
    v = rng.standard_normal((50, 2))
    paper, squashed, gradient = robustness_bounds(Slope(S), samples_of(s, v))
    # With s along S both corrected forms follow from Cauchy and Schwarz...
    assert squashed.holds.all()
    assert gradient.holds.all()
    # ... and the printed one fails just where s . v < 0, since there |s| < 1 makes the cross
    # term larger than the bound has it.
    cross = (s * v).sum(axis=1)
    clear = np.abs(cross) * (1 - np.linalg.norm(s, axis=1)) > 1e-6
    np.testing.assert_array_equal(paper.holds[clear], cross[clear] > 0)


def test_the_gradient_bound_is_missed_by_the_error_of_the_direction():
    S, s = np.array([[2.0, 0.0]] * 3), np.array([[0.5, 0.0], [0.3, 0.4], [0.0, 0.5]])
    gradient = robustness_bounds(Slope(S), samples_of(s, np.zeros((3, 2))))[2]
    np.testing.assert_array_equal(gradient.holds, [True, False, False])
    # |s| (1 - cos(s, S)).
    np.testing.assert_allclose(gradient.excess, [0.0, 0.2, 0.5], atol=1e-12)
    assert gradient.summary()["nearly_holds_fraction"] == pytest.approx(1 / 3)
    # With v beside S its eps is |cos(S, v)| = 0.6, where |cos(s, v)| is 0, 1 and 0.8.
    s, v = np.array([[0.4, -0.3], [0.3, 0.4], [0.0, 0.5]]), np.array([[0.6, 0.8]] * 3)
    gradient = robustness_bounds(Slope(S), samples_of(s, v))[2]
    np.testing.assert_allclose(gradient.excess, -(s[:, 0] + 0.6) + 0.5 - 0.6, atol=1e-12)


def test_a_bound_promises_a_decrease_where_the_score_outweighs_the_error():
    s = np.array([[0.9, 0.0], [0.1, 0.0]])
    v = np.array([[0.6, 0.8], [0.6, 0.8]])
    paper, squashed, _ = robustness_bounds(Slope(s), samples_of(s, v))
    # eps |v| = 0.6: less than 0.9, more than 0.1; the printed form asks only for less than 1.
    np.testing.assert_array_equal(squashed.decreases, [True, False])
    np.testing.assert_array_equal(paper.decreases, [True, True])
