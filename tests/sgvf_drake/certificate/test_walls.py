"""Walls: robots between them come to the tube in time, and stay there under disturbances."""

from dataclasses import replace

from matplotlib.path import Path
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.certificate import find_tube, prove_walls
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.tube import LARGEST
from sgvf_drake.certificate.tube_cells import Parts
from sgvf_drake.certificate.walls import Walls
from tests.helpers import circle


@pytest.fixture(scope="module")
def trained(robust_field):
    """A trained field, and what is found around one of its circles."""
    points = robust_field.cloud.normalize(circle(2.0, 80))
    return robust_field, find_tube(robust_field, points, closed=True)


def tube_walls(tube):
    rows = tube.rows[:-1]
    return {side: rows[:, 0] + side * rows[:, 1] for side in (1, -1)}


def normals_inward(polygon, side):
    """Unit normals of the sides of a polygon towards the tube."""
    along = np.roll(polygon, -1, axis=0) - polygon
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return side * np.column_stack([along[:, 1], -along[:, 0]])


def m_of(field, z):
    return field(field.cloud.denormalize(z.reshape(-1, 2))).reshape(z.shape)


def test_walls_are_found_at_every_angle_and_m_crosses_them_as_is_told(trained):
    field, found = trained
    proof = found.walls_proof
    assert len(found.walls) == proof.proved == 5
    assert list(proof.e_star) == sorted(proof.e_star)
    share = np.linspace(0, 1, 9)[:, None, None]
    for side in (1, -1):
        for polygon, told in zip(found.walls.polygons(side), proof.e_star, strict=True):
            z = (1 - share) * polygon + share * np.roll(polygon, -1, axis=0)
            inward = (m_of(field, z) * normals_inward(polygon, side)).sum(axis=2)
            assert told <= inward.min()
    # The angles are 0.15 to 1.2 rad; walls turn by less than half of them on the way.
    assert np.sin(0.07) < proof.e_star[0] < np.sin(0.15)
    assert np.sin(0.9) < proof.e_star[-1] < np.sin(1.2)


def test_robots_between_walls_come_to_the_tube_in_time(trained):
    field, found = trained
    inner = tube_walls(found.tube)
    rng = np.random.default_rng(0)
    for pair, time in enumerate(found.walls_proof.entry_times):
        for side in (1, -1):
            wall = found.walls.polygons(side)[pair]
            for start in wall[rng.choice(len(wall), 5)]:
                run = solve_ivp(lambda _, z: m_of(field, z), (0, time), start, rtol=1e-9)
                end = run.y[:, -1:].T
                assert Path(inner[-1]).contains_points(end) != Path(inner[1]).contains_points(
                    end
                )


@pytest.mark.parametrize("pair", [0, 2, 4])
def test_robots_stay_between_walls_under_what_these_tolerate(trained, pair):
    """Blown outward as hard as that at every place, and not much harder."""
    field, found = trained
    walls, e_star = found.walls[: pair + 1], found.walls_proof.e_star[pair]

    def ends(strength):
        def rate(_, z):
            radius = np.linalg.norm(z)
            return m_of(field, z) + strength * np.sign(radius - 2.0) * z / radius

        starts = np.concatenate([walls.polygons(side)[-1][::20] for side in (1, -1)])
        runs = [solve_ivp(rate, (0, 3.0), start, rtol=1e-7) for start in starts]
        return np.array([run.y[:, -1] for run in runs])

    held = walls.hold(Boxes.points(ends(0.99 * e_star)))[0]
    assert held.all()
    if pair < 4:
        assert not walls.hold(Boxes.points(ends(2.0 * e_star)))[0].all()


def test_squares_between_walls_are_those_that_matplotlib_says(trained):
    walls = trained[1].walls
    rng = np.random.default_rng(1)
    angle, radius = rng.uniform(0, 2 * np.pi, 3000), rng.normal(2.0, 0.2, 3000)
    centers = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    boxes = Boxes(centers, rng.uniform(0.0, 0.03, 3000))
    held, apart = walls.hold(boxes)
    left, right = (Path(walls.polygons(side)[-1], closed=False) for side in (1, -1))
    steps = np.stack(np.meshgrid(*[np.linspace(-1, 1, 7)] * 2), axis=-1).reshape(-1, 2)
    grid = (centers[:, None] + boxes.half[:, None, None] * steps).reshape(-1, 2)
    inside = right.contains_points(grid) & ~left.contains_points(grid)
    inside = inside.reshape(len(boxes), -1)
    assert inside[held].all()
    assert not inside[apart].any()
    # Those that a wall may pass through have both, but for what 49 points do not see.
    mixed = inside.any(axis=1) & ~inside.all(axis=1)
    assert not (mixed & (held | apart)).any()
    assert (~held & ~apart).sum() < 1.2 * mixed.sum()
    assert min(held.sum(), apart.sum(), mixed.sum()) > 300


def test_the_distance_between_walls_is_that_of_circles(trained):
    walls = trained[1].walls
    radii = [np.linalg.norm(walls.polygons(side)[-1], axis=1) for side in (1, -1)]
    assert walls.narrowest <= radii[1].max() - radii[0].min()
    assert walls.narrowest == pytest.approx(np.mean(radii[1]) - np.mean(radii[0]), rel=0.1)
    widths = walls.half_widths(trained[1].tube)
    assert widths == sorted(widths)
    assert widths[-1] < 0.2


def test_no_walls_are_proved_of_another_field(trained):
    field, found = trained
    away = replace(field, composition=replace(field.composition, gain=-field.composition.gain))
    assert prove_walls(away, found.tube, found.walls).proved == 0
    # Nor if only one of them is beyond the one before.
    crossed = replace(found.walls, left=found.walls.left[::-1])
    assert prove_walls(field, found.tube, crossed).proved < 2


def test_halves_of_cells_cover_them_and_are_the_same_map():
    rows = np.array([[[0.0, 0.0], [0.0, 1.0]], [[0.5, 0.1], [0.1, 0.8]]])
    whole = Parts(rows[:1], rows[1:], np.array([0]))
    halves = whole.longer_halves().longer_halves()
    assert len(halves) == 4

    def area(parts):
        corners = [parts.start[:, 0] - parts.start[:, 1], parts.end[:, 0] - parts.end[:, 1]]
        corners += [parts.end[:, 0] + parts.end[:, 1], parts.start[:, 0] + parts.start[:, 1]]
        x, y = np.moveaxis(np.array(corners), 2, 0)
        return (x * np.roll(y, -1, axis=0) - y * np.roll(x, -1, axis=0)).sum(axis=0) / 2

    assert area(halves).sum() == pytest.approx(area(whole)[0])
    assert (area(halves) > 0).all()
    # The first halving is across, since the cell is wider than long.
    across = whole.longer_halves()
    np.testing.assert_array_equal(across.start[:, 1], [[0, 0.5], [0, 0.5]])


@pytest.mark.parametrize(
    ("left", "right", "message"),
    [
        ((((0, 0), (1, 0)),), (), "1 walls on the left and 0 right"),
        ((((0, 0.5), (1, 0)),), (((0, 0), (1, 0)),), "whole numbers"),
        ((((0, 2 * LARGEST), (1, 0)),), (((0, 0), (1, 0)),), "up to"),
    ],
)
def test_what_are_no_walls(left, right, message):
    with pytest.raises(ValueError, match=message):
        Walls(left, right)


def test_walls_are_those_of_a_closed_tube_with_as_many_sections(trained):
    field, found = trained
    fewer = replace(found.tube, sections=found.tube.sections[::2])
    for tube in (fewer, replace(found.tube, closed=False)):
        with pytest.raises(ValueError, match="a vertex for each section of a closed tube"):
            prove_walls(field, tube, found.walls)
