"""The named shapes: their true paths, and the clouds that are sampled from them."""

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths import SHAPES, make_shape, shape_path
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.shapes import regular_polygon

LENGTHS = {
    "concentric-circles": [4 * np.pi, 8 * np.pi],
    "separated-circles": [3 * np.pi, 3 * np.pi],
    "concentric-flight": [2 * np.pi, 4 * np.pi],
    "separated-flight": [2 * np.pi, 2 * np.pi],
    "circle": [6 * np.pi],
    "square": [24],
    "hexagon": [18],
    "octagon": [48 * np.sin(np.pi / 8)],
    "triangle": [9 * np.sqrt(3)],
    # By the law of sines, in the triangle of the centre, a tip and the notch beside it.
    "star": [10 * 4 * np.sin(np.radians(36)) / np.sin(np.radians(126))],
}


def signed_area(vertices):
    after = np.roll(vertices, -1, axis=0)
    return 0.5 * np.sum(vertices[:, 0] * after[:, 1] - after[:, 0] * vertices[:, 1])


@pytest.mark.parametrize("name", SHAPES)
def test_lengths_and_orientation(name):
    path = shape_path(name)
    np.testing.assert_allclose(path.lengths, LENGTHS[name], rtol=1e-6)
    assert path.closed.all()
    assert all(signed_area(piece.vertices) > 0 for piece in path.pieces)


@pytest.mark.parametrize("sampling", ["uniform", "random"])
@pytest.mark.parametrize("name", SHAPES)
def test_waypoints_lie_on_the_path_and_cover_it(name, sampling):
    cloud, path = make_shape(name, num_points=300, sampling=sampling, seed=3)
    assert (cloud.num_points, cloud.shape, cloud.dim) == (300, name, 2)
    projection = path.project(cloud.points)
    assert projection.distance.max() < 1e-9
    share = path.lengths / path.lengths.sum()
    np.testing.assert_allclose(np.bincount(projection.piece) / 300, share, atol=1 / 300)
    for number, piece in enumerate(path.pieces):
        arcs = np.sort(projection.arc[projection.piece == number])
        if sampling == "uniform":
            step = piece.length / len(arcs)
            np.testing.assert_allclose(np.diff(arcs), step, rtol=1e-6)
        else:
            # Kolmogorov-Smirnov distance to the uniform distribution.
            rank = (np.arange(len(arcs)) + 0.5) / len(arcs)
            assert np.abs(arcs / piece.length - rank).max() < 1.6 / np.sqrt(len(arcs))


@pytest.mark.parametrize("name", SHAPES)
def test_the_pieces_are_found(name):
    cloud, path = make_shape(name)
    pieces = find_paths(cloud).path.pieces
    assert [piece.closed for piece in pieces] == [True] * len(path.pieces)
    lengths = [piece.length for piece in pieces]
    np.testing.assert_allclose(sorted(lengths), np.sort(path.lengths), rtol=0.04)


def test_the_tips_point_up():
    assert shape_path("star").pieces[0].vertices[:, 1].max() == 4
    np.testing.assert_allclose(shape_path("triangle").pieces[0].vertices[0], [0, 3], atol=1e-12)


def test_the_seed_decides_and_the_order_is_shuffled():
    first, again, other = (make_shape("star", noise=0.1, seed=s)[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(first.points, again.points)
    assert not np.array_equal(first.points, other.points)
    clean = make_shape("star", seed=1)[0].points
    np.testing.assert_allclose((first.points - clean).std(), 0.1, rtol=0.1)
    cloud, path = make_shape("circle")
    steps = np.abs(np.diff(path.project(cloud.points).arc))
    assert np.median(steps) > 1
    # Every piece has its share.
    for num_points in (6, 7, 11, 200):
        cloud, path = make_shape("concentric-circles", num_points=num_points)
        counts = np.bincount(path.project(cloud.points).piece)
        assert counts.sum() == num_points
        assert counts.min() >= 3


def test_bad_input_is_refused():
    for arguments, match in (
        ({"name": "cirlce"}, "no shape 'cirlce'; did you mean 'circle'"),
        ({"name": "qqq"}, r"no shape 'qqq' \(the shapes are concentric-circles"),
        ({"name": "circle", "num_points": 2}, "at least 3, not 2"),
        ({"name": "separated-circles", "num_points": 5}, "at least 6, not 5"),
        ({"name": "circle", "noise": -0.1}, "not negative, not -0.1"),
        ({"name": "circle", "noise": np.nan}, "noise must be finite"),
        ({"name": "circle", "sampling": "even"}, "uniform, random, not 'even'"),
    ):
        with pytest.raises(ConfigurationError, match=match):
            make_shape(**arguments)
    for corners, radius, match in (
        (2, 1.0, "at least 3 corners, not 2"),
        (4, 0.0, "not 0.0"),
        (4, np.inf, "not inf"),
    ):
        with pytest.raises(ConfigurationError, match=match):
            regular_polygon(corners, radius)


def test_a_regular_polygon_has_its_angles_and_rests_on_a_side():
    for corners in (3, 4, 5, 6, 8, 12):
        (piece,) = regular_polygon(corners, 3.0).pieces
        vertices = piece.vertices
        assert (len(vertices), piece.closed) == (corners, True)
        assert signed_area(vertices) > 0
        np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 3.0)
        before, after = (np.roll(vertices, shift, axis=0) - vertices for shift in (1, -1))
        lengths = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
        angles = np.degrees(np.arccos((before * after).sum(axis=1) / lengths))
        np.testing.assert_allclose(angles, 180 - 360 / corners)
        # Its first side is the lowest part of it.
        np.testing.assert_allclose(vertices[:2, 1], vertices[:, 1].min())
    for name, corners, radius in (("square", 4, 3 * np.sqrt(2)), ("hexagon", 6, 3.0)):
        own = regular_polygon(corners, radius).pieces[0].vertices
        gaps = np.linalg.norm(own[:, None] - shape_path(name).pieces[0].vertices, axis=2)
        assert gaps.min(axis=0).max() < 1e-9
