import numpy as np
import pytest
import torch

from sgvf_drake.learning import tangent
from sgvf_drake.learning.networks import Network
from sgvf_drake.learning.schedule import NoiseSchedule
from sgvf_drake.learning.tangent import paper_tangent_loss, robust_tangent_loss
from sgvf_drake.learning.tangent_losses import (
    directional_consistency_loss,
    normalized_score,
    orientation_loss,
    orthogonality_loss,
    unit_length_loss,
)

ONES = {"unit": 1.0, "orthogonality": 1.0, "direction": 1.0, "hint": 1.0}
PAPER_TERMS, ROBUST_TERMS = list(ONES)[:3], list(ONES)
EACH_TERM = pytest.mark.parametrize(
    ("recipe", "name"),
    [("paper", name) for name in PAPER_TERMS] + [("robust", name) for name in ROBUST_TERMS],
)


@pytest.fixture
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


@pytest.fixture(params=[2, 3])
def vectors(request):
    rng = np.random.default_rng(2)
    shape = (40, request.param)
    s, v = rng.standard_normal(shape), rng.standard_normal(shape)
    return s, v, rng.standard_normal((5, *shape))


def cosine(a, b):
    return (a * b).sum(axis=-1) / (np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1))


def tensors(*arrays):
    return map(torch.as_tensor, arrays)


def test_unit_length_is_the_papers_formula(vectors):
    s, v, _ = vectors
    expected = np.mean((np.linalg.norm(s + v, axis=1) - 1) ** 2)
    assert unit_length_loss(*tensors(s, v)).item() == pytest.approx(expected, rel=1e-12)


def test_orthogonality_is_the_papers_formula(vectors):
    s, v, _ = vectors
    expected = np.mean(cosine(s, v) ** 2)
    assert orthogonality_loss(*tensors(s, v)).item() == pytest.approx(expected, rel=1e-12)


def test_directional_consistency_is_the_papers_formula(vectors):
    _, v, neighbours = vectors
    each = [1 - np.mean([cosine(v[i], copy[i]) for copy in neighbours]) for i in range(len(v))]
    loss = directional_consistency_loss(*tensors(v, neighbours))
    assert loss.item() == pytest.approx(np.mean(each), rel=1e-12)


def test_orientation_is_one_minus_the_cosine(vectors):
    s, v, _ = vectors
    loss = orientation_loss(*tensors(v, s)).item()
    assert loss == pytest.approx(1 - cosine(s, v).mean(), rel=1e-12)


def test_normalized_score_is_the_papers_formula(vectors):
    s, _, _ = vectors
    size = np.linalg.norm(s, axis=1, keepdims=True)
    np.testing.assert_allclose(
        normalized_score(torch.as_tensor(30 * s), 0.2), np.tanh(0.2 * 30 * size) * s / size
    )


def test_the_cosines_do_not_see_lengths(vectors):
    s, v, neighbours = vectors
    for loss, a, b in [
        (orthogonality_loss, s, v),
        (orientation_loss, v, s),
        (directional_consistency_loss, v, neighbours),
    ]:
        scaled = loss(*tensors(3 * a, 0.01 * b)).item()
        assert scaled == pytest.approx(loss(*tensors(a, b)).item(), rel=1e-12)


def test_only_the_hint_sees_the_sign(vectors):
    s, v, neighbours = vectors
    turned = directional_consistency_loss(*tensors(-v, -neighbours)).item()
    assert turned == pytest.approx(directional_consistency_loss(*tensors(v, neighbours)).item())
    both = [orthogonality_loss(*tensors(s, sign * v)).item() for sign in (1, -1)]
    assert both[0] == pytest.approx(both[1])
    there, back = (orientation_loss(*tensors(sign * v, s)).item() for sign in (1, -1))
    assert there + back == pytest.approx(2)
    assert there != pytest.approx(back, abs=1e-3)


def test_perfect_and_opposite_fields():
    v = torch.eye(2, dtype=torch.float64)
    assert unit_length_loss(torch.zeros_like(v), v) == 0
    assert orthogonality_loss(v.flip(0), v) == 0
    assert orthogonality_loss(v, -v) == pytest.approx(1)
    assert directional_consistency_loss(v, v.expand(3, 2, 2)) == pytest.approx(0)
    assert directional_consistency_loss(v, -v.expand(3, 2, 2)) == pytest.approx(2)
    assert orientation_loss(v, v) == pytest.approx(0)
    assert orientation_loss(v, -v) == pytest.approx(2)


@pytest.mark.parametrize(
    "loss",
    [
        lambda zero, v: orthogonality_loss(zero, v),
        lambda zero, v: orientation_loss(zero, v),
        lambda zero, v: directional_consistency_loss(zero, v.expand(2, 3, 2)),
        lambda zero, v: normalized_score(zero, 0.2).sum() + 0 * v.sum(),
    ],
)
def test_gradients_at_zero_are_finite(loss):
    zero = torch.zeros(3, 2, dtype=torch.float64, requires_grad=True)
    loss(zero, torch.ones(3, 2, dtype=torch.float64)).backward()
    assert torch.isfinite(zero.grad).all()


@pytest.mark.usefixtures("seeded")
def test_algorithm_2_has_the_papers_three_terms():
    network, points = Network(2, (8,), 2), torch.randn(20, 2)
    loss = paper_tangent_loss(network, lambda x: -x, points, NoiseSchedule(0.1), 0.2, 64, ONES)
    terms = loss()
    assert list(terms) == ["unit", "orthogonality", "direction"]
    assert all(term.requires_grad for term in terms.values())
    # For v = -s turned by a right angle only the length is left to improve.
    turned = paper_tangent_loss(
        lambda x: torch.stack([x[:, 1], -x[:, 0]], dim=1),
        lambda x: x,
        points,
        NoiseSchedule(0.1),
        0.2,
        64,
        ONES,
    )()
    assert turned["orthogonality"] < 1e-12
    assert turned["unit"] > 0.01


@pytest.mark.usefixtures("seeded")
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
    at_waypoints = seen[-1]
    torch.testing.assert_close(at_waypoints, points[:1].expand(60, 2))
    # A right angle to the hint: 1 - 0, times the weight of three.
    assert terms["hint"].item() == pytest.approx(3)
    assert terms["unit"].item() == pytest.approx(0)
    assert terms["direction"].item() == pytest.approx(0, abs=1e-6)


def terms_and_gradients(recipe, weights):
    """The loss terms of one batch, always the same, and the gradient of their sum."""
    torch.manual_seed(4)
    network, points = Network(2, (8,), 2), torch.randn(20, 2)
    hint = torch.randn(20, 2)
    losses = (
        paper_tangent_loss(network, score, points, NoiseSchedule(0.1), 0.2, 64, weights)
        if recipe == "paper"
        else robust_tangent_loss(network, score, points, hint, 0.1, 64, weights)
    )
    terms = losses()
    torch.stack(list(terms.values())).sum().backward()
    values = {name: term.item() for name, term in terms.items()}
    gradients = [parameter.grad for parameter in network.parameters()]
    return values, torch.cat([gradient.ravel() for gradient in gradients])


def score(x):
    return torch.stack([-x[:, 0], -2 * x[:, 1]], dim=1)


@pytest.mark.usefixtures("seeded", "double")
@EACH_TERM
def test_a_loss_of_weight_zero_is_not_computed_and_leaves_the_others(recipe, name, monkeypatch):
    full, whole = terms_and_gradients(recipe, ONES)
    alone = {other: float(other == name) for other in ONES}
    _, part = terms_and_gradients(recipe, alone)
    assert part.abs().max() > 1e-4
    functions = {
        "unit": "unit_length_loss",
        "orthogonality": "orthogonality_loss",
        "direction": "directional_consistency_loss",
        "hint": "orientation_loss",
    }
    monkeypatch.setattr(tangent, functions[name], lambda *_: pytest.fail("it was computed"))
    values, rest = terms_and_gradients(recipe, ONES | {name: 0.0})
    # On the same draws.
    assert values == {other: value for other, value in full.items() if other != name}
    torch.testing.assert_close(rest, whole - part, rtol=0, atol=1e-13)


@pytest.mark.usefixtures("seeded", "double")
@EACH_TERM
def test_a_weight_scales_its_loss_alone(recipe, name):
    full, whole = terms_and_gradients(recipe, ONES)
    values, gradient = terms_and_gradients(recipe, ONES | {name: 4.0})
    # A power of two: to the last bit.
    assert values == full | {name: 4 * full[name]}
    _, part = terms_and_gradients(recipe, {other: float(other == name) for other in ONES})
    torch.testing.assert_close(gradient, whole + 3 * part, rtol=0, atol=1e-13)
