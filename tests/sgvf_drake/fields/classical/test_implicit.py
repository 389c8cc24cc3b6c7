"""Implicit curves by Taubin's fit, and the fields of them."""

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import AlgebraicCurve, Field, ImplicitField
from sgvf_drake.paths import PointCloud, make_shape


def test_a_circle_is_of_degree_two_and_its_function_a_distance(circle):
    phi = AlgebraicCurve.fit(circle)
    assert phi.degree == 2
    assert phi.residual < 1e-7
    radius = np.array([3.9, 4.0, 4.1, 4.3])
    angle = np.array([0.1, 2.0, 4.0, 5.5])
    z = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    # With a gradient of length one on the circle, outward: (r^2 - R^2) / 2 R.
    value = phi.value(z)
    np.testing.assert_allclose(value, (radius**2 - 16) / 8, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(phi.gradient(z), axis=1), radius / 4, rtol=1e-9)


def test_two_circles_are_of_degree_four():
    cloud, _ = make_shape("concentric-circles")
    phi = AlgebraicCurve.fit(cloud)
    assert phi.degree == 4
    for radius in (2.0, 4.0):
        x = radius * np.column_stack([np.cos(np.arange(9)), np.sin(np.arange(9))])
        np.testing.assert_allclose(phi.value(cloud.normalize(x)), 0.0, atol=1e-5)


def test_the_order_of_the_waypoints_does_not_matter(flower):
    shuffled = PointCloud(np.random.default_rng(0).permutation(flower.points))
    phi, other = (AlgebraicCurve.fit(cloud) for cloud in (flower, shuffled))
    np.testing.assert_allclose(other.coefficients, phi.coefficients, atol=1e-8)


def test_the_fit_is_the_best_of_its_degree(flower):
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


@pytest.mark.parametrize("degree", range(2, 9))
def test_it_is_positive_far_away(flower, degree):
    phi = AlgebraicCurve.fit(flower, [degree], tolerance=0.0)
    side = 5.0 * np.array(
        [[-1, -1], [-1, 0], [-1, 1], [0, 1], [1, 1], [1, 0], [1, -1], [0, -1]]
    )
    assert phi.value(side).sum() > 0


def test_the_lowest_degree_that_is_near_enough_is_taken(flower):
    residuals = {degree: AlgebraicCurve.fit(flower, [degree]).residual for degree in (2, 3, 4)}
    assert residuals[2] > residuals[3] > 0.1 > residuals[4]
    assert AlgebraicCurve.fit(flower).degree == 4
    assert AlgebraicCurve.fit(flower, tolerance=1.01 * residuals[3]).degree == 3
    assert AlgebraicCurve.fit(flower, tolerance=0.99 * residuals[3]).degree == 4
    assert AlgebraicCurve.fit(flower, [2, 3], tolerance=1e-3).degree == 3
    # Degree 7 has 36 coefficients, more than there are waypoints.
    few = PointCloud(flower.points[::2])
    assert AlgebraicCurve.fit(few, tolerance=0.0).degree <= 6


def test_on_a_circle_the_field_is_the_known_one(circle):
    k = 3.0
    field = ImplicitField(circle, AlgebraicCurve.fit(circle), gain=k)
    assert isinstance(field, Field)
    x = np.random.default_rng(2).uniform(*circle.box, (50, 2))
    z = circle.normalize(x)
    r = np.linalg.norm(z, axis=1)
    away = z / r[:, None]
    around = np.column_stack([-away[:, 1], away[:, 0]])
    m = field(x)
    angle = np.arctan(k * (r**2 - 16) / 8)
    np.testing.assert_allclose(np.linalg.norm(m, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose((m * away).sum(axis=1), -np.sin(angle), atol=1e-6)
    np.testing.assert_allclose((m * around).sum(axis=1), np.cos(angle), atol=1e-6)
    assert field.approach_length == pytest.approx(circle.unit_length / k)


def test_there_is_no_direction_in_the_middle(circle):
    field = ImplicitField(circle, AlgebraicCurve.fit(circle))
    assert np.linalg.norm(field(np.array([3.0, -1.0]))) < 1e-3


def test_derivatives(flower, check_derivatives):
    field = ImplicitField(flower, AlgebraicCurve.fit(flower), gain=2.0)
    x = np.random.default_rng(7).uniform(*flower.box, (40, 2))
    # Not where the gradient of phi vanishes: there the field turns at once.
    g = field.phi.gradient(flower.normalize(x))
    x = x[np.linalg.norm(g, axis=1) > 0.3]
    assert len(x) > 20
    check_derivatives(field, x, flower.unit_length)


def test_what_cannot_be_fitted_is_refused(circle):
    spatial = PointCloud(np.random.default_rng(0).normal(size=(30, 3)))
    with pytest.raises(ConfigurationError, match="planar, the cloud 3-D"):
        AlgebraicCurve.fit(spatial)
    with pytest.raises(ConfigurationError, match="5 waypoints are too few"):
        AlgebraicCurve.fit(PointCloud(np.random.default_rng(0).normal(size=(5, 2))))
    with pytest.raises(ConfigurationError, match="gain must be a positive number, not 0"):
        ImplicitField(circle, AlgebraicCurve.fit(circle), gain=0)
