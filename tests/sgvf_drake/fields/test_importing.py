from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from sgvf_drake import ConfigurationError, PointCloud, load_field
from sgvf_drake.fields import (
    NormalisedComposition,
    PaperComposition,
    Perceptron,
    ScoreNetwork,
    find_activation,
    import_field,
)
from sgvf_drake.fields.activation import ACTIVATIONS, SILU
from sgvf_drake.fields.importing import measured_sigma, perceptron_from_arrays

# Not at the origin, and not in the normalised unit; then in millimetres, far off.
NEAR, FAR = ((0.4, -0.3), 1.7), ((-3e4, 2e4), 1000.0)
ACTIVATION = pytest.mark.parametrize("name", [activation.name for activation in ACTIVATIONS])


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
        torch.nn.init.constant_(tangent[-1].bias, 1.0)
        return score, tangent

    return make


def imported(networks, cloud, name="SiLU", **options):
    score, tangent = (perceptron(network, name) for network in networks)
    return import_field(score, tangent, cloud, **options)


@ACTIVATION
@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("place", [NEAR, FAR], ids=["near", "far"])
def test_it_is_the_papers_field_of_the_networks(
    networks, largest_difference, name, normalise, place
):
    pair = networks(name)
    options = {"gain": 0.35, "normalise": normalise}
    field = imported(pair, cloud_at(place), name, **options)
    # With Softplus, torch leaves out log(1 + e^-20) = 2e-9 a neuron.
    tolerance = 1e-6 if name == "Softplus" else 1e-9
    assert largest_difference(field, *pair, **options) < tolerance


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32, torch.float16, torch.bfloat16])
def test_weights_of_any_precision_are_taken_as_they_are(networks, largest_difference, dtype):
    pair = networks(dtype=dtype)
    assert largest_difference(imported(pair, cloud_at(NEAR)), *pair) < 1e-12


def test_weights_of_numpy_are_those_of_torch(networks):
    score, _ = networks()
    arrays = {key: value.numpy() for key, value in score.state_dict().items()}
    z = np.random.default_rng(0).uniform(-5, 5, (20, 3))
    found, expected = perceptron_from_arrays(arrays, SILU), perceptron(score)(z)
    np.testing.assert_array_equal(found(z), expected)
    # It keeps none of the memory of what it was made from.
    for array in arrays.values():
        array[...] = 0
    np.testing.assert_array_equal(found(z), expected)


@pytest.mark.parametrize("dim", [2, 3])
def test_score_and_tangent_are_the_outputs_of_the_networks(networks, dim):
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


@ACTIVATION
@pytest.mark.parametrize("normalise", [False, True])
def test_derivatives_are_those_of_torch(networks, field_in_torch, name, normalise):
    pair = networks(name)
    field = imported(pair, cloud_at(NEAR), name, normalise=normalise)
    formula = field_in_torch(*pair, normalise=normalise)
    x = np.random.default_rng(0).uniform(*field.cloud.box, (8, 2))
    tolerance = {"rtol": 1e-6, "atol": 1e-6} if name == "Softplus" else {"rtol": 1e-9}
    tolerance = {"atol": 1e-10, **tolerance}
    _, J = field.value_and_jacobian(x)
    H = field.hessian(x)
    for n, point in enumerate(torch.as_tensor(x)):
        expected = torch.autograd.functional.jacobian(formula, point)
        np.testing.assert_allclose(J[n], expected, **tolerance)
        for i in range(2):
            expected = torch.autograd.functional.hessian(lambda y, i=i: formula(y)[i], point)
            np.testing.assert_allclose(H[n, i], expected, **tolerance)


def test_another_unit_of_length_is_the_same_field(networks):
    """In millimetres, a score is a thousandth as large, and its k_s a thousandfold."""
    score, tangent = (perceptron(network) for network in networks())
    field = import_field(score, tangent, cloud_at(NEAR), gain=0.3)

    def in_millimetres(network, output_factor):
        first = network.weights[0] * np.append(
            np.full(2, 1e-3), np.ones(network.num_inputs - 2)
        )
        last = [array[-1] * output_factor for array in (network.weights, network.biases)]
        return replace(
            network,
            weights=(first, *network.weights[1:-1], last[0]),
            biases=(*network.biases[:-1], last[1]),
        )

    millimetres = import_field(
        in_millimetres(score, 1e-3),
        in_millimetres(tangent, 1),
        PointCloud(1e3 * field.cloud.points),
        gain=300,
    )
    x = np.random.default_rng(0).uniform(*field.cloud.box, (50, 2))
    np.testing.assert_allclose(millimetres(1e3 * x), field(x), rtol=1e-10)
    np.testing.assert_allclose(field.rescaled(1e3)(1e3 * x), field(x), rtol=1e-10)
    assert millimetres.sigma == pytest.approx(field.sigma, rel=1e-10)
    assert millimetres.approach_length == pytest.approx(1e3 * field.approach_length)


def test_the_field_tells_where_it_comes_from(networks):
    files = {"score": "a.pth", "tangent": "b.pth"}
    pair = networks("Tanh")
    field = imported(pair, cloud_at(NEAR), "Tanh", gain=0.3, normalise=True, files=files)
    assert (field.recipe, field.seed) == ("imported", 0)
    assert field.provenance == {
        "import": {
            "files": files,
            "score_activation": "Tanh",
            "tangent_activation": "Tanh",
            "gain": 0.3,
            "normalised": True,
        }
    }
    assert field.composition == NormalisedComposition(0.3 / field.cloud.unit_length)
    plain = imported(pair, cloud_at(NEAR), "Tanh")
    assert plain.composition == PaperComposition(0.2 / plain.cloud.unit_length)


@ACTIVATION
def test_saved_and_loaded_it_is_the_same_to_the_bit(networks, tmp_path, name):
    field = imported(networks(name), cloud_at(FAR), name, normalise=True)
    field.save(tmp_path / "field")
    loaded = load_field(tmp_path / "field")
    x = np.random.default_rng(0).uniform(*field.cloud.box, (50, 2))
    np.testing.assert_array_equal(loaded(x), field(x))
    np.testing.assert_array_equal(loaded.hessian(x), field.hessian(x))
    assert loaded.provenance == field.provenance
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "field").read_bytes()


# The noise level.


def linear_score(slopes):
    """S = diag(slopes) x."""
    weight = np.column_stack([np.diag(slopes), np.zeros(len(slopes))])
    return ScoreNetwork(Perceptron((weight,), (np.zeros(len(slopes)),)), 1.0)


@pytest.mark.parametrize(
    ("slopes", "sigma"),
    [
        # The steepest descent counts: across the path.
        ((-4.0, -1.6), 0.5),
        ((-4.0, 7.0), 0.5),
        ((2.0, 0.0), 0.1),
        # Beyond the range of noise levels that the rest of the library can follow.
        ((-1e6, 0.0), 0.02),
        ((-1e-3, 0.0), 1.0),
    ],
)
def test_the_noise_level_of_a_score_that_falls(slopes, sigma):
    z = np.random.default_rng(0).uniform(-4, 4, (9, 2))
    assert measured_sigma(linear_score(slopes), z) == pytest.approx(sigma, rel=1e-12)


def test_the_noise_level_is_the_median_of_the_waypoints_where_the_score_falls():
    """S = -25 tanh(x) in either coordinate falls by 25 / cosh^2, so sigma is cosh / 5."""
    network = Perceptron(
        (np.eye(2, 3), -np.eye(2)), (np.zeros(2), np.zeros(2)), None, find_activation("Tanh")
    )
    z = np.array([[0.0, 0.0], [0.3, 0.3], [0.5, 0.5]])
    model = ScoreNetwork(network, 0.04)
    assert measured_sigma(model, z) == pytest.approx(0.2 * np.cosh(0.3), rel=1e-12)


def test_the_noise_level_of_a_trained_score(ring_networks):
    score, tangent = ring_networks
    angle = 2 * np.pi * np.arange(50) / 50
    cloud = PointCloud(3 * np.column_stack([np.cos(angle), np.sin(angle)]))
    field = import_field(perceptron(score, "Tanh"), perceptron(tangent), cloud)
    assert field.sigma * cloud.unit_length == pytest.approx(0.3, rel=1e-4)


# What is refused.


def arrays_of(widths, prefix="net."):
    rng = np.random.default_rng(0)
    arrays = {}
    for layer, (inputs, outputs) in enumerate(pairwise(widths)):
        arrays[f"{prefix}{2 * layer}.weight"] = rng.standard_normal((outputs, inputs))
        arrays[f"{prefix}{2 * layer}.bias"] = rng.standard_normal(outputs)
    return arrays


def test_layers_come_in_the_order_of_their_numbers():
    widths = [3, *range(4, 11), 2]
    arrays = arrays_of(widths)
    backward = dict(reversed(arrays.items()))
    # The last is number 14, which is before 2 in the order of the alphabet.
    assert sorted(arrays)[2] == "net.10.bias"
    found = perceptron_from_arrays(backward, SILU)
    assert [len(bias) for bias in found.biases] == widths[1:]


@pytest.mark.parametrize("prefix", ["", "net.", "module.net.", "fc", "block2.layers."])
def test_any_common_prefix_will_do(prefix):
    z = np.random.default_rng(0).uniform(-5, 5, (20, 3))
    expected = perceptron_from_arrays(arrays_of([3, 5, 2]), SILU)(z)
    found = perceptron_from_arrays(arrays_of([3, 5, 2], prefix), SILU)
    np.testing.assert_array_equal(found(z), expected)


BAD_ARRAYS = {
    "nothing": (lambda a: a.clear(), "there is no layer"),
    "no bias": (lambda a: a.pop("net.2.bias"), "net.2.bias is missing"),
    "no weight": (lambda a: a.pop("net.2.weight"), "net.2.weight is missing"),
    "extra": (
        lambda a: a.update({"net.1.scale": np.ones(2)}),
        "'net.1.scale' is not the weight",
    ),
    "no name": (lambda a: a.update({7: np.ones(2)}), "7 is not the weight"),
    "no number": (lambda a: a.update({"out.weight": np.ones((2, 2))}), "'out.weight' is not"),
    "two networks": (
        lambda a: a.update(arrays_of([2, 2], "other.")),
        "other.0.weight belongs to another network",
    ),
    "norm": (
        lambda a: a.update({"net.1.weight": np.ones(5), "net.1.bias": np.ones(5)}),
        "net.1",
    ),
    "flat bias": (
        lambda a: a.update({"net.2.bias": np.ones((2, 1))}),
        r"net.2.bias is of shape \(2, 1\), but net.2.weight \(2, 5\)",
    ),
    "widths": (
        lambda a: a.update({"net.2.weight": np.ones((2, 4))}),
        r"net.2.weight is of shape \(2, 4\), but net.0.weight \(5, 3\)",
    ),
    "NaN": (lambda a: np.put(a["net.2.bias"], 1, np.nan), "net.2.bias is not all finite"),
    "infinity": (lambda a: np.put(a["net.0.weight"], 1, np.inf), "net.0.weight is not all"),
    "integers": (
        lambda a: a.update({"net.0.bias": np.ones(5, int)}),
        "net.0.bias is not a plain",
    ),
    "integer tensor": (
        lambda a: a.update({"net.0.bias": torch.ones(5, dtype=torch.int64)}),
        "net.0.bias is not a plain",
    ),
    "complex": (lambda a: a.update({"net.0.bias": torch.ones(5) * 1j}), "net.0.bias is not a"),
    "sparse": (
        lambda a: a.update({"net.0.weight": torch.eye(5, 3).to_sparse()}),
        "net.0.weight is not a plain",
    ),
    "no data": (
        lambda a: a.update({"net.0.bias": torch.ones(5, device="meta")}),
        "net.0.bias is not a plain",
    ),
    "a list": (lambda a: a.update({"net.0.bias": [[1.0], 2]}), "net.0.bias is not a plain"),
    "text": (lambda a: a.update({"net.0.bias": "ones"}), "net.0.bias is not a plain"),
}


@pytest.mark.parametrize(("spoil", "match"), BAD_ARRAYS.values(), ids=BAD_ARRAYS)
def test_arrays_that_are_no_perceptron_are_refused(spoil, match):
    arrays = arrays_of([3, 5, 2])
    spoil(arrays)
    with pytest.raises(ConfigurationError, match=match):
        perceptron_from_arrays(arrays, SILU)


@pytest.mark.parametrize(
    ("score", "tangent", "dim", "match"),
    [
        ([2, 4, 2], [2, 4, 2], 2, r"a score network has d \+ 1 inputs .* not 2 and 2"),
        ([3, 4, 3], [2, 4, 2], 2, "a score network .* not 3 and 3"),
        ([3, 4, 2], [3, 4, 2], 2, "a tangent network has d inputs .* not 3 and 2"),
        ([4, 4, 3], [2, 4, 2], 2, "tangent network is of 2 dimensions, the score network of 3"),
        ([3, 4, 2], [2, 4, 2], 3, "the score network of 2, and the waypoints of 3"),
    ],
)
def test_parts_that_do_not_fit_are_refused(make_sequential, score, tangent, dim, match):
    pair = make_sequential(score), make_sequential(tangent)
    with pytest.raises(ConfigurationError, match=match):
        imported(pair, cloud_at(NEAR, dim))


@pytest.mark.parametrize("gain", [0.0, -0.2, np.nan, np.inf])
def test_k_s_is_a_positive_number(networks, gain):
    with pytest.raises(ConfigurationError, match=f"k_s must be a positive number, not {gain}"):
        imported(networks(), cloud_at(NEAR), gain=gain)


@pytest.mark.parametrize("magnitude", [1e60, 1e200])
def test_a_score_beyond_all_measure_is_refused(networks, magnitude):
    score, tangent = (perceptron(network) for network in networks())
    huge = replace(score, weights=tuple(magnitude * weight for weight in score.weights))
    with pytest.raises(ConfigurationError, match="beyond what float64 can square"):
        import_field(huge, tangent, cloud_at(NEAR))
