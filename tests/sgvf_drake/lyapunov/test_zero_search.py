"""The search for zeros: planted ones, hard ones, and those of trained fields."""

from dataclasses import dataclass, replace

from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial import cKDTree
import sympy

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import PaperComposition, ScoreField, TangentField
from sgvf_drake.lyapunov import find_modes, find_zeros
from sgvf_drake.lyapunov.cells import Cells
from sgvf_drake.lyapunov.winding import box_corners, winding_number

from .dense import dense_zeros

BOX = (np.array([-5.0, -5.0]), np.array([5.0, 5.0]))
# Side of the first cells in that box, whose lines are multiples of it.
SIDE = 10 / 64


class Planted:
    """Base of planar fields that are written out; they need no Hessian."""

    dim = 2

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]


@dataclass
class Polynomial(Planted):
    """c prod (z - a) prod conj(z - b): zeros a of index 1, b of index -1."""

    positive: tuple = ()
    negative: tuple = ()
    factor: complex = 1.0

    def value_and_jacobian(self, x):
        z = x[:, 0] + 1j * x[:, 1]
        A, dA = self._product(z, self.positive)
        B, dB = self._product(z, self.negative)
        f = self.factor * A * B.conj()
        f_z, f_conj = self.factor * dA * B.conj(), self.factor * A * dB.conj()
        by_x, by_y = f_z + f_conj, 1j * (f_z - f_conj)
        columns = [np.column_stack([d.real, d.imag]) for d in (by_x, by_y)]
        return np.column_stack([f.real, f.imag]), np.stack(columns, axis=2)

    @staticmethod
    def _product(z, zeros):
        value, slope = np.ones_like(z), np.zeros_like(z)
        for zero in zeros:
            value, slope = value * (z - zero), slope * (z - zero) + value
        return value, slope


class Written(Planted):
    """A field and its Jacobian, of two expressions in x and y, or three in x, y and z."""

    def __init__(self, *parts):
        self.dim = len(parts)
        variables = sympy.symbols("x y z")[: self.dim]
        field = sympy.Matrix([sympy.sympify(part) for part in parts])
        both = field.row_join(field.jacobian(variables))
        self.entries = [sympy.lambdify(variables, entry) for entry in both]

    def value_and_jacobian(self, x):
        entries = [np.broadcast_to(entry(*x.T), len(x)) for entry in self.entries]
        both = np.stack(entries, axis=1).reshape(-1, self.dim, self.dim + 1)
        return both[..., 0], both[..., 1:]


@dataclass
class Moved(Planted):
    """Another field, turned, scaled and shifted: x = shift + scale R x'."""

    field: object
    angle: float
    scale: float
    shift: np.ndarray

    def value_and_jacobian(self, x):
        R = self.rotation
        value, J = self.field.value_and_jacobian((x - self.shift) @ R / self.scale)
        return value @ R.T, R @ J @ R.T / self.scale

    @property
    def rotation(self):
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        return np.array([[cos, -sin], [sin, cos]])

    def place(self, points):
        return self.shift + self.scale * points @ self.rotation.T


def on_plane(zeros):
    return np.array([[zero.real, zero.imag] for zero in zeros]).reshape(-1, 2)


def check_planted(search, points, indices, tolerance=1e-9):
    """All planted zeros, once each, with their indices, and nothing else."""
    assert search.undecided == 0
    assert not search.degenerate.any()
    assert len(search.points) == len(points)
    if len(points):
        distance, nearest = cKDTree(search.points).query(points)
        assert distance.max() < tolerance
        assert sorted(nearest) == list(range(len(points)))
        assert np.array_equal(search.indices[nearest], indices)


def check_polynomial(positive, negative, factor=1.0):
    search = find_zeros(Polynomial(tuple(positive), tuple(negative), factor), BOX)
    indices = [1] * len(positive) + [-1] * len(negative)
    check_planted(search, on_plane([*positive, *negative]), indices)


coordinate = st.floats(-4.9, 4.9)
planted = st.lists(st.builds(complex, coordinate, coordinate), max_size=3)


@settings(max_examples=30, derandomize=True)
@given(planted, planted, st.floats(0, 6.28))
def test_planted_zeros_are_found(positive, negative, angle):
    zeros = on_plane([*positive, *negative])
    assume(len(zeros) < 2 or len(cKDTree(zeros).query_pairs(1e-4)) == 0)
    check_polynomial(positive, negative, np.exp(1j * angle))


def test_close_pairs_are_told_apart():
    zero = 1.234 - 0.567j
    for distance in (1e-1, 1e-3, 1e-5):
        for direction in (1, 1j, np.exp(0.3j)):
            other = zero + distance * direction
            check_polynomial([zero, other], [-3 + 1j])
            check_polynomial([zero], [other])


def test_zeros_on_the_lines_and_corners_of_cells_are_found_once():
    line, corner = 3 * SIDE + 0.05j, -7 * SIDE + 4j * SIDE
    finer = SIDE / 2 + 1j * SIDE / 4
    check_polynomial([line, corner, finer], [complex(-line.imag, line.real), 5 * SIDE * 1j])


def test_the_border_belongs_to_the_box():
    on_border = [5 + 1j, -5 - 5j, 2 - 5j]
    check_polynomial(on_border, [])
    outside = [5 + 1e-6 + 1j, -6j, -7 + 7j]
    search = find_zeros(Polynomial((*outside, 4.999999 + 2j)), BOX)
    check_planted(search, [[4.999999, 2]], [1])


def test_rounding_loses_no_zero_on_the_border():
    # The sine is flat there: its zeros are rounded by many times what the border is.
    for border in np.linspace(1.2, 1.5, 25):
        field = Written(f"sin(x) - {float(np.sin(border))!r}", "y")
        search = find_zeros(field, (np.array([0.0, -1.0]), np.array([border, 1.0])))
        check_planted(search, [[border, 0.0]], [1])


def test_a_field_without_zeros_has_none():
    for parts in (("1 + x**2", "y"), ("1e-6 + x**2", "y"), ("0.3", "-0.4")):
        check_planted(find_zeros(Written(*parts), BOX), [], [])


def test_a_hundred_zeros_on_a_grid():
    field = Written("sin(pi * x)", "sin(pi * y)")
    grid = np.stack(np.meshgrid(*[np.arange(-4, 6)] * 2), axis=-1).reshape(-1, 2)
    indices = np.where(grid.sum(axis=1) % 2 == 0, 1, -1)
    box = (np.array([-4.4, -4.7]), np.array([5.3, 5.6]))
    check_planted(find_zeros(field, box), grid, indices)


def test_zeros_along_a_steep_valley():
    # Off the lines of the cells: the valley of (x - y^2 / 8) is a parabola, turned by 0.4.
    number = np.arange(-6, 7)
    y = np.pi / 3 * number
    indices = np.where(number % 2 == 0, 1, -1)
    for slope in (1e-1, 3e-5):
        valley = Written("x - y**2 / 8", f"{slope} * sin(3 * y)")
        field = Moved(valley, 0.4, 1.0, np.array([0.1, 0.2]))
        points = field.place(np.column_stack([y**2 / 8, y]))
        inside = np.abs(points).max(axis=1) < 5
        assert inside.sum() == 9
        search = find_zeros(field, BOX)
        check_planted(search, points[inside], indices[inside], tolerance=1e-7)


@pytest.mark.parametrize(("unit", "offset"), [(1e-3, 0.0), (1e3, 1e4), (1.0, 1e4)])
def test_zeros_move_with_the_field(unit, offset):
    positive, negative = (1 + 2j, -3 - 1j, 1.01 + 2j), (-2 + 2j, 0.5j)
    shift = unit * np.array([offset, -2 * offset])
    field = Moved(Polynomial(positive, negative), 0.7, unit, shift)
    box = (shift + unit * BOX[0], shift + unit * BOX[1])
    search = find_zeros(field, box)
    points = field.place(on_plane([*positive, *negative]))
    check_planted(search, points, [1, 1, 1, -1, -1], tolerance=unit * (1e-9 + 1e-12 * offset))


@pytest.mark.parametrize(
    ("positive", "negative", "index"),
    [([0j] * 2, [], 2), ([], [0j] * 2, -2), ([1 + 1j] * 3, [], 3), ([-2j], [-2j], 0)],
)
def test_multiple_zeros_are_degenerate(positive, negative, index):
    others = [2 - 1j, -3 + 0.5j]
    search = find_zeros(Polynomial((*positive, *others), tuple(negative)), BOX)
    assert search.undecided == 1
    assert search.degenerate.sum() == 1
    (place,) = on_plane([*positive, *negative][:1])
    assert np.allclose(search.points[search.degenerate], place, atol=1e-6)
    assert search.indices[search.degenerate] == [index]
    assert np.array_equal(search.indices[~search.degenerate], [1, 1])


def test_pairs_that_appear_and_vanish():
    def fold(height):
        return Written(f"(x - 0.3)**2 + {height}", "y - 0.1")

    check_planted(find_zeros(fold(-1e-6), BOX), [[0.299, 0.1], [0.301, 0.1]], [-1, 1])
    check_planted(find_zeros(fold(1e-6), BOX), [], [])
    double = find_zeros(fold(0.0), BOX)
    assert double.degenerate.tolist() == [True]
    assert double.indices.tolist() == [0]


def test_a_line_of_zeros_is_one_undecided_place():
    ring = Written("(1 - x**2 - y**2) * x", "(1 - x**2 - y**2) * y")
    search = find_zeros(ring, BOX)
    assert search.undecided == 1
    assert search.degenerate.tolist() == [False, True]
    # The flow runs onto the ring from both sides: no index; the centre has all of it.
    assert search.indices.tolist() == [1, 0]
    assert np.allclose(search.points[0], 0, atol=1e-12)
    assert np.linalg.norm(search.points[1]) == pytest.approx(1)


def test_a_zero_beside_a_line_of_zeros_counts_once():
    # Just inside of the cells around the ring's, and found from the cell beside those.
    x, y = -8 * SIDE + 0.02 * SIDE, 0.3 * SIDE
    for sign in (1, -1):
        field = Written(
            f"(1 - x**2 - y**2) * (x - {x})", f"{sign} * (1 - x**2 - y**2) * (y - {y})"
        )
        search = find_zeros(field, BOX)
        assert search.undecided == 1
        assert search.indices.sum() == winding_number(field, box_corners(BOX)) == sign
        assert np.allclose(search.points[~search.degenerate], [[x, y]], atol=1e-9)


def test_a_line_of_zeros_out_of_the_box_is_refused():
    line = Written("x", "0")
    with pytest.raises(ConfigurationError, match="vanishes at"):
        find_zeros(line, BOX)


def test_a_box_of_another_dimension_is_refused(make_field):
    for field, dim in ((make_field("robust", dim=3), 2), (Polynomial((0j,)), 3)):
        with pytest.raises(ConfigurationError, match=f"in {field.dim}-D are found in boxes"):
            find_zeros(field, (np.zeros(dim), np.ones(dim)))


CUBE = (np.full(3, -2.6), np.full(3, 2.5))


def test_planted_zeros_in_space_are_found():
    field = Written("(x - 1) * (x + 2)", "(y - 0.5) * (y + x)", "z + x * y")
    points = np.array([(1, 0.5, -0.5), (1, -1, 1), (-2, 0.5, 1), (-2, 2, 4)])
    box = (np.full(3, -5.0), np.full(3, 5.0))
    # det J is (2 x + 1) (2 y + x - 0.5).
    check_planted(find_zeros(field, box, 0.5), points, [1, -1, 1, -1])
    # On the lines of cells, and on the border, too.
    search = find_zeros(field, (np.full(3, -2.0), np.array([2.0, 2.0, 4.0])), 0.25)
    check_planted(search, points, [1, -1, 1, -1])


def test_a_grid_of_zeros_in_space():
    sines = [f"sin(pi * {name})" for name in "xyz"]
    skew = ((3.0, 1.0, 0.0), (2.9, 1.2, 0.3), (0.1, 0.4, 1.0))
    field = Written(*(sympy.Matrix(skew) * sympy.Matrix(sines)))
    grid = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3), axis=-1).reshape(-1, 3)
    indices = np.where(grid.sum(axis=1) % 2 == 0, 1, -1) * np.sign(np.linalg.det(skew))
    check_planted(find_zeros(field, CUBE, 0.3), grid, indices)


@pytest.mark.parametrize(
    ("parts", "simple"),
    [
        # A ring, along which two of three directions are steep.
        (("x**2 + y**2 - 1", "z", "z * x"), 0),
        # A sphere, across which one is; and the zero at its centre.
        ([f"(1 - x**2 - y**2 - z**2) * {name}" for name in "xyz"], 1),
    ],
)
def test_lines_and_surfaces_of_zeros_in_space_are_one_undecided_place(parts, simple):
    search = find_zeros(Written(*parts), CUBE, 0.2)
    assert search.undecided == 1
    assert search.degenerate.tolist() == [False] * simple + [True]
    assert search.indices.tolist() == [1] * simple + [0]
    assert np.linalg.norm(search.points[-1]) == pytest.approx(1)


def test_the_score_of_equal_waypoints_on_rings(ring_field):
    # As far apart as 1.6 noise levels, so that the density has a peak for each waypoint.
    radii = (4.0, 1.5)
    field, _ = ring_field(radii, spacing=0.24, sigma=0.15)
    search = find_zeros(ScoreField(field), field.cloud.box, field.mixture.sigma)
    assert search.undecided == 0
    modes = find_modes(field.mixture)
    assert len(modes) == field.cloud.num_points
    r = np.linalg.norm(search.points, axis=1)
    for radius in radii:
        count = round(2 * np.pi * radius / 0.24)
        on_ring = np.abs(r - radius) < 0.1
        assert (search.indices[on_ring] == 1).sum() == count
        assert (search.indices[on_ring] == -1).sum() == count
    distance, _ = cKDTree(search.points).query(modes)
    assert distance.max() < 1e-6
    assert search.indices.sum() == 1
    assert (r < 0.1).sum() == 1


FULL = pytest.mark.full


@pytest.mark.parametrize(
    ("name", "part"),
    [
        *(("robust", "guiding"), ("exact", "score")),
        *(pytest.param(name, "score", marks=FULL) for name in ("robust", "open")),
        *(pytest.param(name, "tangent", marks=FULL) for name in ("robust", "exact", "open")),
        *(pytest.param(name, "guiding", marks=FULL) for name in ("exact", "open")),
    ],
)
def test_a_dense_search_finds_no_other_zeros(name, part, request):
    field = request.getfixturevalue(f"{name}_field")
    unsquashed = replace(field, composition=PaperComposition(field.composition.gain))
    searched = {
        "guiding": field,
        "score": ScoreField(field),
        "tangent": TangentField(unsquashed),
    }
    function, scale = searched[part], field.mixture.sigma
    search = find_zeros(function, field.cloud.box, scale)
    turns = winding_number(function, box_corners(field.cloud.box), scale)
    assert search.indices.sum() == turns
    # Not those of a flat valley.
    dense = dense_zeros(function, field.cloud.box, cells=200, flat=1e-4)
    distance, _ = cKDTree(search.points).query(dense)
    assert distance.max(initial=0) < 1e-6
    assert search.undecided == 0
    residual = np.linalg.norm(function(search.points), axis=1)
    assert residual.max() < 1e-8


def test_cells_cover_a_box_and_split():
    box = (np.array([-1.0, 2.0]), np.array([2.0, 3.0]))
    cells = Cells.covering(box, 0.3)
    assert cells.side == pytest.approx(0.3)
    assert len(cells) == 10 * 4
    x = np.random.default_rng(0).uniform(*box, (200, 2))
    assert cells.contains(x).all()
    quarters = cells[cells.numbers[:, 0] == 3].quartered()
    assert len(quarters) == 16
    assert np.array_equal(quarters.contains(x), (x[:, 0] >= -0.1) & (x[:, 0] < 0.2))


def test_the_border_of_cells_leaves_holes_out():
    numbers = np.indices((5, 5)).reshape(2, -1).T
    ring = Cells(np.zeros(2), 1.0, numbers[np.abs(numbers - 2).max(axis=1) > 0])
    start, end = ring.border()
    assert len(start) == 20 + 4
    # By Green's theorem: the area on the left of the border.
    area = (start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]).sum() / 2
    assert area == pytest.approx(24)


def test_clusters_stay_apart_when_they_grow():
    numbers = np.array([[0, 0], [1, 1], [3, 3], [10, 0], [13, 0], [15, 2]])
    clusters = Cells(np.zeros(2), 1.0, numbers).clusters()
    assert sorted(len(cluster) for cluster in clusters) == [1, 2, 3]
    grown = np.concatenate([cluster.grown().numbers for cluster in clusters])
    assert len(np.unique(grown, axis=0)) == len(grown)
    assert Cells(np.zeros(2), 1.0, numbers[:0]).clusters() == []
