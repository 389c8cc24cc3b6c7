"""Fields of networks from torch: they are the paper's formula, or they are refused."""

import copy
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import pytest
import torch
from torch import nn

from sgvf_drake import ConfigurationError, GuidingField, PointCloud, load_field
from sgvf_drake.fields import (
    NormalisedComposition,
    PaperComposition,
    Perceptron,
    ScoreNetwork,
    find_activation,
    import_field,
)
from sgvf_drake.fields.activation import ACTIVATIONS, SILU
from sgvf_drake.fields.importing import (
    measured_sigma,
    perceptron_from_arrays,
    perceptron_from_module,
)

# Not at the origin, and not in the normalised unit; then in millimetres, far off.
NEAR, FAR = ((0.4, -0.3), 1.7), ((-3e4, 2e4), 1000.0)
ACTIVATION = pytest.mark.parametrize("name", [activation.name for activation in ACTIVATIONS])


@pytest.fixture(autouse=True)
def seeded():
    """Draws the weights of every network of a test from one seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        yield


def cloud_at(place, dim=2):
    center, half_extent = place
    points = np.random.default_rng(3).uniform(-1, 1, (40, dim))
    return PointCloud(np.resize(center, dim) + half_extent * points)


def perceptron(network, name="SiLU"):
    return perceptron_from_arrays(network.state_dict(), find_activation(name))


@pytest.fixture(scope="module")
def networks(make_sequential):
    """Makes untrained networks, (score, tangent), whose tangent is about one long."""

    def make(name="SiLU", dim=2, dtype=torch.float32):
        score = make_sequential([dim + 1, 24, 16, dim], name, seed=1, dtype=dtype)
        tangent = make_sequential([dim, 24, dim], name, seed=2, dtype=dtype)
        nn.init.constant_(tangent[-1].bias, 1.0)
        return score, tangent

    return make


def imported(networks, cloud, name="SiLU", **options):
    score, tangent = (perceptron(network, name) for network in networks)
    return import_field(score, tangent, cloud, **options)


@ACTIVATION
def test_it_is_the_papers_field_of_the_networks_with_torchs_derivatives(
    networks, largest_difference, field_in_torch, name
):
    pair = networks(name)
    # With Softplus, torch leaves out log(1 + e^-20) = 2e-9 a neuron.
    tolerance = 1e-6 if name == "Softplus" else 1e-9
    for normalise, place in product((False, True), (NEAR, FAR)):
        options = {"gain": 0.35, "normalise": normalise}
        field = imported(pair, cloud_at(place), name, **options)
        assert largest_difference(field, *pair, **options) < tolerance
    for normalise in (False, True):
        field = imported(pair, cloud_at(NEAR), name, normalise=normalise)
        formula = field_in_torch(*pair, normalise=normalise)
        x = np.random.default_rng(0).uniform(*field.cloud.box, (4, 2))
        near = {"rtol": tolerance, "atol": max(1e-10, tolerance * (name == "Softplus"))}
        J, H = field.value_and_jacobian(x)[1], field.hessian(x)
        for n, point in enumerate(torch.as_tensor(x)):
            expected = torch.autograd.functional.jacobian(formula, point)
            np.testing.assert_allclose(J[n], expected, **near)
            for i in range(2):
                bend = torch.autograd.functional.hessian(
                    lambda y, i=i, m=formula: m(y)[i], point
                )
                np.testing.assert_allclose(H[n, i], bend, **near)


def test_score_and_tangent_are_the_outputs_of_the_networks(networks):
    for dim in (2, 3):
        score, tangent = (network.double() for network in networks(dim=dim))
        field = imported((score, tangent), cloud_at(FAR, dim))
        x = np.random.default_rng(0).uniform(*field.cloud.box, (50, dim))
        with torch.no_grad():
            S = score(torch.cat([torch.as_tensor(x), torch.ones(50, 1)], dim=1)).numpy()
            v = tangent(torch.as_tensor(x)).numpy()
        np.testing.assert_allclose(field.score(x), S, rtol=1e-9)
        np.testing.assert_allclose(field.tangent(x), v, rtol=1e-9)
        s, rest = field.components(x)
        np.testing.assert_array_equal(s + rest, field(x))
        np.testing.assert_allclose(rest, v, rtol=1e-9)
        size = np.linalg.norm(S, axis=1, keepdims=True)
        np.testing.assert_allclose(s, np.tanh(0.2 * size) * S / size, rtol=1e-9)


def test_another_unit_of_length_is_the_same_field(networks):
    """In millimetres, a score is a thousandth as large, and its k_s a thousandfold."""
    score, tangent = (perceptron(network) for network in networks())
    field = import_field(score, tangent, cloud_at(NEAR), gain=0.3)

    def in_millimetres(network, output_factor):
        first = network.weights[0].copy()
        first[:, :2] *= 1e-3
        last = [array[-1] * output_factor for array in (network.weights, network.biases)]
        weights = (first, *network.weights[1:-1], last[0])
        return replace(network, weights=weights, biases=(*network.biases[:-1], last[1]))

    pair = in_millimetres(score, 1e-3), in_millimetres(tangent, 1)
    millimetres = import_field(*pair, PointCloud(1e3 * field.cloud.points), gain=300)
    x = np.random.default_rng(0).uniform(*field.cloud.box, (50, 2))
    np.testing.assert_allclose(millimetres(1e3 * x), field(x), rtol=1e-10)
    np.testing.assert_allclose(field.rescaled(1e3)(1e3 * x), field(x), rtol=1e-10)
    assert millimetres.sigma == pytest.approx(field.sigma, rel=1e-10)
    assert millimetres.approach_length == pytest.approx(1e3 * field.approach_length)


def test_the_field_tells_where_it_comes_from_and_is_stored_to_the_bit(networks, tmp_path):
    for activation in ACTIVATIONS:
        name = activation.name
        files = {"score": "a.pth", "tangent": "b.pth"}
        options = {"gain": 0.3, "normalise": True, "files": files}
        field = imported(networks(name), cloud_at(FAR), name, **options)
        assert (field.recipe, field.seed) == ("imported", 0)
        assert field.composition == NormalisedComposition(0.3 / field.cloud.unit_length)
        expected = {"gain": 0.3, "normalised": True, "files": files}
        for kind in ("score", "tangent"):
            expected[f"{kind}_activation"] = name
        assert field.provenance == {"import": expected}
        field.save(tmp_path / "field", overwrite=True)
        loaded = load_field(tmp_path / "field")
        x = np.random.default_rng(0).uniform(*field.cloud.box, (50, 2))
        np.testing.assert_array_equal(loaded(x), field(x))
        np.testing.assert_array_equal(loaded.hessian(x), field.hessian(x))
        assert loaded.provenance == field.provenance
    plain = imported(networks(), cloud_at(NEAR))
    assert plain.composition == PaperComposition(0.2 / plain.cloud.unit_length)


# The noise level.


def test_the_noise_level_of_a_score_that_falls(ring_networks):
    z = np.random.default_rng(0).uniform(-4, 4, (9, 2))
    for slopes, sigma in (
        # The steepest descent counts: across the path.
        ((-4.0, -1.6), 0.5),
        ((-4.0, 7.0), 0.5),
        ((2.0, 0.0), 0.1),
        # Beyond the range of noise levels that the rest of the library can follow.
        ((-1e6, 0.0), 0.02),
        ((-1e-3, 0.0), 1.0),
    ):
        weight = np.column_stack([np.diag(slopes), np.zeros(2)])
        linear = ScoreNetwork(Perceptron((weight,), (np.zeros(2),)), 1.0)
        assert measured_sigma(linear, z) == pytest.approx(sigma, rel=1e-12)
    # The median: S = -25 tanh(x) in either coordinate falls by 25 / cosh^2: sigma = cosh / 5.
    tanh = find_activation("Tanh")
    network = Perceptron((np.eye(2, 3), -np.eye(2)), (np.zeros(2), np.zeros(2)), None, tanh)
    z = np.array([[0.0, 0.0], [0.3, 0.3], [0.5, 0.5]])
    found = measured_sigma(ScoreNetwork(network, 0.04), z)
    assert found == pytest.approx(0.2 * np.cosh(0.3), rel=1e-12)
    score, tangent = ring_networks
    angle = 2 * np.pi * np.arange(50) / 50
    cloud = PointCloud(3 * np.column_stack([np.cos(angle), np.sin(angle)]))
    field = import_field(perceptron(score, "Tanh"), perceptron(tangent), cloud)
    assert field.sigma * cloud.unit_length == pytest.approx(0.3, rel=1e-4)


# Arrays.


def arrays_of(widths, prefix="net."):
    rng = np.random.default_rng(0)
    arrays = {}
    for layer, (inputs, outputs) in enumerate(pairwise(widths)):
        arrays[f"{prefix}{2 * layer}.weight"] = rng.standard_normal((outputs, inputs))
        arrays[f"{prefix}{2 * layer}.bias"] = rng.standard_normal(outputs)
    return arrays


def test_layers_come_in_the_order_of_their_numbers_under_any_common_prefix():
    widths = [3, *range(4, 11), 2]
    arrays = arrays_of(widths)
    backward = dict(reversed(arrays.items()))
    # The last is number 14, which is before 2 in the order of the alphabet.
    assert sorted(arrays)[2] == "net.10.bias"
    found = perceptron_from_arrays(backward, SILU)
    assert [len(bias) for bias in found.biases] == widths[1:]
    z = np.random.default_rng(0).uniform(-5, 5, (20, 3))
    expected = found(z)
    for prefix in ("", "module.net.", "fc", "block2.layers."):
        other = perceptron_from_arrays(arrays_of(widths, prefix), SILU)
        np.testing.assert_array_equal(other(z), expected)
    # It keeps none of the memory of what it was made from.
    for array in arrays.values():
        array[...] = 0
    np.testing.assert_array_equal(found(z), expected)


BAD_ARRAYS = (
    (lambda a: a.clear(), "there is no layer"),
    (lambda a: a.pop("net.2.bias"), "net.2.bias is missing"),
    (lambda a: a.pop("net.2.weight"), "net.2.weight is missing"),
    (lambda a: a.update({"net.1.scale": np.ones(2)}), "'net.1.scale' is not the weight"),
    (lambda a: a.update({7: np.ones(2)}), "7 is not the weight"),
    (lambda a: a.update({"out.weight": np.ones((2, 2))}), "'out.weight' is not"),
    (lambda a: a.update(arrays_of([2, 2], "o.")), "o.0.weight belongs to another network"),
    (lambda a: a.update({"net.1.weight": np.ones(5), "net.1.bias": np.ones(5)}), "net.1"),
    (
        lambda a: a.update({"net.2.bias": np.ones((2, 1))}),
        r"net.2.bias is of shape \(2, 1\), but net.2.weight \(2, 5\)",
    ),
    (
        lambda a: a.update({"net.2.weight": np.ones((2, 4))}),
        r"net.2.weight is of shape \(2, 4\), but net.0.weight \(5, 3\)",
    ),
    (lambda a: np.put(a["net.2.bias"], 1, np.nan), "net.2.bias is not all finite"),
    (lambda a: np.put(a["net.0.weight"], 1, np.inf), "net.0.weight is not all"),
)


def test_arrays_that_are_no_perceptron_are_refused():
    no_arrays = (
        np.ones(5, int),
        torch.ones(5, dtype=torch.int64),
        torch.ones(5) * 1j,
        torch.eye(5, 1).to_sparse(),
        torch.ones(5, device="meta"),
        [[1.0], 2],
        "ones",
    )
    spoilt = [
        (lambda a, value=value: a.update({"net.0.bias": value}), "net.0.bias is not a plain")
        for value in no_arrays
    ]
    for spoil, match in (*BAD_ARRAYS, *spoilt):
        arrays = arrays_of([3, 5, 2])
        spoil(arrays)
        with pytest.raises(ConfigurationError, match=match):
            perceptron_from_arrays(arrays, SILU)


def test_parts_that_do_not_fit_are_refused(make_sequential, networks):
    for score, tangent, dim, match in (
        ([2, 4, 2], [2, 4, 2], 2, r"a score network has d \+ 1 inputs .* not 2 and 2"),
        ([3, 4, 3], [2, 4, 2], 2, "a score network .* not 3 and 3"),
        ([3, 4, 2], [3, 4, 2], 2, "a tangent network has d inputs .* not 3 and 2"),
        ([4, 4, 3], [2, 4, 2], 2, "tangent network is of 2 dimensions, the score network of 3"),
        ([3, 4, 2], [2, 4, 2], 3, "the score network of 2, and the waypoints of 3"),
    ):
        pair = make_sequential(score), make_sequential(tangent)
        with pytest.raises(ConfigurationError, match=match):
            imported(pair, cloud_at(NEAR, dim))
    for gain in (0.0, -0.2, np.nan, np.inf):
        with pytest.raises(ConfigurationError, match=f"k_s must be a positive .*, not {gain}"):
            imported(networks(), cloud_at(NEAR), gain=gain)
    score, tangent = map(perceptron, networks())
    for magnitude in (1e60, 1e200):
        huge = replace(score, weights=tuple(magnitude * weight for weight in score.weights))
        with pytest.raises(ConfigurationError, match="beyond what float64 can square"):
            import_field(huge, tangent, cloud_at(NEAR))


# Modules.


class Wrapped(nn.Module):
    """A module that holds its Sequential, and joins position and time in its own way."""

    def __init__(self, net, join=lambda x, t: torch.cat([x, t], dim=1)):
        super().__init__()
        self.net, self.join = net, join

    def forward(self, *arguments):
        return self.net(self.join(*arguments))


class Scaled(Wrapped):
    """Divides by a noise level, as score networks often do."""

    def forward(self, x, t):
        return super().forward(x, t) / 0.1


class Twice(Wrapped):
    """Numbers and shapes say nothing of the order in which a forward method calls."""

    def forward(self, xt):
        return self.net[2:](self.net[1](self.net[2:](self.net[:2](xt)).repeat(1, 2)))


class Residual(Wrapped):
    def forward(self, x):
        return x + self.net(x)


class Functional(nn.Module):
    """Its activation is no module."""

    def __init__(self):
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(3, 4), nn.Linear(4, 2)])

    def forward(self, x):
        return self.layers[1](torch.tanh(self.layers[0](x)))


def test_a_module_of_any_usual_form(make_sequential, largest_difference):
    score, tangent = make_sequential([3, 16, 16, 2]), make_sequential([2, 16, 2], seed=1)
    cloud = cloud_at(NEAR)
    shared = nn.SiLU()
    for form in (
        score,
        Wrapped(score),
        Wrapped(score, lambda xt: xt),
        Wrapped(score, lambda x, t: torch.cat([x, t[:, None]], dim=1)),
        Wrapped(score, lambda x, t: torch.cat([x, t.expand(len(x), 1)], dim=1)),
        Wrapped(score, lambda x, t: torch.cat([x, torch.full_like(x[:, :1], t)], dim=1)),
        # One activation for every layer, and layers that do nothing.
        nn.Sequential(score[0], shared, score[2], shared, score[4]),
        nn.Sequential(nn.Identity(), *score[:4], nn.Dropout(0.5), score[4]).eval(),
    ):
        field = GuidingField.from_torch(form, tangent, cloud)
        assert largest_difference(field, score, tangent) < 1e-12


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
def test_every_activation_in_any_precision(make_sequential, largest_difference, dtype):
    options = {"gain": 0.4, "normalise": True}
    for activation in ACTIVATIONS:
        score = make_sequential([3, 16, 16, 2], activation.name, dtype=dtype)
        tangent = make_sequential([2, 16, 2], "Tanh", seed=1, dtype=dtype)
        field = GuidingField.from_torch(score, tangent, cloud_at(NEAR), **options)
        assert field.provenance["import"]["score_activation"] == activation.name
        assert field.provenance["import"]["tangent_activation"] == "Tanh"
        # Where s and v nearly cancel, m is short of one long by 5e-13 / |s + v|^2.
        assert largest_difference(field, score, tangent, **options) < 1e-6


def test_the_modules_stay_as_they_are_and_the_field_keeps_nothing_of_them(make_sequential):
    score, tangent = make_sequential([3, 16, 2]), make_sequential([2, 2])
    before = copy.deepcopy(score.state_dict())
    score.train()
    random_state = torch.get_rng_state()
    field = GuidingField.from_torch(score, tangent, cloud_at(NEAR))
    assert score.training
    assert all(p.requires_grad and p.grad is None for p in score.parameters())
    assert torch.equal(torch.get_rng_state(), random_state)
    for key, tensor in score.state_dict().items():
        assert tensor.dtype == torch.float32
        assert torch.equal(tensor, before[key])
    values = field(field.cloud.points)
    with torch.no_grad():
        score[0].weight.zero_()
        score[2].bias.zero_()
    np.testing.assert_array_equal(field(field.cloud.points), values)


def refused():
    """Score modules that are no perceptron, each with what is said of it."""
    a, b, c, silu = nn.Linear(3, 4), nn.Linear(4, 4), nn.Linear(4, 2), nn.SiLU()
    nowhere = nn.Linear(3, 2)
    nn.init.constant_(nowhere.bias, torch.nan)
    stands = "stands where the next"
    for layers, match in (
        ((), "there is no layer"),
        ((a, nn.LayerNorm(4), c), r"layer '1' \(LayerNorm\): unknown act"),
        (
            (a, silu, nn.LayerNorm(4), c),
            rf"layer '2' \(LayerNorm\) {stands} Linear layer has to",
        ),
        ((a, nn.Mish(), c), r"layer '1' \(Mish\): unknown act"),
        ((a, b, silu, c), rf"layer '1' \(Linear\) {stands} activation has to be"),
        ((a, silu, nn.SiLU(), c), rf"layer '2' \(SiLU\) {stands} Linear"),
        ((nn.SiLU(), a, silu, c), r"layer '0' \(SiLU\) stands"),
        ((a, silu, c, nn.Tanh()), r"layer '3' \(Tanh\) comes after the last Linear layer"),
        ((a, silu, b, nn.Tanh(), c), "differ: SiLU, Tanh"),
        ((a, silu, nn.Dropout(0.1), c), r"'2' \(Dropout\) is in training; call eval\(\) first"),
        ((a, nn.Softplus(beta=2), c), r"'1' \(Softplus\) has beta=2, not 1"),
        ((a, nn.Softplus(threshold=3), c), "threshold=3, not 20"),
        ((a, nn.GELU("tanh"), c), "has approximate='tanh', not 'none'"),
        ((a, nn.ELU(alpha=2), c), "has alpha=2, not 1"),
        ((a, silu, nn.Linear(4, 2, bias=False)), r"2\.bias is missing"),
        # Numbers of layers that are nested start anew, so they have no order.
        ((nn.Sequential(a), nn.Sequential(silu, c)), "belongs to another network"),
        ((nn.Linear(2, 2),), "a score network .* not 2 and 2"),
        ((nowhere,), "0.bias is not all finite"),
    ):
        yield nn.Sequential(*layers), match
    yield "score.pth", "score network: a torch module is needed, not str"
    yield Functional(), rf"layer 'layers.1' \(Linear\) {stands} activation has to be"
    own = "does not compute what its layers alone do; pass their Sequential"
    yield Scaled(nn.Sequential(a, silu, c)), f"Scaled {own}"
    yield Twice(nn.Sequential(nn.Linear(3, 4), nn.SiLU(), nn.Linear(4, 2))), "Twice does not"


def test_modules_that_are_no_perceptron_are_refused(make_sequential):
    cloud = cloud_at(NEAR)
    for score, match in refused():
        with pytest.raises(ConfigurationError, match=match):
            GuidingField.from_torch(score, nn.Sequential(nn.Linear(2, 2)), cloud)
    residual = Residual(make_sequential([2, 4, 2]))
    with pytest.raises(ConfigurationError, match="tangent network: Residual does not compute"):
        GuidingField.from_torch(make_sequential([3, 4, 2]), residual, cloud)
    # It can be passed as its Sequential.
    found = perceptron_from_module(residual.net, "tangent")
    x = np.random.default_rng(0).uniform(-5, 5, (9, 2))
    with torch.no_grad():
        expected = residual.net.double()(torch.as_tensor(x)).numpy()
    np.testing.assert_allclose(found(x), expected, rtol=1e-12)
