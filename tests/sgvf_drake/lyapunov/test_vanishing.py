"""Where the score vanishes: the comparison, the shape of paths, and fields of known answers."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import binom

from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import find_singularities, measure_vanishing
from sgvf_drake.lyapunov.vanishing import BLUR, concentration, path_shape
from sgvf_drake.paths import Piece, ReferencePath, make_shape
from sgvf_drake.paths.finding import find_paths

NO_BRANCHES = np.empty((0, 2))


def arms(angles, length=4.0, spacing=0.1):
    """Straight arms from the origin, evenly sampled."""
    r = spacing * np.arange(1, round(length / spacing) + 1)
    rays = [r[:, None] * [np.cos(angle), np.sin(angle)] for angle in angles]
    return np.concatenate([np.zeros((1, 2)), *rays])


@pytest.fixture(scope="module")
def make_y(ring_field):
    """Makes the exact score of a Y at a noise level of 0.15, and its paths."""

    def make(spacing):
        points = arms(np.radians([90, 210, 330]), spacing=spacing)
        cloud = PointCloud(np.random.default_rng(0).permutation(points))
        sigma = 0.15 / cloud.unit_length
        score = GaussianMixture(cloud.normalize(cloud.points), sigma)
        field = replace(
            ring_field()[0],
            cloud=cloud,
            sigma=sigma,
            score_model=score,
            support=None,
            path_network=find_paths(cloud),
        )
        return field, field.path

    return make


def test_concentration_is_a_share_of_pairs():
    rng = np.random.default_rng(0)
    zeros, even = rng.normal(0.4, 1, 30), rng.normal(size=500)
    found = concentration(zeros, even)
    assert found["probability"] == pytest.approx((zeros[:, None] > even).mean())
    # Ties count half.
    assert concentration(np.ones(3), np.array([0.0, 1, 2, 1]))["probability"] == 0.5
    assert concentration(zeros[:0], even) is None


def test_concentration_is_rarely_an_accident():
    rng = np.random.default_rng(1)
    runs = [concentration(rng.random(20), rng.random(400))["holds"] for _ in range(400)]
    assert binom.cdf(sum(runs) - 1, 400, 0.05) < 0.999
    assert concentration(rng.random(20) + 0.3, rng.random(400))["holds"]
    assert not concentration(rng.random(20) - 0.3, rng.random(400))["holds"]


def test_circles_have_the_curvature_of_their_radius():
    unit = 1e3
    cloud, path = make_shape("concentric-circles")
    cloud = PointCloud(unit * cloud.points)
    scaled = ReferencePath(tuple(Piece(unit * p.vertices, p.closed) for p in path.pieces))
    for reference in (scaled, find_paths(cloud).path):
        shape = path_shape(reference, NO_BRANCHES, 0.1 * cloud.unit_length)
        r = np.linalg.norm(shape.points, axis=1)
        assert np.allclose(shape.curvature * np.round(r / unit) * unit, 1, rtol=0.02)
        assert np.allclose(np.linalg.norm(shape.tangents, axis=1), 1)
        radial = (shape.tangents * shape.points).sum(axis=1) / r
        assert np.abs(radial).max() < 0.02


def test_corners_are_curved_and_sides_are_straight():
    cloud, path = make_shape("square")
    sigma = 0.1 * cloud.unit_length
    shape = path_shape(path, NO_BRANCHES, sigma)
    to_corner = np.abs(np.abs(shape.points) - 3).max(axis=1)
    assert shape.curvature[to_corner > 20 * sigma].max() < 1e-3
    # Around a corner the tangent is (1 - u, u), with u the integral of the blur.  So the
    # curvature is at most 2^1.5 times the density of the blur, and its integral
    # int_0^1 du / (u^2 + (1 - u)^2)^1.5 = 2.
    peak = 2**1.5 / np.sqrt(2 * np.pi) / (BLUR * sigma)
    assert shape.curvature.max() == pytest.approx(peak, rel=0.02)
    total = shape.curvature.sum() * path.lengths[0] / len(shape.points)
    assert total == pytest.approx(4 * 2, rel=1e-3)


def test_the_closed_form_around_a_ring(ring_field):
    # So far apart that each waypoint has a peak and a saddle.
    field, path = ring_field((4.0,), spacing=0.24, sigma=0.15)
    found = find_singularities(field)
    vanishing = measure_vanishing(field, found, path)
    summary, score = vanishing.summary, vanishing.score
    assert summary["zeros_on_path"] == 2 * field.cloud.num_points
    assert summary["zeros_off_path"] == 1
    assert summary["index_sum_on_path"] == 0
    assert summary["index_sum_off_path"] == 1
    # One curvature cannot be high.
    assert summary["high_curvature"] is summary["curvature_correlation"] is None
    assert summary["median_curvature"] == pytest.approx(0.25, rel=1e-2)
    r = np.linalg.norm(found.score.points, axis=1)
    assert np.array_equal(score.on_path, r > 2)
    assert np.allclose(score.curvature[score.on_path] * r[score.on_path], 1, rtol=0.02)
    assert np.isnan(score.curvature[~score.on_path]).all()
    assert np.allclose(score.path_distance, np.abs(r - 4), atol=1e-5)
    log_density = field.mixture.log_density(found.score.points)
    assert np.array_equal(score.log_density, log_density)
    # The density is highest on the path: hardly any area exceeds that of a zero there.
    assert score.density_percentile[score.on_path].min() > 0.95
    assert score.density_percentile[~score.on_path].max() < 0.01


@pytest.fixture(scope="module")
def measured(robust_field, robust_zeros, concentric):
    """A trained field around two rings, its singularities, and where its score vanishes."""
    vanishing = measure_vanishing(robust_field, robust_zeros, concentric[1])
    return robust_field, robust_zeros, vanishing


def test_the_claim_on_low_density_is_about_the_medial_axis_at_best(measured, concentric):
    field, _, vanishing = measured
    summary = vanishing.summary
    # Off the path |S| grows as the density falls; most zeros are at the highest density.
    assert summary["density_correlation"] < -0.8
    assert not summary["low_density"]["holds"]
    assert summary["low_density_off_path"]["holds"]
    # The share of pairs, over the middles of other cells that are off the path.
    (lower, upper), steps = field.cloud.box, (np.arange(300) + 0.5) / 300
    x = lower + (upper - lower) * np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    off = concentric[1].project(x).distance > 3 * field.mixture.sigma
    score = vanishing.score[vanishing.score.isolated & ~vanishing.score.on_path]
    denser = field.mixture.log_density(x[off]) > score.log_density.to_numpy()[:, None]
    probability = summary["low_density_off_path"]["probability"]
    assert probability == pytest.approx(denser.mean(), abs=5e-3)
    small = summary["small_score"]
    assert small["near_path"] > 0.9
    assert small["low_density"] < 0.1
    # Within half a noise level of 38 U of path, and little else.
    strip = 2 * 0.5 * field.mixture.sigma * concentric[1].lengths.sum() / 100
    assert small["fraction"] == pytest.approx(strip, rel=0.15)
    assert summary["branches"] is None


def test_where_the_score_vanishes_m_is_one_on_the_path(measured):
    _, found, vanishing = measured
    summary = vanishing.summary
    assert summary["guiding_min_at_score_zeros_on_path"] > 0.99
    # The hole is where both vanish.
    assert summary["guiding_zeros_at_score_zeros"] == len(found.guiding.zeros) == 1
    assert summary["score_zeros_at_guiding_zeros"] == 1
    assert vanishing.guiding.other_distance[0] == vanishing.score.other_distance.min()
    assert vanishing.guiding.guiding_norm.max() < 1e-9
    assert vanishing.score.score_norm.max() < 1e-9


def test_a_dense_y_has_its_only_isolated_zero_where_it_branches(make_y):
    field, reference = make_y(spacing=0.1)
    found = find_singularities(field)
    for zeros in found.by_field.values():
        assert zeros.index_sum == zeros.winding_number
    vanishing = measure_vanishing(field, found, reference)
    # The arms are flat, lines of zeros, of which rounding decides how many places stand for
    # them; where they meet, the density has its peak.
    isolated = vanishing.score.isolated.tolist()
    assert isolated == [True] + [False] * (len(isolated) - 1)
    assert len(isolated) > 1
    assert np.linalg.norm(found.score.points[0]) < 1e-6
    assert found.score.zeros[0].kind == "sink"
    assert vanishing.summary["branches"]["holds"]
    assert vanishing.summary["branches"]["probability"] > 0.98


def test_a_sparse_y_has_zeros_everywhere(make_y):
    field, reference = make_y(spacing=0.24)
    vanishing = measure_vanishing(field, find_singularities(field), reference)
    assert vanishing.score.isolated.all()
    assert len(vanishing.score.indices) > 80
    assert not vanishing.summary["branches"]["holds"]
    assert not np.isnan(vanishing.score.curvature[vanishing.score.on_path]).any()
    # Each of its arms is straight.
    assert vanishing.summary["high_curvature"] is None
