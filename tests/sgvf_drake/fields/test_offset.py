"""How far from a strand robots run, where the tangent is off by an angle alpha."""

import numpy as np
import pytest
from scipy.optimize import brentq

from sgvf_drake.fields import RobustComposition, StrandMixture
from sgvf_drake.fields.composition import DIRECTION_SOFTENING

SIGMA, GAIN = 0.1, 0.2


def speed_across(y, alpha, sigma, gain, one_way):
    """The component of m across the x axis, at a height y above it."""
    x = np.arange(-60, 61) * sigma / 2
    points = np.column_stack([x, np.zeros_like(x)])
    turned = np.array([np.cos(alpha), np.sin(alpha)])
    directions = np.broadcast_to(turned, points.shape)
    mixture = StrandMixture(points, directions, np.full(len(x), one_way), sigma)
    S, N = mixture(np.array([[0.013, y]]), turned[None])
    return RobustComposition(gain, sigma).value(S, N)[0, 1]


def offset(alpha, sigma=SIGMA, gain=GAIN, one_way=True):
    """Where that is zero: robots run along the strand there."""
    return brentq(speed_across, 0, 1.5 * sigma, args=(alpha, sigma, gain, one_way), xtol=1e-14)


def slope(factors, offsets):
    """Of the logarithms."""
    return np.polyfit(np.log(factors), np.log(offsets), 1)[0]


@pytest.mark.parametrize("one_way", [True, False])
@pytest.mark.parametrize("degrees", [2, 10, 30])
def test_the_offset_is_that_of_the_theory(degrees, one_way):
    alpha = np.radians(degrees)
    expected = SIGMA**2 * np.arcsinh(np.tan(alpha)) / (GAIN * np.cos(alpha))
    # |v| is a little less than 1, and so is the pull off the strand.
    softened = 1 / np.hypot(1, DIRECTION_SOFTENING)
    assert offset(alpha, one_way=one_way) == pytest.approx(softened * expected, rel=1e-3)


def test_it_grows_as_sigma_squared_tan_alpha_over_the_gain():
    tangents = np.array([0.005, 0.01, 0.02])
    assert slope(tangents, [offset(np.arctan(t)) for t in tangents]) == pytest.approx(
        1.0, abs=1e-3
    )
    sigmas, gains = 0.1 * np.array([0.8, 1.0, 1.25]), 0.2 * np.array([0.8, 1.0, 1.25])
    alpha = np.radians(5)
    by_sigma = [offset(alpha, sigma=sigma) for sigma in sigmas]
    by_gain = [offset(alpha, gain=gain) for gain in gains]
    assert slope(sigmas, by_sigma) == pytest.approx(2.0, abs=1e-3)
    assert slope(gains, by_gain) == pytest.approx(-1.0, abs=1e-3)


def test_what_the_linear_law_leaves_out_is_a_third_of_tan_alpha_squared():
    tangents = np.array([0.1, 0.15, 0.2])
    softened = 1 / np.hypot(1, DIRECTION_SOFTENING)
    linear = softened * SIGMA**2 * tangents / GAIN
    excess = np.array([offset(np.arctan(t)) for t in tangents]) / linear - 1
    assert slope(tangents, excess) == pytest.approx(2.0, abs=0.1)
    np.testing.assert_allclose(excess, tangents**2 / 3, rtol=0.05)


def test_beyond_the_bound_of_the_theory_robots_come_closer():
    radius, width, largest = 2.0, 1.5 * SIGMA, np.radians(20)
    turn = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    # Uneven, so that the density varies along the path.
    angle = turn + 0.08 * np.sin(3 * turn)
    points = radius * np.column_stack([np.cos(angle), np.sin(angle)])
    heading = angle + np.pi / 2 + largest * np.sin(5 * angle)
    directions = np.column_stack([np.cos(heading), np.sin(heading)])
    mixture = StrandMixture(points, directions, np.ones(len(points), bool), SIGMA)

    rng = np.random.default_rng(0)
    theta, y = rng.uniform(0, 2 * np.pi, 4_000), rng.uniform(-width, width, 4_000)
    n = np.column_stack([np.cos(theta), np.sin(theta)])
    tau = np.column_stack([-n[:, 1], n[:, 0]])
    S, N = mixture((radius + y)[:, None] * n, np.zeros_like(n))
    a = 1 / SIGMA**2
    c = np.abs((S * n).sum(1) + a * y).max()
    b = np.abs((S * tau).sum(1)).max()
    off = np.arctan2((N * n).sum(1), (N * tau).sum(1))
    tangent = np.tan(np.abs(off).max())
    bound = (c + b * tangent + np.arcsinh(tangent) * np.hypot(1, tangent) / GAIN) / a
    assert bound < 0.2 * width
    away = (RobustComposition(GAIN, SIGMA).value(S, N) * n).sum(1) * np.sign(y)
    assert away[np.abs(y) > bound].max() < 0
    # Nearer than that, some do not: the bound is not for nothing.
    assert away[np.abs(y) < 0.5 * bound].max() > 0
