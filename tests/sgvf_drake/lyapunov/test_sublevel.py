"""Sublevel sets whose parts, holes and areas are known."""

import numpy as np
import pytest

from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction, sublevel_set
from sgvf_drake.lyapunov.sublevel import _holes
from sgvf_drake.paths import Piece, ReferencePath
from tests import helpers

BOX = (np.array([-5.0, -5.0]), np.array([5.0, 5.0]))


def circle(radius, x=0.0, y=0.0, count=2_000):
    return helpers.circle(radius, count, (x, y))


def rings(*circles, sigma=0.1, spacing=0.04):
    """V of rings (radius, x, y), and the rings."""
    points = [circle(*c, count=round(2 * np.pi * c[0] / spacing)) for c in circles]
    pieces = tuple(Piece(circle(*c), closed=True) for c in circles)
    return LyapunovFunction(GaussianMixture(np.concatenate(points), sigma)), ReferencePath(
        pieces
    )


@pytest.mark.parametrize("level", [0.05, 2.0])
def test_around_a_ring_it_is_an_annulus(level):
    # V = d^2 / 2 sigma^2, so the annulus is 2 sigma sqrt(2 c) wide.
    function, path = rings((3.0, 0.0, 0.0))
    found = sublevel_set(function, level, path, BOX)
    width = 0.1 * np.sqrt(2 * level)
    assert [component.holes for component in found.components] == [1]
    assert found.area == pytest.approx(2 * np.pi * 3.0 * 2 * width, rel=0.03)
    # To a cell, and to the curvature of the ring.
    assert found.half_width == pytest.approx(width, abs=width / 12 + 0.1 / 24 + 0.002)
    # The middles of its cells are in the set.
    assert found.half_width <= width + 0.002
    assert found.compact
    assert found.follows(path.closed)


def test_rings_apart_and_one_in_another_are_one_component_each():
    for circles in (((1.5, -2.0, 0.0), (1.5, 2.0, 0.0)), ((2.0, 0.0, 0.0), (4.0, 0.0, 0.0))):
        function, path = rings(*circles)
        found = sublevel_set(function, 1.0, path, BOX)
        assert sorted(c.pieces for c in found.components) == [(0,), (1,)]
        assert [c.holes for c in found.components] == [1, 1]
        assert found.follows(path.closed)


def test_above_a_critical_level_parts_join_and_holes_close():
    # Each with the place of the critical point, and the holes and pieces below and above.
    for circles, place, below, above in (
        (((1.5, -2.0, 0.0), (1.5, 2.0, 0.0)), [0.0, 0.0], [1, 1], [(2, (0, 1))]),
        (((1.0, 0.0, 0.0),), [0.0, 0.0], [1], [(0, (0,))]),
    ):
        function, path = rings(*circles, sigma=0.3)
        critical = float(function(np.array([place]))[0])
        lower, upper = (sublevel_set(function, c * critical, path, BOX) for c in (0.93, 1.07))
        assert [c.holes for c in lower.components] == below
        assert lower.follows(path.closed)
        assert [(c.holes, c.pieces) for c in upper.components] == above
        assert not upper.follows(path.closed)


def test_below_the_saddles_between_waypoints_it_is_beads():
    # Waypoints two noise levels and more apart: each is a mode of its own.
    function, path = rings((3.0, 0.0, 0.0), sigma=0.1, spacing=0.4)
    found = sublevel_set(function, 0.3, path, BOX)
    assert len(found.components) == round(2 * np.pi * 3 / 0.4)
    assert not found.follows(path.closed)


def test_an_open_piece_is_a_strip_without_holes():
    x = np.linspace(-3, 3, 200)
    line = np.column_stack([x, 0.3 * np.sin(2 * x)])
    function = LyapunovFunction(GaussianMixture(line, 0.1))
    path = ReferencePath((Piece(line, closed=False),))
    found = sublevel_set(function, 1.0, path, BOX)
    assert [(c.holes, c.pieces) for c in found.components] == [(0, (0,))]
    assert found.follows(path.closed)
    assert not found.follows(np.array([True]))


def test_a_set_that_reaches_the_border_is_not_compact_and_an_empty_one_has_no_parts():
    function, path = rings((3.0, 0.0, 0.0))
    border = float(function(np.array([[5.0, 0.0]]))[0])
    inside, outside = (sublevel_set(function, c * border, path, BOX) for c in (0.9, 1.1))
    assert inside.compact
    assert not outside.compact
    empty = sublevel_set(function, -1.0, path, BOX)
    assert (empty.components, empty.area, empty.half_width) == ((), 0.0, 0.0)
    assert not empty.follows(path.closed)


def test_it_scales_with_the_unit():
    unit = 1e3
    plain, path = rings((3.0, 0.0, 0.0))
    function = LyapunovFunction(GaussianMixture(unit * plain.mixture.points, unit * 0.1))
    scaled = ReferencePath((Piece(unit * path.pieces[0].vertices, closed=True),))
    box = tuple(unit * corner for corner in BOX)
    one, other = sublevel_set(plain, 1.0, path, BOX), sublevel_set(function, 1.0, scaled, box)
    assert other.area == pytest.approx(unit**2 * one.area, rel=1e-3)
    assert other.half_width == pytest.approx(unit * one.half_width, rel=1e-2)


def test_a_hole_hangs_together_across_a_corner():
    """As a set that hangs together along edges leaves it."""
    corner, apart = np.ones((2, 4, 5), int)
    corner[1, 1] = corner[2, 2] = 0
    apart[1, 1] = apart[2, 3] = 0
    assert (_holes(corner, 1), _holes(apart, 1)) == (1, 2)
