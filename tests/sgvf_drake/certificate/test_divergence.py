"""Derivatives over patches, and that areas shrink in a ring."""

from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.conditions import Contraction
from sgvf_drake.certificate.field_model import dual_field
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.fields import GaussianMixture

from .balls import random_patch

seeds = st.integers(0, 2**32 - 1)


def normalised(field, z):
    m, J = field.value_and_jacobian(field.cloud.denormalize(z))
    return m, J * field.cloud.unit_length


@pytest.mark.parametrize("recipe", ["robust", "paper", "exact"])
@settings(max_examples=20)
@given(seed=seeds, exponent=st.integers(-16, -5))
def test_derivatives_are_inside_of_their_models(make_field, recipe, seed, exponent):
    """Held against the analytic Jacobian, which is right to rounding."""
    rng = np.random.default_rng(seed)
    field = make_field(recipe, seed=int(rng.integers(1000)), ends=int(rng.integers(2)))
    patch = random_patch(rng, 2.0**exponent, 2, int(rng.integers(1, 3)))
    with np.errstate(over="ignore", invalid="ignore"):
        models = dual_field(field, patch)
    u = rng.uniform(-1, 1, (40, patch.axes.shape[2]))
    m, J = normalised(field, patch.centers + u @ patch.axes[0].T)
    rounding = 1e-9 * (1 + np.abs(J).max())
    parts = ((models.value, m), (models.slopes[0], J[..., 0]), (models.slopes[1], J[..., 1]))
    for model, values in (*parts, (models.divergence, np.trace(J, 0, 1, 2)[:, None])):
        if np.isfinite(model.remainder).all():
            assert (values >= model.lower - rounding).all()
            assert (values <= model.upper + rounding).all()


@pytest.fixture(scope="module")
def tube(robust_field):
    """A trained field, V, a level whose tube has a ring about each piece, and its squares."""
    field = robust_field
    mixture = GaussianMixture(field.cloud.normalize(field.mixture.points), field.sigma)
    levels = MixtureModel(mixture)
    lowest = levels.level_range(Boxes.points(mixture.points))[0].min()
    levels = replace(levels, lowest=float(lowest))
    return field, levels, 0.03


def of_piece(boxes, radii):
    distance = np.linalg.norm(boxes.centers, axis=1)
    return boxes[(distance > radii[0]) & (distance < radii[1])]


def test_the_ring_of_a_trained_field_contracts(tube):
    field, levels, c_in = tube
    squares = of_piece(levels.squares_below(c_in, Boxes.square(8.0), 2.0**-6), (1.0, 3.0))
    assert Contraction(field, levels, c_in).prove(squares, 2.0**-12).proved


def test_a_field_that_spreads_is_not_said_to_contract(tube, make_ring):
    field, levels, c_in = tube
    backward = replace(field, composition=replace(field.composition, gain=-1.0))
    squares = of_piece(levels.squares_below(c_in, Boxes.square(8.0), 2.0**-5), (1.0, 3.0))
    found = Contraction(backward, levels, c_in).prove(squares, 2.0**-10)
    assert not found.proved
    assert found.counterexample is not None
