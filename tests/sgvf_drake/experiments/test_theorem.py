"""Theorem 1 along trajectories: against closed forms on a ring, and on a trained field."""

import json
import math

from matplotlib.image import imread
import numpy as np
import pytest
from scipy.optimize import brentq

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.experiments.figures.verification import theorem_figure
from sgvf_drake.experiments.results import write_summary
from sgvf_drake.experiments.theorem import (
    check_decrease,
    check_level_sets,
    check_modes,
    follow_lyapunov,
    level_set_points,
)
from sgvf_drake.fields import GaussianMixture, TangentField
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.metrics import grid_starts
from tests.helpers import circle

SIGMA = 0.1
TURN = 2.0 * math.pi


class Spiral:
    """Around the origin at one radian a second, with r' = -rate (r - 1).

    Its trajectories are r(t) = 1 + (r(0) - 1) exp(-rate t).
    """

    dim = 2

    def __init__(self, rate):
        self.rate = rate

    def __call__(self, x):
        r = np.linalg.norm(x, axis=-1, keepdims=True)
        around = np.stack([-x[..., 1], x[..., 0]], axis=-1)
        return around - self.rate * (r - 1.0) * x / r

    def radius(self, start, times):
        return 1.0 + (start - 1.0) * np.exp(-self.rate * times)


@pytest.fixture(scope="module")
def V():  # noqa: N802
    """Of waypoints so dense that V depends on the radius alone, up to rounding."""
    return LyapunovFunction(GaussianMixture(circle(1.0, 200), SIGMA))


def of_radius(function, radius):
    return function(np.column_stack([radius, np.zeros_like(radius)]))


def on_circles(radii, count=3):
    angle = np.linspace(0.0, 5.0, count)
    directions = np.column_stack([np.cos(angle), np.sin(angle)])
    return np.concatenate([radius * directions for radius in radii])


def time_at(field, function, start, level):
    """When V is at a level, from a start at a radius."""

    def excess(t):
        return float(of_radius(function, np.array([field.radius(start, t)]))[0]) - level

    return brentq(excess, 0.0, 8.0)


@pytest.fixture(scope="module")
def trained(exact_field):
    return exact_field, LyapunovFunction.of(exact_field)


# The trajectories.


def test_a_run_is_that_of_the_field_with_V_along_it(V):  # noqa: N802
    field, starts = Spiral(2.0), on_circles([0.8, 1.3])
    run = follow_lyapunov(field, V, starts, 3.0)
    r = np.linalg.norm(run.positions, axis=2)
    exact = field.radius(np.linalg.norm(starts, axis=1), run.times[:, None])
    # The integrator's step of half a noise level, 0.05.
    np.testing.assert_allclose(r, exact, atol=2e-5)
    x = run.positions.reshape(-1, 2)
    np.testing.assert_array_equal(run.V.ravel(), V(x))
    V_dot = (V.gradient(x) * field(x)).sum(axis=1)
    np.testing.assert_allclose(run.V_dot.ravel(), V_dot, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(np.diff(run.times), 0.05, rtol=1e-9)
    assert run.exit is None


def test_a_run_ends_where_the_sublevel_set_is_left(V):
    field = Spiral(-1.0)
    run = follow_lyapunov(field, V, on_circles([1.05, 1.02], 1), 5.0, level=2.0, step=0.01)
    time = time_at(field, V, 1.05, 2.0)
    assert run.exit.agent == 0
    assert run.exit.time_inside < time <= run.exit.time
    assert run.times[-1] <= run.exit.time <= run.times[-1] + 0.01 + 1e-9


def test_what_cannot_be_followed_is_refused(V):
    for duration in (0.0, -1.0, 0.04, math.nan, math.inf):
        with pytest.raises(ConfigurationError, match=r"duration must be .* at least 0\.05 s"):
            follow_lyapunov(Spiral(1.0), V, on_circles([1.2]), duration)
    with pytest.raises(NonFiniteValueError, match="agent 0"):
        follow_lyapunov(Spiral(math.nan), V, on_circles([1.2]), 1.0)
    starts = on_circles([1.1, 2.0], 1)
    with pytest.raises(ConfigurationError, match=r"1 starts .* V > 6; .* start 1 at \[2\.0"):
        check_decrease(Spiral(2.0), V, (0.05, 6.0), starts, 3.0, lap=TURN)
    for band in ((0.0, 1.0), (2.0, 1.0), (math.nan, 1.0)):
        with pytest.raises(ConfigurationError, match="two rising positive levels"):
            check_decrease(Spiral(2.0), V, band, on_circles([1.0]), 3.0, lap=TURN)


# (i) Decrease.


def test_V_falls_and_the_times_of_entry_are_right(V):  # noqa: N802
    field, radii = Spiral(2.0), np.array([0.7, 0.9, 1.2, 1.3])
    starts = on_circles(radii)
    band = (0.05, 6.0)
    check = check_decrease(field, V, band, starts, 8.0, lap=TURN)
    step = check.run.times[1]
    for start, entry in zip(np.repeat(radii, 3), check.entry_times, strict=True):
        time = time_at(field, V, start, 0.05)
        assert time <= entry + 1e-4
        assert entry < time + step + 1e-4
    summary = check.summary()
    assert summary["starts"] == 12
    assert summary["entered_fraction"] == summary["stayed_fraction"] == 1.0
    assert summary["entry_time_max"] == check.entry_times.max()
    assert summary["V_rise_max"] < 0.0
    assert summary["V_dot_max"] < 0.0
    assert summary["V_after_entry_max"] <= 0.05
    assert summary["exit"] is None
    # After the entry V falls on: at the end the agents are on the circle itself, of radius 1,
    # where V is almost the lowest; the lap begins at 8 - 2 pi s.
    last = check.run.times >= 8.0 - TURN
    assert summary["V_last_lap_mean"] == pytest.approx(check.run.V[last].mean())
    assert check.run.V[-1].max() < 0.01


def test_an_outward_field_is_found_out(V):
    check = check_decrease(Spiral(-1.0), V, (0.05, 4.0), on_circles([1.1], 2), 8.0, lap=TURN)
    summary = check.summary()
    assert summary["V_rise_max"] > 0.0
    assert summary["V_dot_max"] > 0.0
    assert summary["entered_fraction"] == summary["stayed_fraction"] == 0.0
    assert summary["entry_time_max"] is None
    assert summary["V_after_entry_max"] is None
    assert "left the sublevel set V <= 4" in summary["exit"]
    assert np.isinf(check.entry_times).all()
    assert np.isnan(check.largest_after_entry).all()


def test_an_agent_that_comes_in_and_goes_out_again_did_not_stay():
    # Straight across the bowl V = |x|^2 / 2, lowest at time 2 in the middle.
    class Across:
        dim = 2

        def __call__(self, x):
            return np.broadcast_to([1.0, 0.0], x.shape)

    bowl = LyapunovFunction(GaussianMixture(np.zeros((1, 2)), 1.0))
    check = check_decrease(Across(), bowl, (0.5, 2.1), np.array([[-2.0, 0.0]]), 4.0, lap=1.0)
    assert check.entry_times[0] == pytest.approx(1.0)
    assert check.largest_after_entry[0] == pytest.approx(2.0)
    summary = check.summary()
    assert (summary["entered_fraction"], summary["stayed_fraction"]) == (1.0, 0.0)
    assert summary["V_rise_max"] == pytest.approx(0.5 * (2.0**2 - 1.5**2))
    assert summary["V_dot_max"] == pytest.approx(2.0)


def test_agents_that_start_below_the_band_say_nothing_of_it(V):
    check = check_decrease(Spiral(2.0), V, (0.5, 6.0), on_circles([1.01]), 2.0, lap=1.0)
    assert check.summary()["V_rise_max"] is None
    assert check.summary()["V_dot_max"] is None
    assert (check.entry_times == 0.0).all()


# (ii) Level sets.


def integration_drift(function, run):
    """How much V changes at most, because Runge and Kutta's third order shrinks a circle.

    On p' = i p each step multiplies p by 1 + ih - h^2/2 - ih^3/6, of modulus 1 - h^4/24.
    """
    h = run.times[1]
    shrinkage = h**3 / 24.0 * run.times[-1] * np.linalg.norm(run.positions[0], axis=1)
    slopes = np.linalg.norm(function.gradient(run.positions.reshape(-1, 2)), axis=1)
    return shrinkage * slopes.reshape(run.V.shape).max(axis=0)


@pytest.mark.parametrize("dim", [2, 3])
def test_points_are_on_their_level_set(dim):
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (15, dim))
    function = LyapunovFunction(GaussianMixture(points, 0.6))
    for level in (0.5, 8.0):
        x, again = (
            level_set_points(function, level, 9, np.random.default_rng(0)) for _ in range(2)
        )
        assert x.shape == (9, dim)
        np.testing.assert_allclose(function(x), level, rtol=1e-9)
        assert len(np.unique(x.round(6), axis=0)) == 9
        np.testing.assert_array_equal(x, again)
    lowest = 0.5 * function(points).min()
    with pytest.raises(ConfigurationError, match=r"no waypoint is inside .* V = "):
        level_set_points(function, lowest, 9, np.random.default_rng(0))


def test_a_tangent_that_is_orthogonal_keeps_V(V):  # noqa: N802
    check = check_level_sets(Spiral(0.0), V, [0.05, 0.5, 4.0], TURN)
    for run, drift, lengths in zip(check.runs, check.drift, check.lengths, strict=True):
        assert (drift <= 1.05 * integration_drift(V, run)).all()
        # Chords of circles.
        chord = 2.0 * math.sin(run.times[1] / 2.0)
        radius = np.linalg.norm(run.positions[0], axis=1)
        expected = (len(run.times) - 1) * chord * radius
        np.testing.assert_allclose(lengths, expected, rtol=1e-4)


def test_the_drift_of_a_spiral_is_that_of_its_radius(V):
    field = Spiral(-0.05)
    check = check_level_sets(field, V, [0.3, 2.0], 3.0, starts_per_level=6, seed=3)
    for level, run, drift, rate, length in zip(
        check.levels, check.runs, check.drift, check.rate, check.lengths, strict=True
    ):
        start = np.linalg.norm(run.positions[0], axis=1)
        end = of_radius(V, field.radius(start, run.times[-1]))
        # It moves off monotonically, so the largest drift is the last, and so is the sum.
        # The radius grows meanwhile, by up to a tenth.
        error = 1.2 * integration_drift(V, run)
        assert (np.abs(drift - (end - level)) <= error).all()
        assert (np.abs(rate * length - (end - level)) <= error).all()
        assert (error < 0.01 * drift).all()
    summary = check.summary()
    assert summary["levels"] == [0.3, 2.0]
    assert summary["drift_max"] == check.drift.max(axis=1).tolist()
    assert summary["drift_relative_max"][1] == pytest.approx(check.drift[1].max() / 2.0)
    assert summary["rate_relative_mean"][0] == pytest.approx(check.rate[0].mean() / 0.3)


# (iii) Modes.


def test_the_speed_is_read_at_the_modes():
    # Waypoints so far apart that each is a mode; the pair at 0 is the higher one.
    points = np.array([[0.0, 0.0], [0.0, 0.0], [3.0, 0.0], [0.0, -5.0]])
    function = LyapunovFunction(GaussianMixture(points, 0.2))

    class Distance:
        dim = 2

        def __call__(self, x):
            return x + np.array([0.5, 0.0])

    check = check_modes(Distance(), function)
    expected = np.hypot(points[1:, 0] + 0.5, points[1:, 1])
    np.testing.assert_allclose(np.sort(check.speeds), np.sort(expected), atol=1e-6)
    summary = check.summary()
    assert summary["modes"] == 3
    assert summary["speed_at_global_mode"] == pytest.approx(0.5)
    assert summary["speed_min"] == pytest.approx(0.5)
    assert summary["speed_max"] == pytest.approx(math.hypot(0.5, 5.0))
    assert summary["speed_mean"] == pytest.approx(expected.mean())
    np.testing.assert_allclose(np.sort(check.V), [0.0, math.log(2.0), math.log(2.0)], atol=1e-9)


# On a trained field, all three.


@pytest.fixture(scope="module")
def checks(trained):
    field, function = trained
    grid = grid_starts(field.cloud.box, 49, 2)
    band = (0.06, 48.0)
    return (
        check_decrease(field, function, band, grid[function(grid) <= 48.0], 8.0, lap=TURN),
        check_level_sets(TangentField(field), function, [0.06, 1.0], TURN, 8),
        check_modes(field, function),
    )


def test_theorem_1_on_a_trained_field(checks, tmp_path):
    decrease, level_sets, modes = summaries = [check.summary() for check in checks]
    assert decrease["starts"] > 25
    assert decrease["entered_fraction"] == decrease["stayed_fraction"] == 1.0
    assert decrease["V_rise_max"] < 0.0
    assert decrease["exit"] is None
    # The path is no level set: V goes on between its modes.
    assert 1e-4 < decrease["V_last_lap_mean"] < 0.02
    # V is far from constant along v: the angle to the level sets is small, but kept for long.
    assert all(0.02 < drift < 1.0 for drift in level_sets["drift_relative_max"])
    assert 0.98 < modes["speed_min"] <= modes["speed_max"] < 1.02
    write_summary(tmp_path, {"all": summaries})
    assert json.loads((tmp_path / "summary.json").read_text()) == {"all": summaries}


def test_the_figure_shows_all_three(checks, V, tmp_path):
    decrease, level_sets, modes = checks
    left = check_decrease(Spiral(-1.0), V, (0.05, 4.0), on_circles([1.1], 2), 8.0, lap=TURN)
    for name, first in (("held", decrease), ("left", left)):
        file = tmp_path / f"{name}.png"
        theorem_figure(first, level_sets, modes).savefig(file)
        for panel in np.array_split(imread(file)[..., :3], 3, axis=1):
            assert 0.005 < np.any(panel < 0.9, axis=2).mean() < 0.9
