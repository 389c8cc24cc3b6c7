"""Networks, mixtures and whole fields over squares, point by point in ball arithmetic."""

from dataclasses import replace

from flint import arb
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.field_model import model_field
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.certificate.network_model import model_network
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GaussianMixture, NormalisedComposition
from sgvf_drake.fields.activation import ACTIVATIONS, find_activation

from .balls import field_at, mixture_at, model_at, network_at

seeds = st.integers(0, 2**32 - 1)
halves = st.integers(-20, 1).map(lambda exponent: 2.0**exponent)
CORNERS = np.array([[-1.0, -1.0], [1.0, 1.0], [1.0, -1.0], [0.0, 1.0], [0.0, 0.0]])


def steps(rng, half, count=3):
    return half * np.concatenate([CORNERS, rng.uniform(-1, 1, (count, 2))])


def at(boxes, d):
    return [arb(float(c)) + arb(float(x)) for c, x in zip(boxes.centers[0], d, strict=True)]


def assert_inside(model, d, values):
    for column, value in enumerate(values):
        polynomial, remainder = model_at(model, 0, column, d)
        assert abs(value - polynomial) <= remainder
        assert arb(float(model.lower[0, column])) <= value
        assert value <= arb(float(model.upper[0, column]))


def one_box(rng, half, spread=4.0):
    return Boxes(rng.uniform(-spread, spread, (1, 2)), np.array([half]))


@pytest.mark.parametrize("activation", [activation.name for activation in ACTIVATIONS])
@settings(max_examples=25, deadline=None)
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
        assert_inside(model, d, network_at(network, at(boxes, d)))


@settings(max_examples=60, deadline=None)
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
        value, slope = mixture_at(model.mixture, at(boxes, d))
        assert arb(float(low[0])) <= value
        assert value <= arb(float(high[0]))
        # On squares that are too large to say anything, the models say so.
        if np.isfinite(gradient.remainder).all():
            assert_inside(gradient, d, slope)
            assert_inside(level, d, [value])


@pytest.mark.parametrize("recipe", ["robust", "exact", "paper"])
@settings(max_examples=25, deadline=None)
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
        assert_inside(model, d, field_at(field, at(boxes, d)))


def test_the_balls_compute_the_same_field_as_the_library(make_field):
    rng = np.random.default_rng(0)
    for recipe in ("robust", "exact", "paper"):
        field = make_field(recipe)
        z = rng.uniform(-4, 4, 2)
        x = z * field.cloud.unit_length + field.cloud.center
        found = [float(value) for value in field_at(field, [arb(float(v)) for v in z])]
        np.testing.assert_allclose(found, field(x), rtol=1e-9, atol=1e-12)


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
