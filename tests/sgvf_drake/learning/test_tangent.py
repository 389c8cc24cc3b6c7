"""The losses of the tangent: the paper's formulas, and what each of them sees."""

import numpy as np
import pytest
import torch

from sgvf_drake.learning import tangent
from sgvf_drake.learning.networks import Network
from sgvf_drake.learning.score_matching import NoiseSchedule
from sgvf_drake.learning.tangent import (
    directional_consistency_loss,
    normalized_score,
    orientation_loss,
    orthogonality_loss,
    paper_tangent_loss,
    robust_tangent_loss,
    unit_length_loss,
)

FUNCTIONS = {
    "unit": "unit_length_loss",
    "orthogonality": "orthogonality_loss",
    "direction": "directional_consistency_loss",
    "hint": "orientation_loss",
}
ONES = dict.fromkeys(FUNCTIONS, 1.0)
CASES = [("paper", name) for name in list(ONES)[:3]] + [("robust", name) for name in ONES]
SCHEDULE = NoiseSchedule(0.1)


@pytest.fixture(autouse=True)
def seeded():
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(9)
        yield


@pytest.fixture
def double():
    """Networks and draws in float64, so that sums of gradients can be compared."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def cosine(a, b):
    return (a * b).sum(axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))


def loss_of(loss, *arrays):
    return loss(*map(torch.as_tensor, arrays)).item()


@pytest.mark.parametrize("dim", [2, 3])
def test_the_losses_are_the_papers_formulas(dim):
    rng = np.random.default_rng(2)
    s, v = rng.standard_normal((2, 40, dim))
    copies = rng.standard_normal((5, 40, dim))
    turns = [1 - np.mean([cosine(v[i], copy[i]) for copy in copies]) for i in range(40)]
    orthogonality, consistency = np.mean(cosine(s, v) ** 2), np.mean(turns)
    lengths = np.mean((np.linalg.norm(s + v, axis=1) - 1) ** 2)
    hint = 1 - cosine(s, v).mean()
    for loss, arguments, expected in (
        (unit_length_loss, (s, v), lengths),
        (orthogonality_loss, (s, v), orthogonality),
        (directional_consistency_loss, (v, copies), consistency),
        (orientation_loss, (v, s), hint),
        # The cosines do not see lengths, and only the hint sees the sign.
        (orthogonality_loss, (3 * s, 0.01 * v), orthogonality),
        (directional_consistency_loss, (3 * v, 0.01 * copies), consistency),
        (orientation_loss, (3 * v, 0.01 * s), hint),
        (orthogonality_loss, (s, -v), orthogonality),
        (directional_consistency_loss, (-v, -copies), consistency),
        (orientation_loss, (-v, s), 2 - hint),
    ):
        assert loss_of(loss, *arguments) == pytest.approx(expected, rel=1e-12)
    assert hint != pytest.approx(1, abs=1e-3)
    size = np.linalg.norm(s, axis=1, keepdims=True)
    np.testing.assert_allclose(
        normalized_score(torch.as_tensor(30 * s), 0.2), np.tanh(0.2 * 30 * size) * s / size
    )


def test_perfect_opposite_and_vanishing_fields():
    v = np.eye(2)
    copies = np.stack([v] * 3)
    for loss, arguments, expected in (
        (unit_length_loss, (0 * v, v), 0),
        (orthogonality_loss, (v[::-1].copy(), v), 0),
        (orthogonality_loss, (v, -v), 1),
        (directional_consistency_loss, (v, copies), 0),
        (directional_consistency_loss, (v, -copies), 2),
        (orientation_loss, (v, v), 0),
        (orientation_loss, (v, -v), 2),
    ):
        assert loss_of(loss, *arguments) == pytest.approx(expected)
    ones = torch.ones(3, 2, dtype=torch.float64)
    for loss in (
        lambda zero: orthogonality_loss(zero, ones),
        lambda zero: orientation_loss(zero, ones),
        lambda zero: directional_consistency_loss(zero, ones.expand(2, 3, 2)),
        lambda zero: normalized_score(zero, 0.2).sum(),
    ):
        zero = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
        loss(zero).backward()
        assert torch.isfinite(zero.grad).all()


def test_algorithm_2_has_the_papers_three_terms():
    network, points = Network(2, (8,), 2), torch.randn(20, 2)
    terms = paper_tangent_loss(network, lambda x: -x, points, SCHEDULE, 0.2, 64, ONES)()
    assert list(terms) == ["unit", "orthogonality", "direction"]
    assert all(term.requires_grad for term in terms.values())

    seen = []

    def turned(x):
        seen.append(x)
        return torch.stack([x[:, 1], -x[:, 0]], dim=1)

    # For v = -s turned by a right angle only the length is left to improve.
    terms = paper_tangent_loss(turned, lambda x: x, points, SCHEDULE, 0.2, 64, ONES)()
    assert terms["orthogonality"] < 1e-12
    r = seen[-1][:64].norm(dim=1)
    expected = (torch.hypot(torch.tanh(0.2 * r), r) - 1).square().mean()
    assert terms["unit"].item() == pytest.approx(expected.item(), rel=1e-5)


def test_waypoints_without_a_hint_are_left_out():
    points = torch.cat([torch.full((10, 2), 1.0), torch.full((10, 2), -1.0)])
    hint = torch.cat([torch.tensor([[1.0, 0.0]]).expand(10, 2), torch.zeros(10, 2)])
    seen = []

    def network(x):
        seen.append(x)
        return torch.tensor([[0.0, 1.0]]).expand(len(x), 2)

    weights = ONES | {"hint": 3.0}
    terms = robust_tangent_loss(network, lambda x: -x, points, hint, 0.1, 100, weights)()
    assert list(terms) == ["unit", "orthogonality", "direction", "hint"]
    torch.testing.assert_close(seen[-1], points[:1].expand(60, 2))
    # A right angle to the hint: 1 - 0, times the weight of three.
    assert terms["hint"].item() == pytest.approx(3)
    assert terms["unit"].item() == pytest.approx(0)
    assert terms["direction"].item() == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("sigma", "noise"), [(0.02, 0.02), (0.5, 0.1)])
def test_neighbours_are_no_farther_than_a_noise_level(sigma, noise):
    seen = []

    def network(x):
        seen.append(x)
        return torch.tensor([[0.0, 1.0]]).expand(len(x), 2)

    points, hint = torch.zeros(1, 2), torch.tensor([[1.0, 0.0]])
    robust_tangent_loss(network, lambda x: -x, points, hint, sigma, 1_000, ONES)()
    # The places and their neighbours, and of each of these those by the waypoint first.
    x = seen[0].reshape(-1, 1_000, 2)
    assert x[0, :600].std().item() == pytest.approx(noise, rel=0.1)
    assert (x[1:] - x[0]).std().item() == pytest.approx(noise, rel=0.1)


def terms_and_gradients(recipe, weights):
    """The loss terms of one batch, always the same, and the gradient of their sum."""
    torch.manual_seed(4)
    network, points, hint = Network(2, (8,), 2), torch.randn(20, 2), torch.randn(20, 2)

    def score(x):
        return torch.stack([-x[:, 0], -2 * x[:, 1]], dim=1)

    losses = (
        paper_tangent_loss(network, score, points, SCHEDULE, 0.2, 64, weights)
        if recipe == "paper"
        else robust_tangent_loss(network, score, points, hint, 0.1, 64, weights)
    )
    terms = losses()
    torch.stack(list(terms.values())).sum().backward()
    values = {name: term.item() for name, term in terms.items()}
    gradients = [parameter.grad for parameter in network.parameters()]
    return values, torch.cat([gradient.ravel() for gradient in gradients])


@pytest.mark.usefixtures("double")
def test_a_weight_scales_its_loss_alone_and_at_zero_it_is_not_computed(monkeypatch):
    for recipe, name in CASES:
        full, whole = terms_and_gradients(recipe, ONES)
        alone = {other: float(other == name) for other in ONES}
        _, part = terms_and_gradients(recipe, alone)
        assert part.abs().max() > 1e-4
        values, gradient = terms_and_gradients(recipe, ONES | {name: 4.0})
        # A power of two: to the last bit.
        assert values == full | {name: 4 * full[name]}
        torch.testing.assert_close(gradient, whole + 3 * part, rtol=0, atol=1e-13)
        with monkeypatch.context() as patch:
            patch.setattr(tangent, FUNCTIONS[name], lambda *_: pytest.fail("it was computed"))
            values, rest = terms_and_gradients(recipe, ONES | {name: 0.0})
        # On the same draws.
        assert values == {other: full[other] for other in full if other != name}
        torch.testing.assert_close(rest, whole - part, rtol=0, atol=1e-13)
