"""V against its definition, finite differences and what is known of modes."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import minimize

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction, find_modes


def mixture_of(seed, count=12, sigma=0.5, dim=2, scale=1.0):
    points = np.random.default_rng(seed).uniform(-2, 2, (count, dim))
    return GaussianMixture(scale * points, scale * sigma)


@pytest.mark.parametrize("dim", [2, 3])
def test_it_is_the_logarithm_of_the_density(dim):
    mixture = mixture_of(0, dim=dim)
    V = LyapunovFunction(mixture)
    x = np.random.default_rng(1).uniform(-3, 3, (50, dim))
    density = np.exp(mixture.log_density(x))
    highest = np.exp(-V.lowest)
    np.testing.assert_allclose(V(x), -np.log(density / highest), rtol=1e-12)


@pytest.mark.parametrize(("seed", "sigma"), [(0, 0.1), (1, 0.4), (2, 0.4), (3, 1.5)])
def test_it_is_nowhere_negative_and_zero_at_the_global_mode(seed, sigma):
    # The independent library searches from every waypoint.
    mixture = mixture_of(seed, sigma=sigma)
    V = LyapunovFunction(mixture)
    lowest = min(
        minimize(
            lambda x: V(x[None])[0],
            start,
            jac=lambda x: V.gradient(x[None])[0],
            options={"gtol": 1e-10},
        ).fun
        for start in mixture.points
    )
    assert lowest == pytest.approx(0.0, abs=1e-9)


def test_gradient_and_hessian_are_those_of_its_values():
    V = LyapunovFunction(mixture_of(3))
    x = np.random.default_rng(4).uniform(-3, 3, (40, 2))
    h = 1e-5
    steps = h * np.eye(2)
    slopes = np.stack([(V(x + s) - V(x - s)) / (2 * h) for s in steps], axis=1)
    value, slope = V.value_and_gradient(x)
    gradient, hessian = V.gradient_and_hessian(x)
    np.testing.assert_allclose(gradient, slopes, atol=1e-7)
    np.testing.assert_array_equal(V(x), value)
    np.testing.assert_allclose(V.gradient(x), gradient, atol=1e-12)
    np.testing.assert_allclose(slope, gradient, atol=1e-12)
    bends = np.stack([(V.gradient(x + s) - V.gradient(x - s)) / (2 * h) for s in steps], axis=2)
    np.testing.assert_allclose(hessian, bends, atol=1e-6)
    # The curvature of a mixture of equal Gaussians is at most theirs.
    assert np.linalg.eigvalsh(hessian).max() <= 1 / V.sigma**2 + 1e-9
    m = np.random.default_rng(5).standard_normal(x.shape)
    along = (V(x + h * m) - V(x - h * m)) / (2 * h)
    np.testing.assert_allclose(V.derivative(x, m), along, atol=1e-6)
    np.testing.assert_array_equal(V.along(lambda _: m, x), V.derivative(x, m))


def test_near_a_dense_ring_it_is_the_square_of_the_distance(ring_field):
    # V ~ d^2 / (2 sigma^2) + log(1 + d / R) / 2 beside a circle of radius R, from Laplace's
    # method on the angle; what it leaves out is of the order (sigma / R)^2.
    sigma, radius = 0.1, 4.0
    V = LyapunovFunction.of(ring_field(spacing=0.02, sigma=sigma)[0])
    d = np.linspace(-0.3, 0.3, 13)
    x = np.column_stack([radius + d, np.zeros_like(d)])
    expected = d**2 / (2 * sigma**2) + 0.5 * np.log1p(d / radius)
    np.testing.assert_allclose(V(x) - V(x[6:7]), expected, atol=(sigma / radius) ** 2)


@given(st.integers(0, 10_000), st.sampled_from([1e-3, 1.0, 1e4]))
@settings(max_examples=25)
def test_it_has_no_unit(seed, scale):
    x = np.random.default_rng(seed).uniform(-3, 3, (20, 2))
    plain, scaled = (
        LyapunovFunction(mixture_of(seed, scale=factor)) for factor in (1.0, scale)
    )
    np.testing.assert_allclose(scaled(scale * x), plain(x), rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(scale * scaled.gradient(scale * x), plain.gradient(x), atol=1e-8)


def test_the_noise_level_is_free(ring):
    field, _ = ring
    unit = field.cloud.unit_length
    assert LyapunovFunction.of(field).sigma == pytest.approx(field.sigma * unit)
    assert LyapunovFunction.of(field, 0.3).sigma == 0.3
    with pytest.raises(ConfigurationError, match="sigma must be a positive number, not 0"):
        LyapunovFunction.of(field, 0.0)


@pytest.mark.parametrize(("seed", "sigma"), [(0, 0.15), (1, 0.5)])
def test_every_mode_is_found_once(seed, sigma):
    mixture = mixture_of(seed, count=40, sigma=sigma)
    modes = find_modes(mixture)
    # The independent library follows the score from every waypoint to where it ends.
    ends = [
        solve_ivp(
            lambda _, x: mixture.score(x[None])[0], (0, 1e3 * sigma**2), start, method="BDF"
        ).y[:, -1]
        for start in mixture.points
    ]
    apart = np.linalg.norm(np.array(ends)[:, None] - modes, axis=2)
    assert apart.min(axis=1).max() < 1e-2 * sigma
    # Each is higher than a small circle about it, and there is no other one near.
    angle = 2 * np.pi * np.arange(32) / 32
    circle = 0.01 * sigma * np.column_stack([np.cos(angle), np.sin(angle)])
    around = mixture.log_density((modes[:, None] + circle).reshape(-1, 2)).reshape(-1, 32)
    assert (around.max(axis=1) < mixture.log_density(modes)).all()
    between = np.linalg.norm(modes[:, None] - modes, axis=2)[~np.eye(len(modes), dtype=bool)]
    assert between.min(initial=1.0) > 1e-3 * sigma


def test_a_waypoint_on_a_saddle_is_no_mode():
    # Between two that count twice: by symmetry no search leaves it.
    x = np.array([-1.0, -1.0, 0.0, 1.0, 1.0])
    mixture = GaussianMixture(np.column_stack([x, np.zeros(5)]), 0.5)
    bends = np.linalg.eigvalsh(mixture.score_and_jacobian(np.zeros((1, 2)))[1][0])
    assert bends[0] < 0 < bends[1]
    modes = find_modes(mixture)
    np.testing.assert_allclose(np.sort(modes[:, 0]), [-modes[:, 0].max(), modes[:, 0].max()])
    assert np.abs(modes[:, 0]).min() > 0.5


def test_one_waypoint_many_times_is_one_mode():
    mixture = GaussianMixture(np.tile([[1.0, 2.0]], (5, 1)), 0.2)
    np.testing.assert_allclose(find_modes(mixture), [[1.0, 2.0]])
    assert LyapunovFunction(mixture)(np.array([[1.0, 2.2]])) == pytest.approx([0.5])
