"""What is learned from: clean waypoints as they are, or points on the lines that were found."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.distance import pdist, squareform

from sgvf_drake.clouds import PointCloud
from sgvf_drake.learning.support import SIGMA_DEFAULT, find_support, tangents_at
from sgvf_drake.paths import SHAPES, Piece, ReferencePath, make_shape
from sgvf_drake.paths.finding import find_paths


def support_of(cloud, sigma=None, **options):
    return find_support(cloud, find_paths(cloud, **options), sigma)


def distances(cloud, path, support):
    """In U: of each support point to the path, and of the path to the line of the support."""
    to_path = path.project(cloud.denormalize(support.points)).distance / cloud.unit_length
    samples = np.concatenate([piece.sample(1000) for piece in path.pieces])
    return to_path, support.path.project(cloud.normalize(samples)).distance


def are_closed(support, path):
    return support.path.closed.tolist() == path.closed.tolist()


def rms(values):
    return float(np.sqrt(np.mean(values**2)))


@pytest.mark.parametrize("name", SHAPES)
def test_a_clean_shape_is_learned_as_it_is(name):
    cloud, path = make_shape(name)
    support = support_of(cloud)
    assert not support.resampled
    learned, given = (np.sort(x, axis=0) for x in (support.points, cloud.points))
    np.testing.assert_array_equal(learned, cloud.normalize(given))
    assert are_closed(support, path)
    # 0.65 spacings, where that is more than the default; chords are shorter than arcs.
    spacing = path.lengths.sum() / cloud.unit_length / 200
    assert support.sigma == pytest.approx(max(0.1, 0.65 * spacing), rel=2e-3)


def test_a_gap_is_filled_wherever_the_line_of_a_loop_begins():
    cloud, _ = make_shape("circle")
    network = find_paths(cloud)
    assert not find_support(cloud, network).resampled
    arc = network.path.project(cloud.points).arc
    for middle in (0.0, network.length / 3):
        away = (arc - middle + network.length / 2) % network.length - network.length / 2
        rest = PointCloud(cloud.points[np.abs(away) > 0.2 * cloud.unit_length])
        assert 195 < rest.num_points < 200
        assert find_support(rest, network).resampled


@pytest.mark.parametrize("name", SHAPES)
def test_noisy_waypoints_become_points_on_a_line_half_a_noise_level_apart(name):
    cloud, path = make_shape(name, noise=0.05, seed=0, sampling="random")
    support = support_of(cloud)
    assert support.resampled
    assert are_closed(support, path)
    to_path, to_support = distances(cloud, path, support)
    assert rms(to_path) < 0.1
    assert to_support.max() < (0.45 if name == "star" else 0.35)
    distinct = support.path.project(support.points)
    for number, line in enumerate(support.path.pieces):
        arc = np.sort(distinct.arc[distinct.piece == number])
        np.testing.assert_allclose(np.diff(arc), 0.5 * support.sigma, rtol=0.02)
        assert line.length == pytest.approx(len(arc) * 0.5 * support.sigma, rel=0.02)


def test_uneven_density_becomes_even():
    """Ten times as dense at the first vertex as on the far side."""
    x = np.linspace(0, 1, 10_001)
    cumulative = x + 9 / 11 * np.sin(2 * np.pi * x) / (2 * np.pi)
    for name in ("circle", "star"):
        _, path = make_shape(name)
        at = np.interp((np.arange(200) + 0.5) / 200, cumulative, x) * path.longest
        cloud = PointCloud(np.random.default_rng(0).permutation(path.pieces[0].at(at)))
        network = find_paths(cloud)
        support = find_support(cloud, network)
        assert support.resampled
        assert network.dropped == 0, "a sparse stretch is no stray"
        assert are_closed(support, path)
        to_path, to_support = distances(cloud, path, support)
        assert rms(to_path) < 0.05
        assert to_support.max() < 0.35


def test_copies_of_waypoints_change_nothing():
    for name, copies in product(("concentric-circles", "star"), (2, 5)):
        cloud, _ = make_shape(name)
        once, often = (
            support_of(PointCloud(np.repeat(cloud.points, k, 0))) for k in (1, copies)
        )
        # The lines differ by how copies are averaged.
        assert often.sigma == pytest.approx(once.sigma, rel=1e-4)
        distinct = (np.unique(support.points, axis=0) for support in (once, often))
        np.testing.assert_array_equal(*distinct)


@pytest.mark.parametrize("name", ["square", "star", "concentric-circles"])
def test_five_percent_of_outliers(name):
    """The path is covered, and what is learned lies near it; or it is said to be unsure."""
    right = 0
    for seed in range(5):
        cloud, path = make_shape(name, num_points=190, seed=seed)
        low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
        outliers = np.random.default_rng(seed).uniform(low, high, (10, 2))
        cloud = PointCloud(np.concatenate([cloud.points, outliers]))
        network = find_paths(cloud)
        support = find_support(cloud, network)
        if network.unsure is not None and not are_closed(support, path):
            continue
        right += 1
        assert are_closed(support, path), seed
        to_path, to_support = distances(cloud, path, support)
        assert to_path.max() < 0.45
        assert rms(to_path) < 0.1
        assert to_support.max() < 0.15
    assert right >= 4


def test_the_noise_level_stays_below_a_quarter_of_the_gap_between_strands():
    """Of two circles, and of the legs of a hairpin; a corner is no gap."""
    rng = np.random.default_rng(0)
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    for gap in (0.2, 0.3, 1.0):
        cloud = PointCloud(rng.permutation(np.concatenate([4 * circle, (4 - gap) * circle])))
        support = support_of(cloud)
        assert support.path.closed.tolist() == [True, True]
        assert support.sigma == pytest.approx(min(SIGMA_DEFAULT, gap / 4), rel=0.05)
    x = np.linspace(-4, 3.8, 200)
    turn = np.linspace(-np.pi / 2, np.pi / 2, 20)[1:-1]
    legs = [np.column_stack([x, np.full_like(x, y)]) for y in (-0.15, 0.15)]
    bend = [3.8 + 0.15 * np.cos(turn), 0.15 * np.sin(turn)]
    hairpin = PointCloud(np.concatenate([legs[0], np.column_stack(bend), legs[1][::-1]]))
    assert support_of(hairpin, sigma=None).sigma == pytest.approx(0.075, rel=0.05)
    assert support_of(make_shape("star")[0]).sigma == SIGMA_DEFAULT


def test_a_loop_or_an_arc_is_what_the_user_says():
    opened = support_of(make_shape("circle")[0], closed=False)
    assert opened.path.closed.tolist() == [False]
    np.testing.assert_array_equal(opened.ends, opened.path.pieces[0].vertices[-1:])
    angle = np.linspace(0, 1.3 * np.pi, 80)
    arc = PointCloud(3 * np.column_stack([np.cos(angle), np.sin(angle)]))
    for closed in (None, True):
        support = support_of(arc, closed=closed)
        assert support.path.closed.tolist() == [closed is True]
        assert len(support.ends) == (closed is None)


def test_a_noise_level_that_is_given_is_kept():
    for noise in (0.0, 0.05):
        support = support_of(make_shape("star", noise=noise)[0], sigma=0.3)
        assert support.sigma == 0.3
        if support.resampled:
            apart = squareform(pdist(support.points)) + 9 * np.eye(len(support.points))
            assert np.median(apart.min(axis=1)) == pytest.approx(0.15, rel=0.02)


def test_tangents_run_with_the_path():
    """They are those of a circle to second order, and turn a corner within their width."""
    angle = np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    at = np.random.default_rng(0).uniform(0, 2 * np.pi, 50)
    exact = np.column_stack([-np.sin(at), np.cos(at)])
    for line, sign in ((Piece(circle, True), 1), (Piece(circle[::-1], True), -1)):
        arc = ReferencePath((line,)).project(np.column_stack([np.cos(at), np.sin(at)])).arc
        np.testing.assert_allclose(tangents_at(line, arc, 0.1), sign * exact, atol=2e-3)
    corner = Piece(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), closed=False)
    found = tangents_at(corner, np.array([0.0, 0.5, 1.0, 1.5, 2.0]), 0.1)
    diagonal = [np.sqrt(0.5)] * 2
    np.testing.assert_allclose(found, [[1, 0], [1, 0], diagonal, [0, 1], [0, 1]], atol=1e-12)


def test_edges_of_a_branching_piece_run_away_from_its_first_end():
    arms = np.radians([90, 210, 330])
    radius = np.linspace(0, 4, 60)
    points = np.concatenate([np.outer(radius, [np.cos(a), np.sin(a)]) for a in arms])
    cloud = PointCloud(points)
    support = support_of(cloud)
    tips = cloud.normalize(4 * np.column_stack([np.cos(arms), np.sin(arms)]))
    # From the first of the tips, all robots come to one of the two others.
    assert len(support.ends) == 2
    assert cKDTree(tips).query(support.ends)[0].max() < 0.3
    (first,) = set(range(3)) - set(cKDTree(tips).query(support.ends)[1].tolist())
    from_first = np.linalg.norm(support.points - tips[first], axis=1)
    outward = support.points - tips[first]
    far = from_first > 0.5
    along = (outward * support.tangents).sum(axis=1) / np.maximum(from_first, 1e-9)
    assert along[far].min() > 0
