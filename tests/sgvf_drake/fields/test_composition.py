"""How score and tangent make m: formulas, limits, and derivatives of every composition."""

from itertools import product

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.stats import ortho_group

from sgvf_drake.fields import (
    NormalisedComposition,
    PaperComposition,
    RobustComposition,
    composition,
)

SIGMA = 0.1
PAPER, ROBUST = PaperComposition(0.2), RobustComposition(0.2, SIGMA)
NORMALISED = NormalisedComposition(0.2)
UNPROJECTED = RobustComposition(0.2, SIGMA, projects=False)
EACH = pytest.mark.parametrize(
    "compose",
    [PAPER, ROBUST, NORMALISED, UNPROJECTED],
    ids=["paper", "robust", "normalised", "unprojected"],
)


def arguments(dim=2, n=50, score_scale=10.0, seed=0):
    """Scores from well inside the projection range (|S| < 3 / sigma) to outside, and N."""
    rng = np.random.default_rng(seed)
    return score_scale * rng.standard_normal((n, dim)), rng.standard_normal((n, dim))


def step_partials(compose, S, N):
    """By a complex step through `value`: exact to rounding, at any magnitude."""
    eye, step = np.eye(S.shape[1]), 1e-30
    by_S = [compose.value(S + 1j * step * e, N).imag / step for e in eye]
    by_N = [compose.value(S, N + 1j * step * e).imag / step for e in eye]
    return np.stack(by_S, axis=2), np.stack(by_N, axis=2)


@EACH
def test_partials_at_every_magnitude(compose):
    scores, tangents = (0.0, 1e-13, 1e-9, 1e-3, 1.0, 30.0, 1e3, 1e6), (0.0, 1e-9, 1.0, 1e6)
    for score_size, tangent_size in product(scores, tangents):
        S, N = arguments()
        S *= score_size / np.linalg.norm(S, axis=1, keepdims=True)
        N *= tangent_size / np.linalg.norm(N, axis=1, keepdims=True)
        m, by_S, by_N = compose.value_and_partials(S, N)
        assert np.isfinite(m).all()
        exact_S, exact_N = step_partials(compose, S, N)
        # Relative to the largest entry, k_s or 1 / delta; the clamp of |S|^2 costs 1e-12.
        np.testing.assert_allclose(by_S, exact_S, rtol=1e-8, atol=1e-11 * compose.gain)
        np.testing.assert_allclose(by_N, exact_N, rtol=1e-8, atol=1e-11 / 0.05)


@EACH
@settings(max_examples=30, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    dim=st.integers(2, 3),
    size=st.floats(-9, 6),
    n=st.floats(-9, 6),
)
def test_the_composition_has_no_preferred_direction(compose, seed, dim, size, n):
    """Under rotations and reflections Q, m(Q S, Q N) = Q m(S, N)."""
    S, N = arguments(dim, n=5, score_scale=10**size, seed=seed)
    N *= 10**n
    Q = ortho_group.rvs(dim, random_state=np.random.default_rng(seed))
    m, by_S, _ = compose.value_and_partials(S, N)
    turned, turned_by_S, _ = compose.value_and_partials(S @ Q.T, N @ Q.T)
    scale = max(1.0, np.abs(m).max())
    np.testing.assert_allclose(turned, m @ Q.T, atol=1e-11 * scale)
    np.testing.assert_allclose(turned_by_S, Q @ by_S @ Q.T, atol=1e-11)


def test_at_the_peak_of_the_density_the_field_is_its_tangent():
    _, N = arguments()
    for compose in (PAPER, ROBUST):
        m, by_S, by_N = compose.value_and_partials(np.zeros_like(N), N)
        v = compose.tangent(N)
        np.testing.assert_allclose(m, v, rtol=1e-14)
        # tanh(k |S|) S / |S| begins as k S; the robust form first takes out the part along v.
        slope = np.eye(2) - (v[:, :, None] * v[:, None] if compose is ROBUST else 0)
        np.testing.assert_allclose(by_S, np.broadcast_to(0.2 * slope, by_S.shape), atol=1e-13)
        norm = np.sqrt((N**2).sum(axis=1) + composition.DIRECTION_SOFTENING**2)[:, None, None]
        direction = np.eye(2) / norm - N[:, :, None] * N[:, None] / norm**3
        expected = direction if compose is ROBUST else np.broadcast_to(np.eye(2), by_N.shape)
        np.testing.assert_allclose(by_N, expected, rtol=1e-12, atol=1e-12)


def test_paper_adds_without_renormalising_and_normalised_is_the_direction_of_that_sum():
    S, N = arguments()
    size = np.linalg.norm(S, axis=1, keepdims=True)
    n = np.tanh(0.2 * size) * S / size + N
    np.testing.assert_allclose(PAPER.value(S, N), n, rtol=1e-13, atol=1e-15)
    length = np.linalg.norm(n, axis=1, keepdims=True)
    assert length.min() > 1e-3
    # delta^2 / (2 |n|^2), with delta of 1e-6.
    np.testing.assert_allclose(NORMALISED.value(S, N), n / length, rtol=5e-7)
    np.testing.assert_allclose(np.linalg.norm(NORMALISED.value(S, N), axis=1), 1, rtol=5e-7)
    # Both parts are scaled by the same factor.
    for part, whole in zip(NORMALISED.components(S, N), PAPER.components(S, N), strict=True):
        np.testing.assert_allclose(part, whole / length, rtol=1e-6)
    for compose in (PAPER, NORMALISED):
        np.testing.assert_array_equal(compose.tangent(N), N)


def test_where_score_and_tangent_cancel_the_normalised_field_is_zero_and_smooth():
    S, _ = arguments()
    s, _ = PAPER.components(S, S)
    m, by_S, by_N = NORMALISED.value_and_partials(S, -s)
    np.testing.assert_array_equal(m, 0)
    assert np.isfinite(by_S).all()
    # There the direction turns over a length of delta.
    np.testing.assert_allclose(by_N, np.broadcast_to(1e6 * np.eye(2), by_N.shape), rtol=1e-12)


def test_robust_is_the_papers_sum_with_unit_length_where_score_and_tangent_are_orthogonal():
    rng = np.random.default_rng(1)
    angle, size = rng.uniform(0, 2 * np.pi, 100), 10 ** rng.uniform(-2, 1.3, 100)
    v = np.column_stack([np.cos(angle), np.sin(angle)])
    S = size[:, None] * np.column_stack([-v[:, 1], v[:, 0]])
    m = ROBUST.value(S, 1e7 * v)
    s = np.tanh(0.2 * size)[:, None] * S / size[:, None]
    np.testing.assert_allclose(m, s + v / np.cosh(0.2 * size)[:, None], atol=1e-14)
    # tanh^2 + sech^2 = 1; the softening of a huge N is below the last bit.
    np.testing.assert_allclose(np.linalg.norm(m, axis=1), 1, rtol=1e-14)
    sizes = np.array([0.0, 1e-6, 0.05, 1.0, 1e9])
    shrunk = np.linalg.norm(ROBUST.tangent(sizes[:, None] * np.array([0.6, -0.8])), axis=1)
    np.testing.assert_allclose(shrunk, sizes / np.hypot(sizes, 0.05), rtol=1e-14)


def test_the_projection_drops_the_tangential_part_near_the_path_and_gives_it_back():
    S, N = arguments(score_scale=1.0)
    v = ROBUST.tangent(1e7 * N)
    tilted = S + 3 * v
    size = np.linalg.norm(tilted, axis=1).max()
    # What g = 1 / (1 + (r / 3 sigma)^8) leaves of it, through the slope k_s of tanh.
    left = ROBUST.gain * size * (SIGMA * size / 3) ** 8
    assert left < 1e-5
    straight, m = ROBUST.value(S, 1e7 * N), ROBUST.value(tilted, 1e7 * N)
    np.testing.assert_allclose(m, straight, rtol=0, atol=left)
    # At r = sigma^2 |S| = 3 sigma exactly half of it is left.
    v = np.array([[1.0, 0.0]])
    m = ROBUST.value(3 / SIGMA * v, 1e7 * v)
    np.testing.assert_allclose(m[0, 0], np.tanh(0.2 * 15) + 1 / np.cosh(0.2 * 15), rtol=1e-12)
    # Far from the path the robot heads straight for it.
    S, N = arguments(score_scale=1e5)
    m, direction = ROBUST.value(S, N), S / np.linalg.norm(S, axis=1, keepdims=True)
    np.testing.assert_allclose(m, direction, atol=1e-8)


def test_without_the_projection_the_whole_score_counts_everywhere():
    S, N = arguments(score_scale=3.0)
    size = np.linalg.norm(S, axis=1, keepdims=True)
    s, v = UNPROJECTED.components(S, N)
    np.testing.assert_allclose(s, np.tanh(0.2 * size) * S / size, rtol=1e-13)
    unit = N / np.hypot(np.linalg.norm(N, axis=1, keepdims=True), 0.05)
    np.testing.assert_allclose(v, unit / np.cosh(0.2 * size), rtol=1e-13)
    # Against the tangent it can stop the robot: tanh(k |S|) = sech(k |S|).
    stop = np.arcsinh(1) / 0.2
    forward, against = np.array([[1e7, 0.0]]), np.array([[-stop, 0.0]])
    np.testing.assert_allclose(UNPROJECTED.value(against, forward), 0, atol=1e-9)
    assert np.linalg.norm(ROBUST.value(against, forward)) > 0.99


def test_the_slopes_of_the_factors_and_their_series():
    """Just below and above z = (k r)^2 = 1e-4 they agree; d/d(r^2) is half of (d/dr)/r."""
    z = 1e-4
    for gain in (0.01, 0.2, 3.0, 5.0):
        square = z * np.array([1 - 1e-9, 1 + 1e-9]) / gain**2
        (below, above), (sech_below, sech_above) = composition._squash_slopes(gain, square)
        assert above == pytest.approx(below, rel=1e-10)
        assert sech_above == pytest.approx(sech_below, rel=1e-8)
        assert below == pytest.approx(gain**3 * (-2 / 3 + 8 / 15 * z), rel=1e-8)
        square = np.logspace(-9, 2, 50) / gain**2
        factors = composition._squash_factors(gain, square + 1e-30j)
        slopes = composition._squash_slopes(gain, square)
        for factor, slope in zip(factors, slopes, strict=True):
            # The complex step through tanh(k r) / r cancels as the closed form does: eps / z.
            atol = 1e-15 * gain / square.min()
            np.testing.assert_allclose(2 * factor.imag / 1e-30, slope, rtol=1e-7, atol=atol)


def test_sech_neither_overflows_nor_loses_its_tail():
    z = np.array([0.0, 1e-8, 1.0, 30.0, 800.0, 1e6])
    with np.errstate(over="ignore"):
        expected = 1 / np.cosh(z)
    np.testing.assert_allclose(composition._sech(z), expected, rtol=1e-13, atol=1e-300)
