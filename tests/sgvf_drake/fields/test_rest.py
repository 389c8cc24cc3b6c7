from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GaussianMixture, RobustComposition, load_field
from sgvf_drake.fields.rest import REST_WIDTH, Rest

SIGMA = 0.1
COMPOSITION = RobustComposition(0.2, SIGMA, projects=False)
ONE = np.array([[1.0, 2.0]])
TWO = np.array([[1.0, 2.0], [1.3, 1.8]])
IN_SPACE = np.array([[1.0, 2.0, 0.0], [0.9, 2.1, 0.2], [-1.0, 0.0, 0.0]])
ENDS = pytest.mark.parametrize("ends", [ONE, TWO, IN_SPACE], ids=["one", "two", "space"])


def rest(ends):
    return Rest.at(ends, COMPOSITION)


def around(ends, n=60, spread=0.4, seed=0):
    rng = np.random.default_rng(seed)
    return ends[rng.integers(len(ends), size=n)] + spread * rng.standard_normal(
        (n, ends.shape[1])
    )


@ENDS
def test_the_weight_is_one_at_every_end_and_zero_far_away(ends):
    np.testing.assert_allclose(rest(ends).weight(ends), 1, rtol=1e-15)
    away = ends[0] + 10 * REST_WIDTH * SIGMA * np.eye(ends.shape[1])[-1:]
    assert rest(ends).weight(away).max() < 1e-12
    weight = rest(ends).weight(around(ends))
    assert weight.min() >= 0
    assert weight.max() <= 1


def test_the_weight_of_one_end_is_a_gaussian_of_three_noise_levels():
    distance = SIGMA * np.array([0.5, 1.0, 3.0, 6.0])
    z = ONE + distance[:, None] * np.array([0.6, -0.8])
    expected = np.exp(-0.5 * (distance / (3 * SIGMA)) ** 2)
    np.testing.assert_allclose(rest(ONE).weight(z), expected, rtol=1e-13)


def test_another_end_only_adds():
    z = around(TWO)
    one, two = rest(ONE).weight(z), rest(TWO).weight(z)
    other = rest(TWO[1:]).weight(z)
    np.testing.assert_allclose(two, one + other - one * other, rtol=1e-10, atol=1e-15)
    assert (two >= np.maximum(one, other) - 1e-15).all()


@ENDS
def test_the_gradient_of_the_weight(ends):
    z, h = around(ends), 1e-6
    weight, gradient = rest(ends).weight_and_gradient(z)
    np.testing.assert_allclose(weight, rest(ends).weight(z), rtol=1e-14)
    for axis, e in enumerate(np.eye(ends.shape[1])):
        numeric = (rest(ends).weight(z + h * e) - rest(ends).weight(z - h * e)) / (2 * h)
        # h^2 / (3 sigma)^3, and rounding over h.
        np.testing.assert_allclose(gradient[:, axis], numeric, atol=1e-9)
    np.testing.assert_allclose(rest(ends).weight_and_gradient(ends)[1], 0, atol=1e-12)


@ENDS
def test_a_complex_step_passes_through_the_weight(ends):
    z, step = around(ends), 1e-30
    gradient = rest(ends).weight_and_gradient(z)[1]
    for axis, e in enumerate(np.eye(ends.shape[1])):
        exact = rest(ends).weight(z + 1j * step * e).imag / step
        np.testing.assert_allclose(gradient[:, axis], exact, rtol=1e-11, atol=1e-14)


# A field with ends.


@pytest.fixture(params=["robust", "exact"])
def resting(request, make_field):
    return make_field(request.param, ends=2)


def near_the_ends(field, n=40, seed=1):
    """Within the region of rest, at its rim, and outside."""
    rng = np.random.default_rng(seed)
    width = REST_WIDTH * field.sigma * field.cloud.unit_length
    ends = field.ends[rng.integers(len(field.ends), size=n)]
    return ends + width * rng.standard_normal((n, field.dim))


def test_m_is_the_blend_of_two_compositions(resting):
    x = np.vstack([near_the_ends(resting), resting.ends])
    z = resting.cloud.normalize(x)
    S, N = resting.score_model.score(z), resting.tangent_network(z)
    width = 3 * resting.sigma
    bumps = [
        np.exp(-0.5 * ((z - end) ** 2).sum(axis=1) / width**2)
        for end in resting.cloud.normalize(resting.ends)
    ]
    w = (1 - (1 - bumps[0]) * (1 - bumps[1]))[:, None]
    free = replace(resting.composition, projects=False).value(S, N)
    expected = (1 - w) * resting.composition.value(S, N) + w * free
    np.testing.assert_allclose(resting(x), expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(resting(resting.ends), free[-2:], rtol=1e-12, atol=1e-14)


def test_without_ends_and_far_from_them_nothing_changes(resting):
    plain = replace(resting, end_points=None)
    x = near_the_ends(resting)
    assert np.abs(plain(x) - resting(x)).max() > 1e-3
    away = resting.ends[0] + 20 * resting.cloud.half_extent * np.array([[0.6, 0.8], [-1, 0]])
    np.testing.assert_array_equal(plain(away), resting(away))
    assert plain.ends.shape == (0, 2)
    none = replace(resting, end_points=np.empty((0, 2)))
    np.testing.assert_array_equal(none(x), plain(x))


def test_the_papers_form_knows_no_rest(make_field):
    field = make_field("paper")
    ends = replace(field, end_points=field.cloud.points[:2])
    x = near_the_ends(ends)
    np.testing.assert_array_equal(ends(x), field(x))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("ends", [1, 2])
@pytest.mark.parametrize("recipe", ["robust", "exact"])
def test_jacobian_and_hessian_of_a_field_with_ends(make_field, recipe, ends, dim):
    field = make_field(recipe, dim=dim, ends=ends)
    x = np.vstack([near_the_ends(field), field.ends])
    m, J = field.value_and_jacobian(x)
    np.testing.assert_allclose(m, field(x), rtol=1e-12, atol=1e-14)
    h = 1e-5 * field.cloud.unit_length
    ahead, behind = (
        [field.value_and_jacobian(x + s * h * e) for e in np.eye(dim)] for s in (1, -1)
    )
    pairs = list(zip(ahead, behind, strict=True))
    numeric = np.stack([(a[0] - b[0]) / (2 * h) for a, b in pairs], axis=2)
    np.testing.assert_allclose(J, numeric, atol=1e-6 * np.abs(J).max())
    H = field.hessian(x)
    numeric = np.stack([(a[1] - b[1]) / (2 * h) for a, b in pairs], axis=3)
    np.testing.assert_allclose(H, numeric, atol=1e-6 * np.abs(H).max())
    np.testing.assert_allclose(H, np.swapaxes(H, 2, 3), atol=1e-11 * np.abs(H).max())


def test_m_is_continuous_through_an_end_and_across_the_region_of_rest(resting):
    """No step is longer than the largest slope on the way allows."""
    width = REST_WIDTH * resting.sigma * resting.cloud.unit_length
    at = np.linspace(-8 * width, 8 * width, 20_001)
    x = resting.ends[0] + at[:, None] * np.array([0.8, 0.6])
    m, J = resting.value_and_jacobian(x)
    steps = np.linalg.norm(np.diff(m, axis=0), axis=1)
    slopes = np.linalg.norm(J, ord=2, axis=(1, 2))
    assert (steps <= 1.05 * np.maximum(slopes[1:], slopes[:-1]) * (at[1] - at[0]) + 1e-12).all()


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_rescaling_scales_support_and_ends(make_field, factor):
    field = make_field("exact", ends=2, support=12)
    other = field.rescaled(factor)
    np.testing.assert_allclose(other.support, factor * field.support, rtol=1e-15)
    np.testing.assert_allclose(other.ends, factor * field.ends, rtol=1e-15)
    x = near_the_ends(field)
    np.testing.assert_allclose(other(factor * x), field(x), rtol=1e-9, atol=1e-11)
    J = field.value_and_jacobian(x)[1] / factor
    np.testing.assert_allclose(
        other.value_and_jacobian(factor * x)[1], J, rtol=1e-7, atol=1e-9 * np.abs(J).max()
    )
    with pytest.raises(ConfigurationError):
        field.rescaled(0.0)


def test_the_mixture_is_that_of_the_support(make_field):
    field = make_field("exact", support=12)
    np.testing.assert_array_equal(field.mixture.points, field.support)
    x = near_the_ends(replace(field, end_points=field.cloud.points[:2]))
    np.testing.assert_allclose(field.score(x), field.mixture.score(x), rtol=1e-9, atol=1e-10)
    waypoints = GaussianMixture(field.cloud.points, field.mixture.sigma)
    assert np.abs(field.score(x) - waypoints.score(x)).max() > 0.1


def test_another_approach_length_applies_at_the_ends_too(resting):
    wide = resting.with_approach_length(3 * resting.approach_length)
    z = resting.cloud.normalize(resting.ends)
    S, N = resting.score_model.score(z), resting.tangent_network(z)
    # The score is a third at the same place, and so is what it has to hold.
    free = RobustComposition(
        resting.composition.gain / 3, resting.sigma, projects=False, tangent_share=1 / 3
    )
    np.testing.assert_allclose(wide(resting.ends), free.value(S, N), rtol=1e-9)


# A trained open path.


def run(field, starts, duration):
    solution = solve_ivp(
        lambda _, x: field(x.reshape(starts.shape)).ravel(),
        (0, duration),
        starts.ravel(),
        rtol=1e-5,
        atol=1e-6,
        method="LSODA",
    )
    return solution.y[:, -1].reshape(starts.shape)


def test_every_run_on_an_open_path_comes_to_rest_at_its_end(open_result):
    assert open_result.self_check.passed, open_result.self_check.message
    field = open_result.field
    U = field.cloud.unit_length
    np.testing.assert_allclose(field.ends, [[3, 0]], atol=1e-3)
    axes = [np.linspace(*bounds, 7) for bounds in zip(*field.cloud.box, strict=True)]
    starts = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    last = run(field, starts, 1.5 * 3.6 * np.pi + 15 * U)
    assert np.linalg.norm(last - field.ends, axis=1).max() < 0.1 * U
    assert np.linalg.norm(field(last), axis=1).max() < 0.01


def test_an_open_path_is_travelled_at_full_speed_but_for_its_end(open_result):
    field = open_result.field
    angle = np.linspace(0.2, 1.2 * np.pi - 0.2, 200)
    x = 3 * np.column_stack([np.cos(angle), np.sin(angle)])
    tangent = np.column_stack([np.sin(angle), -np.cos(angle)])
    assert (field(x) * tangent).sum(axis=1).min() > 0.95
    np.testing.assert_allclose(np.linalg.norm(field(x), axis=1), 1, atol=0.02)
    # Pulled back from beyond the end.
    beyond = np.array([[3.0, -0.5], [3.0, -1.0]])
    assert field(beyond)[:, 1].min() > 0.1


def test_without_its_end_the_run_goes_on(open_result):
    """The projection lets go of the score where the waypoints end: that is too late."""
    field = replace(open_result.field, end_points=None)
    last = run(field, np.array([[0.0, 3.0]]), 20.0)
    U = field.cloud.unit_length
    assert np.linalg.norm(last - open_result.field.ends) > 0.2 * U


def test_a_trained_open_path_is_stored_to_the_bit(open_result, tmp_path):
    field = open_result.field
    field.save(tmp_path / "field")
    loaded = load_field(tmp_path / "field")
    assert loaded.ends.tobytes() == field.ends.tobytes()
    assert loaded.support.tobytes() == field.support.tobytes()
    x = near_the_ends(field)
    np.testing.assert_allclose(loaded(x), field(x), rtol=1e-9, atol=1e-12)
