"""Sublevel sets whose parts, holes and areas are known."""

import numpy as np
import pytest
from scipy import ndimage
from scipy.special import i0e

from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction, sublevel_set
from sgvf_drake.lyapunov.sublevel import Raster
from sgvf_drake.paths import Piece, ReferencePath
from tests import helpers
from tests.fields import ACROSS

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
    assert [Raster(np.argwhere(cells)).holes for cells in (corner, apart)] == [[1], [2]]


@pytest.mark.parametrize(("shape", "count"), [((12, 15), 60), ((6, 7, 8), 40)])
def test_components_edges_and_what_is_enclosed_are_those_of_ndimage(shape, count):
    rng = np.random.default_rng(0)
    corners = np.ones((3,) * len(shape))
    for _ in range(count):
        cells = rng.random(shape) < rng.uniform(0.3, 0.9)
        found = Raster(np.argwhere(cells))
        labels, number = ndimage.label(cells)
        np.testing.assert_array_equal(labels[tuple(found.numbers.T)] - 1, found.label)
        edge = cells & ~ndimage.binary_erosion(cells)
        np.testing.assert_array_equal(np.argwhere(edge), found.numbers[found.on_edge])
        outside = [np.pad(labels != k, 1, constant_values=True) for k in range(1, number + 1)]
        enclosed = [ndimage.label(part, corners)[1] - 1 for part in outside]
        assert (found.holes if len(shape) == 2 else found.cavities) == enclosed


def test_holes_of_solids():
    x, y, z = np.indices((41, 41, 21)) - np.array([20, 20, 10])[:, None, None, None]

    def ring(middle, radius):
        return (np.hypot(x - middle, y) - radius) ** 2 + z**2 <= 9

    ball, core = x**2 + y**2 + z**2 <= 81, x**2 + y**2 + z**2 <= 16
    tunnel = (x**2 + y**2 <= 4) & (z > 0)
    for solid, holes, cavities in (
        (ball, 0, 0),
        (ball & ~core, 0, 1),
        (ball & ~core & ~tunnel, 0, 0),
        (ring(0, 9), 1, 0),
        (ring(-6, 7) | ring(6, 7), 2, 0),
    ):
        found = Raster(np.argwhere(solid))
        assert (found.holes, found.cavities) == ([holes], [cavities])


@pytest.mark.parametrize("level", [0.05, 1.0, 20.0])
def test_around_a_circle_in_space_it_is_a_solid_torus(level):
    """Of a circle of density, V is known at a distance r from the axis and z from the plane."""
    radius, sigma, box = 2.0, 0.1, (np.full(3, -3.0), np.full(3, 3.0))
    points = circle(radius, count=320) @ ACROSS
    path = ReferencePath((Piece(circle(radius) @ ACROSS, closed=True),))
    found = sublevel_set(LyapunovFunction(GaussianMixture(points, sigma)), level, path, box)
    width = sigma * np.sqrt(2 * level)
    r, z = np.mgrid[0 : radius + 2 * width : 2000j, -2 * width : 2 * width : 1000j]
    V = ((r - radius) ** 2 + z**2) / (2 * sigma**2) - np.log(i0e(r * radius / sigma**2))
    inside = V - V.min() <= level
    cell = (r[1, 0] - r[0, 0]) * (z[0, 1] - z[0, 0])
    assert found.area == pytest.approx((2 * np.pi * r * cell)[inside].sum(), rel=0.03)
    farthest = np.hypot(r - radius, z)[inside].max()
    assert 0.8 * farthest < found.half_width <= farthest + 0.005
    (component,) = found.components
    assert (component.pieces, component.holes, component.cavities) == ((0,), 1, 0)
    assert found.compact
    assert found.follows(path.closed)


def test_an_arc_in_space_has_no_hole_and_a_shell_is_no_tube():
    t = np.linspace(0, 4, 300)
    arc = np.column_stack([np.cos(t), np.sin(t), 0.3 * t])
    box = (np.full(3, -2.0), np.full(3, 2.0))
    path = ReferencePath((Piece(arc, closed=False),))
    found = sublevel_set(LyapunovFunction(GaussianMixture(arc, 0.1)), 1.0, path, box)
    assert [(c.pieces, c.holes) for c in found.components] == [((0,), 0)]
    assert found.follows(path.closed)
    # Fibonacci's lattice on a sphere: the low levels are a shell around its middle.
    height = 1 - 2 * (np.arange(600) + 0.5) / 600
    turn = np.pi * (1 + np.sqrt(5)) * np.arange(600)
    flat = np.sqrt(1 - height**2)
    sphere = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
    shell = sublevel_set(LyapunovFunction(GaussianMixture(sphere, 0.2)), 1.0, path, box)
    assert [(c.pieces, c.holes, c.cavities) for c in shell.components] == [((0,), 0, 1)]
    assert not shell.follows(path.closed)
