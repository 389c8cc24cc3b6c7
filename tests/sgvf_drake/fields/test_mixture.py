"""The Gaussian mixture against SciPy, finite differences and what is known of Gaussians."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, ortho_group

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GaussianMixture, mixture

DIMENSIONS = pytest.mark.parametrize("dim", [1, 2, 3])


def central_difference(function, x, step=1e-5):
    """The derivative of a batched function along each coordinate, on the last axis."""
    columns = [
        (function(x + step * axis) - function(x - step * axis)) / (2 * step)
        for axis in np.eye(x.shape[1])
    ]
    return np.stack(columns, axis=-1)


def random_mixture(dim=2, num_points=25, sigma=0.4, seed=0):
    points = np.random.default_rng(seed).uniform(-2, 2, (num_points, dim))
    return GaussianMixture(points, sigma)


def queries(dim=2, n=40, seed=1):
    return np.random.default_rng(seed).uniform(-3, 3, (n, dim))


@DIMENSIONS
def test_density_score_and_jacobian(dim):
    """The density is SciPy's; the others are its derivatives, by differences."""
    p, x = random_mixture(dim), queries(dim)
    covariance = p.sigma**2 * np.eye(dim)
    densities = [multivariate_normal(point, covariance).pdf(x) for point in p.points]
    np.testing.assert_allclose(p.log_density(x), np.log(np.mean(densities, axis=0)), rtol=1e-11)
    score, jacobian = p.score_and_jacobian(x)
    np.testing.assert_allclose(score, p.score(x), rtol=1e-14, atol=1e-14)
    slope = central_difference(p.log_density, x)
    np.testing.assert_allclose(score, slope, rtol=1e-6, atol=1e-7)
    unit = 1 / p.sigma**2
    bend = central_difference(p.score, x)
    np.testing.assert_allclose(jacobian, bend, rtol=1e-6, atol=1e-6 * unit)
    np.testing.assert_allclose(jacobian, np.swapaxes(jacobian, 1, 2), atol=1e-12 * unit)


def test_the_density_integrates_to_one_and_its_logarithm_does_not_underflow():
    p, x = random_mixture(), 100 * queries()
    # Equal steps are spectrally accurate on a smooth function that vanishes at the edges.
    axis, step = np.linspace(-6, 6, 241, retstep=True)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    assert step < p.sigma / 4
    assert np.exp(p.log_density(grid)).sum() * step**2 == pytest.approx(1, abs=1e-12)
    squares = ((x[:, None] - p.points) ** 2).sum(axis=2)
    logs = -0.5 * squares / p.sigma**2 - np.log(2 * np.pi * p.sigma**2)
    expected = logsumexp(logs, axis=1) - np.log(len(p.points))
    assert expected.max() < -745, "else exp would not underflow"
    np.testing.assert_allclose(p.log_density(x), expected, rtol=1e-13)


def test_complex_step_continues_score_and_jacobian():
    p, x = random_mixture(), queries()
    _, jacobian = p.score_and_jacobian(x)
    numeric = central_difference(lambda y: p.score_and_jacobian(y)[1], x)
    for j, axis in enumerate(np.eye(2)):
        score, slope = p.score_and_jacobian(x + 1e-30j * axis)
        for value in (score, p.score(x + 1e-30j * axis)):
            exact = jacobian[:, :, j]
            np.testing.assert_allclose(value.imag / 1e-30, exact, rtol=1e-10, atol=1e-10)
        atol = 1e-5 / p.sigma**3
        np.testing.assert_allclose(slope.imag / 1e-30, numeric[..., j], rtol=1e-5, atol=atol)


def test_chunks_change_nothing(monkeypatch):
    p, x = random_mixture(), queries(n=17)
    whole = (p.log_density(x), p.score(x), *p.score_and_jacobian(x))
    monkeypatch.setattr(mixture, "CHUNK_ENTRIES", 3 * len(p.points))
    chunked = (p.log_density(x), p.score(x), *p.score_and_jacobian(x))
    assert len(list(p._chunks(len(x)))) == 6
    for a, b in zip(whole, chunked, strict=True):
        # Only the order of BLAS's sums may differ.
        np.testing.assert_allclose(b, a, rtol=1e-12, atol=1e-12)


def test_one_waypoint_is_one_gaussian_and_duplicates_count_by_their_number():
    p, x = GaussianMixture(np.array([[1.0, -2.0]]), 0.5), queries()
    score, jacobian = p.score_and_jacobian(x)
    np.testing.assert_allclose(score, (p.points - x) / 0.25, rtol=1e-14)
    np.testing.assert_array_equal(jacobian, np.broadcast_to(-np.eye(2) / 0.25, (40, 2, 2)))
    gaussian = multivariate_normal(p.points[0], 0.25 * np.eye(2))
    np.testing.assert_allclose(p.log_density(x), gaussian.logpdf(x))
    points = np.array([[0.0, 0.0], [1.0, 0.0]])
    weighted = GaussianMixture(points[[0, 0, 0, 1]], 0.5)
    # Both are equally far: the mean is 3/4 of the way to the first.
    middle = weighted.score(np.array([[0.5, 0.0]]))
    np.testing.assert_allclose(middle, [[-0.25 / 0.25, 0]], atol=1e-15)
    once, twice = GaussianMixture(points, 0.5), GaussianMixture(points[[0, 1, 0, 1]], 0.5)
    np.testing.assert_allclose(twice.log_density(x), once.log_density(x), rtol=1e-13)


def test_a_coordinate_far_away_costs_no_digits():
    """Differences come before squares, so that an offset of 1e6 leaves ten digits."""
    near, x, offset = random_mixture(), queries(), np.array([1e6, 0.0])
    far = GaussianMixture(near.points + offset, near.sigma)
    np.testing.assert_allclose(far.score(x + offset), near.score(x), rtol=1e-8, atol=1e-8)


def test_far_away_the_score_points_at_the_nearest_waypoint_and_nothing_overflows():
    p = random_mixture()
    unit = 1 / p.sigma**2
    for distance in (1e3, 1e8, 1e100):
        x = distance * np.array([[1.0, 0.0], [-0.6, 0.8]])
        score, jacobian = p.score_and_jacobian(x)
        assert np.isfinite(p.log_density(x)).all()
        assert np.isfinite(jacobian).all()
        # At the last one, distances round to ties.
        np.testing.assert_allclose(score, -x * unit, atol=4 * unit)
        if distance < 1e100:
            nearest = p.points[np.argmax(x @ p.points.T, axis=1)]
            np.testing.assert_allclose(score, (nearest - x) * unit, rtol=1e-12)
            np.testing.assert_allclose(jacobian, [-np.eye(2) * unit] * 2, atol=1e-9)


@settings(max_examples=40, derandomize=True)
@given(
    dim=st.integers(2, 3),
    seed=st.integers(0, 2**32 - 1),
    shift=st.floats(-10, 10),
    sigma=st.floats(0.05, 3),
    factor=st.floats(1e-6, 1e6),
)
def test_a_rigid_motion_moves_the_score_along_and_another_unit_scales_it(
    dim, seed, shift, sigma, factor
):
    """Rotations and reflections Q and translations c: S_moved(Q x + c) = Q S(x)."""
    rng = np.random.default_rng(seed)
    points, x = rng.uniform(-2, 2, (12, dim)), rng.uniform(-3, 3, (10, dim))
    Q, c = ortho_group.rvs(dim, random_state=rng), shift * rng.standard_normal(dim)
    p, moved = GaussianMixture(points, sigma), GaussianMixture(points @ Q.T + c, sigma)
    # Rounding of the squared distances, up to (60 / sigma)^2, is the error of the weights.
    tolerance = 1e-14 * (60 / sigma) ** 2
    turned = sigma**2 * p.score(x) @ Q.T
    np.testing.assert_allclose(sigma**2 * moved.score(x @ Q.T + c), turned, atol=tolerance)
    np.testing.assert_allclose(moved.log_density(x @ Q.T + c), p.log_density(x), atol=tolerance)
    p = random_mixture(seed=seed)
    scaled, x = GaussianMixture(factor * p.points, factor * p.sigma), queries(seed=seed)
    score, density = factor * scaled.score(factor * x), scaled.log_density(factor * x)
    np.testing.assert_allclose(score, p.score(x), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(density, p.log_density(x) - 2 * np.log(factor), rtol=1e-10)


def test_no_points_to_evaluate_and_bad_noise_levels():
    p, empty = random_mixture(), np.empty((0, 2))
    assert (p.log_density(empty).shape, p.score(empty).shape) == ((0,), (0, 2))
    assert p.score_and_jacobian(empty)[1].shape == (0, 2, 2)
    for sigma in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ConfigurationError, match="sigma must be a positive number"):
            GaussianMixture(np.zeros((2, 2)), sigma)
