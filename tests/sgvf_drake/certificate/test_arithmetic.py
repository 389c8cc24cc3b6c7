"""Bounds of a machine's errors against machines: float32 in several orders, double in balls."""

from dataclasses import replace
from itertools import product

from flint import arb
import numpy as np
import pytest

from sgvf_drake.certificate.arithmetic import (
    ARITHMETICS,
    ExportedField,
    Rounded,
    network_error,
)
from sgvf_drake.certificate.field_model import model_field
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import Perceptron, load_field
from sgvf_drake.fields.activation import ACTIVATIONS, find_activation
from tests.fields import COMPOSITIONS, random_field, random_perceptron

from .ball_fields import BallField
from .balls import vector

FLOAT, DOUBLE = ARITHMETICS["float"], ARITHMETICS["double"]
F = np.float32


def summed(products, order):
    """The sum along the last axis in float32, one after another in some order, or in pairs."""
    products = products[..., order] if order is not None else products
    total = np.zeros(products.shape[:-1], F)
    if order is None:
        while products.shape[-1] > 1:
            if products.shape[-1] % 2:
                products = np.concatenate([products, np.zeros_like(products[..., :1])], axis=-1)
            products = products[..., ::2] + products[..., 1::2]
        return products[..., 0]
    for column in np.moveaxis(products, -1, 0):
        total = total + column
    return total


def float_network(network, z, rng, *, pairs=False):
    """A network in float32, its sums in random orders, or in pairs."""

    def affine(h, weight, bias):
        products = h[:, None, :] * weight.astype(F)
        return summed(
            products, None if pairs else rng.permutation(weight.shape[1])
        ) + bias.astype(F)

    h = z.astype(F)
    if network.features is not None:
        angles = affine(h, network.features.frequencies, network.features.phases)
        h = np.concatenate([np.sin(angles), np.cos(angles)], axis=1)
    for weight, bias in zip(network.weights[:-1], network.biases[:-1], strict=True):
        h = network.activation.value(affine(h, weight, bias)).astype(F)
    return affine(h, network.weights[-1], network.biases[-1])


def float_field(field, x, rng, **how):
    """The field in float32 all along; x as well, (n, d)."""
    cloud = field.cloud
    z = (x.astype(F) - cloud.center.astype(F)) / F(cloud.unit_length)
    score = field.score_model.network.with_last_input(1.0)
    S = float_network(score, z, rng, **how) / F(field.score_model.scale)
    s, v = field._composed(z, S, float_network(field.tangent_network, z, rng, **how))
    assert s.dtype == v.dtype == F or field.rest is not None
    return s + v


def patches_of(field, half, count, seed=0):
    """Turned patches beside the path and over the box, and points in them by patch."""
    rng, d = np.random.default_rng(seed), field.dim
    path = field.cloud.normalize(field.cloud.points)
    centers = path[rng.integers(len(path), size=count)] + field.sigma * rng.uniform(
        -1, 1, (count, d)
    )
    centers[::2] = rng.uniform(-5, 5, (len(centers[::2]), d))
    axes = half * rng.uniform(-1, 1, (count, d, d))
    u = rng.uniform(-1, 1, (40, count, d))
    u[:20] = np.sign(u[:20])
    return Patches(centers, axes), centers + np.einsum("ndk,rnk->rnd", axes, u)


def check_bounds(field, half, count=60):
    """No error in float32 is beyond its bound; returns the largest part that one needs."""
    patches, points = patches_of(field, half, count)
    bound = ExportedField(field, FLOAT).error(patches)
    rng, worst = np.random.default_rng(1), 0.0
    for number, z in enumerate(points):
        x = field.cloud.denormalize(z)
        found = float_field(field, x, rng, pairs=number % 3 == 0)
        error = np.linalg.norm(found.astype(float) - field(x), axis=1)
        assert (error <= bound).all()
        worst = max(worst, float((error / bound).max()))
    return worst


@pytest.mark.parametrize("composition", COMPOSITIONS.values(), ids=COMPOSITIONS)
@pytest.mark.parametrize("dim", [2, 3])
def test_float_is_within_its_bound_whatever_the_composition(composition, dim):
    for recipe in ("robust", "paper"):
        field = replace(random_field(recipe, dim=dim), composition=composition)
        for half in (1e-4, 0.05):
            assert check_bounds(field, half, count=16) > 1e-5


def test_float_is_within_its_bound_where_paths_end():
    for half in (1e-4, 0.05):
        check_bounds(random_field("robust", ends=2), half, count=20)


@pytest.mark.parametrize("activation", ACTIVATIONS, ids=lambda one: one.name)
def test_float_is_within_its_bound_whatever_the_activation(activation):
    network = replace(
        random_perceptron(np.random.default_rng(3), 2, (12, 12), 2), activation=activation
    )
    rng = np.random.default_rng(4)
    patches = Patches(rng.uniform(-4, 4, (50, 2)), rng.uniform(-0.1, 0.1, (50, 2, 2)))
    bound = network_error(network, patches, np.zeros((50, 2)), FLOAT)
    for _ in range(30):
        z = patches.centers + np.einsum("nij,nj->ni", patches.axes, rng.uniform(-1, 1, (50, 2)))
        # Numbers of float32, so that there is no error before the network.
        z = z.astype(F).astype(float)
        error = np.abs(float_network(network, z, rng) - network(z))
        assert (error <= bound).all()


def test_trained_fields_and_how_tight_the_bounds_are():
    for name in ("robust", "paper"):
        field = load_field(f"tests/data/fields/{name}.safetensors")
        # Roundings are worst cases: of thousands that fall either way the bounds are 100 times.
        assert check_bounds(field, 1e-3, count=40) > 1 / 1000
        bound = ExportedField(field, FLOAT).error(patches_of(field, 1e-3, 40)[0])
        assert bound.max() < 0.02


def test_a_steep_network_in_balls():
    """One that is made to round badly, in float32, against exact numbers of double."""
    big = 1e4 * np.array([[1.0, -1.0], [1.0, -1.0 + 1e-7]])
    network = Perceptron((big, np.array([[1.0, -1.0], [1.0, 1.0]])), (np.zeros(2), np.zeros(2)))
    z = np.array([[0.3, 0.3], [1.1, 1.1000001]])
    patches = Patches.points(z)
    bound = network_error(network, patches, np.abs(z) * 2.0**-24, FLOAT)
    error = np.abs(float_network(network, z, np.random.default_rng(0)) - network(z))
    assert (error <= bound).all()
    assert (error > bound / 100).any()


def test_roundings_that_all_fall_one_way_are_within_the_bound():
    """A thousand tenths, one added after another: in float32 they are a thousandth too few."""
    hidden = Perceptron(
        (np.zeros((1000, 2)), np.full((1, 1000), np.float64(F(0.1)))),
        (np.ones(1000), np.zeros(1)),
        activation=find_activation("ReLU"),
    )
    z = np.zeros((1, 2))
    error = np.abs(float_network(hidden, z, np.random.default_rng(0)) - hidden(z))
    bound = network_error(hidden, Patches.points(z), z, FLOAT)
    assert 9e-4 < error[0, 0] < bound[0, 0]


def test_an_error_is_carried_by_the_steepest_slope_on_the_patch():
    """At the middle of the patch tanh is flat, at its end it is not."""
    unit = Perceptron(
        (np.array([[1.0, 0.0]]), np.ones((1, 1))),
        (np.zeros(1), np.zeros(1)),
        activation=find_activation("Tanh"),
    )
    off = np.array([[1e-3, 0.0]])
    patches = Patches(np.array([[4.0, 0.0]]), np.diag([4.0, 0.0])[None])
    bound = network_error(unit, patches, off, DOUBLE)
    assert bound >= np.tanh(1e-3)


def test_what_is_made_of_numbers_that_are_off_is_within_its_error():
    """Whichever way they are off: sums, differences, products and their sums."""
    rng = np.random.default_rng(6)
    values, errors = rng.uniform(-2, 2, (2, 30, 3)), rng.uniform(0, 1, (2, 30, 3))
    a, b = (
        Rounded(TaylorModel.position(Patches.points(value)), error, DOUBLE)
        for value, error in zip(values, errors, strict=True)
    )
    for name, found, exact in (
        ("sum", a + b, np.add),
        ("difference", a - b, np.subtract),
        ("product", a * b, np.multiply),
        ("dot", a.dot(b), lambda x, y: (x * y).sum(axis=1, keepdims=True)),
    ):
        for one, other in product((-1, 0, 1), repeat=2):
            signs = np.array([one, other])[:, None, None]
            off = exact(*(values + signs * errors)) - exact(*values)
            assert (np.abs(off) <= found.error).all(), name


@pytest.mark.parametrize("ends", [0, 2])
def test_double_is_within_its_bound_of_the_exact_field(ends):
    """NumPy's own double, against the field in balls of 256 bits."""
    field = random_field("robust", ends=ends)
    exact, rng = BallField(field), np.random.default_rng(2)
    # Numbers of 20 bits, whose way into the unit of the waypoints and back is exact but for
    # what the bound counts.
    z = np.round(rng.uniform(-4, 4, (20, 2)) * 2.0**17) / 2.0**17
    bound = ExportedField(field, DOUBLE).error(Patches.points(z))
    found = field(field.cloud.denormalize(z))
    parts = []
    for row, value in enumerate(found):
        m = exact(vector(z[row])).m
        off = sum((arb(float(a)) - b) ** 2 for a, b in zip(value, m, strict=True)).sqrt()
        assert off < bound[row]
        parts.append(float(off) / bound[row])
    assert max(parts) > 1e-4


def test_the_bounds_of_less_rounding_are_less():
    field = load_field("tests/data/fields/robust.safetensors")
    patches, points = patches_of(field, 1e-3, 20)
    double, single = (ExportedField(field, one).error(patches) for one in (DOUBLE, FLOAT))
    assert (double < 1e-8 * single).all()
    # Double in another order: on reversed units.
    order = np.arange(64)[::-1]
    weights, biases = field.tangent_network.weights, field.tangent_network.biases
    turned = replace(
        field.tangent_network,
        weights=(weights[0][order], weights[1][:, order], *weights[2:]),
        biases=(biases[0][order], *biases[1:]),
    )
    other = replace(field, tangent_network=turned)
    for z in points:
        x = field.cloud.denormalize(z)
        error = np.linalg.norm(other(x) - field(x), axis=1)
        assert (error <= 2 * double).all()
    assert error.max() > 0


def test_what_is_far_from_the_origin_loses_its_position():
    """A field whose waypoints are far away and a few metres wide: as those of a map."""
    near = random_field("robust")
    patches, _ = patches_of(near, 1e-3, 30)
    assert ExportedField(near, FLOAT).error(patches).max() < 1e-3
    for away, least in ((2e3, 1e-3), (5e5, 0.5)):
        far = replace(near, cloud=PointCloud(near.cloud.points + away))
        assert np.median(ExportedField(far, FLOAT).error(patches)) > least
        assert ExportedField(far, DOUBLE).error(patches).max() < 1e-6
        if away < 1e4:
            assert check_bounds(far, 1e-3) > 0.01


def test_the_model_of_a_perturbed_field_is_wider_by_its_error():
    field = random_field("robust")
    patches, _ = patches_of(field, 1e-3, 10)
    exported = ExportedField(field, FLOAT)
    wider, exact = model_field(exported, patches), model_field(field, patches)
    np.testing.assert_array_equal(wider.parts, exact.parts)
    added = wider.remainder - exact.remainder
    assert (added >= exported.error(patches)[:, None]).all()
    assert exported.largest >= exported.error(patches).max()


def test_kinds_that_nothing_bounds_are_told():
    exact = load_field("tests/data/fields/exact.safetensors")
    with pytest.raises(ConfigurationError, match="closed-form score"):
        ExportedField(exact, FLOAT)
