"""Networks, mixtures and whole fields over squares, point by point in ball arithmetic."""

from dataclasses import replace

from flint import arb
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.field_model import model_field
from sgvf_drake.certificate.mixture_model import MixtureModel, dual_mixture
from sgvf_drake.certificate.network_model import model_network
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GaussianMixture, NormalisedComposition
from sgvf_drake.fields.activation import ACTIVATIONS, find_activation

from .ball_fields import BallField, BallNetwork
from .balls import assert_inside, dot, mixture_at, point_of, vector

seeds = st.integers(0, 2**32 - 1)
halves = st.integers(-20, 1).map(lambda exponent: 2.0**exponent)
CORNERS = np.array([[-1.0, -1.0], [1.0, 1.0], [1.0, -1.0], [0.0, 1.0], [0.0, 0.0]])


def steps(rng, half, count=3):
    return half * np.concatenate([CORNERS, rng.uniform(-1, 1, (count, 2))])


def one_box(rng, half, spread=4.0):
    return Boxes(rng.uniform(-spread, spread, (1, 2)), np.array([half]))


@pytest.mark.parametrize("activation", [activation.name for activation in ACTIVATIONS])
@settings(max_examples=25)
@given(seed=seeds, half=halves, scale=st.sampled_from([0.01, 1.0, 10.0]))
def test_a_network_is_inside_of_its_model(make_perceptron, activation, seed, half, scale):
    rng = np.random.default_rng(seed)
    hidden = [(), (7,), (6, 5), (5, 6, 4)][rng.integers(4)]
    network = make_perceptron(rng, 2, hidden, 2, num_frequencies=int(rng.integers(2)) * 4)
    network = replace(
        network,
        weights=tuple(scale * weight for weight in network.weights),
        activation=find_activation(activation),
    )
    boxes = one_box(rng, half)
    model = model_network(network, boxes)
    for d in steps(rng, half):
        assert_inside(model, d, [row[0] for row in BallNetwork(network)(point_of(boxes, d))])


@settings(max_examples=60)
@given(seed=seeds, half=halves, sigma=st.sampled_from([0.05, 0.3, 2.0]))
def test_a_mixture_is_inside_of_its_models(seed, half, sigma):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-3, 3, (int(rng.integers(1, 9)), 2))
    model = MixtureModel(GaussianMixture(points, sigma))
    boxes = one_box(rng, half)
    low, high = model.level_range(boxes)
    with np.errstate(over="ignore", invalid="ignore"):
        gradient = model.gradient(boxes)
        level = model.level(boxes, gradient)
    for d in steps(rng, half):
        value, slope = mixture_at(model.mixture, point_of(boxes, d))
        assert arb(float(low[0])) <= value
        assert value <= arb(float(high[0]))
        # On squares that are too large to say anything, the models say so.
        if np.isfinite(gradient.remainder).all():
            assert_inside(gradient, d, slope)
            assert_inside(level, d, [value])


def slopes_at(mixture, z):
    """dS_m / dz_k of a mixture as balls, by k and m."""
    variance = arb(mixture.sigma) ** 2
    offsets = [[a - b for a, b in zip(vector(x), z, strict=True)] for x in mixture.points]
    weights = [(-dot(y, y) / (2 * variance)).exp() for y in offsets]
    total = sum(weights, arb(0))
    means = [dot(weights, [y[k] for y in offsets]) / total for k in range(2)]

    def covariance(k, m):
        products = [(y[k] - means[k]) * (y[m] - means[m]) for y in offsets]
        return dot(weights, products) / total

    return [
        [covariance(k, m) / variance**2 - (k == m) / variance for m in range(2)]
        for k in range(2)
    ]


@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**32 - 1),
    half=st.integers(-45, 0).map(lambda exponent: 2.0**exponent),
    sigma=st.sampled_from([0.05, 0.3, 2.0]),
)
def test_derivatives_of_a_mixture_are_inside_of_their_models(seed, half, sigma):
    rng = np.random.default_rng(seed)
    mixture = GaussianMixture(
        rng.uniform(-3, 3, (int(rng.choice([1, 2, 2, 3, 5, 8])), 2)), sigma
    )
    center = rng.uniform(-4, 4, 2)
    if len(mixture.points) == 2:
        # About as far from one as from the other, where weights change most and are off most.
        first, last = mixture.points
        apart = last - first
        center = (first + last) / 2 + rng.uniform(-9, 9) * apart[::-1] * [-1, 1]
        center += rng.uniform(-3, 3) * sigma**2 * apart / (apart**2).sum()
    boxes = Boxes(center[None], np.array([half]))
    with np.errstate(over="ignore", invalid="ignore"):
        models = dual_mixture(mixture, boxes)
    corners = [[-1.0, -1.0], [1.0, 1.0], [1.0, -1.0], [0.0, 0.0]]
    for d in half * np.concatenate([corners, rng.uniform(-1, 1, (3, 2))]):
        slopes = slopes_at(mixture, point_of(boxes, d))
        for k, model in enumerate(models.slopes):
            # On squares that are too large to say anything, the models say so.
            if np.isfinite(model.remainder).all():
                assert_inside(model, d, slopes[k])


def test_what_is_left_falls_with_the_cube_of_the_square():
    rng = np.random.default_rng(1)
    mixture = GaussianMixture(rng.uniform(-3, 3, (40, 2)), 0.3)
    centers = rng.uniform(-3, 3, (50, 2))
    remainders = [
        np.median([slope.remainder for slope in dual_mixture(mixture, boxes).slopes])
        for boxes in (Boxes(centers, np.full(50, 2.0**-exponent)) for exponent in (10, 11))
    ]
    assert remainders[0] / remainders[1] == pytest.approx(8, rel=0.1)


@pytest.mark.parametrize("recipe", ["robust", "exact", "paper"])
@settings(max_examples=25)
@given(seed=seeds, exponent=st.integers(-16, -3), normalises=st.booleans())
def test_a_field_is_inside_of_its_model(make_field, recipe, seed, exponent, normalises):
    rng = np.random.default_rng(seed)
    field = make_field(recipe, seed=int(rng.integers(1000)))
    if normalises and recipe == "paper":
        field = replace(field, composition=NormalisedComposition(field.composition.gain))
    half = 2.0**exponent
    boxes = one_box(rng, half)
    with np.errstate(over="ignore", invalid="ignore"):
        model = model_field(field, boxes)
    # On squares that are too large to say anything, the model says so.
    assume(np.isfinite(model.remainder).all())
    for d in steps(rng, half, count=1):
        assert_inside(model, d, BallField(field)(point_of(boxes, d)).m)


def test_bounds_become_tight_as_squares_become_small(make_field):
    rng = np.random.default_rng(1)
    field = make_field("robust")
    centers = rng.uniform(-4, 4, (50, 2))
    over = []
    for half in (2.0**-7, 2.0**-9):
        model = model_field(field, Boxes(centers, np.full(50, half)))
        x = centers[:, None] + half * rng.uniform(-1, 1, (50, 400, 2))
        m = field(field.cloud.denormalize(x.reshape(-1, 2))).reshape(50, 400, 2)
        over.append(np.median((model.upper - model.lower) / np.ptp(m, axis=1)))
    assert over[1] < over[0]
    assert over[1] < 1.1


def test_a_field_with_terminal_ends_is_not_bounded(make_field):
    with pytest.raises(ConfigurationError, match="terminal ends"):
        model_field(make_field("robust", ends=1), Boxes.square(0.5))
