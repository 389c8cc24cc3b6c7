"""Networks, mixtures and whole fields over patches, point by point in ball arithmetic."""

from dataclasses import replace

from flint import arb
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.field_model import dual_field, model_field
from sgvf_drake.certificate.mixture_model import Components, MixtureModel
from sgvf_drake.certificate.network_model import model_network
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GaussianMixture, NormalisedComposition, StrandMixture
from sgvf_drake.fields.activation import ACTIVATIONS, find_activation
from tests.fields import random_directed_field as field_of

from .ball_fields import BallField, BallNetwork
from .balls import (
    assert_inside,
    corners,
    dot,
    mixture_at,
    point_of,
    random_patch,
    strands_at,
    vector,
)

seeds = st.integers(0, 2**32 - 1)
halves = st.integers(-20, 1).map(lambda exponent: 2.0**exponent)
# Dimensions of space, and numbers of parameters.
shapes = st.sampled_from([(2, 1), (2, 2), (3, 1), (3, 2), (3, 3)])


def steps(rng, patch, count=3):
    """The centre, some of the corners and sides, and parameters at random."""
    k = patch.axes.shape[2]
    extreme = rng.permutation(corners(k))[:5]
    return np.concatenate([np.zeros((1, k)), extreme, rng.uniform(-1, 1, (count, k))])


@pytest.mark.parametrize("activation", [activation.name for activation in ACTIVATIONS])
@settings(max_examples=25)
@given(seed=seeds, half=halves, scale=st.sampled_from([0.01, 1.0, 10.0]), shape=shapes)
def test_a_network_is_inside_of_its_model(
    make_perceptron, activation, seed, half, scale, shape
):
    """Of a network of the position and of two numbers that are held."""
    rng, (dim, k) = np.random.default_rng(seed), shape
    hidden = [(), (7,), (6, 5), (5, 6, 4)][rng.integers(4)]
    network = make_perceptron(rng, dim + 2, hidden, 2, num_frequencies=int(rng.integers(2)) * 4)
    network = replace(
        network,
        weights=tuple(scale * weight for weight in network.weights),
        activation=find_activation(activation),
    )
    patch, held = random_patch(rng, half, dim, k), rng.uniform(-1, 1, 2)
    model, balls = model_network(network, patch, held), BallNetwork(network, dim)
    for u in steps(rng, patch):
        found = balls([*point_of(patch, u), *vector(held)])
        assert_inside(model, u, [row[0] for row in found])


@settings(max_examples=60)
@given(seed=seeds, half=halves, sigma=st.sampled_from([0.05, 0.3, 2.0]), shape=shapes)
def test_a_mixture_is_inside_of_its_models(seed, half, sigma, shape):
    rng, (dim, k) = np.random.default_rng(seed), shape
    points = rng.uniform(-3, 3, (int(rng.integers(1, 9)), dim))
    model = MixtureModel(GaussianMixture(points, sigma))
    patch = random_patch(rng, half, dim, k)
    # A cube holds what is turned in it.
    cube = Boxes(patch.centers, np.abs(patch.axes).sum(axis=(1, 2)) * (1 + 1e-9))
    low, high = model.level_range(cube)
    with np.errstate(over="ignore", invalid="ignore"):
        gradient = model.gradient(patch)
        level = model.level(patch, gradient)
    for u in steps(rng, patch):
        value, slope = mixture_at(model.mixture, point_of(patch, u))
        assert arb(float(low[0])) <= value
        assert value <= arb(float(high[0]))
        # On squares that are too large to say anything, the models say so.
        if np.isfinite(gradient.remainder).all():
            assert_inside(gradient, u, slope)
            assert_inside(level, u, [value])


@pytest.mark.parametrize("dim", [2, 3])
def test_strands_across_the_intended_direction_are_inside_of_their_models(dim):
    """There tanh(kappa T.g) is nothing but the rounding of T.g."""
    rng = np.random.default_rng(6)
    T, across = np.linalg.qr(rng.standard_normal((dim, dim)))[0].T[:2]
    g = across + 1e-16 * T
    directions = np.where(rng.integers(2, size=(20, 1)), T, -T)
    points = rng.uniform(-1, 1, (20, dim))
    strands = StrandMixture(points, directions, np.zeros(20, bool), 0.4)
    assert 0 < abs(T @ g) < 1e-15
    patch = random_patch(rng, 2.0**-20, dim, 2, spread=1.0)
    model = Components.heading(strands, g).model(patch)
    for u in steps(rng, patch):
        S, N = strands_at(strands, point_of(patch, u), vector(g))
        assert_inside(model, u, [*S, *N])


def slopes_at(mixture, z):
    """dS_m / dz_k of a mixture as balls, by k and m."""
    variance = arb(mixture.sigma) ** 2
    offsets = [[a - b for a, b in zip(vector(x), z, strict=True)] for x in mixture.points]
    weights = [(-dot(y, y) / (2 * variance)).exp() for y in offsets]
    total = sum(weights, arb(0))
    dim = len(z)
    means = [dot(weights, [y[k] for y in offsets]) / total for k in range(dim)]

    def covariance(k, m):
        products = [(y[k] - means[k]) * (y[m] - means[m]) for y in offsets]
        return dot(weights, products) / total

    return [
        [covariance(k, m) / variance**2 - (k == m) / variance for m in range(dim)]
        for k in range(dim)
    ]


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    half=st.integers(-45, 0).map(lambda exponent: 2.0**exponent),
    sigma=st.sampled_from([0.05, 0.3, 2.0]),
    shape=shapes,
)
def test_derivatives_of_a_mixture_are_inside_of_their_models(seed, half, sigma, shape):
    rng, (dim, k) = np.random.default_rng(seed), shape
    mixture = GaussianMixture(
        rng.uniform(-3, 3, (int(rng.choice([1, 2, 2, 3, 5, 8])), dim)), sigma
    )
    patch = random_patch(rng, half, dim, k)
    if len(mixture.points) == 2:
        # About as far from one as from the other, where weights change most and are off most.
        first, last = mixture.points
        apart = last - first
        across = rng.standard_normal(dim)
        across -= apart * (across @ apart) / (apart @ apart)
        center = (first + last) / 2 + rng.uniform(-9, 9) * across
        center += rng.uniform(-3, 3) * sigma**2 * apart / (apart**2).sum()
        patch = replace(patch, centers=center[None])
    with np.errstate(over="ignore", invalid="ignore"):
        models = Components.of(mixture).dual(patch)
    for u in steps(rng, patch):
        slopes = slopes_at(mixture, point_of(patch, u))
        for axis, model in enumerate(models.slopes):
            # On patches that are too large to say anything, the models say so.
            if np.isfinite(model.remainder).all():
                assert_inside(model, u, slopes[axis])


def test_waypoints_that_count_for_nothing_are_left_out_safely():
    """Of a thousand, most are too far away; the sum of all is in balls."""
    rng = np.random.default_rng(5)
    mixture = GaussianMixture(rng.uniform(-4, 4, (1000, 2)), 0.3)
    patch = random_patch(rng, 0.02, 2, 2, spread=2.0)
    model = Components.of(mixture).model(patch)
    for u in steps(rng, patch, count=1):
        _, gradient = mixture_at(mixture, point_of(patch, u))
        assert_inside(model, u, [-entry for entry in gradient])


def test_what_is_left_falls_with_the_cube_of_the_square():
    rng = np.random.default_rng(1)
    mixture = GaussianMixture(rng.uniform(-3, 3, (40, 2)), 0.3)
    centers = rng.uniform(-3, 3, (50, 2))
    remainders = [
        np.median([slope.remainder for slope in Components.of(mixture).dual(patches).slopes])
        for patches in (Boxes(centers, np.full(50, 2.0**-n)).patches for n in (10, 11))
    ]
    assert remainders[0] / remainders[1] == pytest.approx(8, rel=0.1)


@pytest.mark.parametrize("recipe", ["robust", "exact", "paper"])
@settings(max_examples=25)
@given(seed=seeds, exponent=st.integers(-16, -3), normalises=st.booleans(), shape=shapes)
def test_a_field_is_inside_of_its_model(make_field, recipe, seed, exponent, normalises, shape):
    rng, (dim, k) = np.random.default_rng(seed), shape
    ends = int(rng.integers(3))
    field = make_field(recipe, dim=dim, seed=int(rng.integers(1000)), ends=ends)
    if normalises and recipe == "paper":
        field = replace(field, composition=NormalisedComposition(field.composition.gain))
    patch = random_patch(rng, 2.0**exponent, dim, k)
    if ends:
        # Where it comes to rest.
        end = field.cloud.normalize(field.ends[:1]) + 0.5 * rng.standard_normal((1, dim))
        patch = replace(patch, centers=end)
    with np.errstate(over="ignore", invalid="ignore"):
        model = model_field(field, patch)
    # On patches that are too large to say anything, the model says so.
    assume(np.isfinite(model.remainder).all())
    for u in steps(rng, patch, count=1):
        assert_inside(model, u, BallField(field)(point_of(patch, u)).m)


def test_bounds_become_tight_as_squares_become_small(make_field):
    rng = np.random.default_rng(1)
    field = make_field("robust")
    centers = rng.uniform(-4, 4, (50, 2))
    over = []
    for half in (2.0**-7, 2.0**-9):
        model = model_field(field, Boxes(centers, np.full(50, half)).patches)
        x = centers[:, None] + half * rng.uniform(-1, 1, (50, 400, 2))
        m = field(field.cloud.denormalize(x.reshape(-1, 2))).reshape(50, 400, 2)
        over.append(np.median((model.upper - model.lower) / np.ptp(m, axis=1)))
    assert over[1] < over[0]
    assert over[1] < 1.1


def test_a_segment_is_a_square_that_has_shrunk_to_it(make_field):
    """The other axis is zero, or left out."""
    field, rng = make_field("robust", ends=1), np.random.default_rng(2)
    segments = Patches(rng.uniform(-4, 4, (50, 2)), 0.01 * rng.standard_normal((50, 2, 1)))
    nothing = np.zeros((50, 2, 1))
    squares = replace(segments, axes=np.concatenate([segments.axes, nothing], axis=2))
    for bound in (model_field, lambda *of: dual_field(*of).divergence):
        narrow, wide = bound(field, segments), bound(field, squares)
        for a, b in ((narrow.lower, wide.lower), (narrow.upper, wide.upper)):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(narrow.slopes, wide.slopes[:, :1], rtol=1e-9, atol=1e-13)


def test_a_turned_square_has_the_bounds_of_its_turned_field(make_field):
    """The parameters do not know the axes of space: |m| is bounded as well in any of them."""
    field, rng = make_field("exact"), np.random.default_rng(3)
    centers = rng.uniform(-4, 4, (20, 2))
    squares, turn = Boxes(centers, np.full(20, 2.0**-6)).patches, np.array([[0, -1.0], [1, 0]])
    turned = replace(squares, axes=squares.axes @ turn)
    a, b = model_field(field, squares), model_field(field, turned)
    np.testing.assert_allclose(a.upper, b.upper, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(a.lower, b.lower, rtol=1e-9, atol=1e-12)


def test_what_is_no_field_of_the_position_alone_is_not_bounded():
    directed = field_of("two-way", 2)
    for field in (directed, directed.heading(np.ones((3, 2)))):
        with pytest.raises(ConfigurationError, match="at one intended direction"):
            model_field(field, Boxes.square(0.5).patches)
