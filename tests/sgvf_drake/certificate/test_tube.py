"""Tubes around orbits in the plane and in space, seen from outside of their proof."""

from dataclasses import asdict, replace
from itertools import product
import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.certificate.trajectories import closed_orbit
from sgvf_drake.certificate.tube import (
    LARGEST,
    TICK,
    Tube,
    _contraction,
    _ends_in_rest,
    _passes_once,
    normal,
    prove_tube,
)
from sgvf_drake.certificate.tube_search import find_tube
from tests.fields import exact_field, linear_network
from tests.helpers import circle

# A quarter turn about an axis of space, and the circles that it leaves as they are.
AXIS = np.array([1.0, 2.0, 2.0]) / 3
SPIN = np.array([[0, -AXIS[2], AXIS[1]], [AXIS[2], 0, -AXIS[0]], [-AXIS[1], AXIS[0], 0]])
ACROSS = np.linalg.svd(AXIS[None])[2][1:]


def found_in(field, points, closed):
    found = find_tube(field, field.cloud.normalize(points), closed=closed)
    assert found is not None
    return field, found


@pytest.fixture(scope="module")
def planar(ring):
    return found_in(ring[0], circle(4.0, 80), closed=True)


@pytest.fixture(scope="module")
def spatial():
    points = circle(4.0, 80) @ ACROSS
    field = exact_field(points, linear_network(SPIN, np.zeros(3)), sigma=0.4, gain=0.8)
    return found_in(field, points[:: 1 if np.linalg.det([*ACROSS, AXIS]) > 0 else -1], True)


@pytest.fixture(scope="module")
def trained(robust_field):
    return found_in(robust_field, circle(2.0, 80), closed=True)


@pytest.fixture(scope="module")
def resting(half_circle_field):
    return found_in(half_circle_field, half_circle_field.path.pieces[0].vertices, closed=False)


@pytest.fixture(params=["planar", "spatial", "trained", "resting"])
def case(request):
    return request.getfixturevalue(request.param)


def points_of(rows, s):
    """The points of sections (K, d, d) at coordinates s (n, d - 1), (K, n, d)."""
    return rows[:, :1] + s @ rows[:, 1:]


def coordinates(section, z):
    """The coordinates of a point along the normal of a section, and in it."""
    across = np.linalg.svd(section[1:])[2][-1]
    across *= np.sign(np.linalg.det([across, *section[1:]]))
    return np.linalg.solve(np.column_stack([across, *section[1:]]), z - section[0])


def arrivals(field, section, starts, bounds):
    """The times between bounds at which orbits pass a section, (n,), and where, (n, d - 1)."""

    def rate(_, z):
        return field(field.cloud.denormalize(z.reshape(starts.shape))).ravel()

    run = solve_ivp(
        rate, (0, bounds[1]), starts.ravel(), "DOP853", dense_output=True, rtol=1e-8, atol=1e-9
    )

    def place(t, k):
        return coordinates(section, run.sol(t).reshape(starts.shape)[k])

    # Raises an error unless the section is passed in between.
    times = [brentq(lambda t, k: place(t, k)[0], *bounds, k) for k in range(len(starts))]
    return times, np.array([place(t, k)[1:] for k, t in enumerate(times)])


def test_orbits_from_the_first_section_pass_the_last_in_the_time_that_is_proved(case):
    field, found = case
    proof, rows = found.proof, found.tube.rows
    assert proof.proved
    assert not proof.weak.any()
    assert proof.spread <= 0.02
    corners = np.array(list(product((-1.0, 1.0), repeat=field.dim - 1)))
    starts = points_of(rows[:1], corners)[0]
    _, places = arrivals(field, rows[-1], starts, (proof.time_low, proof.time_high))
    assert np.abs(places).max() < 1
    if found.tube.closed:
        assert proof.once
        assert proof.unique
        assert np.ptp(places, axis=0).max() < 1e-3


def test_m_points_inward_on_the_walls(case):
    """By the field itself, at points of F and with normals by differences of F."""
    field, found = case
    rows, rng = found.tube.rows, np.random.default_rng(1)
    start, end = rows[:-1], rows[1:]
    for column, side in product(range(field.dim - 1), (-1.0, 1.0)):
        s = rng.uniform(-1, 1, (10, field.dim - 1))
        s[:, column] = side
        share = rng.uniform(0, 1, (10, 1))
        z = (1 - share) * points_of(start, s) + share * points_of(end, s)
        along = points_of(end, s) - points_of(start, s)
        columns = [
            (1 - share) * start[:, 1 + k, None] + share * end[:, 1 + k, None]
            for k in range(field.dim - 1)
        ]
        frame = np.stack([along, *columns], axis=-1)
        m = field(field.cloud.denormalize(z.reshape(-1, field.dim))).reshape(z.shape)
        assert (np.linalg.det(frame) > 0).all()
        rates = np.linalg.solve(frame, m[..., None])[..., 0]
        assert (rates[..., 0] > 0).all()
        assert (side * rates[..., 1 + column] < 0).all()


@pytest.mark.parametrize("name", ["planar", "spatial", "trained"])
def test_the_contraction_is_no_stronger_than_on_the_orbit(name, request):
    """The bound of the integral over a lap, beside the integral along the orbit itself."""
    field, found = request.getfixturevalue(name)
    orbit = closed_orbit(field, found.tube.rows[0, 0], found.proof.time_high)
    times = np.linspace(0, orbit.duration, 4001)
    m, J = field.value_and_jacobian(field.cloud.denormalize(orbit.at(times).T))
    J *= field.cloud.unit_length
    rates = np.trace(J, 0, 1, 2)
    if field.dim == 3:
        E = np.linalg.svd(m[:, None])[2][:, 1:].swapaxes(1, 2)
        rates = np.linalg.eigvalsh(E.swapaxes(1, 2) @ (J + J.swapaxes(1, 2)) @ E)[:, -1] / 2
    assert np.trapezoid(rates, times) < found.proof.contraction < 0


def test_the_rate_of_a_rotation_is_told_by_the_lap(planar):
    """The field turns with |m| about one on a circle of radius 4 normalised units."""
    proof = planar[1].proof
    assert proof.time_low < 8 * np.pi < proof.time_high


def test_an_open_tube_ends_where_the_vehicle_rests(resting):
    field, found = resting
    tube, ball = found.tube, found.tube.rest
    assert not tube.closed
    assert not found.proof.unique
    corners = points_of(tube.rows[-1:], np.array([[-1.0], [1.0]]))[0]
    assert (np.linalg.norm(corners - ball.center, axis=1) < ball.radius).all()
    outside = replace(tube, rest=replace(ball, radius=0.5 * found.tube.half_width))
    assert not prove_tube(field, outside).proved
    assert prove_tube(field, replace(tube, rest=None)).proved


def test_a_tube_is_proved_anew_from_its_json(case):
    field, found = case
    again = Tube.of(json.loads(json.dumps(asdict(found.tube))))
    assert again == found.tube
    proof = prove_tube(field, again)
    assert proof.proved
    assert (proof.time_low, proof.time_high) == (found.proof.time_low, found.proof.time_high)


def spoiled(tube, change):
    rows = np.array(tube.sections)
    change(rows)
    return replace(tube, sections=tuple(tuple(map(tuple, row)) for row in rows.tolist()))


def narrow(rows):
    rows[7, 1] *= -1


def flat(rows):
    rows[7, 1] = 0


def shifted(rows):
    rows[7, 0] += 3 * rows[7, 1]


def wide(rows):
    rows[:, 1:] *= 260


def shrunk(rows):
    """The walls close in so fast at one section that m does not follow them."""
    rows[7, 1:] //= 20


@pytest.mark.parametrize("change", [narrow, flat, shifted, wide, shrunk])
def test_what_is_no_tube_is_refused(case, change):
    field, found = case
    proof = prove_tube(field, spoiled(found.tube, change))
    assert not proof.proved
    assert not proof.unique
    assert proof.contraction is None
    assert np.isnan([proof.time_low, proof.time_high]).all()
    assert proof.weak.any()


def test_a_removed_section_is_refused(case):
    field, found = case
    sections = found.tube.sections
    proof = prove_tube(field, replace(found.tube, sections=sections[:9] + sections[14:]))
    assert not proof.proved
    assert proof.weak[8]
    assert proof.weak.sum() == 1


def test_a_chain_against_the_field_is_refused(case):
    field, found = case
    proof = prove_tube(
        field, replace(found.tube, sections=found.tube.sections[::-1], rest=None)
    )
    assert proof.weak.all()


def test_a_rest_on_the_path_is_no_part_of_a_closed_tube(resting):
    """The chain goes on through the place of rest, straight ahead."""
    field, found = resting
    rows = found.tube.rows
    onward = rows[-1, 0] - rows[-2, 0]
    onward *= 0.01 / np.linalg.norm(onward)
    more = np.repeat(rows[-1:], 8, axis=0)
    more[:, 0] += np.arange(1, 9)[:, None] * onward
    rows = np.concatenate([rows, more])
    tube = Tube.around(rows[:, 0], rows[:, 1:].swapaxes(1, 2), closed=False)
    proof = prove_tube(field, tube)
    assert not proof.proved
    assert not proof.weak[: len(found.tube.sections) - 2].any()


def test_a_tube_of_another_space_is_an_error(planar, spatial):
    with pytest.raises(ValueError, match="a tube in 3-D is none of a field in 2-D"):
        prove_tube(planar[0], spatial[1].tube)


def test_a_chain_of_two_laps_is_told(planar):
    """Its closed orbit is the same, but passes the first section twice."""
    field, found = planar
    twice = prove_tube(field, replace(found.tube, sections=2 * found.tube.sections))
    assert twice.unique
    assert not twice.once
    assert twice.time_low == pytest.approx(2 * found.proof.time_low, rel=1e-10)


@pytest.mark.parametrize(
    ("sections", "once"),
    [
        ([(1, 0), (3, 5), (-3, 5), (-1, 0)], True),
        # The second cell comes back over the first section.
        ([(1, 0), (-1, 0), (-2, 0)], False),
        # A later one does.
        ([(1, 0), (3, 5), (-3, 5), (-1, 0), (1, 0), (3, 5), (-3, 5), (-1, 0)], False),
        # What follows the first section, or comes before it, is on both of its sides.
        ([(1, 3, 1.5, 1), (3, 5), (-3, 5), (-1, 0)], False),
        ([(1, 0), (3, 5), (-3, 5), (-1, 3, 1.5, 1)], False),
    ],
)
def test_cells_that_touch_the_first_section_again_are_told(sections, once):
    """The first section is from (0, -1) to (0, 1), and the others are like it but for two."""
    chain = [(0, 0), *sections, (0, 0)]
    rows = [[section[:2], section[2:] or (0, 1)] for section in chain]
    assert _passes_once(np.array(rows, float)) is once


def test_the_last_section_is_in_the_ball_with_its_corners(resting):
    field, found = resting
    ball, rows = found.tube.rest, found.tube.rows.copy()
    rows[-1, 0] = ball.center
    side = rows[-1, 1] / np.linalg.norm(rows[-1, 1])
    for half, inside in ((0.9 * ball.radius, True), (1.1 * ball.radius, False)):
        rows[-1, 1] = half * side
        tube = Tube.around(rows[:, 0], rows[:, 1:].swapaxes(1, 2), closed=False, rest=ball)
        assert _ends_in_rest(field, tube) is inside


def test_contraction_counts_for_the_shortest_time_and_its_opposite_for_the_longest(planar):
    field, found = planar
    cells = found.tube.cells

    def bound(field, *times):
        return _contraction(field, cells, np.tile(times, (len(cells), 1)))[0]

    assert bound(field, 0.1, 0.3) == pytest.approx(bound(field, 0.1, 0.1))
    assert bound(field, 0.1, 0.1) < 0
    spreading = replace(field, composition=replace(field.composition, gain=-1.0))
    assert bound(spreading, 0.1, 0.3) == pytest.approx(bound(spreading, 0.3, 0.3))
    assert bound(spreading, 0.1, 0.3) > 0


def test_a_field_that_spreads_has_no_tube_and_contracts_nothing(planar):
    field, found = planar
    backward = replace(field, composition=replace(field.composition, gain=-1.0))
    assert find_tube(backward, circle(4.0, 80), closed=True) is None
    assert prove_tube(backward, found.tube).weak.all()


def test_an_orbit_that_does_not_close_has_no_tube(open_field):
    points = open_field.cloud.normalize(open_field.path.pieces[0].vertices)
    assert find_tube(open_field, points, closed=True) is None


def test_an_orbit_that_stops_on_the_path_has_no_tube(paper_field):
    """Fields of the paper's recipe may: on the inner circle this one has a sink."""
    assert find_tube(paper_field, circle(2.0, 80), closed=True) is None
    assert find_tube(paper_field, circle(4.0, 80), closed=True).proof.unique


def test_a_path_without_an_end_does_not_rest(ring):
    assert find_tube(ring[0], circle(4.0, 80), closed=False) is None


@pytest.mark.parametrize("dim", [2, 3, 4])
def test_a_normal_is_that_of_the_determinant(dim):
    rng = np.random.default_rng(dim)
    columns, x = rng.normal(size=(dim - 1, 5, dim)), rng.normal(size=(5, dim))
    models = [TaylorModel.position(Patches.points(column)) for column in columns]
    found = normal(models).weighted(x)
    matrices = np.stack([x, *columns], axis=2)
    expected = np.linalg.det(matrices)[:, None]
    assert ((found.lower <= expected + 1e-12) & (expected - 1e-12 <= found.upper)).all()
    assert (found.upper - found.lower < 1e-9).all()


def body():
    return {"sections": [[[k, 0], [0, 5]] for k in range(4)], "closed": False, "rest": None}


@pytest.mark.parametrize(
    ("key", "value", "error"),
    [
        ("closed", 1, TypeError),
        ("sections", [[[0, 0], [0, 1]]] * 2, ValueError),
        ("sections", [[[0, 0], [0, 1.0]]] * 3, ValueError),
        ("sections", [[[True, True], [True, True]]] * 3, ValueError),
        ("sections", [[[0, 0], [0, "1"]]] * 3, ValueError),
        ("sections", [[[0, 0], [0, -(2**63)]]] * 3, ValueError),
        ("sections", [[[0, 0], [0, 2**70]]] * 3, ValueError),
        ("sections", 3, TypeError),
        ("sections", [[[0, 0], [0, LARGEST + 1]]] * 3, ValueError),
        ("sections", [[[0, 0]]] * 3, ValueError),
        ("sections", [[[0, 0], [0, 1]], [[0, 0]], [[0, 0], [0, 1]]], ValueError),
        ("sections", [[[0], [1]]] * 3, ValueError),
        ("rest", {"center": [0, 0], "radius": 0}, ValueError),
        ("rest", {"center": [0, float("nan")], "radius": 1}, ValueError),
        ("rest", {"center": [0, 0, 0], "radius": 1}, ValueError),
        ("rest", 3, TypeError),
    ],
)
def test_what_is_not_the_object_of_a_tube_is_refused(key, value, error):
    assert Tube.of(body()).rows[3, 0, 0] == 3 * TICK
    with pytest.raises(error):
        Tube.of({**body(), key: value})
    with pytest.raises(KeyError):
        Tube.of({name: value for name, value in body().items() if name != key})
