"""What is measured against: polylines, their lengths and nearest points."""

import numpy as np
import pytest

from sgvf_drake.exceptions import PointCloudError
from sgvf_drake.paths import Piece, ReferencePath, shape_path

L_SHAPE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0]])


def brute_force(x, start, end):
    """Distance to each of a list of segments, the plain way."""
    along = end - start
    t = np.einsum("nsd,sd->ns", x[:, None] - start, along) / (along**2).sum(axis=1)
    nearest = start + np.clip(t, 0, 1)[:, :, None] * along
    return np.linalg.norm(x[:, None] - nearest, axis=2).min(axis=1)


def test_lengths_samples_and_projection_of_a_polyline():
    open_piece, closed_piece = Piece(L_SHAPE, closed=False), Piece(L_SHAPE, closed=True)
    assert (open_piece.length, closed_piece.length) == (7, 12)
    for piece in (open_piece, closed_piece):
        np.testing.assert_array_equal(piece.arc, [0, 4, 7])
    samples = open_piece.sample(8)[[0, 1, 4, 7]]
    np.testing.assert_allclose(samples, [[0, 0], [1, 0], [4, 0], [4, 3]])
    np.testing.assert_allclose(closed_piece.sample(12)[[0, 4, 7, 11]], [*L_SHAPE, [0.8, 0.6]])
    moved = Piece(L_SHAPE + np.array([10, 0]), closed=True)
    path = ReferencePath((open_piece, moved))
    x = np.array([[1.0, -2.0], [-3.0, 4.0], [5.0, 4.0], [13.0, 1.0], [11.7, 2.4]])
    projection = path.project(x)
    np.testing.assert_allclose(projection.distance, [2, 5, np.sqrt(2), 1, 0.9], atol=1e-12)
    np.testing.assert_array_equal(projection.piece, [0, 0, 0, 1, 1])
    np.testing.assert_allclose(projection.arc[:3], [1, 0, 7])


def test_projection_agrees_with_brute_force():
    for name in ("star", "square", "separated-circles"):
        path = shape_path(name)
        x = np.random.default_rng(0).uniform(-6, 6, (200, 2))
        knots = [np.vstack([piece.vertices, piece.vertices[:1]]) for piece in path.pieces]
        start = np.concatenate([points[:-1] for points in knots])
        end = np.concatenate([points[1:] for points in knots])
        expected = np.concatenate([brute_force(part, start, end) for part in np.split(x, 10)])
        np.testing.assert_allclose(path.project(x).distance, expected, atol=1e-6)
    # At an acute tip all nearest samples are on one side, the nearest point is on the other.
    tip = Piece(np.array([[10.0, 1e-3], [0.0, 0.0], [10.0, -1e-3]]), closed=False)
    x = np.random.default_rng(2).uniform([0, -2e-3], [10, 2e-3], (1000, 2))
    expected = brute_force(x, tip.vertices[:-1], tip.vertices[1:])
    found = ReferencePath((tip,)).project(x).distance
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_projection_on_a_circle_is_that_of_the_circle():
    path = shape_path("circle")
    rng = np.random.default_rng(1)
    angle, radius = rng.uniform(0, 2 * np.pi, 2000), rng.uniform(0, 6, 2000)
    radius[0] = 0
    x = (radius * np.array([np.cos(angle), np.sin(angle)])).T
    projection = path.project(x)
    np.testing.assert_allclose(projection.distance, np.abs(radius - 3), atol=2e-6)
    error = projection.arc - 3 * angle
    error -= path.longest * np.round(error / path.longest)
    # Near the centre the nearest point is ill-defined: the polygon's corners attract.
    assert np.abs(error[radius > 1]).max() < 6e-3


def test_projection_is_exact_beside_a_denser_piece_and_in_chunks():
    """Few samples on the nearest segment, a thousand on a piece that lies beyond it."""
    sparse = np.array([[0.0, 0.0], [16.0, 0.0]])
    dense = np.column_stack([np.linspace(5, 6, 20_001), np.full(20_001, 4e-4)])
    path = ReferencePath((Piece(sparse, closed=False), Piece(dense, closed=False)))
    x = np.column_stack([np.linspace(5.1, 5.9, 500), np.full(500, 1e-4)])
    projection = path.project(x)
    np.testing.assert_allclose(projection.distance, 1e-4, rtol=1e-9)
    np.testing.assert_array_equal(projection.piece, 0)
    path = shape_path("square")
    x = np.random.default_rng(3).uniform(-5, 5, (100_000, 2))
    whole, some = path.project(x), path.project(x[70_000:70_100])
    np.testing.assert_array_equal(whole.arc[70_000:70_100], some.arc)


def test_reading_an_ordered_polyline(tmp_path):
    for rows, closed, expected in (
        ("0,0\n4,0\n4,3\n", None, (False, 3, 7)),
        ("0,0\n4,0\n4,3\n", True, (True, 3, 12)),
        ("0,0\n4,0\n4,3\n0,0\n", None, (True, 3, 12)),
        ("0,0\n4,0\n4,3\n1e-10,0\n", None, (True, 3, 12)),
        ("0,0\n4,0\n4,3\n1e-3,0\n", None, (False, 4, 12)),
        ("0,0\n4,0\n4,3\n0,0\n", False, (False, 4, 12)),
    ):
        (tmp_path / "path.csv").write_text("x,y\n" + rows)
        path = ReferencePath.read(tmp_path / "path.csv", closed=closed)
        (piece,) = path.pieces
        assert (piece.closed, len(piece.vertices)) == expected[:2]
        assert path.longest == pytest.approx(expected[2], rel=1e-3)


def test_bad_references_are_refused():
    both = Piece(np.eye(2), False), Piece(np.eye(3), False)
    for make, match in (
        (lambda: Piece(np.zeros((1, 2)), closed=False), r"at least 2 finite vertices"),
        (lambda: Piece(np.full((3, 2), np.nan), closed=False), "finite vertices"),
        (lambda: Piece(np.ones((3, 2)), closed=True), "coincide"),
        (lambda: ReferencePath(()), "pieces of one dimension"),
        (lambda: ReferencePath(both), r"dimensions \[2, 3\]"),
    ):
        with pytest.raises(PointCloudError, match=match):
            make()
