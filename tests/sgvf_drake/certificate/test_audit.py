"""The audit on a few patches, that it tells a model which does not hold, and its balls."""

from dataclasses import replace

from flint import arb
import numpy as np
import pytest

from sgvf_drake import load_field
from sgvf_drake.certificate.boxes import BoxSizes
from sgvf_drake.certificate.mixture_model import MixtureModel, lowest_of, mixture_of
from tests.data.make import field_file
from tests.fields import DIRECTED_KINDS as KINDS
from tests.fields import RECIPES
from tests.fields import random_directed_field as field_of

from .audit import audit, held, random_patches
from .ball_fields import BallField
from .balls import mixture_at, point_of

# Sides of patches, from large ones to those about which rounding matters.
HALVES = (2.0**-5, 2.0**-13)
FEW_POINTS = 3


def levels_of(field):
    mixture = mixture_of(field, field.sigma)
    return MixtureModel(mixture, lowest_of(mixture))


def assert_passes(field, levels, k, rng, count=2):
    for half in HALVES:
        patches = random_patches(field, half, k, count, rng)
        for number, violations, largest in audit(field, levels, patches, rng).values():
            assert number >= count * FEW_POINTS**k
            assert violations == 0
            assert largest <= 1


@pytest.mark.parametrize("k", [1, 2, 3])
@pytest.mark.parametrize("ends", [0, 2])
@pytest.mark.parametrize("recipe", RECIPES)
def test_an_untrained_field_passes(make_field, recipe, ends, k):
    field = make_field(recipe, dim=3 if k == 3 else 2, ends=ends)
    assert_passes(field, levels_of(field), k, np.random.default_rng(0))


@pytest.mark.parametrize(("dim", "k"), [(2, 1), (2, 2), (3, 2)])
@pytest.mark.parametrize("kind", KINDS)
def test_a_directed_field_that_is_held_passes(kind, dim, k):
    rng = np.random.default_rng(3)
    g = rng.standard_normal(dim)
    field = field_of(kind, dim, ends=dim == 3).heading(0.9 * g / np.linalg.norm(g))
    assert_passes(field, None, k, rng)


@pytest.mark.full
@pytest.mark.parametrize("k", [1, 2])
@pytest.mark.parametrize(
    "name", ["robust", "exact", "paper", "flight", "open", "half_circle", "ring"]
)
def test_a_trained_field_passes(name, k):
    field = load_field(field_file(name))
    assert_passes(field, levels_of(field), k, np.random.default_rng(4), count=20)


def test_a_model_that_does_not_hold_is_told(make_field):
    field, rng = make_field("robust"), np.random.default_rng(1)
    levels = MixtureModel(mixture_of(field, field.sigma))
    patches = random_patches(field, BoxSizes.of(field).ring, 2, 1, rng)
    model, u = levels.gradient(patches), np.ones(2)
    value = mixture_at(levels.mixture, point_of(patches, u))[1][0]
    holds, used = held(model, 0, 0, u, value)
    assert holds
    smaller = replace(model, remainder=0.99 * used * model.remainder)
    assert not held(smaller, 0, 0, u, value)[0]


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("recipe", RECIPES)
def test_the_balls_are_the_field_of_the_library_with_its_derivatives(make_field, recipe, dim):
    assert_same(make_field(recipe, dim=dim, ends=dim - 2), dim)


@pytest.mark.parametrize("kind", KINDS)
def test_the_balls_are_the_directed_field_of_the_library(kind):
    assert_same(field_of(kind, 2, ends=True).heading(np.array([0.6, -0.7])), 2)


def assert_same(field, dim):
    for z in np.random.default_rng(2).uniform(-4, 4, (3, dim)):
        there = BallField(field)([arb(float(value)) for value in z])
        m, expected = field.value_and_jacobian(field.cloud.denormalize(z))
        values = [float(value) for value in there.m]
        np.testing.assert_allclose(values, m, rtol=1e-9, atol=1e-12)
        found = np.array([[float(entry) for entry in row] for row in there.slopes]).T
        np.testing.assert_allclose(
            found, expected * field.cloud.unit_length, rtol=1e-8, atol=1e-10
        )
