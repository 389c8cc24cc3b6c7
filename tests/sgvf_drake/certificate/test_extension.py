"""Parts above the band: each up to the level at which something is in its way."""

from dataclasses import replace

import numpy as np
import pytest

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.mixture_model import MixtureModel, mixture_of
from sgvf_drake.certificate.sublevel_sets import extend


def level_at(levels, z):
    return levels.level_range(Boxes.points(z))[0]


def above(field, certificate, c_out):
    conditions = replace(certificate.conditions, c_out=c_out)
    levels = MixtureModel(mixture_of(field, conditions.sigma), conditions.lowest)
    return levels, extend(field, levels, conditions)


def test_the_parts_of_a_ring_are_its_two_sides(ring):
    """Inside V ends at the centre, where it is critical; outside at the border of the box."""
    field, _, certificate = ring
    levels, found = above(field, certificate, 2.0)
    inner, outer = sorted(found.parts, key=lambda part: np.hypot(*part.point))
    assert np.hypot(*inner.point) < 4.0 < np.hypot(*outer.point)
    lower, upper = (field.cloud.normalize(corner[None])[0] for corner in field.cloud.box)
    middle = np.array([[0.0, 0.0], [upper[0], 0.0]])
    at_centre, at_border = level_at(levels, middle)
    assert 0.7 * at_centre < inner.level < at_centre
    assert 0.5 * at_border < outer.level < at_border
    assert lower[0] == pytest.approx(-upper[0])


@pytest.mark.parametrize("c_out", [2.0, 5.0])
def test_what_is_said_to_fall_is_no_more_than_samples_say(ring, c_out):
    field, _, certificate = ring
    levels, found = above(field, certificate, c_out)
    z = field.cloud.normalize(np.random.default_rng(0).uniform(*field.cloud.box, (40_000, 2)))
    V_dot = -(levels.mixture.score(z) * field(field.cloud.denormalize(z))).sum(axis=1)
    falls = (V_dot < -certificate.conditions.alpha) & (level_at(levels, z) >= c_out)
    lower, upper = (corner / field.cloud.unit_length for corner in field.cloud.box)
    share = found.falling_area / np.prod(upper - lower)
    assert 0.9 * falls.mean() < share < falls.mean() + 0.01


def test_a_field_that_does_not_lead_down_has_no_parts(ring):
    """Backwards, V falls nowhere above the path."""
    field, _, certificate = ring
    backward = replace(field, composition=replace(field.composition, gain=-1.0))
    _, found = above(backward, certificate, 2.0)
    assert found.parts == ()
    assert found.falling_area == 0.0
