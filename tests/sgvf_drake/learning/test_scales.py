"""Spacing, noise and gap of a cloud, and the noise level to learn at."""

from itertools import product

import numpy as np
import pytest

from sgvf_drake.learning.scales import (
    NOISE_PER_SPACING,
    SIGMA_CEILING,
    SIGMA_DEFAULT,
    SPARSE,
    WIDEST_GAP,
    CloudScales,
    cloud_scales,
)
from sgvf_drake.paths import SHAPES, make_shape, trace_pieces


def scales_of(points):
    return cloud_scales(points, trace_pieces(points))


def normalized(name, **kwargs):
    cloud, path = make_shape(name, **kwargs)
    return cloud.normalize(cloud.points), path.lengths.sum() / cloud.unit_length, cloud


@pytest.mark.parametrize("name", SHAPES)
def test_the_scales_of_clean_shapes(name):
    """Neither bends nor corners count as noise: they ask for no coarser level."""
    for sampling, tolerance in (("uniform", 0.01), ("random", 0.03)):
        points, length, _ = normalized(name, sampling=sampling)
        scales = scales_of(points)
        # Chords are shorter than the path, and the tree cuts the tips of a star.
        tolerance += 0.07 * (name == "star")
        assert scales.spacing == pytest.approx(length / 200, rel=tolerance)
        assert scales.noise < (0.04 if name == "star" else 0.001)
        assert 3 * scales.noise <= SIGMA_DEFAULT
        # The sides of an acute tip are not strands.
        assert scales.gap == WIDEST_GAP


def test_noise_is_estimated():
    for noise, seed in product((0.01, 0.03), range(4)):
        points, _, cloud = normalized("circle", noise=noise, seed=seed)
        assert scales_of(points).noise == pytest.approx(noise / cloud.unit_length, rel=0.3)
    # At two thirds of the spacing the tree picks its way: it finds a smoother chain than the
    # path's own.  Over 20 seeds .63 to .94 of the noise, .76 in the mean.
    ratios = []
    for seed in range(10):
        points, _, cloud = normalized("circle", noise=0.06, seed=seed)
        ratios.append(scales_of(points).noise * cloud.unit_length / 0.06)
    assert min(ratios) > 0.6
    assert max(ratios) < 1
    assert np.mean(ratios) > 0.7
    # The bend of a sparse circle is hardly noise: of five waypoints, .5 apart.
    assert scales_of(normalized("circle", num_points=50)[0]).noise < 1e-3


def test_noise_in_space():
    rng = np.random.default_rng(3)
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    circle = 4 * np.column_stack([np.cos(angle), 0.6 * np.sin(angle), 0.8 * np.sin(angle)])
    assert scales_of(circle).noise < 1e-3
    noisy = scales_of(circle + 0.04 * rng.standard_normal(circle.shape)).noise
    # Two directions across, of which the fit takes the one of larger spread.
    assert 0.7 * 0.04 < noisy < 1.5 * 0.04


def two_lines(gap, step, ends):
    """Parallel strands, joined at their ends by points at these heights."""
    x = np.arange(-4, 4 + step / 2, step)
    strands = [np.column_stack([x, np.full_like(x, y)]) for y in (0.0, gap)]
    return np.concatenate([*strands, [[a, y] for y in ends for a in (-4, 4)]])


def test_the_gap_between_parallel_strands_of_one_piece_or_of_two():
    """Of one loop there and back, or of two concentric circles."""
    cases = [(0.17, two_lines(0.17, 0.02, (0.05, 0.11)), 1)]
    angle = np.linspace(0, 2 * np.pi, 600, endpoint=False)
    circle = np.column_stack([np.cos(angle), np.sin(angle)])
    for gap in (0.2, 0.3, 0.39, 0.5):
        cases.append((gap, two_lines(gap, 0.05, np.arange(0.05, gap - 0.02, 0.05)), 1))
        cases.append((gap, np.concatenate([4 * circle, (4 - gap) * circle]), 2))
    for gap, points, count in cases:
        pieces = trace_pieces(points)
        assert len(pieces) == count
        scales = cloud_scales(points, pieces)
        assert scales.gap == pytest.approx(min(gap, WIDEST_GAP), rel=1e-9)
        assert scales.fine_sigma == pytest.approx(min(gap / 4, SIGMA_DEFAULT))
    # The two sides of a tip are no strands, however they are sampled.
    for name, seed in product(("star", "triangle", "square"), range(3)):
        points = normalized(name, num_points=1000, sampling="random", seed=seed)[0]
        assert scales_of(points).gap == WIDEST_GAP


def test_sparse_waypoints_cannot_tell_noise_from_corners():
    """A zigzag across a circle: noise if it is dense, and perhaps a path if it is sparse."""
    for count, is_sparse in ((20, True), (62, True), (80, False)):
        angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
        spacing = 2 * np.pi * 3 / count
        radius = 3 + 0.25 * spacing * np.array([1, -1] * (count // 2))
        points = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
        scales = scales_of(points)
        assert (scales.spacing > SPARSE) == is_sparse
        if is_sparse:
            assert scales.noise == pytest.approx(NOISE_PER_SPACING * scales.spacing)
        else:
            assert scales.noise > 1.2 * NOISE_PER_SPACING * scales.spacing


def test_the_noise_level_to_learn_at():
    for spacing, noise, gap, expected in (
        (0.0, 0.0, WIDEST_GAP, SIGMA_DEFAULT),
        (0.1, 0.01, WIDEST_GAP, SIGMA_DEFAULT),
        (0.4, 0.01, WIDEST_GAP, 0.26),  # 0.65 spacings
        (0.1, 0.05, WIDEST_GAP, 0.15),  # 3 noise levels
        (0.01, 0.0, 0.2, 0.05),  # a quarter of the gap
        (0.1, 0.0, 0.2, 0.065),  # the spacing forbids it
        (9.0, 0.0, WIDEST_GAP, SIGMA_CEILING),
        (0.0, 9.0, 0.1, SIGMA_CEILING),
    ):
        scales = CloudScales(spacing, noise, gap)
        assert max(scales.fine_sigma, scales.coarse_sigma) == pytest.approx(expected)


def test_few_and_coincident_waypoints_have_scales():
    for count in (2, 3, 4, 5):
        points = np.column_stack([np.linspace(-4, 4, count), np.zeros(count)])
        scales = scales_of(points)
        assert scales.noise == pytest.approx(0, abs=1e-12)
        assert scales.spacing == pytest.approx(8 / count)
        assert scales.coarse_sigma == pytest.approx(min(0.65 * 8 / count, SIGMA_CEILING))
    for kwargs in ({"num_points": 50}, {"noise": 0.03}):
        points = normalized("circle", **kwargs)[0]
        once, often = scales_of(points), scales_of(np.repeat(points, 10, axis=0))
        assert often.spacing == pytest.approx(once.spacing, rel=1e-9)
        assert often.noise == pytest.approx(once.noise, rel=1e-9)
        assert often.gap == once.gap
