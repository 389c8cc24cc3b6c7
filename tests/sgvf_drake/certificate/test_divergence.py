"""Derivatives of fields over patches, held against their analytic Jacobian."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.certificate.field_model import dual_field

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
