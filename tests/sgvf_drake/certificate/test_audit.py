"""The audit on a few squares, that it tells a model which does not hold, and its balls."""

from dataclasses import replace

from flint import arb
import numpy as np
import pytest

from sgvf_drake.certificate.boxes import BoxSizes
from sgvf_drake.certificate.mixture_model import MixtureModel, lowest_of, mixture_of

from .audit import audit, held, random_boxes
from .ball_fields import BallField
from .balls import mixture_at


@pytest.mark.parametrize("recipe", ["robust", "exact", "paper"])
def test_an_untrained_field_passes(make_field, recipe):
    field, rng = make_field(recipe), np.random.default_rng(0)
    mixture = mixture_of(field, field.sigma)
    levels, sizes = MixtureModel(mixture, lowest_of(mixture)), BoxSizes.of(field)
    for half in (sizes.ring, sizes.last):
        boxes = random_boxes(field, half, 4, rng)
        for count, violations, largest in audit(field, levels, boxes, rng).values():
            assert count >= 4 * 18
            assert violations == 0
            assert 0 < largest <= 1


def test_a_model_that_does_not_hold_is_told(make_field):
    field, rng = make_field("robust"), np.random.default_rng(1)
    mixture = mixture_of(field, field.sigma)
    levels = MixtureModel(mixture)
    boxes = random_boxes(field, BoxSizes.of(field).ring, 1, rng)
    model, d = levels.gradient(boxes), np.array([boxes.half[0], boxes.half[0]])
    z = [arb(float(c)) + arb(float(x)) for c, x in zip(boxes.centers[0], d, strict=True)]
    value = mixture_at(mixture, z)[1][0]
    holds, used = held(model, 0, 0, d, value)
    assert holds
    smaller = replace(model, remainder=0.99 * used * model.remainder)
    assert not held(smaller, 0, 0, d, value)[0]


@pytest.mark.parametrize("recipe", ["robust", "exact", "paper"])
def test_the_balls_are_the_field_of_the_library_with_its_derivatives(make_field, recipe):
    field, rng = make_field(recipe), np.random.default_rng(2)
    for z in rng.uniform(-4, 4, (3, 2)):
        balls = [arb(float(value)) for value in z]
        there = BallField(field)(balls)
        m, expected = field.value_and_jacobian(field.cloud.denormalize(z))
        values = [float(value) for value in there.m]
        np.testing.assert_allclose(values, m, rtol=1e-9, atol=1e-12)
        found = np.array([[float(entry) for entry in row] for row in there.slopes]).T
        np.testing.assert_allclose(
            found, expected * field.cloud.unit_length, rtol=1e-8, atol=1e-10
        )
