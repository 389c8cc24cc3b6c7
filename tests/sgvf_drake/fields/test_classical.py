"""The classical fields, against what is known of circles and lines, and by differences."""

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    AlgebraicCurve,
    CurveField,
    FourierCurve,
    ImplicitField,
    ParametricField,
    PursuitField,
)
from sgvf_drake.paths import make_shape
from tests import helpers

# Corners of a square of half-extent 4, so that U is 1, and points between them.
SQUARE = np.array([[4, -4], [4, 0], [4, 4], [0, 4], [-4, 4], [-4, 0], [-4, -4], [0, -4]], float)


def on_circle(n, radius=1.0):
    return helpers.circle(radius, n)


@pytest.fixture(scope="module")
def circle():
    """Forty waypoints on a circle about (3, -1), counter-clockwise; U is a half."""
    return PointCloud(on_circle(40, 2.0) + np.array([3.0, -1.0]))


@pytest.fixture(scope="module")
def flower():
    """Sixty waypoints on a curve that is not convex, in order."""
    radius = 30 * (1 + 0.3 * np.cos(6 * np.pi * np.arange(60) / 60))
    return PointCloud(radius[:, None] * on_circle(60))


@pytest.fixture(scope="module")
def line():
    """Waypoints on a straight line, to be followed to (4, 0); U is 1."""
    return PointCloud(np.column_stack([np.linspace(-4, 4, 17), np.zeros(17)]))


def polar(cloud, x):
    """The distance from the middle in U (n, 1), and the directions away and around (n, 2)."""
    z = cloud.normalize(x)
    r = np.linalg.norm(z, axis=1)[:, None]
    return r, z / r, np.column_stack([-z[:, 1], z[:, 0]]) / r


def states(field, n=60):
    """Positions over the box, with parameters over three rounds."""
    rng = np.random.default_rng(1)
    x = rng.uniform(*field.cloud.box, (n, field.cloud.dim))
    length = field.curve.length * field.cloud.unit_length
    return np.column_stack([x, rng.uniform(-length, 2 * length, n)])


def test_derivatives_where_the_registry_does_not_go(line):
    """Beyond the ends of an open curve, on both sides of the last waypoint."""
    field = CurveField(line, [FourierCurve.through(line, closed=False)], gain=2.0)
    x = np.array([[4.3, 0.2], [5.0, -1.0], [-4.4, 0.3], [3.7, 0.1]])
    J, H = field.value_and_jacobian(x)[1], field.hessian(x)
    for i, e in enumerate(1e-5 * np.eye(2)):
        ahead, behind = field.value_and_jacobian(x + e), field.value_and_jacobian(x - e)
        np.testing.assert_allclose(J[..., i], (ahead[0] - behind[0]) / 2e-5, atol=1e-6)
        np.testing.assert_allclose(H[..., i], (ahead[1] - behind[1]) / 2e-5, atol=1e-4)
    assert field.approach_length == pytest.approx(0.5)


def test_what_cannot_be_followed_is_refused(circle):
    def curve(closed=True):
        return FourierCurve.through(circle, closed=closed)

    for make, match in (
        (lambda: CurveField(circle, []), "needs a curve"),
        (lambda: CurveField(circle, [curve()], gain=np.nan), "gain must be a .*, not nan"),
        (lambda: ParametricField(circle, curve(closed=False)), "closed curve"),
        (lambda: ParametricField(circle, curve(), gain=-1.0), "gain must be a positive number"),
        (lambda: PursuitField(circle, -1.0), "look_ahead must be a positive number"),
        (lambda: ImplicitField(circle, AlgebraicCurve.fit(circle), gain=0), "number, not 0"),
        (lambda: AlgebraicCurve.fit(PointCloud(np.eye(30, 3))), "planar, the cloud 3-D"),
        (lambda: AlgebraicCurve.fit(PointCloud(on_circle(5))), "5 waypoints are too few"),
    ):
        with pytest.raises(ConfigurationError, match=match):
            make()


# Pursuit.


def heading(field, x):
    """The waypoint that a field heads for, from x."""
    away = field.cloud.points - x
    cosine = away @ field(x) / np.linalg.norm(away, axis=1)
    assert np.isclose(cosine.max(), 1.0)
    return int(cosine.argmax())


def test_pursuit_heads_for_the_first_waypoint_that_is_far_enough_ahead():
    # Nearest to number 1, and on no line through two waypoints.
    for ahead, target in ((0.5, 2), (4.0, 2), (4.01, 3), (8.1, 4), (30.0, 1), (99.0, 1)):
        assert heading(PursuitField(PointCloud(SQUARE), ahead), np.array([3.1, 0.3])) == target
    # After the last waypoint comes the first; the order is taken as given.
    assert heading(PursuitField(PointCloud(SQUARE)), np.array([0.2, -4.3])) == 0
    assert heading(PursuitField(PointCloud(SQUARE), 10.0), np.array([0.2, -4.3])) == 2
    backward = PursuitField(PointCloud(SQUARE[::-1]))
    target = backward.cloud.points[heading(backward, np.array([3.1, 0.3]))]
    assert target.tolist() == [4, -4]


# Implicit curves.


def test_circles_are_algebraic_and_their_function_a_distance(circle):
    phi = AlgebraicCurve.fit(circle)
    assert phi.degree == 2
    assert phi.residual < 1e-7
    radius = np.array([3.9, 4.0, 4.1, 4.3])
    z = radius[:, None] * on_circle(4)
    # With a gradient of length one on the circle, outward: (r^2 - R^2) / 2 R.
    np.testing.assert_allclose(phi.value(z), (radius**2 - 16) / 8, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(phi.gradient(z), axis=1), radius / 4, rtol=1e-9)
    cloud, _ = make_shape("concentric-circles")
    phi = AlgebraicCurve.fit(cloud)
    assert phi.degree == 4
    for radius in (2.0, 4.0):
        value = phi.value(cloud.normalize(on_circle(9, radius)))
        np.testing.assert_allclose(value, 0.0, atol=1e-5)


def test_the_fit_is_the_best_of_its_degree_whatever_the_order(flower):
    """No other cubic of the same mean gradient is nearer to zero at the waypoints."""
    phi = AlgebraicCurve.fit(flower, [3])
    z = flower.normalize(flower.points)
    gradient_square = (phi.gradient(z) ** 2).sum(axis=1).mean()
    assert gradient_square == pytest.approx(1.0, rel=1e-9)
    assert np.sqrt((phi.value(z) ** 2).mean()) == pytest.approx(phi.residual, rel=1e-9)
    rng = np.random.default_rng(5)
    mask = np.add.outer(np.arange(4), np.arange(4)) <= 3
    for _ in range(50):
        other = AlgebraicCurve(phi.coefficients + 0.01 * mask * rng.normal(size=(4, 4)), 0.0)
        size = np.sqrt((other.gradient(z) ** 2).sum(axis=1).mean())
        assert np.sqrt((other.value(z) ** 2).mean()) / size > phi.residual
    shuffled = PointCloud(np.random.default_rng(0).permutation(flower.points))
    other = AlgebraicCurve.fit(shuffled, [3])
    np.testing.assert_allclose(other.coefficients, phi.coefficients, atol=1e-8)


def test_the_lowest_degree_that_is_near_enough_is_taken(flower):
    residuals = {degree: AlgebraicCurve.fit(flower, [degree]).residual for degree in (2, 3, 4)}
    assert residuals[2] > residuals[3] > 0.1 > residuals[4]
    for options, degree in (
        ({}, 4),
        ({"tolerance": 1.01 * residuals[3]}, 3),
        ({"tolerance": 0.99 * residuals[3]}, 4),
        ({"degrees": [2, 3], "tolerance": 1e-3}, 3),
    ):
        assert AlgebraicCurve.fit(flower, **options).degree == degree
    # Degree 7 has 36 coefficients, more than there are waypoints.
    few = PointCloud(flower.points[::2])
    assert AlgebraicCurve.fit(few, tolerance=0.0).degree <= 6
    # It is positive far away.
    side = 5.0 / 4 * np.vstack([SQUARE, SQUARE])
    for degree in range(2, 9):
        assert AlgebraicCurve.fit(flower, [degree], tolerance=0.0).value(side).sum() > 0


def test_on_a_circle_the_implicit_field_is_the_known_one(circle):
    k = 3.0
    field = ImplicitField(circle, AlgebraicCurve.fit(circle), gain=k)
    x = np.random.default_rng(2).uniform(*circle.box, (50, 2))
    r, away, around = polar(circle, x)
    angle = np.arctan(k * (r**2 - 16) / 8)
    expected = np.cos(angle) * around - np.sin(angle) * away
    np.testing.assert_allclose(field(x), expected, atol=1e-6)
    # There is no direction in the middle.
    assert np.linalg.norm(field(np.array([3.0, -1.0]))) < 1e-3


# Curves through the waypoints.


def test_on_a_circle_the_field_of_a_curve_is_the_known_one(circle):
    k = 5.0
    field = CurveField(circle, [FourierCurve.through(circle)], gain=k)
    x = np.random.default_rng(2).uniform(*circle.box, (60, 2))
    r, away, around = polar(circle, x)
    expected = (around - k * (r - 4) * away) / np.sqrt(1 + k**2 * (r - 4) ** 2)
    np.testing.assert_allclose(field(x), expected, atol=1e-9)
    assert len(field.ends) == 0
    larger = PointCloud(1e3 * circle.points)
    other = CurveField(larger, [FourierCurve.through(larger)], gain=k)
    np.testing.assert_allclose(other(1e3 * x), field(x), atol=1e-9)


def test_it_comes_to_rest_at_the_end_of_an_open_curve(line):
    k = 5.0
    field = CurveField(line, [FourierCurve.through(line, closed=False)], gain=k)
    np.testing.assert_allclose(field.ends, [[4.0, 0.0]], atol=1e-12)
    x = np.array([[0.0, 0.0], [3.9, 0.0], [4.0, 0.0], [4.2, 0.0], [4.0, 0.3], [-5.0, 0.0]])
    beyond, beside = (k * r / np.sqrt(1 + (k * r) ** 2) for r in (0.2, 0.3))
    along = [[1.0, 0.0], [np.tanh(k * 0.1), 0.0], [0.0, 0.0], [-beyond, 0.0]]
    np.testing.assert_allclose(field(x), [*along, [0.0, -beside], [1.0, 0.0]], atol=1e-9)


def test_the_nearest_of_several_curves_counts(circle):
    inner = PointCloud(np.concatenate([circle.points, (circle.points - [3, -1]) / 2 + [3, -1]]))
    halves = (np.arange(40), np.arange(40, 80))
    curves = [FourierCurve.through(inner, half) for half in halves]
    both = CurveField(inner, curves)
    alone = [CurveField(inner, [curve]) for curve in curves]
    x = np.random.default_rng(3).uniform(*inner.box, (50, 2))
    near_inner = np.linalg.norm(x - [3, -1], axis=1) < 1.5
    assert 0 < near_inner.sum() < len(x)
    expected = np.where(near_inner[:, None], alone[1](x), alone[0](x))
    np.testing.assert_allclose(both(x), expected, atol=1e-12)


# The singularity-free field, in one more dimension.


def test_the_parametric_field_is_the_wedge_product_less_the_gradients(flower):
    """chi = grad phi_1 x grad phi_2 - k (phi_1 grad phi_1 + phi_2 grad phi_2)."""
    field = ParametricField(flower, FourierCurve.through(flower), gain=2.0)
    x, unit = states(field), flower.unit_length
    f, f_w = field.curve.derivatives(x[:, 2] / unit, 1)
    phi = flower.normalize(x[:, :2]) - f
    gradients = [
        np.column_stack([np.broadcast_to(e, f.shape), -f_w[:, i]])
        for i, e in enumerate(np.eye(2))
    ]
    chi = np.cross(*gradients)
    chi -= field.gain * sum(phi[:, [i]] * gradient for i, gradient in enumerate(gradients))
    chi *= np.sqrt(2) / np.linalg.norm(chi, axis=1, keepdims=True)
    np.testing.assert_allclose(field(x), chi, atol=1e-12)
    # It vanishes nowhere, not even where the first part does, at k phi = f'.
    x[:, :2] = flower.denormalize(f + f_w / field.gain)
    m = field(x)
    np.testing.assert_allclose(m[:, :2], 0.0, atol=1e-9)
    np.testing.assert_allclose(m[:, 2], np.sqrt(2), rtol=1e-12)


def test_the_speed_on_the_path_is_one_at_the_nearest_parameter(circle):
    field = ParametricField(circle, FourierCurve.through(circle))
    m = field(field.lift(circle.points))
    # The parameter runs along the polyline, which is shorter than the circle by this.
    stretch = np.pi / 40 / np.sin(np.pi / 40)
    exact = np.sqrt(2) * np.array([stretch, 1.0]) / np.sqrt(1 + stretch**2)
    np.testing.assert_allclose(np.linalg.norm(m[:, :2], axis=1), exact[0], rtol=1e-9)
    np.testing.assert_allclose(m[:, 2], exact[1], rtol=1e-9)
    assert exact[0] == pytest.approx(1.0, abs=1e-3)
    x = np.array([[3.0, 5.0], [3.0, -1.1]])
    quarter = field.curve.length / 4 * circle.unit_length
    lifted = field.lift(x)
    np.testing.assert_array_equal(lifted[:, :2], x)
    np.testing.assert_allclose(lifted[:, 2] % (4 * quarter), [quarter, 3 * quarter], rtol=1e-9)
