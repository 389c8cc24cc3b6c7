"""Components and holes of sublevel sets, by covers."""

import numpy as np
import pytest

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.certificate.sublevel_sets import cover, shape_of_band
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
from tests import helpers


def circle(radius, center=(0.0, 0.0)):
    return helpers.circle(radius, 120, center)


def levels_of(points, sigma=0.2):
    mixture = GaussianMixture(points, sigma)
    free = MixtureModel(mixture)
    at = Boxes.points(points[:1])
    lowest = float(free.level_range(at)[0][0] - LyapunovFunction(mixture)(points[:1])[0])
    return MixtureModel(mixture, lowest)


SHAPES = {
    "a ring": ([circle(2.0)], (1,)),
    "one ring in another": ([circle(1.5), circle(3.5)], (1, 1)),
    "a ring around a disc": ([circle(2.5), np.zeros((4, 2))], (0, 1)),
    "three discs": ([np.array([[x, 1.0]]) for x in (-2.0, 0.0, 2.0)], (0, 0, 0)),
    "an eight": ([circle(1.0, (-1.0, 0)), circle(1.0, (1.0, 0))], (2,)),
}


@pytest.mark.parametrize("name", SHAPES)
def test_shapes_are_counted(name):
    pieces, holes = SHAPES[name]
    levels = levels_of(np.concatenate(pieces))
    found = shape_of_band(levels, 1.0, 4.0, 2.0**-6)
    assert tuple(sorted(found.holes)) == holes
    assert found.components == len(holes)
    components = [set(found.component_of(piece)) for piece in pieces]
    assert 0 not in set.union(*components)
    assert len(set.union(*components)) == len(holes)
    assert found.component_of(np.array([[3.9, -3.9]])) == 0


def test_squares_that_are_too_large_for_the_band_say_nothing():
    levels = levels_of(circle(2.0))
    assert shape_of_band(levels, 1.0, 1.2, 2.0**-2) is None


def test_a_gap_below_the_level_opens_the_ring():
    """What a coarse cover alone would call a ring is none, and the outer cover tells."""
    points = circle(2.0)[4:]
    levels = levels_of(points, sigma=0.08)
    ends = Boxes.points(circle(2.0)[1:2])
    gap = float(levels.level_range(ends)[0][0])
    open_ring = shape_of_band(levels, 0.3, gap / 2, 2.0**-7)
    assert open_ring.holes == (0,)
    closed_ring = shape_of_band(levels, 2 * gap, 3 * gap, 2.0**-7)
    assert closed_ring.holes == (1,)


def test_a_cover_holds_the_set_and_not_much_more():
    levels = levels_of(circle(2.0))
    found = cover(levels, 2.0, 2.0**-5)
    x = np.random.default_rng(0).uniform(-4, 4, (20_000, 2))
    V = levels.level_range(Boxes.points(x))[0]
    rows, columns = found.cells_of(x).T
    covered = found.inside[rows, columns]
    assert covered[V <= 2.0].all()
    assert V[covered].max() <= found.highest
    assert covered.mean() < 1.3 * (V <= 2.0).mean()
