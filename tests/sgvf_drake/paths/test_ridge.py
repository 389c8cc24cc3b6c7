"""The ridge and the holes of clouds for which both are known in closed form."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ive
from scipy.stats import special_ortho_group

from sgvf_drake.paths.loops import find_holes
from sgvf_drake.paths.ridge import climb, find_ridge, thin
from tests.helpers import circle


@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.6])
def test_the_ridge_of_a_circle(sigma):
    """Its density is exp(-(r^2 + R^2) / 2 sigma^2) I0(r R / sigma^2), with a ridge inside."""
    points = circle(2.0, 720)

    def radial_score(r):
        return 2 * ive(1, 2 * r / sigma**2) / ive(0, 2 * r / sigma**2) - r

    expected = brentq(radial_score, 1.0, 2.0)
    starts = np.concatenate([circle(1.7, 5), circle(2.3, 7)])
    reached, _ = climb(starts, points, np.ones(720), sigma)
    np.testing.assert_allclose(np.linalg.norm(reached, axis=1), expected, atol=0.01 * sigma)
    # Points climb across the ridge, and not along it.
    np.testing.assert_allclose(
        reached / np.linalg.norm(reached, axis=1, keepdims=True),
        starts / np.linalg.norm(starts, axis=1, keepdims=True),
        atol=0.02,
    )


def test_points_climb_across_a_line_that_grows_denser():
    x = np.linspace(-4, 4, 400)
    line = np.column_stack([x, np.zeros(400)])
    starts = np.column_stack([np.linspace(-2, 2, 9), np.full(9, 0.2)])
    reached, _ = climb(starts, line, np.exp(x), 0.3)
    np.testing.assert_allclose(reached, starts * [1, 0], atol=1e-9)


def test_the_ridge_of_a_line_in_space_is_the_line():
    rotation = special_ortho_group.rvs(3, random_state=0)
    along = np.linspace(-4, 4, 200)
    rng = np.random.default_rng(1)
    offsets = rng.normal(0, 0.1, (200, 2))
    # Each point and its mirror image: the density is symmetric about the line.
    local = np.concatenate([np.column_stack([along, sign * offsets]) for sign in (1.0, -1.0)])
    ridge = find_ridge(local @ rotation.T, np.ones(400), 0.3) @ rotation
    inner = ridge[np.abs(ridge[:, 0]) < 3.5]
    assert len(inner) > 30
    assert np.abs(inner[:, 1:]).max() < 0.03


def test_thinning_keeps_weight_and_centre():
    points = np.random.default_rng(0).normal(size=(500, 3))
    weights = np.random.default_rng(1).uniform(1, 2, 500)
    means, total = thin(points, weights, 0.5)
    assert len(means) < 500
    assert total.sum() == pytest.approx(weights.sum())
    np.testing.assert_allclose(total @ means, weights @ points)


def test_strays_are_no_part_of_the_ridge():
    points = np.concatenate([circle(3.0, 1200), [[0.0, 0.5], [4.5, 4.5]]])
    ridge = find_ridge(points, np.ones(1202), 0.2)
    assert np.abs(np.linalg.norm(ridge, axis=1) - 3).max() < 0.1


@pytest.mark.parametrize("corners", [5, 12, 101])
def test_the_hole_of_a_polygon(corners):
    """It is closed by discs of half a side, and filled by those of the circle's radius."""
    holes = find_holes(circle(3.0, corners))
    k = int(np.argmax(holes.death / holes.birth))
    assert holes.death[k] == pytest.approx(3.0)
    assert holes.birth[k] == pytest.approx(3 * np.sin(np.pi / corners))


def test_loops_depend_on_the_scale():
    """Of a bay with a throat .2 wide there is none at a fine scale, and one at a coarse one."""
    angle = np.linspace(0.05, 2 * np.pi - 0.05, 400)
    bay = 2 * np.column_stack([np.cos(angle), np.sin(angle)])
    holes = find_holes(bay)
    throat = np.linalg.norm(bay[0] - bay[-1])
    assert holes.loops(0.4 * throat, reach=0.0) == 0
    assert holes.loops(0.6 * throat, reach=0.0) == 1
    # A gap that is bridged is none.
    assert holes.loops(0.1 * throat, reach=1.1 * throat) == 1
    # At a scale as wide as the bay it is filled.
    assert holes.loops(2.1, reach=0.0) == 0
