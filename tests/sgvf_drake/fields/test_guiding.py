from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import (
    AdjustableField,
    Field,
    GaussianMixture,
    RobustComposition,
    composition,
)


def queries(field, n=30, seed=5):
    """Positions over the box of the cloud, in the user's unit."""
    lower, upper = field.cloud.box
    return np.random.default_rng(seed).uniform(lower, upper, (n, field.dim))


def torch_network(network, z):
    if network.features is not None:
        Omega, phi = map(
            torch.as_tensor, (network.features.frequencies, network.features.phases)
        )
        angles = Omega @ z + phi
        z = torch.cat([torch.sin(angles), torch.cos(angles)])
    *hidden, last = zip(network.weights, network.biases, strict=True)
    for W, b in hidden:
        z = torch.nn.functional.silu(torch.as_tensor(W) @ z + torch.as_tensor(b))
    return torch.as_tensor(last[0]) @ z + torch.as_tensor(last[1])


def torch_field(field, x):
    """m(x), (d,) -> (d,), written again from the formulas of the paper and of the design."""
    z = (x - torch.tensor(field.cloud.center)) / field.cloud.unit_length
    if isinstance(field.score_model, GaussianMixture):
        points = torch.as_tensor(field.score_model.points)
        weights = torch.softmax(-0.5 * ((z - points) ** 2).sum(dim=1) / field.sigma**2, dim=0)
        S = (weights @ points - z) / field.sigma**2
    else:
        model = field.score_model
        S = torch_network(model.network, torch.cat([z, torch.ones(1)])) / model.scale
    N = torch_network(field.tangent_network, z)
    k = field.composition.gain
    if field.recipe == "paper":
        return torch.tanh(k * S.norm()) * S / S.norm() + N
    v = N / torch.sqrt(N @ N + 0.05**2)
    g = 1 / (1 + (field.sigma * S.norm() / 3) ** 8) if field.composition.projects else 0.0
    normal = S - g * (S @ v) * v
    size = normal.norm()
    return torch.tanh(k * size) * normal / size + v / torch.cosh(k * size)


def test_value_is_that_of_an_independent_implementation(field):
    x = queries(field)
    expected = [torch_field(field, torch.as_tensor(row)).numpy() for row in x]
    np.testing.assert_allclose(field(x), expected, rtol=1e-11, atol=1e-12)


def test_automatic_analytic_and_numeric_jacobians_agree(field):
    x = queries(field)
    m, J = field.value_and_jacobian(x)
    np.testing.assert_allclose(m, field(x), rtol=1e-12, atol=1e-14)
    automatic = [
        torch.autograd.functional.jacobian(
            lambda row: torch_field(field, row), torch.as_tensor(row)
        ).numpy()
        for row in x
    ]
    scale = np.abs(J).max()
    np.testing.assert_allclose(J, automatic, rtol=1e-9, atol=1e-11 * scale)
    h = 1e-5 * field.cloud.unit_length
    numeric = [(field(x + h * e) - field(x - h * e)) / (2 * h) for e in np.eye(2)]
    np.testing.assert_allclose(J, np.stack(numeric, axis=2), atol=1e-6 * scale)


@pytest.mark.parametrize("recipe", ["robust", "exact"])
def test_the_field_without_the_projection(make_field, recipe):
    """Value, Jacobian and Hessian, against the formulas; also in another unit."""
    projected = make_field(recipe)
    bare = replace(projected, composition=replace(projected.composition, projects=False))
    x = queries(bare, n=10)
    written = partial(torch_field, bare)
    for row, m, J, H in zip(
        x, bare(x), bare.value_and_jacobian(x)[1], bare.hessian(x), strict=True
    ):
        point = torch.as_tensor(row)
        slope = torch.autograd.functional.jacobian(written, point)
        np.testing.assert_allclose(m, written(point), rtol=1e-11, atol=1e-12)
        np.testing.assert_allclose(J, slope, rtol=1e-9, atol=1e-11)
        bend = [
            torch.autograd.functional.hessian(lambda row, i=i: written(row)[i], point)
            for i in range(2)
        ]
        np.testing.assert_allclose(H, np.stack(bend), rtol=1e-8, atol=1e-10)
    np.testing.assert_array_equal(bare.rescaled(4.0)(4 * x), bare(x))
    assert not bare.with_approach_length(2.0).composition.projects


def test_hessian_is_the_derivative_of_the_jacobian(field):
    x = queries(field)
    H = field.hessian(x)
    h = 1e-5 * field.cloud.unit_length
    numeric = [
        (field.value_and_jacobian(x + h * e)[1] - field.value_and_jacobian(x - h * e)[1])
        / (2 * h)
        for e in np.eye(2)
    ]
    scale = np.abs(H).max()
    np.testing.assert_allclose(H, np.stack(numeric, axis=3), atol=1e-6 * scale)
    np.testing.assert_allclose(H, np.swapaxes(H, 2, 3), atol=1e-11 * scale)


def test_one_point_and_a_batch_agree(field):
    x = queries(field)
    m, J = field.value_and_jacobian(x)
    H = field.hessian(x)
    assert (m.shape, J.shape, H.shape) == ((30, 2), (30, 2, 2), (30, 2, 2, 2))
    one, one_J = field.value_and_jacobian(x[7])
    one_H = field.hessian(x[7])
    assert (one.shape, one_J.shape, one_H.shape) == ((2,), (2, 2), (2, 2, 2))
    # BLAS sums one row in another order than many.
    np.testing.assert_allclose(one, m[7], rtol=1e-12)
    np.testing.assert_allclose(field(x[7]), m[7], rtol=1e-12)
    np.testing.assert_allclose(one_J, J[7], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(one_H, H[7], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(field.score(x[7]), field.score(x)[7], rtol=1e-12)
    np.testing.assert_allclose(field.tangent(x[7]), field.tangent(x)[7], rtol=1e-12)


def test_no_points_and_other_types_of_input(field):
    empty = np.empty((0, 2))
    assert field(empty).shape == (0, 2)
    assert field.value_and_jacobian(empty)[1].shape == (0, 2, 2)
    assert field.hessian(empty).shape == (0, 2, 2, 2)
    np.testing.assert_array_equal(field([3, 4]), field(np.array([3.0, 4.0])))
    assert field(np.array([3, 4], dtype=np.float32)).dtype == np.float64


@pytest.mark.parametrize("shape", [(), (3,), (1,), (4, 3), (0,), (2, 2, 2)])
@pytest.mark.parametrize("method", ["__call__", "value_and_jacobian", "hessian", "score"])
def test_wrong_shapes_are_refused(field, shape, method):
    with pytest.raises(ValueError, match=r"expected positions of shape \(2,\) or \(n, 2\)"):
        getattr(field, method)(np.zeros(shape))


def test_a_third_dimension(make_field):
    field = make_field("robust", dim=3)
    x = queries(field, n=5)
    assert field.dim == 3
    expected = [torch_field(field, torch.as_tensor(row)).numpy() for row in x]
    np.testing.assert_allclose(field(x), expected, rtol=1e-11, atol=1e-12)
    _, J = field.value_and_jacobian(x)
    h = 1e-5
    numeric = [(field(x + h * e) - field(x - h * e)) / (2 * h) for e in np.eye(3)]
    np.testing.assert_allclose(J, np.stack(numeric, axis=2), atol=1e-6 * np.abs(J).max())
    assert field.hessian(x).shape == (5, 3, 3, 3)


@pytest.mark.parametrize("factor", [1000.0, 1e-3, 2.0**10])
def test_another_unit_of_length(field, factor):
    """m is a direction and keeps its value; J is per length, H per length squared."""
    other = field.rescaled(factor)
    x = queries(field)
    m, J = field.value_and_jacobian(x)
    other_m, other_J = other.value_and_jacobian(factor * x)
    np.testing.assert_allclose(other_m, m, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(
        other_J, J / factor, rtol=1e-7, atol=1e-9 * np.abs(J / factor).max()
    )
    H = field.hessian(x) / factor**2
    np.testing.assert_allclose(
        other.hessian(factor * x), H, rtol=1e-6, atol=1e-8 * np.abs(H).max()
    )
    np.testing.assert_allclose(other.score(factor * x), field.score(x) / factor, rtol=1e-9)
    np.testing.assert_allclose(other.tangent(factor * x), field.tangent(x), rtol=1e-9)
    assert other.approach_length == pytest.approx(factor * field.approach_length)
    assert other.mixture.sigma == pytest.approx(factor * field.mixture.sigma)


def test_value_is_composed_of_score_and_tangent(field):
    x = queries(field)
    U = field.cloud.unit_length
    S, v = U * field.score(x), field.tangent(x)
    if field.recipe == "paper":
        a = np.tanh(0.8 * np.linalg.norm(S, axis=1, keepdims=True))
        expected = a * S / np.linalg.norm(S, axis=1, keepdims=True) + v
    else:
        N = field.tangent_network(field.cloud.normalize(x))
        expected = field.composition.value(S, N)
        np.testing.assert_allclose(
            v, N / np.sqrt((N**2).sum(axis=1, keepdims=True) + 0.05**2), rtol=1e-13
        )
    np.testing.assert_allclose(field(x), expected, rtol=1e-12, atol=1e-14)


def test_score_of_the_exact_recipe_is_that_of_the_mixture(make_field):
    field = make_field("exact")
    x = queries(field)
    assert field.mixture.sigma == field.sigma * field.cloud.unit_length
    np.testing.assert_array_equal(field.mixture.points, field.cloud.points)
    np.testing.assert_allclose(field.score(x), field.mixture.score(x), rtol=1e-9, atol=1e-10)


def test_the_score_network_is_asked_at_the_data_end(make_field):
    field = make_field("robust")
    x = queries(field)
    z = np.column_stack([field.cloud.normalize(x), np.ones(len(x))])
    network = field.score_model.network
    np.testing.assert_allclose(
        field.score(x) * field.sigma * field.cloud.unit_length, network(z), rtol=1e-12
    )


def test_another_approach_length(field):
    U = field.cloud.unit_length
    assert field.approach_length == pytest.approx(0.4**2 / 0.8 * U)
    wide = field.with_approach_length(3 * field.approach_length)
    assert wide.approach_length == pytest.approx(3 * field.approach_length)
    assert wide.composition.gain == pytest.approx(field.composition.gain / 3)
    assert wide.composition == replace(field.composition, gain=wide.composition.gain)
    assert field.composition.gain == 0.8, "the field itself is left as it was"
    x = queries(field)
    np.testing.assert_array_equal(wide.score(x), field.score(x))
    np.testing.assert_array_equal(wide.tangent(x), field.tangent(x))
    assert not np.allclose(wide(x), field(x), atol=1e-3)


def test_the_approach_length_is_the_slope_of_the_turn_and_keeps_the_direction_on_the_path():
    """Over a line, at a small distance r, m points back by r / approach_length."""
    length, sigma = 0.7, 0.4
    line = RobustComposition(sigma**2 / length, sigma)
    v, r = np.array([[1.0, 0.0]]), 1e-4
    # Beside a dense line the mixture's score is -r / sigma^2, straight to it.
    m = line.value(np.array([[0.0, -r / sigma**2]]), 1e8 * v)
    np.testing.assert_allclose(m[0], [1, -r / length], rtol=1e-7)
    on_path = [
        RobustComposition(sigma**2 / other, sigma).value(0 * v, 1e8 * v)
        for other in (0.1, length, 5.0)
    ]
    np.testing.assert_array_equal(on_path, np.broadcast_to(v, (3, 1, 2)))


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_bad_lengths_and_scales_are_refused(field, value):
    with pytest.raises(ConfigurationError, match="length must be a positive number"):
        field.with_approach_length(value)
    with pytest.raises(ConfigurationError, match="scale must be a positive number"):
        field.rescaled(value)


def test_it_is_a_field(field):
    assert isinstance(field, Field)
    assert isinstance(field, AdjustableField)
    assert not isinstance(field.mixture, Field)


@pytest.mark.parametrize("distance", [1e2, 1e4, 1e8])
def test_far_outside_the_box_everything_is_finite(field, distance):
    x = field.cloud.center + distance * np.array([[1.0, 0.0], [-0.6, 0.8]])
    m, J = field.value_and_jacobian(x)
    for values in (m, J, field.hessian(x)):
        assert np.isfinite(values).all()


def test_where_the_tangent_vanishes_the_field_stays_smooth(make_field):
    """Topology demands zeros of N (Poincare-Hopf); there only the score leads."""
    field = make_field("exact")
    network = field.tangent_network
    biases = (*network.biases[:-1], network.biases[-1] - network(np.zeros((1, 2)))[0])
    field = replace(field, tangent_network=replace(network, biases=biases))
    center = field.cloud.center
    S = field.score(center) * field.cloud.unit_length
    size = np.linalg.norm(S)
    np.testing.assert_allclose(field(center), np.tanh(0.8 * size) * S / size, atol=1e-10)
    _, J = field.value_and_jacobian(center)
    h = 1e-6
    numeric = [(field(center + h * e) - field(center - h * e)) / (2 * h) for e in np.eye(2)]
    # The direction turns over |N| ~ delta, so its third derivative is of order delta^-3.
    h_error = h**2 / composition.DIRECTION_SOFTENING**3
    np.testing.assert_allclose(J, np.stack(numeric, axis=1), atol=100 * h_error)
