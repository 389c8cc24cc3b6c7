"""How a field comes to rest at the ends of open paths."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.fields import GaussianMixture, RobustComposition
from sgvf_drake.fields.rest import REST_WIDTH, Rest

SIGMA = 0.1
COMPOSITION = RobustComposition(0.2, SIGMA, projects=False)
ONE = np.array([[1.0, 2.0]])
TWO = np.array([[1.0, 2.0], [1.3, 1.8]])
IN_SPACE = np.array([[1.0, 2.0, 0.0], [0.9, 2.1, 0.2], [-1.0, 0.0, 0.0]])


def rest(ends):
    return Rest.at(ends, COMPOSITION)


def around(ends, n=60, spread=0.4):
    rng = np.random.default_rng(0)
    spread = spread * rng.standard_normal((n, ends.shape[1]))
    return ends[rng.integers(len(ends), size=n)] + spread


@pytest.mark.parametrize("ends", [ONE, TWO, IN_SPACE], ids=["one", "two", "space"])
def test_the_weight_and_its_gradient(ends):
    np.testing.assert_allclose(rest(ends).weight(ends), 1, rtol=1e-15)
    away = ends[0] + 10 * REST_WIDTH * SIGMA * np.eye(ends.shape[1])[-1:]
    assert rest(ends).weight(away).max() < 1e-12
    z, h = around(ends), 1e-6
    weight, gradient = rest(ends).weight_and_gradient(z)
    assert weight.min() >= 0
    assert weight.max() <= 1
    np.testing.assert_allclose(weight, rest(ends).weight(z), rtol=1e-14)
    for axis, e in enumerate(np.eye(ends.shape[1])):
        numeric = (rest(ends).weight(z + h * e) - rest(ends).weight(z - h * e)) / (2 * h)
        # h^2 / (3 sigma)^3, and rounding over h.
        np.testing.assert_allclose(gradient[:, axis], numeric, atol=1e-9)
        exact = rest(ends).weight(z + 1e-30j * e).imag / 1e-30
        np.testing.assert_allclose(gradient[:, axis], exact, rtol=1e-11, atol=1e-14)
    np.testing.assert_allclose(rest(ends).weight_and_gradient(ends)[1], 0, atol=1e-12)


def test_the_weight_is_a_gaussian_of_three_noise_levels_and_another_end_only_adds():
    distance = SIGMA * np.array([0.5, 1.0, 3.0, 6.0])
    z = ONE + distance[:, None] * np.array([0.6, -0.8])
    expected = np.exp(-0.5 * (distance / (3 * SIGMA)) ** 2)
    np.testing.assert_allclose(rest(ONE).weight(z), expected, rtol=1e-13)
    z = around(TWO)
    one, other, two = (rest(ends).weight(z) for ends in (ONE, TWO[1:], TWO))
    np.testing.assert_allclose(two, one + other - one * other, rtol=1e-10, atol=1e-15)


def test_a_widened_field_has_more_room_to_come_to_rest():
    distance = SIGMA * np.array([1.0, 4.0, 9.0])
    z = ONE + distance[:, None] * np.array([0.6, -0.8])
    for length in SIGMA * np.array([0.5, 2.0, 6.0]):
        composition = replace(COMPOSITION, gain=SIGMA**2 / length)
        width = 3 * max(SIGMA, length / 2)
        expected = np.exp(-0.5 * (distance / width) ** 2)
        found = Rest.at(ONE, composition).weight(z)
        np.testing.assert_allclose(found, expected, rtol=1e-10)


# A field with ends.


@pytest.fixture(params=["robust", "exact"])
def resting(request, make_field):
    return make_field(request.param, ends=2)


def near_the_ends(field, n=40):
    """Within the region of rest, at its rim, and outside."""
    rng = np.random.default_rng(1)
    width = REST_WIDTH * field.sigma * field.cloud.unit_length
    ends = field.ends[rng.integers(len(field.ends), size=n)]
    return ends + width * rng.standard_normal((n, field.dim))


def test_m_is_the_blend_of_two_compositions(resting):
    x = np.vstack([near_the_ends(resting), resting.ends])
    z = resting.cloud.normalize(x)
    S, N = resting.score_model.score(z), resting.tangent_network(z)
    bumps = [
        np.exp(-0.5 * ((z - end) ** 2).sum(axis=1) / (3 * resting.sigma) ** 2)
        for end in resting.cloud.normalize(resting.ends)
    ]
    w = (1 - (1 - bumps[0]) * (1 - bumps[1]))[:, None]
    free = replace(resting.composition, projects=False).value(S, N)
    expected = (1 - w) * resting.composition.value(S, N) + w * free
    np.testing.assert_allclose(resting(x), expected, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(resting(resting.ends), free[-2:], rtol=1e-12, atol=1e-14)
    # With another approach length the score is a third at the same place, and so is what it
    # has to hold.
    wide = resting.with_approach_length(3 * resting.approach_length)
    free = RobustComposition(
        resting.composition.gain / 3, resting.sigma, projects=False, tangent_share=1 / 3
    )
    at_ends = free.value(S[-2:], N[-2:])
    np.testing.assert_allclose(wide(resting.ends), at_ends, rtol=1e-9)


def test_without_ends_and_far_from_them_nothing_changes(resting, make_field):
    plain = replace(resting, end_points=None)
    x = near_the_ends(resting)
    assert np.abs(plain(x) - resting(x)).max() > 1e-3
    away = resting.ends[0] + 20 * resting.cloud.half_extent * np.array([[0.6, 0.8], [-1, 0]])
    np.testing.assert_array_equal(plain(away), resting(away))
    assert plain.ends.shape == (0, 2)
    none = replace(resting, end_points=np.empty((0, 2)))
    np.testing.assert_array_equal(none(x), plain(x))
    # The paper's form knows no rest.
    paper = make_field("paper")
    np.testing.assert_array_equal(make_field("paper", ends=2)(x), paper(x))


def test_m_is_continuous_through_an_end_and_across_the_region_of_rest(resting):
    """No step is longer than the largest slope on the way allows."""
    width = REST_WIDTH * resting.sigma * resting.cloud.unit_length
    at = np.linspace(-8 * width, 8 * width, 20_001)
    x = resting.ends[0] + at[:, None] * np.array([0.8, 0.6])
    m, J = resting.value_and_jacobian(x)
    steps = np.linalg.norm(np.diff(m, axis=0), axis=1)
    slopes = np.linalg.norm(J, ord=2, axis=(1, 2))
    assert (steps <= 1.05 * np.maximum(slopes[1:], slopes[:-1]) * (at[1] - at[0]) + 1e-12).all()


def test_the_mixture_is_that_of_the_support(make_field):
    field = make_field("exact", ends=2, support=12)
    x = near_the_ends(field)
    np.testing.assert_array_equal(field.mixture.points, field.support)
    np.testing.assert_allclose(field.score(x), field.mixture.score(x), rtol=1e-9, atol=1e-10)
    waypoints = GaussianMixture(field.cloud.points, field.mixture.sigma)
    assert np.abs(field.score(x) - waypoints.score(x)).max() > 0.1


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


def test_every_run_on_an_open_path_comes_to_rest_at_its_end(open_field):
    U = open_field.cloud.unit_length
    np.testing.assert_allclose(open_field.ends, [[3, 0]], atol=1e-3)
    axes = [np.linspace(*bounds, 5) for bounds in zip(*open_field.cloud.box, strict=True)]
    starts = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    last = run(open_field, starts, 1.5 * 3.6 * np.pi + 15 * U)
    assert np.linalg.norm(last - open_field.ends, axis=1).max() < 0.1 * U
    assert np.linalg.norm(open_field(last), axis=1).max() < 0.01
    # Without its end the run goes on: where the waypoints end, the projection lets go of the
    # score too late.
    last = run(replace(open_field, end_points=None), np.array([[0.0, 3.0]]), 20.0)
    assert np.linalg.norm(last - open_field.ends) > 0.2 * U


def test_an_open_path_is_travelled_at_full_speed_but_for_its_end(open_field):
    angle = np.linspace(0.2, 1.2 * np.pi - 0.2, 200)
    x = 3 * np.column_stack([np.cos(angle), np.sin(angle)])
    tangent = np.column_stack([np.sin(angle), -np.cos(angle)])
    assert (open_field(x) * tangent).sum(axis=1).min() > 0.95
    np.testing.assert_allclose(np.linalg.norm(open_field(x), axis=1), 1, atol=0.02)
    # Pulled back from beyond the end.
    assert open_field(np.array([[3.0, -0.5], [3.0, -1.0]]))[:, 1].min() > 0.1
