"""Interpolating curves: their nodes, their derivatives, Runge's swings, nearest points."""

import numpy as np
import pytest
from scipy.interpolate import BarycentricInterpolator
from scipy.optimize import minimize_scalar

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import FourierCurve, LagrangeCurve
from tests.helpers import circle

KINDS = (FourierCurve, LagrangeCurve)
EACH = pytest.mark.parametrize(
    ("kind", "closed"), [(kind, closed) for kind in KINDS for closed in (True, False)]
)


def bent_line(num_points=12):
    """Waypoints of an open polynomial curve of degree three, at equal steps."""
    t = np.linspace(-1, 1, num_points)
    return np.column_stack([2 * t, t**3 - t, 0.5 * t**2])


def round_waypoints(num_points=12):
    return circle(1.0, num_points)


@EACH
def test_a_curve_passes_its_waypoints_at_equal_steps_with_the_derivatives_that_it_tells(
    kind, closed
):
    for num_points in (11, 12):
        points = np.random.default_rng(1).normal(size=(num_points, 3))
        curve = kind(points, closed)
        w = curve.step * np.arange(len(curve.knots))
        np.testing.assert_allclose(curve.derivatives(w, 0)[0], curve.knots, atol=1e-11)
        assert w[-1] == pytest.approx(curve.length)
        sides = np.diff(curve.knots, axis=0)
        assert curve.length == pytest.approx(np.linalg.norm(sides, axis=1).sum())
    curve = kind(np.random.default_rng(2).normal(size=(9, 2)), closed)
    w = np.linspace(0.03, 0.97, 23) * curve.length
    c = curve.derivatives(w, 2)
    # A complex step of the curve, and of its derivative: exact to rounding.
    stepped = curve.derivatives(w + 1e-30j, 1)
    np.testing.assert_allclose(stepped.real, c[:2], rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(stepped[0].imag / 1e-30, c[1], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(stepped[1].imag / 1e-30, c[2], rtol=1e-7, atol=1e-6)


def flower(angle):
    """A curve that is not convex, of the waves 1, 2 and 4."""
    radius = 30 * (1 + 0.3 * np.cos(3 * angle))
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])


def test_fourier_is_exact_for_a_series_that_it_can_hold():
    curve = FourierCurve(flower(2 * np.pi * np.arange(60) / 60))
    w = np.linspace(0, curve.length, 777)
    exact = flower(2 * np.pi * w / curve.length)
    np.testing.assert_allclose(curve.derivatives(w, 0)[0], exact, atol=1e-11)
    first, last = curve.derivatives(w[[0, -1]], 2).transpose(1, 0, 2)
    np.testing.assert_allclose(first, last, atol=1e-11)


def test_an_open_fourier_curve_converges_with_order_three():
    """Its odd continuation has a jump in the second derivative."""
    w = np.linspace(0, 1, 5001)
    exact = np.column_stack([4 * w - 2, np.exp(w)])
    counts, errors = np.array([8, 16, 32, 64]), []
    for count in counts:
        at = np.linspace(0, 1, count)
        curve = FourierCurve(np.column_stack([4 * at - 2, np.exp(at)]), closed=False)
        errors.append(np.abs(curve.derivatives(w * curve.length, 0)[0] - exact).max())
    assert -3.3 < np.polyfit(np.log(counts), np.log(errors), 1)[0] < -1.8


def test_smoothing_leaves_out_short_waves_alone():
    angle = 2 * np.pi * np.arange(60) / 60
    radius = 3 + 0.05 * np.cos(20 * angle)
    curve = FourierCurve(np.column_stack([radius * np.cos(angle), radius * np.sin(angle)]))
    smooth = curve.smoothed(curve.length / 10)
    # The ripple is made of the orders 19 and 21 and is gone; the circle is of order 1.
    c = smooth.derivatives(np.linspace(0, curve.length, 300), 0)[0]
    np.testing.assert_allclose(np.linalg.norm(c, axis=1), 3.0, rtol=1e-12)
    kept = curve.smoothed(curve.length / 21)
    w = np.linspace(0, curve.length, 50)
    np.testing.assert_allclose(kept.derivatives(w, 2), curve.derivatives(w, 2), atol=1e-11)


def test_lagrange_agrees_with_scipy():
    points = np.random.default_rng(3).normal(size=(14, 2))
    curve = LagrangeCurve(points, closed=False)
    nodes = np.linspace(0, curve.length, 14)
    other = BarycentricInterpolator(nodes, points, rng=0)
    w = np.linspace(0, curve.length, 100)
    value, slope, _ = curve.derivatives(w, 2)
    np.testing.assert_allclose(value, other(w), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(slope, other.derivative(w), rtol=1e-6, atol=1e-6)


def test_lagrange_swings_the_more_the_more_waypoints_there_are():
    """Runge's own function, as a curve; between 12 and 48 waypoints the error explodes."""

    def error(count):
        x = np.linspace(-1, 1, count)
        curve = LagrangeCurve(np.column_stack([x, 1 / (1 + 25 * x**2)]), closed=False)
        w = np.linspace(0, 1, 2001)
        y = curve.derivatives(w * curve.length, 0)[0][:, 1]
        return np.abs(y - 1 / (1 + 25 * (2 * w - 1) ** 2)).max()

    errors = [error(count) for count in (12, 24, 48)]
    assert errors[0] > 0.5
    assert errors[1] > 10 * errors[0]
    assert errors[2] > 1e3 * errors[1]


@EACH
def test_the_nearest_point_is_that_of_a_search(kind, closed):
    points = round_waypoints() if closed else bent_line()[:, :2]
    curve = kind(points, closed)
    z = np.random.default_rng(4).uniform(-1.6, 1.6, (60, 2))
    w, _, c = curve.nearest(z)
    np.testing.assert_array_equal(c, curve.derivatives(w, 2))

    def distance(w, z):
        return float(np.linalg.norm(curve.derivatives(np.atleast_1d(w), 0)[0, 0] - z))

    grid = np.linspace(0, curve.length, 501)
    for point, found in zip(z, w, strict=True):
        at = grid[np.linalg.norm(curve.derivatives(grid, 0)[0] - point, axis=1).argmin()]
        bounds = np.array([at - 0.02, at + 0.02])
        if not closed:
            bounds = np.clip(bounds, 0, curve.length)
        best = minimize_scalar(
            distance, bounds=bounds, args=(point,), method="bounded", options={"xatol": 1e-9}
        )
        assert distance(found, point) <= best.fun + 1e-9


def test_the_slope_of_the_nearest_parameter():
    curve = FourierCurve(round_waypoints(30))
    z = np.array([[1.3, 0.4], [-0.5, 0.6]])
    w, slope, _ = curve.nearest(z)
    # On a circle of radius one the parameter is the angle, but for its scale.
    scale = curve.length / (2 * np.pi)
    np.testing.assert_allclose(w, scale * np.arctan2(z[:, 1], z[:, 0]), atol=1e-12)
    exact = scale * np.column_stack([-z[:, 1], z[:, 0]]) / (z**2).sum(axis=1)[:, None]
    np.testing.assert_allclose(slope, exact, atol=1e-10)


def test_beyond_the_ends_the_ends_are_nearest():
    curve = FourierCurve(bent_line()[:, :2], closed=False)
    w, slope, c = curve.nearest(np.array([[-5.0, 0.0], [5.0, 0.0]]))
    assert w.tolist() == [0.0, curve.length]
    np.testing.assert_allclose(c[0], curve.points[[0, -1]], atol=1e-12)
    np.testing.assert_array_equal(slope, 0.0)


def test_bad_waypoints_are_refused():
    for kind in KINDS:
        for points, closed in ((np.zeros((2, 2)), True), (np.zeros((1, 2)), False)):
            with pytest.raises(ConfigurationError, match=f"got {len(points)}"):
                kind(points, closed)
        with pytest.raises(ConfigurationError, match="not all the same"):
            kind(np.ones((5, 2)))
    with pytest.raises(ConfigurationError, match="at most 1000 waypoints, not 1001"):
        LagrangeCurve(np.random.default_rng(0).normal(size=(1001, 2)))
    with pytest.raises(ConfigurationError, match="wavelength"):
        FourierCurve(round_waypoints()).smoothed(0.0)
