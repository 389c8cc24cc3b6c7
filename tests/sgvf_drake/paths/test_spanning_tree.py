"""Pieces of a cloud from its spanning tree: one loop or arc each, in order."""

from itertools import product

from hypothesis import example, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.sparse.csgraph import minimum_spanning_tree
from scipy.spatial.distance import pdist, squareform

from sgvf_drake.exceptions import PointCloudError
from sgvf_drake.paths.shapes import make_shape
from sgvf_drake.paths.spanning_tree import gap_length, trace_pieces


def circle(angles, radius=3.0, center=(0.0, 0.0)):
    return radius * np.column_stack([np.cos(angles), np.sin(angles)]) + np.asarray(center)


def even_circle(n, **kwargs):
    return circle(np.linspace(0, 2 * np.pi, n, endpoint=False), **kwargs)


def edge_set(piece):
    return {tuple(sorted(edge)) for edge in piece.edges.tolist()}


def signed_area(path):
    after = np.roll(path, -1, axis=0)
    return 0.5 * np.sum(path[:, 0] * after[:, 1] - after[:, 0] * path[:, 1])


def test_a_shuffled_circle_gets_its_order_back():
    n = 200
    shuffle = np.random.default_rng(0).permutation(n)
    (piece,) = trace_pieces(even_circle(n)[shuffle])
    steps = np.diff(shuffle[piece.order]) % n
    np.testing.assert_array_equal(steps, 1)  # counter-clockwise, one after the other
    assert piece.closed
    assert piece.length == pytest.approx(2 * np.pi * 3, rel=1e-3)
    np.testing.assert_array_equal(piece.indices, np.arange(n))
    spacing = 6 * np.sin(np.pi / n)
    np.testing.assert_allclose(piece.arc[piece.order], spacing * np.arange(n), atol=1e-9)


@pytest.mark.parametrize("sampling", ["even", "random"])
def test_separated_circles_are_two_pieces_longest_first(sampling):
    rng = np.random.default_rng(1)
    angles = np.linspace(0, 2 * np.pi, 100, endpoint=False)
    if sampling == "random":
        angles = rng.uniform(0, 2 * np.pi, 100)
    points = np.concatenate([circle(angles, 1.5, (-3, 0)), circle(angles, 2.0, (3, 0))])
    shuffle = rng.permutation(200)
    pieces = trace_pieces(points[shuffle])
    assert [piece.closed for piece in pieces] == [True, True]
    assert pieces[0].length > pieces[1].length
    for piece, members in zip(pieces, (np.arange(100, 200), np.arange(100)), strict=True):
        np.testing.assert_array_equal(np.sort(shuffle[piece.indices]), members)
        assert signed_area(points[shuffle][piece.order]) > 0


def test_a_randomly_sampled_loop_stays_one():
    for noise, seed in product((0.0, 0.05), range(10)):
        rng = np.random.default_rng(seed)
        points = circle(rng.uniform(0, 2 * np.pi, 200))
        points += noise * rng.standard_normal(points.shape)
        (piece,) = trace_pieces(points)
        assert piece.closed
        assert signed_area(points[piece.order]) > 0
        assert len(piece.edges) == 199
        star, _ = make_shape("star", noise=noise, seed=seed, sampling="random")
        (piece,) = trace_pieces(star.points)
        assert piece.closed


@pytest.mark.parametrize("name", ["concentric-circles", "separated-circles"])
def test_loops_that_noise_brings_together_are_told_apart(name):
    """The circles are 1 or 2 apart, which is less than the cut length in these clouds."""
    for seed in range(6):
        cloud, path = make_shape(name, noise=0.05, seed=seed, sampling="random")
        pieces = trace_pieces(cloud.points)
        of_waypoint = path.project(cloud.points).piece
        members = [set(of_waypoint[piece.indices].tolist()) for piece in pieces]
        assert sorted(map(sorted, members)) == [[0], [1]]
        for piece in pieces:
            assert piece.closed
            assert signed_area(cloud.points[piece.order]) > 0
            assert len(piece.edges) == len(piece.indices) - 1


def test_the_tree_of_a_dense_noisy_loop_breaks_beside_its_ends():
    rng = np.random.default_rng(7)
    points = circle(rng.uniform(0, 2 * np.pi, 3000)) + 0.1 * rng.standard_normal((3000, 2))
    piece = trace_pieces(points)[0]
    assert piece.closed
    assert len(piece.indices) > 2900


def test_an_open_arc_is_open_and_starts_at_the_smaller_end():
    for degrees, n in ((90, 5), (90, 200), (180, 5), (180, 40), (270, 40), (340, 200)):
        half = np.radians(degrees) / 2
        points = circle(np.linspace(-half, half, n))[np.random.default_rng(2).permutation(n)]
        (piece,) = trace_pieces(points)
        assert not piece.closed
        first, last = points[piece.order[[0, -1]]]
        assert tuple(first) < tuple(last)
        assert piece.length == pytest.approx(2 * 3 * np.sin(half / (n - 1)) * (n - 1))


def test_a_loop_in_space_runs_by_its_largest_projected_area():
    flat = even_circle(100)
    tilted = np.column_stack([flat[:, 0], 0.2 * flat[:, 1], flat[:, 1]])
    for points in (tilted, tilted[::-1]):
        (piece,) = trace_pieces(points)
        path = points[piece.order]
        # Seen from +y, x turns into z: the (0, 2) component is the largest.
        assert signed_area(path[:, [0, 2]]) > 0


def test_side_branches_measure_their_arc_along_the_tree():
    trunk = np.column_stack([np.arange(11.0), np.zeros(11)])
    branch = np.array([[4.0, 1.0], [4.0, 2.0]])
    (piece,) = trace_pieces(np.concatenate([trunk, branch]))
    np.testing.assert_allclose(piece.arc, [*range(11), 5, 6], atol=1e-9)
    np.testing.assert_array_equal(piece.order, np.arange(11))
    assert not piece.closed
    assert piece.length == pytest.approx(10)


def test_coincident_waypoints_share_their_arc():
    points = even_circle(50)
    repeated = np.concatenate([points, points[10:13], points[10:11]])
    (piece,) = trace_pieces(repeated)
    (plain,) = trace_pieces(points)
    assert piece.closed
    assert piece.length == pytest.approx(plain.length)
    np.testing.assert_array_equal(piece.arc[50:], piece.arc[[10, 11, 12, 10]])
    assert edge_set(piece) == edge_set(plain) | {(10, 50), (11, 51), (12, 52), (10, 53)}
    assert set(piece.order.tolist()) == set(range(50))


def test_few_and_isolated_waypoints_are_pieces_too():
    for points, length, order in (
        ([[1.0, 2.0]], 0, [0]),
        ([[1.0, 2.0], [1.0, 2.0]], 0, None),
        ([[4.0, 6.0], [1.0, 2.0]], 5, [1, 0]),
    ):
        (piece,) = trace_pieces(np.array(points))
        assert piece.length == pytest.approx(length)
        assert not piece.closed
        assert len(piece.edges) == len(points) - 1
        assert order is None or piece.order.tolist() == order
    pieces = trace_pieces(np.concatenate([even_circle(100), [[20.0, 0.0]]]))
    assert [len(piece.indices) for piece in pieces] == [100, 1]
    assert pieces[1].indices.tolist() == [100]


def test_dense_clusters_within_the_cut_length_are_joined():
    """All nearest neighbours are inside the clusters; the graph misses the edges between."""
    rng = np.random.default_rng(3)
    chain = np.column_stack([np.arange(400.0), np.zeros(400)])
    near = np.array([[200.0, 2.0]]) + 0.01 * rng.standard_normal((40, 2))
    far = np.array([[200.0, 4.0]]) + 0.01 * rng.standard_normal((40, 2))
    (piece,) = trace_pieces(np.concatenate([chain, near, far]))
    assert len(piece.edges) == 479


def test_agrees_with_the_tree_of_the_full_distance_matrix():
    points = np.random.default_rng(4).standard_normal((300, 3))
    full = minimum_spanning_tree(squareform(pdist(points))).tocoo()
    cut = gap_length(np.percentile(full.data, 90), 300, 0.01)
    keep = full.data <= cut
    expected = {
        tuple(sorted(edge))
        for edge in zip(full.row[keep].tolist(), full.col[keep].tolist(), strict=True)
    }
    assert set().union(*(edge_set(piece) for piece in trace_pieces(points))) == expected


@settings(max_examples=15, deadline=None, derandomize=True)
@example(seed=0, angle=0.5, log_scale=-12.0, offset=0.0)
@given(
    seed=st.integers(0, 2**32 - 1),
    angle=st.floats(0, 2 * np.pi),
    log_scale=st.floats(-12, 12),
    offset=st.floats(-100, 100),
)
def test_rigid_motion_and_scaling_keep_the_tree(seed, angle, log_scale, offset):
    rng = np.random.default_rng(seed)
    points = circle(rng.uniform(0, 2 * np.pi, 60)) + 0.05 * rng.standard_normal((60, 2))
    c, s = np.cos(angle), np.sin(angle)
    scale = 10.0**log_scale
    moved = scale * (points @ np.array([[c, s], [-s, c]]) + offset)
    before, after = trace_pieces(points), trace_pieces(moved)
    assert [edge_set(piece) for piece in after] == [edge_set(piece) for piece in before]
    for old, new in zip(before, after, strict=True):
        assert new.closed == old.closed
        assert new.length == pytest.approx(old.length * scale, rel=1e-6)
        if old.closed:
            np.testing.assert_array_equal(new.order, old.order)


def test_a_large_cloud_is_one_loop():
    rng = np.random.default_rng(6)
    points = circle(rng.uniform(0, 2 * np.pi, 20_000))
    (piece,) = trace_pieces(points)
    assert piece.closed
    assert piece.length == pytest.approx(6 * np.pi, rel=1e-5)


def test_what_is_not_a_cloud_is_refused():
    for points in (np.zeros((0, 2)), np.zeros(4), np.array([[0.0, np.nan], [1.0, 1.0]])):
        with pytest.raises(PointCloudError, match="finite waypoints"):
            trace_pieces(points)
