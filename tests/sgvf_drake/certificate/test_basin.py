"""The basin: robots do what is proved of squares, and squares are what they are said to be."""

from dataclasses import replace
import itertools

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake import certify
from sgvf_drake.certificate import basin, find_basin, prove_basin
from sgvf_drake.certificate.basin import LEAST, MOST, _graphs, _Known, facts_of
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.cells import COUNT, DEPTH, HALF, ROOT, SIDES, UNIT, Cells
from sgvf_drake.certificate.fences import Fence, Fences
from tests.helpers import circle


def random_cells(seed, rounds=4, share=0.1):
    rng, cells = np.random.default_rng(seed), Cells.first()
    for _ in range(rounds):
        chosen = (rng.uniform(size=len(cells)) < share) & (cells.size > 1)
        cells = cells[~chosen].joined(cells[chosen].quarters())
    return cells


def in_order(cells):
    rows = np.column_stack([cells.corner, cells.size])
    return rows[np.lexsort(rows.T)]


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_squares_are_those_of_their_code(seed):
    cells = random_cells(seed)
    again = Cells.of(cells.code)
    np.testing.assert_array_equal(in_order(again), in_order(cells))
    assert again.code == cells.code


@pytest.mark.parametrize(
    "spoil", [lambda code: code[:-2], lambda code: code + "00", lambda _: "f0"]
)
def test_what_is_no_code(spoil):
    with pytest.raises(ValueError, match="not the code of a quadtree"):
        Cells.of(spoil(random_cells(0).code))


def test_squares_cover_the_box_once():
    cells = random_cells(1)
    whole = np.full(2, HALF)
    assert cells.areas_in(-whole, whole).sum() == pytest.approx((2 * HALF) ** 2, rel=1e-12)
    box = np.array([1.03, 2.5])
    assert cells.areas_in(-box, box).sum() == pytest.approx(4 * box.prod(), rel=1e-12)
    points = np.random.default_rng(2).uniform(-HALF, HALF, (300, 2))
    boxes = cells.boxes
    inside = (np.abs(points[:, None] - boxes.centers) < boxes.half[:, None]).all(axis=2)
    assert (inside.sum(axis=1) == 1).all()


@pytest.mark.parametrize(("axis", "sign"), SIDES)
def test_neighbours_share_the_whole_of_a_side(axis, sign):
    cells = random_cells(3, rounds=3, share=0.05)
    corner, size, other = cells.corner, cells.size, 1 - axis
    end = corner[:, axis] + np.where(sign > 0, size, 0)
    found = cells.neighbours(axis, sign)
    begin = corner[:, axis] + np.where(sign > 0, 0, size)
    for k in range(0, len(cells), 7):
        beside = begin == end[k]
        beside &= corner[:, other] < corner[k, other] + size[k]
        beside &= corner[:, other] + size > corner[k, other]
        others = np.flatnonzero(beside)
        if len(others) == 0:
            assert found[k] == -1
            assert end[k] in (0, COUNT * ROOT)
        elif len(others) == 1 and size[others[0]] >= size[k]:
            assert found[k] == others[0]
        else:
            assert found[k] == -2
            assert (size[others] < size[k]).all()


@pytest.fixture(scope="module")
def two_rings(make_ring):
    field, path = make_ring(1.6, 4.0)
    return field, path, certify(field, path)


def ends_of(field, starts, duration):
    """Where robots are after a time, all normalised; in one run."""

    def rate(_, z):
        return field(field.cloud.denormalize(z.reshape(-1, 2))).ravel()

    run = solve_ivp(rate, (0, duration), starts.ravel(), rtol=1e-6, atol=1e-8)
    return run.y[:, -1].reshape(-1, 2)


def between(walls, z):
    return np.any([one.hold(Boxes.points(z))[0] for one in walls if one is not None], axis=0)


def test_robots_from_proved_squares_come_between_walls(two_rings):
    field, _, found = two_rings
    basin = prove_basin(field, Cells.of(found.cells), found.walls, found.fences)
    assert basin.area == found.area_fraction > 0.95
    boxes = basin.cells.boxes
    rng = np.random.default_rng(0)
    chosen = rng.choice(np.flatnonzero(basin.comes), 400)
    steps = rng.uniform(-1, 1, (400, 2)) * boxes.half[chosen, None]
    assert between(found.walls, ends_of(field, boxes.centers[chosen] + steps, 20.0)).all()
    # Corners of proved squares, too, though they are of others as well.
    corners = boxes.centers[chosen] + boxes.half[chosen, None]
    assert between(found.walls, ends_of(field, corners, 20.0)).all()


def test_what_is_told_is_that_of_the_last_squares(ring, monkeypatch):
    """However often they are divided: no more rounds are counted on than the first here."""
    field, _, stored = ring
    monkeypatch.setattr(basin, "ROUNDS", 1)
    told = []
    found = find_basin(field, stored.walls, lambda *progress: told.append(progress))
    again = prove_basin(field, found.cells, stored.walls, found.fences)
    np.testing.assert_array_equal(found.comes, again.comes)
    assert (found.area, found.almost, found.excluded) == (
        again.area,
        again.almost,
        again.excluded,
    )
    assert len(told) > 3
    assert all(done <= total for _, done, total in told)


def test_what_is_excluded_holds_the_zeros(two_rings):
    field, _, found = two_rings
    # One at the centre, and a circle of places from where nobody knows, between the rings.
    assert np.linalg.norm(field(np.zeros((1, 2)))) < 1e-9
    basin = prove_basin(field, Cells.of(found.cells), found.walls, found.fences)
    boxes = basin.cells.boxes
    at_centre = (np.abs(boxes.centers) <= boxes.half[:, None]).all(axis=1)
    assert at_centre.any()
    assert not basin.comes[at_centre].any()
    assert found.almost_fraction >= found.area_fraction
    assert sum(one.area for one in found.excluded) <= 1 - found.area_fraction + 1e-9


def test_a_ring_without_walls_is_no_goal(two_rings, monkeypatch):
    """Robots that go round the other ring for ever come to nothing that is proved."""
    # Squares as fine as elsewhere would only add to the area.
    monkeypatch.setattr("sgvf_drake.certificate.basin.MOST_AT_ONCE", 3_000)
    field, _, found = two_rings
    inner = [found.walls[0]]
    basin = find_basin(field, inner)
    assert 0.02 < basin.area < 0.35
    boxes = basin.cells.boxes
    distance = np.linalg.norm(boxes.centers[basin.comes], axis=1)
    assert distance.max() < 3.0
    rng = np.random.default_rng(1)
    starts = boxes.centers[rng.choice(np.flatnonzero(basin.comes), 100)]
    assert between(inner, ends_of(field, starts, 20.0)).all()


def test_nobody_comes_between_walls_where_there_are_none(ring):
    """Robots stay at the ring, or leave the box; a fence that they cross inward is no help."""
    field, _, stored = ring
    cells = Cells.of(stored.cells)
    fleeing = replace(field, composition=replace(field.composition, gain=-1.0))
    around = Fence.through(circle(4.5, 80))
    for guiding, fences in ((field, []), (fleeing, []), (field, [around])):
        assert not prove_basin(guiding, cells, [], fences).comes.any()


def test_orbits_are_walks_on_the_graph(two_rings):
    field, _, found = two_rings
    cells = Cells.of(found.cells)
    known = _Known.of(field, cells, found.walls, Fences(()))
    graph = _graphs(field, known, Fences(())).outside
    order = {
        (*corner, size): k
        for k, (corner, size) in enumerate(
            zip(cells.corner.tolist(), cells.size.tolist(), strict=True)
        )
    }

    def cell_of(z):
        place = np.floor((z + HALF) / UNIT).astype(int)
        for depth in range(DEPTH + 1):
            size = 2**depth
            number = order.get((*(place // size * size).tolist(), size))
            if number is not None:
                return number
        raise AssertionError(z)

    def rate(_, z):
        return field(field.cloud.denormalize(z.reshape(-1, 2))).ravel()

    starts = np.random.default_rng(3).uniform(-4.9, 4.9, (40, 2))
    times = np.arange(0, 3, 2e-3)
    run = solve_ivp(rate, times[[0, -1]], starts.ravel(), t_eval=times, rtol=1e-6)
    after, boxes, steps = graph.after.todok(), cells.boxes, 0
    for orbit in run.y.T.reshape(len(times), -1, 2).swapaxes(0, 1):
        for before, now in itertools.pairwise(map(cell_of, orbit)):
            reach = boxes.half[[before, now]].sum()
            shared = reach - np.abs(boxes.centers[now] - boxes.centers[before]) > 1e-9
            # Through a corner an orbit passes two sides at once, and in the goal it may go on.
            if before != now and shared.any() and not known.goal[before]:
                assert after[before, now] == 1
                steps += 1
    assert steps > 100


def test_facts_of_squares_hold_the_field(robust_field):
    """m itself is a positive multiple of what is bounded: of the same signs."""
    cells = random_cells(4, rounds=5, share=0.3)
    rng = np.random.default_rng(5)
    boxes = cells.boxes
    chosen = rng.choice(len(cells), 400, replace=False)
    some = Boxes(boxes.centers[chosen], boxes.half[chosen])
    facts = facts_of(robust_field, some)
    least, most = facts[:, LEAST], facts[:, MOST]
    for k, (axis, sign) in enumerate(SIDES):
        z = some.centers[:, None] + some.half[:, None, None] * rng.uniform(-1, 1, (400, 20, 2))
        z[..., axis] = (some.centers[:, axis] + sign * some.half)[:, None]
        m = robust_field(robust_field.cloud.denormalize(z.reshape(-1, 2))).reshape(z.shape)
        positive, negative = least[:, k] > 0, most[:, k] < 0
        assert (m[positive][..., axis] > 0).all()
        assert (m[negative][..., axis] < 0).all()
        assert min(positive.sum(), negative.sum()) > 50
