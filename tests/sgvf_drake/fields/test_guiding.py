"""The guiding field against its formulas in torch, and what every field keeps to."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sgvf_drake.fields import (
    GaussianMixture,
    RobustComposition,
    ScoreField,
    TangentField,
    composition,
)
from sgvf_drake.fields.vectors import component_along, cosine, curl_share


def queries(field, n=15, seed=5):
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


def check_against_torch(field, x):
    """Value, Jacobian and Hessian are those of torch's automatic differentiation."""
    m, J = field.value_and_jacobian(x)
    np.testing.assert_allclose(m, field(x), rtol=1e-12, atol=1e-14)
    H = field.hessian(x)
    np.testing.assert_allclose(H, np.swapaxes(H, 2, 3), atol=1e-11 * np.abs(H).max())
    for n, point in enumerate(torch.as_tensor(x)):
        value = torch_field(field, point)
        np.testing.assert_allclose(m[n], value, rtol=1e-11, atol=1e-12)
        slope = torch.autograd.functional.jacobian(lambda y: torch_field(field, y), point)
        np.testing.assert_allclose(J[n], slope, rtol=1e-9, atol=1e-11 * np.abs(J).max())
        bend = [
            torch.autograd.functional.hessian(lambda y, i=i: torch_field(field, y)[i], point)
            for i in range(field.dim)
        ]
        atol = 1e-10 * np.abs(H).max()
        np.testing.assert_allclose(H[n], np.stack(bend), rtol=1e-8, atol=atol)


@pytest.mark.parametrize("recipe", ["robust", "exact", "paper"])
def test_value_and_derivatives_are_those_of_an_independent_implementation(make_field, recipe):
    field = make_field(recipe)
    check_against_torch(field, queries(field, n=10))
    in_space = make_field(recipe, dim=3)
    check_against_torch(in_space, queries(in_space, n=4))


def test_the_field_without_the_projection(make_field):
    for recipe in ("robust", "exact"):
        field = make_field(recipe)
        bare = replace(field, composition=replace(field.composition, projects=False))
        x = queries(bare, n=6)
        check_against_torch(bare, x)
        np.testing.assert_array_equal(bare.rescaled(4.0)(4 * x), bare(x))
        assert not bare.with_approach_length(2.0).composition.projects


def test_score_and_tangent_are_the_parts_of_the_value(field):
    x, U = queries(field), field.cloud.unit_length
    z = field.cloud.normalize(x)
    S, v, N = U * field.score(x), field.tangent(x), field.tangent_network(z)
    if field.recipe == "paper":
        size = np.linalg.norm(S, axis=1, keepdims=True)
        expected = np.tanh(0.8 * size) * S / size + v
    else:
        expected = field.composition.value(S, N)
        unit = N / np.sqrt((N**2).sum(axis=1, keepdims=True) + 0.05**2)
        np.testing.assert_allclose(v, unit, rtol=1e-13)
    np.testing.assert_allclose(field(x), expected, rtol=1e-12, atol=1e-14)
    s, rest = field.components(x)
    np.testing.assert_array_equal(s + rest, field(x))
    if field.recipe == "exact":
        assert field.mixture.sigma == field.sigma * U
        np.testing.assert_array_equal(field.mixture.points, field.cloud.points)
        np.testing.assert_allclose(S / U, field.mixture.score(x), rtol=1e-9, atol=1e-10)
    else:
        # The score network is asked at the data end.
        output = field.score_model.network(np.column_stack([z, np.ones(len(x))]))
        np.testing.assert_allclose(S * field.score_model.scale, output, rtol=1e-12)
    # Each of them is a field of its own, with derivatives.
    h = 1e-5 * U
    for part, value in ((ScoreField(field), field.score), (TangentField(field), field.tangent)):
        np.testing.assert_array_equal(part(x), value(x))
        J = part.value_and_jacobian(x)[1]
        numeric = [(value(x + h * e) - value(x - h * e)) / (2 * h) for e in np.eye(2)]
        np.testing.assert_allclose(J, np.stack(numeric, axis=2), atol=1e-6 * np.abs(J).max())


def test_the_approach_length_is_the_slope_of_the_turn_and_keeps_the_direction_on_the_path():
    """Over a line, at a small distance r, m points back by r / approach_length."""
    length, sigma = 0.7, 0.4
    line = RobustComposition(sigma**2 / length, sigma)
    v, r = np.array([[1.0, 0.0]]), 1e-4
    # Beside a dense line the mixture's score is -r / sigma^2, straight to it.
    m = line.value(np.array([[0.0, -r / sigma**2]]), 1e8 * v)
    np.testing.assert_allclose(m[0], [1, -r / length], rtol=1e-7)
    for other in (0.1, length, 5.0):
        on_path = RobustComposition(sigma**2 / other, sigma).value(0 * v, 1e8 * v)
        np.testing.assert_array_equal(on_path, v)


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


def test_angles_between_vectors_and_the_part_of_a_jacobian_that_no_gradient_has():
    a = np.array([[1.0, 0.0], [0.0, 0.0], [3.0, 4.0]])
    b = np.array([[1.0, 1.0], [1.0, 0.0], [-3.0, -4.0]])
    np.testing.assert_allclose(cosine(a, b), [np.sqrt(0.5), 0.0, -1.0])
    np.testing.assert_allclose(component_along(b, a), [np.sqrt(0.5), 0.0, -5.0])
    symmetric = np.array([[2.0, 1.0], [1.0, -3.0]])
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    shares = curl_share(np.stack([symmetric, 5 * turn, symmetric + turn]))
    # Of the last, the parts are orthogonal: |turn| / sqrt(|symmetric|^2 + |turn|^2).
    both = np.sqrt(2) / np.sqrt(4 + 1 + 1 + 9 + 2)
    np.testing.assert_allclose(shares, [0.0, np.sqrt(2), np.sqrt(2) * both])
