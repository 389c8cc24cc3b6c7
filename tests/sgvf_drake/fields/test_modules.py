import copy
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import nn

from sgvf_drake import ConfigurationError, GuidingField, PointCloud
from sgvf_drake.fields.activation import ACTIVATIONS
from sgvf_drake.fields.modules import perceptron_from_module


@pytest.fixture(autouse=True)
def seeded():
    """Draws the weights of every network of a test from one seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


@pytest.fixture(scope="module")
def cloud():
    return PointCloud(np.random.default_rng(3).uniform(-2, 4, (40, 2)))


class Wrapped(nn.Module):
    """A module that holds its Sequential, and asks for position and time apart."""

    def __init__(self, net):
        super().__init__()
        self.net = net

    def forward(self, x, t):
        return self.net(torch.cat([x, t], dim=1))


class WrappedTogether(Wrapped):
    def forward(self, xt):
        return self.net(xt)


class WrappedFlatTime(Wrapped):
    def forward(self, x, t):
        return self.net(torch.cat([x, t[:, None]], dim=1))


class WrappedExpanded(Wrapped):
    def forward(self, x, t):
        return self.net(torch.cat([x, t.expand(len(x), 1)], dim=1))


class WrappedNumber(Wrapped):
    def forward(self, x, t):
        return self.net(torch.cat([x, torch.full_like(x[:, :1], t)], dim=1))


class Scaled(Wrapped):
    """Divides by a noise level, as score networks often do."""

    def forward(self, x, t):
        return super().forward(x, t) / 0.1


class Residual(nn.Module):
    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(2, 4), nn.SiLU(), nn.Linear(4, 2))

    def forward(self, x):
        return x + self.layers(x)


class Functional(nn.Module):
    """Its activation is no module."""

    def __init__(self):
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(3, 4), nn.Linear(4, 2)])

    def forward(self, x):
        return self.layers[1](torch.tanh(self.layers[0](x)))


FORMS = {
    "plain": lambda net: net,
    "in two arguments": Wrapped,
    "in one argument": WrappedTogether,
    "flat time": WrappedFlatTime,
    "time as a tensor of no dimension": WrappedExpanded,
    "time as a number": WrappedNumber,
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_a_module_of_any_usual_form(make_sequential, largest_difference, cloud, form):
    score, tangent = make_sequential([3, 16, 16, 2]), make_sequential([2, 16, 2], seed=1)
    field = GuidingField.from_torch(form(score), tangent, cloud)
    assert largest_difference(field, score, tangent) < 1e-12


@pytest.mark.parametrize("name", [activation.name for activation in ACTIVATIONS])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
def test_every_activation_in_any_precision(
    make_sequential, largest_difference, cloud, name, dtype
):
    score = make_sequential([3, 16, 16, 2], name, dtype=dtype)
    tangent = make_sequential([2, 16, 2], "Tanh", seed=1, dtype=dtype)
    options = {"gain": 0.4, "normalise": True}
    field = GuidingField.from_torch(score, tangent, cloud, **options)
    assert field.provenance["import"]["score_activation"] == name
    assert field.provenance["import"]["tangent_activation"] == "Tanh"
    # Where s and v nearly cancel, m is short of one long by 5e-13 / |s + v|^2.
    assert largest_difference(field, score, tangent, **options) < 1e-6


def test_the_modules_stay_as_they_are(make_sequential, cloud):
    score, tangent = make_sequential([3, 16, 2]), make_sequential([2, 2])
    before = copy.deepcopy(score.state_dict())
    score.train()
    random_state = torch.get_rng_state()
    GuidingField.from_torch(score, tangent, cloud)
    assert score.training
    assert all(parameter.requires_grad for parameter in score.parameters())
    assert all(parameter.grad is None for parameter in score.parameters())
    assert torch.equal(torch.get_rng_state(), random_state)
    for key, tensor in score.state_dict().items():
        assert tensor.dtype == torch.float32
        assert torch.equal(tensor, before[key])


def test_the_field_keeps_nothing_of_the_modules(make_sequential, cloud):
    score = make_sequential([3, 16, 2], dtype=torch.float64)
    field = GuidingField.from_torch(score, make_sequential([2, 2]), cloud)
    before = field(cloud.points)
    with torch.no_grad():
        score[0].weight.zero_()
        score[2].bias.zero_()
    np.testing.assert_array_equal(field(cloud.points), before)


def test_one_activation_may_serve_every_layer(make_sequential, largest_difference, cloud):
    shared = nn.Tanh()
    net = make_sequential([3, 8, 8, 2], "Tanh")
    score = nn.Sequential(net[0], shared, net[2], shared, net[4])
    tangent = make_sequential([2, 2])
    field = GuidingField.from_torch(score, tangent, cloud)
    assert largest_difference(field, net, tangent) < 1e-12


def test_layers_that_do_nothing_are_skipped(make_sequential, largest_difference, cloud):
    net = make_sequential([3, 8, 2])
    tangent = make_sequential([2, 2])
    score = nn.Sequential(nn.Identity(), net[0], net[1], nn.Dropout(0.5), net[2]).eval()
    field = GuidingField.from_torch(score, tangent, cloud)
    assert largest_difference(field, score, tangent) < 1e-12


def linear(*widths):
    return [nn.Linear(a, b) for a, b in pairwise(widths)]


def refused():
    """Modules that are no perceptron, each with what is said of it."""
    a, b, c = linear(3, 4, 4, 2)
    nowhere = nn.Linear(3, 2)
    nn.init.constant_(nowhere.bias, torch.nan)
    return {
        "no module": ("score.pth", "score network: a torch module is needed, not str"),
        "no layer": (nn.Sequential(), "there is no layer"),
        "norm first": (
            nn.Sequential(a, nn.LayerNorm(4), c),
            r"layer '1' \(LayerNorm\): unknown act",
        ),
        "norm after": (
            nn.Sequential(a, nn.SiLU(), nn.LayerNorm(4), c),
            r"layer '2' \(LayerNorm\) stands where the next Linear layer has to be",
        ),
        "other activation": (
            nn.Sequential(a, nn.Mish(), c),
            r"layer '1' \(Mish\): unknown act",
        ),
        "no activation": (
            nn.Sequential(a, b, nn.SiLU(), c),
            r"layer '1' \(Linear\) stands where the next activation has to be",
        ),
        "two activations": (
            nn.Sequential(a, nn.SiLU(), nn.SiLU(), c),
            r"layer '2' \(SiLU\) stands where the next Linear",
        ),
        "activation first": (
            nn.Sequential(nn.SiLU(), a, nn.SiLU(), c),
            r"layer '0' \(SiLU\) stands",
        ),
        "activation last": (
            nn.Sequential(a, nn.SiLU(), c, nn.Tanh()),
            r"layer '3' \(Tanh\) comes after the last Linear layer",
        ),
        "mixed": (nn.Sequential(a, nn.SiLU(), b, nn.Tanh(), c), "differ: SiLU, Tanh"),
        "dropout": (
            nn.Sequential(a, nn.SiLU(), nn.Dropout(0.1), c),
            r"layer '2' \(Dropout\) is in training; call eval\(\) first",
        ),
        "beta": (
            nn.Sequential(a, nn.Softplus(beta=2), c),
            r"'1' \(Softplus\) has beta=2, not 1",
        ),
        "threshold": (nn.Sequential(a, nn.Softplus(threshold=3), c), "threshold=3, not 20"),
        "tanh form": (
            nn.Sequential(a, nn.GELU("tanh"), c),
            "has approximate='tanh', not 'none'",
        ),
        "alpha": (nn.Sequential(a, nn.ELU(alpha=2), c), "has alpha=2, not 1"),
        "no bias": (
            nn.Sequential(a, nn.SiLU(), nn.Linear(4, 2, bias=False)),
            r"2\.bias is missing",
        ),
        # Numbers of layers that are nested start anew, so they have no order.
        "nested": (
            nn.Sequential(nn.Sequential(a), nn.Sequential(nn.SiLU(), c)),
            "belongs to another network",
        ),
        "functional": (
            Functional(),
            r"layer 'layers.1' \(Linear\) stands where the next activation has to be",
        ),
        "scaled": (
            Scaled(nn.Sequential(a, nn.SiLU(), c)),
            "Scaled does not compute what its layers alone do; pass their Sequential",
        ),
        "widths": (nn.Sequential(*linear(2, 2)), "a score network .* not 2 and 2"),
        "NaN": (nn.Sequential(nowhere), "0.bias is not all finite"),
    }


with torch.random.fork_rng(devices=[]):
    torch.manual_seed(0)
    REFUSED = refused()


@pytest.mark.parametrize(("score", "match"), REFUSED.values(), ids=REFUSED)
def test_modules_that_are_no_perceptron_are_refused(cloud, score, match):
    with pytest.raises(ConfigurationError, match=match):
        GuidingField.from_torch(score, nn.Sequential(nn.Linear(2, 2)), cloud)


def test_the_network_at_fault_is_named(make_sequential, cloud):
    with pytest.raises(ConfigurationError, match="tangent network: Residual does not compute"):
        GuidingField.from_torch(make_sequential([3, 4, 2]), Residual(), cloud)


def test_an_unusual_module_can_be_passed_as_its_sequential():
    module = Residual()
    found = perceptron_from_module(module.layers, "tangent")
    x = np.random.default_rng(0).uniform(-5, 5, (9, 2))
    with torch.no_grad():
        expected = module.layers.double()(torch.as_tensor(x)).numpy()
    np.testing.assert_allclose(found(x), expected, rtol=1e-12)


def test_unused_layers_are_found_out():
    """Numbers and shapes say nothing of the order in which a forward method calls."""

    class Twice(WrappedTogether):
        def forward(self, xt):
            return self.net[2:](self.net[1](self.net[2:](self.net[:2](xt)).repeat(1, 2)))

    net = nn.Sequential(nn.Linear(3, 4), nn.SiLU(), nn.Linear(4, 2))
    with pytest.raises(ConfigurationError, match="Twice does not compute"):
        perceptron_from_module(Twice(net), "score")
