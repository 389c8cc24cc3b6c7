"""Bands of fields whose V and V_dot are known in closed form, and fields without a band."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import root

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import (
    LyapunovFunction,
    find_band,
    inward_margins,
    search_band,
    take_samples,
    to_level_set,
)
from sgvf_drake.lyapunov.band import LEVEL_MARGIN, MIN_DECREASE, critical_levels
from sgvf_drake.lyapunov.samples import Samples
from sgvf_drake.paths import Piece, ReferencePath
from tests.helpers import circle

GAIN, SIGMA = 0.2, 0.1
GRID = 121


def band_of(field, path, samples=None, ratio=1.0):
    function = LyapunovFunction.of(field, ratio * field.mixture.sigma)
    if samples is None:
        samples = take_samples(field, grid_size=GRID)
    return find_band(field, function, samples, path)


@pytest.fixture(scope="module")
def samples(ring):
    """Samples of the ring's field."""
    return take_samples(ring[0], grid_size=GRID)


@pytest.fixture(scope="module")
def found(ring, samples):
    """A ring's field, the ring, and its band at the noise level of the field."""
    field, path = ring
    return field, path, band_of(field, path, samples)


def test_on_a_ring_v_falls_from_the_border_to_a_thin_tube(found):
    _, _, band = found
    border = float(band.function(np.array([[5.0, 0.0]]))[0])
    assert band.c_out == pytest.approx((1 - LEVEL_MARGIN) * border, rel=1e-3)
    # V_dot = -|S| tanh(k |S|) at |S| = sqrt(2 V) / sigma is the least decrease by then.
    slope = np.sqrt(2 * band.c_in) / SIGMA
    assert band.decrease == pytest.approx(slope * np.tanh(GAIN * slope), rel=0.05)
    assert band.decrease > MIN_DECREASE
    assert band.tube.half_width < 0.5 * SIGMA
    assert band.tube.follows(np.array([True]))
    assert band.basin.follows(np.array([True]))
    assert band.basin.compact


def test_the_lowest_place_of_the_border_is_found_between_the_points_of_a_coarse_grid(ring):
    """That is (5, 0), which a grid of ten by ten points does not have."""
    field, path = ring
    band = band_of(field, path, take_samples(field, grid_size=10))
    border = float(band.function(np.array([[5.0, 0.0]]))[0])
    assert band.c_out == pytest.approx((1 - LEVEL_MARGIN) * border, rel=1e-3)


def test_it_is_what_a_finer_grid_confirms(found):
    # Other points than those of the search: 100,000 on a polar grid about the ring.
    field, _, band = found
    radius, angle = np.meshgrid(np.linspace(3, 5, 200), np.linspace(0, 2 * np.pi, 500))
    x = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1).reshape(-1, 2)
    V, V_dot = band.function(x), band.function.along(field, x)
    inside = (band.c_in <= V) & (band.c_out >= V)
    assert inside.sum() > 25_000
    assert V_dot[inside].max() < -MIN_DECREASE


@pytest.mark.parametrize(("axis", "end"), [(0, 0), (0, -1), (1, 0), (1, -1)])
def test_it_ends_at_the_side_of_the_grid_that_is_nearest(ring, samples, axis, end):
    field, path = ring
    # Without the outer columns or rows on one side, and with points of the grid alone.
    axes = list(samples.axes)
    axes[axis] = axes[axis][6:] if end == 0 else axes[axis][:-6]
    x = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    band = band_of(field, path, Samples(tuple(axes), x, *field.components(x)))
    place = np.zeros(2)
    place[axis] = axes[axis][end]
    border = float(band.function(place[None])[0])
    assert band.c_out == pytest.approx((1 - LEVEL_MARGIN) * border, rel=1e-3)


def test_between_two_rings_it_ends_at_the_critical_level(ring_field):
    field, path = ring_field(radii=(4.0, 3.0))
    band = band_of(field, path)
    medial = np.linspace(3.3, 3.7, 401)
    ridge = band.function(np.column_stack([medial, np.zeros_like(medial)])).max()
    assert 0.9 * ridge < band.c_out < ridge
    assert sorted(c.pieces for c in band.basin.components) == [(0,), (1,)]


def test_the_search_takes_the_thin_tube_among_large_bands(found, samples):
    field, path, band = found
    chosen = search_band(field, samples, path, (1.0, 2.0))
    bands = [band, band_of(field, path, samples, 2.0)]
    largest = max(band.area for band in bands)
    large = [band for band in bands if band.area >= 0.95 * largest]
    assert chosen.tube.half_width == min(band.tube.half_width for band in large)


def test_a_tube_far_from_the_path_is_none(ring, samples):
    far = circle(0.2, 60, center=(40.0, 0.0))
    assert band_of(ring[0], ReferencePath((Piece(far, closed=True),)), samples) is None


def test_a_tube_has_to_cross_the_saddles_between_waypoints(ring_field):
    # Waypoints four noise levels apart, beads below; V has to rise from each to the next.
    field, path = ring_field(spacing=0.4)
    band = band_of(field, path)
    spacing = 2 * np.pi / round(2 * np.pi * 4 / 0.4)
    saddle = 4.0 * np.array([[np.cos(spacing / 2), np.sin(spacing / 2)]])
    assert band is not None
    assert band.c_in > float(band.function(saddle)[0]) > 1


def test_what_lies_between_the_samples_is_found(ring, samples):
    """A place too small for the grid, where m is turned around."""
    field, path = ring
    step = samples.axes[0][1] - samples.axes[0][0]
    near = np.array([3.6, 1.0])
    place = samples.axes[0][0] + step * (np.floor((near - samples.axes[0][0]) / step) + 0.5)
    width = 0.3 * step

    class Turned:
        cloud, mixture, dim = field.cloud, field.mixture, field.dim

        def __call__(self, x):
            weight = np.exp(-0.5 * ((x - place) ** 2).sum(axis=1) / width**2)
            return (1 - 2 * weight)[:, None] * field(x)

    turned = Turned()
    grid = samples.x[samples.on_grid]
    only_grid = replace(samples, x=grid, s=turned(grid), v=np.zeros_like(grid))
    function = LyapunovFunction.of(field)
    # No sample sees it rise, but the search must.
    V = float(function(place[None])[0])
    assert function.along(turned, grid)[np.abs(function(grid) - V) < 0.2 * V].max() < 0
    band = find_band(turned, function, only_grid, path)
    assert band.c_out < V


def test_critical_levels_are_those_of_the_saddles():
    points = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    function = LyapunovFunction(GaussianMixture(points, 0.5))

    class Grid:
        axes = (np.linspace(-3, 3, 61), np.linspace(-3, 3, 61))
        x = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
        on_grid = slice(None)
        corners = (np.array([-3.0, -3.0]), np.array([3.0, 3.0]))

    slope = np.linalg.norm(function.gradient(Grid.x), axis=1).reshape(61, 61)
    levels = np.unique(np.round(critical_levels(function, Grid, slope), 6))
    # The independent library, from a coarse grid: three modes, two of them equally high, two
    # saddles beside the third and one between the two, and a minimum of the density.
    roots = [
        root(lambda x: function.gradient(x[None])[0], start, tol=1e-12) for start in Grid.x[::7]
    ]
    points = np.array([found.x for found in roots if found.success])
    expected = np.unique(np.round(function(points[np.abs(points).max(axis=1) < 3]), 6))
    np.testing.assert_allclose(levels, expected, atol=2e-6)
    assert len(levels) == 5


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_critical_levels_have_no_unit(unit):
    def levels(unit):
        points = unit * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
        function = LyapunovFunction(GaussianMixture(points, 0.5 * unit))
        side = unit * np.linspace(-3, 3, 61)
        x = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        samples = SimpleNamespace(x=x, on_grid=slice(None), corners=(x[0], x[-1]))
        slope = np.linalg.norm(function.gradient(x), axis=1).reshape(61, 61)
        return np.unique(np.round(critical_levels(function, samples, slope), 6))

    assert len(levels(unit)) == 5
    np.testing.assert_allclose(levels(unit), levels(1.0), atol=2e-6)


def test_no_band_holds_a_place_where_m_vanishes(found, samples):
    """However it was found, here between samples of a field that does not vanish."""
    field, path, band = found
    level = np.sqrt(band.c_in * band.c_out)
    stop = to_level_set(band.function, np.array([[4.3, 0.0]]), level)
    with_stop = find_band(field, band.function, samples, path, stops=stop)
    assert with_stop.c_out < level or with_stop.c_in > level


def test_margins_are_the_inward_speed(found, samples):
    field, _, band = found
    margins = inward_margins(field, band.function, samples, band.c_in, band.c_out, 9)
    speed = np.tanh(GAIN * np.sqrt(2 * margins.levels) / SIGMA)
    np.testing.assert_allclose(margins.e_star, speed, rtol=0.03)
    assert (np.diff(margins.e_star) > -1e-6).all()
    assert margins.largest == margins.e_star.max()
    np.testing.assert_allclose(band.function(margins.weakest), margins.levels, rtol=1e-5)
    middle = np.sqrt(margins.levels[3] * margins.levels[4])
    assert margins.at(middle) == pytest.approx(margins.e_star[3:5].mean(), rel=1e-9)


def test_a_dent_that_the_samples_of_a_level_miss_is_found_from_beside_it(ring):
    """Those of the level are on the left; those that say of the dent are on a level nearby."""
    function = LyapunovFunction.of(ring[0])
    radius, level = np.linalg.norm(function.mixture.points[0]), 20.0

    def at(angle, level):
        start = (radius + SIGMA) * np.column_stack([np.cos(angle), np.sin(angle)])
        return to_level_set(function, start, level)

    dent = at(np.zeros(1), level)

    def field(x):
        gradient = function.gradient(x)
        square = ((x - dent) ** 2).sum(axis=1, keepdims=True) / SIGMA**2
        inward = -gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        return (1 - 0.9 * np.exp(-square / 2)) * inward

    beside = at(np.linspace(-0.02, 0.02, 5), 1.1 * level)
    x = np.concatenate([at(np.linspace(2, 4, 3000), level), beside])
    margins = inward_margins(field, function, Samples((), x, field(x), 0 * x), level, level, 1)
    assert margins.e_star == pytest.approx(0.1, abs=0.01)


def test_level_sets_are_reached_all_around(ring, samples):
    function = LyapunovFunction.of(ring[0])
    V = function(samples.x)
    for level in (0.05, 20.0):
        near = np.argsort(np.abs(V - level))[:2_000]
        x = to_level_set(function, samples.x[near], level)
        np.testing.assert_allclose(function(x), level, rtol=1e-5)
        angle = np.sort(np.arctan2(x[:, 1], x[:, 0]))
        assert np.diff(angle).max() < 0.15
        radius = np.linalg.norm(x, axis=1)
        assert 0.2 < (radius < 4).mean() < 0.8


def test_samples_are_even_and_near(ring):
    field, _ = ring
    samples = take_samples(field, seed=1, grid_size=GRID)
    np.testing.assert_array_equal(samples.m, samples.s + samples.v)
    np.testing.assert_allclose(samples.m, field(samples.x), atol=1e-14)
    grid = samples.as_grid(samples.x)
    np.testing.assert_array_equal(grid[0, :, 0], samples.axes[0])
    np.testing.assert_array_equal(grid[:, 0, 1], samples.axes[1])
    lower, upper = field.cloud.box
    assert ((samples.x >= lower) & (samples.x <= upper)).all()
    np.testing.assert_array_equal(samples.corners, (lower, upper))
    near = np.abs(np.linalg.norm(samples.x, axis=1) - 4) < 3 * SIGMA
    assert near.mean() > 0.3
    with pytest.raises(ConfigurationError, match="at least 3 points, not 2"):
        take_samples(field, grid_size=2)
