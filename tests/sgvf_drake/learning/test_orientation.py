"""The hint of the direction of travel: along the path, with one sign on every piece."""

from itertools import product

import numpy as np
import pytest

from sgvf_drake.learning.orientation import orientation_hint
from sgvf_drake.learning.scales import cloud_scales
from sgvf_drake.learning.support import find_support
from sgvf_drake.paths import make_shape, reverse, trace_pieces


def hint_of(points, width=None):
    pieces = trace_pieces(points)
    if width is None:
        scales = cloud_scales(points, pieces)
        width = max(scales.fine_sigma, scales.coarse_sigma)
    return orientation_hint(points, pieces, width)


def travel(path, points, reach):
    """Direction of the true path at the nearest point: its chord over +-`reach`, (N, d)."""
    projection = path.project(points)
    chords = np.empty_like(points)
    for number, piece in enumerate(path.pieces):
        rows = projection.piece == number
        arc = projection.arc[rows]
        chords[rows] = piece.at((arc + reach) % piece.length) - piece.at(
            (arc - reach) % piece.length
        )
    return chords / np.linalg.norm(chords, axis=1, keepdims=True)


def angles(hint, direction):
    """Degrees between the hint and the true direction."""
    return np.degrees(np.arccos(np.clip((hint * direction).sum(axis=1), -1, 1)))


@pytest.mark.parametrize("name", ["circle", "concentric-circles", "separated-circles"])
def test_every_circle_is_hinted_counter_clockwise(name):
    for sampling, noise, typical, worst in (
        ("uniform", 0.0, 0.1, 0.1),
        # One-sided neighbours lean by up to a kernel's reach over the diameter.
        ("random", 0.0, 3.0, 10.0),
        # Noise of up to .067 across chords of .2, over a handful of them; none opposes.
        ("random", 0.05, 15.0, 90.0),
    ):
        for seed in range(3):
            cloud, path = make_shape(name, sampling=sampling, noise=noise, seed=seed)
            hint = hint_of(cloud.normalize(cloud.points))
            np.testing.assert_allclose(np.linalg.norm(hint, axis=1), 1, rtol=1e-12)
            centers = np.array([piece.vertices.mean(axis=0) for piece in path.pieces])
            radial = cloud.points - centers[path.project(cloud.points).piece]
            radial /= np.linalg.norm(radial, axis=1, keepdims=True)
            off = angles(hint, np.column_stack([-radial[:, 1], radial[:, 0]]))
            assert np.median(off) < typical
            assert off.max() < worst


@pytest.mark.parametrize("name", ["square", "hexagon", "octagon", "triangle", "star"])
def test_no_hint_of_a_clean_polygon_opposes_the_travel(name):
    """At a corner, where the direction jumps, the hint is that of the chord across it."""
    cloud, path = make_shape(name)
    hint = hint_of(cloud.normalize(cloud.points))
    off = angles(hint, travel(path, cloud.points, reach=0.3 * cloud.unit_length))
    assert off.max() < 60
    vertices = np.concatenate([piece.vertices for piece in path.pieces])
    from_corner = np.linalg.norm(cloud.points[:, None] - vertices, axis=2).min(axis=1)
    # Beyond the reach along the tree, six noise levels of .1.
    straight = from_corner > 0.7 * cloud.unit_length
    assert straight.sum() > 50
    assert off[straight].max() < 5


def test_on_a_random_star_only_the_tips_are_in_doubt():
    """Where a tip's sides are closer than the gaps, the tree may cut across it.

    The tips open by 36 degrees: half a unit from one the sides are .32 apart, about twice
    the mean spacing.
    """
    for seed in range(8):
        cloud, path = make_shape("star", sampling="random", seed=seed)
        hint = hint_of(cloud.normalize(cloud.points))
        off = angles(hint, travel(path, cloud.points, reach=0.3 * cloud.unit_length))
        tips = path.pieces[0].vertices[::2]
        from_tip = np.linalg.norm(cloud.points[:, None] - tips, axis=2).min(axis=1)
        assert off[from_tip > 0.5 * cloud.unit_length].max() < 90
        assert (off > 90).mean() < 0.1


def thin_loop(gap, step=0.05, half_length=4.0):
    """Two long lines, `gap` apart and joined at their ends: there and back."""
    x = np.arange(-half_length, half_length + step / 2, step)
    end = np.arange(-gap / 2 + step, gap / 2 - step / 2, step)
    sides = [np.column_stack([x, np.full_like(x, y)]) for y in (-gap / 2, gap / 2)]
    caps = [np.column_stack([np.full_like(end, a), end]) for a in (-half_length, half_length)]
    return np.concatenate(sides + caps), len(x)


def test_strands_that_run_opposite_ways_close_together_keep_their_signs():
    """Three noise levels of .1 apart, and less: in space alone they would cancel."""
    for gap in (0.2, 0.3, 0.5):
        points, n = thin_loop(gap)
        shuffle = np.random.default_rng(0).permutation(len(points))
        hint = np.empty_like(points)
        hint[shuffle] = hint_of(points[shuffle], width=0.1)
        inner = np.abs(points[:n, 0]) < 3.3
        for strand, sign in ((hint[:n], 1), (hint[n : 2 * n], -1)):
            np.testing.assert_allclose(sign * strand[inner, 0], 1, atol=0.02)
            assert (sign * strand[:, 0] > 0).all()


def test_an_open_path_from_left_to_right_and_a_circle_in_space():
    t = np.pi * np.linspace(0, 1, 80)
    hint = hint_of(4 * np.column_stack([np.cos(t), np.sin(t)])[::-1])[::-1]
    # At an end all neighbours are ahead: the chord leans in by half of their distance.
    assert angles(hint, np.column_stack([np.sin(t), -np.cos(t)])).max() < 5
    angle = np.linspace(0, 2 * np.pi, 150, endpoint=False)[:, None]
    right, across = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.6, 0.8])
    points = 4 * (np.cos(angle) * right + np.sin(angle) * across)
    tangent = -np.sin(angle) * right + np.cos(angle) * across
    shuffle = np.random.default_rng(1).permutation(150)
    # The largest component of its area, in the plane of x and z, is positive.
    assert angles(hint_of(points[shuffle]), tangent[shuffle]).max() < 0.1


def test_stray_coincident_and_shuffled_waypoints():
    cloud, _ = make_shape("circle", num_points=100)
    points = cloud.normalize(cloud.points)
    stray = hint_of(np.vstack([points / 2, [[4.0, 4.0]]]))
    np.testing.assert_array_equal(stray[-1], 0)
    np.testing.assert_allclose(np.linalg.norm(stray[:-1], axis=1), 1, rtol=1e-12)
    hint = hint_of(np.vstack([points, points[:5]]))
    assert np.isfinite(hint).all()
    np.testing.assert_allclose(hint[100:], hint[:5], atol=1e-12)
    cloud, _ = make_shape("star", sampling="random", noise=0.03, seed=2)
    points = cloud.normalize(cloud.points)
    shuffle = np.random.default_rng(0).permutation(len(points))
    np.testing.assert_allclose(hint_of(points[shuffle]), hint_of(points)[shuffle], atol=1e-9)


def test_the_hint_of_reversed_pieces_is_the_negative():
    """What a field learns its direction from."""
    for name, noise in product(("concentric-circles", "star"), (0.0, 0.05)):
        cloud, _ = make_shape(name, noise=noise)
        support = find_support(cloud.normalize(cloud.points))
        forward = orientation_hint(support.points, support.pieces, support.sigma)
        back = [reverse(piece) for piece in support.pieces]
        backward = orientation_hint(support.points, back, support.sigma)
        np.testing.assert_allclose(backward, -forward, atol=1e-9)
        np.testing.assert_allclose(np.linalg.norm(forward, axis=1), 1, rtol=1e-12)
