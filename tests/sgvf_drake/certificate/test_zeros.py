"""Lists of zeros that are proved: complete, of the right kinds, silent where they must be."""

from dataclasses import dataclass, replace
from itertools import product

import numpy as np
import pytest
from scipy.linalg import block_diag

from sgvf_drake.certificate import enclose_zeros
from sgvf_drake.certificate.boxes import Boxes, Division
from sgvf_drake.certificate.field_model import TAYLOR, model_field, simplify
from sgvf_drake.certificate.isolation import isolate
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import DualModel, TaylorModel
from sgvf_drake.certificate.zeros import (
    HALF_WIDTH,
    _distinct,
    _grid,
    _kinds,
    _Vanishing,
    proved_winding_number,
)
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import NormalisedComposition, Perceptron
from sgvf_drake.fields.activation import find_activation
from sgvf_drake.learning import TrainingConfig, train
from sgvf_drake.lyapunov import find_guiding_zeros, find_singularities, kind_of
from tests.fields import linear_network, tilted_circle

FULL, SLOWER = pytest.mark.full, [("paper", 5), ("exact", 4)]
TURN = np.array([[0.0, -1.0], [1.0, 0.0]])
# Squares of the first size have their corners there.
CORNER = np.array([-0.125, 0.875])


@pytest.fixture
def linear(make_field):
    """Makes fields whose tangent is matrix (z - point)."""

    def make(matrix, point=(0.3, -0.7)):
        matrix = np.asarray(matrix, float)
        network = Perceptron((matrix,), (-matrix @ np.asarray(point, float),))
        return replace(make_field("paper"), tangent_network=network)

    return make


@pytest.fixture
def parabola(make_field):
    """Makes fields whose tangent is (x tanh(x / 2) - height, y)."""

    def make(height):
        # SiLU(u) + SiLU(-u) = u tanh(u / 2), and SiLU(u) - SiLU(-u) = u.
        inner = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        outer = np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
        biases = (np.zeros(4), np.array([-height, 0.0]))
        return replace(make_field("paper"), tangent_network=Perceptron((inner, outer), biases))

    return make


@pytest.mark.parametrize(
    ("matrix", "known", "proved"),
    [
        (np.diag([1.0, 3.0]), ("source", False), None),
        (np.diag([-1.0, -3.0]), ("sink", True), None),
        (np.array([[0.0, 1.0], [1.0, 0.0]]), ("saddle", False), None),
        (np.diag([-1.0, 1e-3]), ("saddle", False), None),
        (TURN - 0.2 * np.eye(2), ("focus", True), None),
        (TURN + 0.2 * np.eye(2), ("focus", False), None),
        # Of these, any rounding makes something else.
        (TURN, ("centre", False), ("unknown", None)),
        (np.array([[-1.0, 1.0], [0.0, -1.0]]), ("sink", True), ("unknown", True)),
    ],
)
def test_the_zero_of_a_linear_field(linear, matrix, known, proved):
    """By the search, and by the proof: both tell it in the same words."""
    field, index = linear(matrix), int(np.sign(np.linalg.det(matrix)))
    place = field.cloud.denormalize([0.3, -0.7])
    found, list_of_zeros = find_singularities(field).tangent, enclose_zeros(field, "tangent")
    for zeros, expected in ((found, known), (list_of_zeros, proved or known)):
        (zero,) = zeros.zeros
        assert (zero.kind, zero.stable, zero.index) == (*expected, index)
        assert zeros.winding_number == zeros.index_sum == index
        assert zeros.undecided == 0
    (zero,) = found.zeros
    assert zero.field == "tangent"
    assert np.allclose(zero.point, place, atol=1e-12)
    assert zero.residual < 1e-12
    eigenvalues = np.linalg.eigvals(matrix) / field.cloud.unit_length
    found_values = np.sort_complex(zero.eigenvalues)
    assert np.allclose(found_values, np.sort_complex(eigenvalues), atol=1e-7)
    (zero,) = list_of_zeros.zeros
    assert (np.abs(zero.point - place) <= zero.radius).all()
    assert zero.radius < 1e-9
    for side, corner in zip((-1, 1), list_of_zeros.box, strict=True):
        assert (side * (corner - field.cloud.box[side > 0]) > 0).all()


def test_a_zero_in_the_corner_of_four_squares_is_one(linear):
    found = enclose_zeros(linear(np.diag([1.0, -2.0]), CORNER), "tangent")
    assert len(found.zeros) == 1
    assert found.complete


def test_the_border_of_what_is_searched(linear):
    inside, on, outside = (
        enclose_zeros(linear(TURN, (HALF_WIDTH + beyond, 1.3)), "tangent")
        for beyond in (-1e-3, 0.0, 1e-3)
    )
    assert (len(inside.zeros), inside.complete, inside.winding_number) == (1, True, 1)
    assert (len(outside.zeros), outside.complete, outside.winding_number) == (0, True, 0)
    assert (len(on.zeros), on.complete, on.winding_number) == (0, False, None)


def test_two_zeros_meet_and_vanish(parabola):
    found = enclose_zeros(parabola(5e-9), "tangent")
    assert sorted((zero.kind, zero.index) for zero in found.zeros) == [
        ("saddle", -1),
        ("source", 1),
    ]
    # x tanh(x / 2) is x^2 / 2 near zero.
    x = np.array([parabola(0.0).cloud.normalize(zero.point)[0] for zero in found.zeros])
    assert np.allclose(np.sort(x), [-1e-4, 1e-4], rtol=1e-6)
    gone, double = (enclose_zeros(parabola(height), "tangent") for height in (-5e-9, 0.0))
    assert gone.zeros == double.zeros == ()
    assert (found.complete, gone.complete, double.complete) == (True, True, False)
    # It is known from the border that the indices add up to zero.
    assert found.winding_number == gone.winding_number == double.winding_number == 0


def test_a_line_of_zeros_is_left_undecided(linear):
    found = enclose_zeros(linear([[1.0, 0.5], [1.0, 0.5]]), "tangent")
    assert found.zeros == ()
    assert found.undecided > 1_000
    assert found.winding_number is None


@pytest.mark.parametrize(
    ("recipe", "seed"),
    [("robust", 1), ("paper", 1), *(pytest.param(*c, marks=FULL) for c in SLOWER)],
)
def test_the_list_is_that_of_the_finder(make_field, recipe, seed):
    """And complete; otherwise what is only said of complete lists would say nothing."""
    field = make_field(recipe, seed=seed)
    proved, found = enclose_zeros(field), find_guiding_zeros(field)
    assert proved.complete
    lower, upper = field.cloud.box
    inside = [z for z in proved.zeros if (lower <= z.point).all() and (z.point <= upper).all()]
    assert len(inside) == len(found.zeros) > 0
    for zero in found.zeros:
        (same,) = (
            other
            for other in proved.zeros
            if np.abs(other.point - zero.point).max() <= other.radius + 1e-9
        )
        assert (same.index, same.kind, same.stable) == (zero.index, zero.kind, zero.stable)


def test_a_direction_has_the_zeros_of_the_sum(make_field):
    field = make_field("paper")
    unit = replace(field, composition=NormalisedComposition(field.composition.gain))
    zeros, same = (enclose_zeros(each).zeros for each in (field, unit))
    assert [zero.point.tolist() for zero in zeros] == [zero.point.tolist() for zero in same]
    assert [zero.kind for zero in zeros] == [zero.kind for zero in same]


@pytest.mark.parametrize("recipe", ["robust", "paper"])
def test_what_is_bounded_is_a_positive_multiple_of_m(make_field, recipe):
    field = make_field(recipe)
    points = Patches.points(np.random.default_rng(3).uniform(-5, 5, (50, 2)))
    S, N = TAYLOR.score_and_tangent(field, points)
    multiple, m = simplify(field.composition, S, N).value, model_field(field, points).value
    cross = multiple[:, 0] * m[:, 1] - multiple[:, 1] * m[:, 0]
    lengths = np.linalg.norm(multiple, axis=1) * np.linalg.norm(m, axis=1)
    assert np.abs(cross).max() < 1e-12 * lengths.max()
    assert ((multiple * m).sum(axis=1) > 0).all()


def test_directions_along_the_border_turn_by_the_winding_number():
    boxes = _grid(2.0, 0.125)
    # Any order of the squares, and what is inside, is the same.
    mixed = np.random.default_rng(0).permutation(len(boxes))
    shuffled = Boxes(boxes.centers[mixed], boxes.half[mixed])
    for power in (-3, -1, 1, 2, 5):
        w = (boxes.centers @ [1, 1j]) ** abs(power)
        directions = np.column_stack([w.real, np.sign(power) * w.imag])
        assert proved_winding_number(boxes, directions, 2.0) == power
        directions[np.abs(boxes.centers).max(axis=1) < 1.8] = np.nan
        assert proved_winding_number(shuffled, directions[mixed], 2.0) == power


def test_a_border_with_a_gap_or_a_jump_has_no_winding_number():
    boxes = _grid(2.0, 0.125)
    here = np.flatnonzero(boxes.centers[:, 0] + 0.125 == 2.0)[3]
    for entry in (np.full(2, np.nan), np.array([-1.0, -1e-3])):
        directions = np.tile([1.0, 0.0], (len(boxes), 1))
        directions[here] = entry
        assert proved_winding_number(boxes, directions, 2.0) is None
    directions[here] = [1.0, 0.0]
    assert proved_winding_number(boxes, directions, 2.0) == 0
    others = np.arange(len(boxes)) != here
    assert proved_winding_number(boxes[others], directions[others], 2.0) is None


def test_enclosures_of_one_zero_are_told_from_those_of_two():
    def count(first, second, radius):
        facts = np.full((2, 6), np.nan)
        facts[:, 2:4], facts[:, 4], facts[:, 5] = (first, second), radius, 1
        boxes = Boxes(np.array([[-1.0, 0.0], [1.0, 0.0]]), np.ones(2))
        found = Division(boxes, facts, 2, None, boxes[:0])
        zeros, ambiguous = _distinct(found)
        return len(zeros), ambiguous

    # The square of the first is enlarged to x = 0.25.
    assert count((0.1, 0.0), (0.1, 0.0), 1e-3) == (1, 0)
    assert count((0.1, 0.0), (0.3, 0.0), 1e-3) == (2, 0)
    assert count((0.1, 0.0), (0.3, 0.0), 0.12) == (1, 1)


@dataclass(frozen=True)
class Uncertain:
    """Functions that are d coordinates to within 0.01, and their slopes to within 0.9 / d."""

    def model(self, patches):
        position = TaylorModel.position(patches)
        return replace(position, remainder=position.remainder + 0.01)

    def dual(self, patches):
        slopes = DualModel.position(patches).slopes
        rough = [
            replace(slope, remainder=slope.remainder + 0.9 / len(slopes)) for slope in slopes
        ]
        return DualModel(self.model(patches), tuple(rough))


@pytest.mark.parametrize("dim", [2, 3])
def test_an_enclosure_reaches_as_far_as_its_bounds_allow_the_zero_to_be(dim):
    found = isolate(Uncertain(), Boxes(np.zeros((1, dim)), np.ones(1)), 0.0)
    assert found.is_one.tolist() == [True]
    assert found.index.tolist() == [1]
    # The farthest zero is that of the flattest of these functions.
    zero = np.linalg.solve(np.eye(dim) - 0.9 / dim, np.full(dim, 0.01))
    assert np.allclose(zero, 0.1)
    assert (np.abs(found.points - zero) <= found.radius).all()


def test_what_may_be_one_zero_or_two_leaves_the_list_open(linear, monkeypatch):
    name = "sgvf_drake.certificate.zeros._distinct"
    monkeypatch.setattr(name, lambda found: (_distinct(found)[0], 1))
    found = enclose_zeros(linear(TURN), "tangent")
    assert (len(found.zeros), found.undecided, found.complete) == (1, 1, False)


def test_what_nothing_bounds_is_refused(make_field):
    robust = make_field("robust")
    kinked = replace(
        robust,
        tangent_network=replace(robust.tangent_network, activation=find_activation("ReLU")),
    )
    for field in (kinked, make_field("robust", ends=1)):
        with pytest.raises(ConfigurationError, match="smooth fields of closed paths"):
            enclose_zeros(field)


@pytest.fixture
def coarse(monkeypatch):
    """First cubes so large that a field without a curve is done in no time."""
    monkeypatch.setattr("sgvf_drake.certificate.zeros.FIRST", HALF_WIDTH / 8)


SPIRAL = block_diag(TURN, 0.0)
MIX = np.array([[1.0, 0.4, 0.2], [-0.3, 1.0, 0.5], [0.1, -0.6, 1.0]])


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (np.diag([1.0, 2.0, 3.0]), ("source", False, 1)),
        (np.diag([-1.0, -2.0, -3.0]), ("sink", True, -1)),
        (np.diag([-1.0, -2.0, 3.0]), ("saddle", False, 1)),
        (np.diag([-1.0, 2.0, 3.0]), ("saddle", False, -1)),
        (SPIRAL - np.eye(3), ("focus", True, -1)),
        (SPIRAL + np.diag([0.1, 0.1, 2.0]), ("focus", False, 1)),
        (SPIRAL + np.diag([0.1, 0.1, -2.0]), ("saddle", False, -1)),
        # Rounding makes something else of what does not turn in or out.
        (SPIRAL + np.diag([0.0, 0.0, -2.0]), ("unknown", None, -1)),
    ],
)
def test_the_zero_of_a_linear_field_in_space(make_field, coarse, matrix, expected):
    z = np.array([0.3, -0.7, 1.1])
    network = linear_network(MIX @ matrix @ np.linalg.inv(MIX), z)
    field = replace(make_field("paper", dim=3), tangent_network=network)
    found = enclose_zeros(field, "tangent")
    (zero,) = found.zeros
    assert (zero.kind, zero.stable, zero.index) == expected
    assert (np.abs(zero.point - field.cloud.denormalize(z)) <= zero.radius).all()
    assert zero.radius < 1e-9
    assert found.complete
    assert found.winding_number is None
    assert found.points.shape == (1, 3)


@dataclass(frozen=True)
class Quadrics:
    """The functions x^2 - 1, y^2 + x / 2 - 4 and z^2 + 0.3 x y - 2, which have eight zeros."""

    def of(self, position):
        x, y, z = (position.functions(slice(k, k + 1)) for k in range(3))
        second = (y * y + x.scaled(0.5)).shifted(-4.0)
        third = (z * z + (x * y).scaled(0.3)).shifted(-2.0)
        return (x * x).shifted(-1.0).joined(second, third)

    def model(self, patches):
        return self.of(TaylorModel.position(patches))

    def dual(self, patches):
        return self.of(DualModel.position(patches))


def test_the_zeros_of_quadrics_in_space(coarse):
    found = _Vanishing(Quadrics(), HALF_WIDTH, 1e-15).prove(3)
    facts, ambiguous = _distinct(found)
    assert (len(found.undecided), ambiguous, len(facts)) == (0, 0, 8)
    for x, b, c in product((-1.0, 1.0), repeat=3):
        y = b * np.sqrt(4 - x / 2)
        zero = np.array([x, y, c * np.sqrt(2 - 0.3 * x * y)])
        (same,) = np.flatnonzero(np.abs(facts[:, 3:6] - zero).max(axis=1) <= facts[:, -2])
        assert facts[same, -1] == x * b * c
    # Where a direction is told, the functions point along it, in the corners and in between.
    told = ~np.isnan(found.facts[:, 0])
    boxes, u = found.boxes[told], found.facts[told, :3]
    for step in product((-1.0, 0.3, 1.0), repeat=3):
        points = Patches.points(boxes.centers + boxes.half[:, None] * step)
        assert ((Quadrics().model(points).value * u).sum(axis=1) > 0).all()


def test_kinds_in_space_are_those_that_eigenvalues_tell():
    J = np.random.default_rng(5).standard_normal((500, 3, 3))
    slopes = [TaylorModel(J[:, None, :, i].copy(), np.zeros((500, 3))) for i in range(3)]
    found = _kinds(DualModel(slopes[0], tuple(slopes)), np.sign(np.linalg.det(J)))
    kinds = [kind_of(matrix) for matrix in J]
    assert [kind for kind, _ in found] == kinds
    assert set(kinds) == {"source", "sink", "saddle", "focus"}
    largest = np.linalg.eigvals(J).real.max(axis=1)
    assert [stable for _, stable in found] == (largest < 0).tolist()


def test_what_would_need_too_many_cubes_is_left_undecided(make_field, coarse, monkeypatch):
    monkeypatch.setattr("sgvf_drake.certificate.zeros.MOST_CUBES", 5_000)
    # Zeros all along a line.
    network = linear_network(SPIRAL, np.zeros(3))
    field = replace(make_field("paper", dim=3), tangent_network=network)
    found = enclose_zeros(field, "tangent")
    assert found.boxes <= 5_000
    assert found.undecided > 0
    assert found.zeros == ()


@pytest.mark.full
def test_a_circle_in_space_has_one_zero():
    """At its centre, by symmetry; of a trained field close to it, and it is the one found."""
    exact = tilted_circle()[0]
    (zero,) = enclose_zeros(exact).zeros
    assert (np.abs(zero.point) <= zero.radius).all()
    assert (zero.kind, zero.index, zero.stable) == ("saddle", -1, False)
    field = train(exact.cloud, TrainingConfig(recipe="robust", seed=0)).field
    proved, found = enclose_zeros(field), find_guiding_zeros(field)
    assert proved.complete
    assert len(proved.zeros) == len(found.zeros) > 0
    for zero, same in zip(proved.zeros, found.zeros, strict=True):
        assert (np.abs(zero.point - same.point) <= zero.radius + 1e-9).all()
        assert (zero.index, zero.kind, zero.stable) == (same.index, same.kind, same.stable)
    # Both point inward on the border, where their indices add up to (-1)^3.
    assert proved.index_sum == -1
