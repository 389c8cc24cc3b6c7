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


@pytest.mark.parametrize("sampling", ["uniform", "random"])
@pytest.mark.parametrize("name", SHAPES)
def test_spacing_is_length_over_number(name, sampling):
    points, length, _ = normalized(name, sampling=sampling)
    # Chords are shorter than the path, and the tree cuts the tips of a star.
    tolerance = {"uniform": 0.01, "random": 0.03}[sampling] + 0.07 * (name == "star")
    assert scales_of(points).spacing == pytest.approx(length / 200, rel=tolerance)


@pytest.mark.parametrize("noise", [0.01, 0.03])
@pytest.mark.parametrize("seed", range(4))
def test_noise_of_a_circle_is_estimated_within_30_percent(noise, seed):
    points, _, cloud = normalized("circle", noise=noise, seed=seed)
    assert scales_of(points).noise == pytest.approx(noise / cloud.unit_length, rel=0.3)


def test_noise_of_two_thirds_of_the_spacing_is_underestimated():
    """There the tree picks its way: it finds a smoother chain than the path's own.

    Over 20 seeds .63 to .94 of the noise, .76 in the mean.
    """
    ratios = []
    for seed in range(20):
        points, _, cloud = normalized("circle", noise=0.06, seed=seed)
        ratios.append(scales_of(points).noise * cloud.unit_length / 0.06)
    assert min(ratios) > 0.6
    assert max(ratios) < 1
    assert np.mean(ratios) > 0.7


def test_noise_in_space():
    rng = np.random.default_rng(3)
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    circle = 4 * np.column_stack([np.cos(angle), 0.6 * np.sin(angle), 0.8 * np.sin(angle)])
    assert scales_of(circle).noise < 1e-3
    noisy = scales_of(circle + 0.04 * rng.standard_normal(circle.shape)).noise
    # Two directions across, of which the fit takes the one of larger spread.
    assert 0.7 * 0.04 < noisy < 1.5 * 0.04


@pytest.mark.parametrize("sampling", ["uniform", "random"])
@pytest.mark.parametrize("name", SHAPES)
def test_clean_shapes_show_no_noise(name, sampling):
    """Neither bends nor corners count: what is found asks for no coarser level."""
    points, _, _ = normalized(name, sampling=sampling)
    noise = scales_of(points).noise
    assert noise < (0.04 if name == "star" else 0.001)
    assert 3 * noise <= SIGMA_DEFAULT


def test_the_gap_between_strands():
    x = np.arange(-4, 4.01, 0.02)
    strands = np.concatenate(
        [np.column_stack([x, np.full_like(x, y)]) for y in (0.0, 0.17)]
        + [[[a, y] for y in (0.05, 0.11) for a in (-4, 4)]]
    )
    scales = scales_of(strands)
    assert scales.gap == pytest.approx(0.17, rel=1e-9)
    assert scales.fine_sigma == pytest.approx(0.17 / 4)
    assert scales.coarse_sigma < scales.fine_sigma


@pytest.mark.parametrize("gap", [0.2, 0.3, 0.39, 0.5])
@pytest.mark.parametrize("joined", [True, False])
def test_the_gap_between_parallel_strands_of_one_piece_or_of_two(gap, joined):
    """Of one loop there and back, or of two concentric circles."""
    if joined:
        x = np.arange(-4, 4.01, 0.05)
        end = np.arange(0.05, gap - 0.02, 0.05)
        points = np.concatenate(
            [np.column_stack([x, np.full_like(x, y)]) for y in (0.0, gap)]
            + [np.column_stack([np.full_like(end, a), end]) for a in (-4, 4)]
        )
    else:
        angle = np.linspace(0, 2 * np.pi, 600, endpoint=False)
        circle = np.column_stack([np.cos(angle), np.sin(angle)])
        points = np.concatenate([4 * circle, (4 - gap) * circle])
    pieces = trace_pieces(points)
    assert len(pieces) == (1 if joined else 2)
    scales = cloud_scales(points, pieces)
    assert scales.gap == pytest.approx(min(gap, WIDEST_GAP), rel=1e-9)
    assert scales.fine_sigma == pytest.approx(min(gap / 4, SIGMA_DEFAULT))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("name", ["star", "triangle", "square"])
def test_the_two_sides_of_a_tip_are_no_strands_however_they_are_sampled(name, seed):
    points = normalized(name, num_points=1000, sampling="random", seed=seed)[0]
    assert scales_of(points).gap == WIDEST_GAP


@pytest.mark.parametrize(("count", "is_sparse"), [(20, True), (62, True), (80, False)])
def test_sparse_waypoints_cannot_tell_noise_from_corners(count, is_sparse):
    """A zigzag across a circle: noise if it is dense, and perhaps a path if it is sparse."""
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


@pytest.mark.parametrize("name", SHAPES)
def test_the_named_shapes_have_no_narrow_gap(name):
    """The sides of an acute tip are not strands."""
    assert scales_of(normalized(name)[0]).gap == WIDEST_GAP


@pytest.mark.parametrize(
    ("spacing", "noise", "gap", "expected"),
    [
        (0.0, 0.0, WIDEST_GAP, SIGMA_DEFAULT),
        (0.1, 0.01, WIDEST_GAP, SIGMA_DEFAULT),
        (0.4, 0.01, WIDEST_GAP, 0.26),  # 0.65 spacings
        (0.1, 0.05, WIDEST_GAP, 0.15),  # 3 noise levels
        (0.01, 0.0, 0.2, 0.05),  # a quarter of the gap
        (0.1, 0.0, 0.2, 0.065),  # the spacing forbids it
        (9.0, 0.0, WIDEST_GAP, SIGMA_CEILING),
        (0.0, 9.0, 0.1, SIGMA_CEILING),
    ],
)
def test_the_noise_level_to_learn_at(spacing, noise, gap, expected):
    scales = CloudScales(spacing, noise, gap)
    assert max(scales.fine_sigma, scales.coarse_sigma) == pytest.approx(expected)


@pytest.mark.parametrize("count", [2, 3, 4, 5])
def test_clouds_of_a_few_waypoints_have_scales(count):
    points = np.column_stack([np.linspace(-4, 4, count), np.zeros(count)])
    scales = scales_of(points)
    assert scales.noise == pytest.approx(0, abs=1e-12)
    assert scales.spacing == pytest.approx(8 / count)
    assert scales.coarse_sigma == pytest.approx(min(0.65 * 8 / count, SIGMA_CEILING))


@pytest.mark.parametrize("kwargs", [{"num_points": 50}, {"noise": 0.03}])
def test_coincident_waypoints_have_the_scales_of_the_distinct_ones(kwargs):
    points = normalized("circle", **kwargs)[0]
    once, often = scales_of(points), scales_of(np.repeat(points, 10, axis=0))
    assert often.spacing == pytest.approx(once.spacing, rel=1e-9)
    assert often.noise == pytest.approx(once.noise, rel=1e-9)
    assert often.gap == once.gap


def test_the_bend_of_a_sparse_circle_is_hardly_noise():
    """Five waypoints over a tenth of a circle, .5 apart: a parabola misses the rest."""
    scales = scales_of(normalized("circle", num_points=50)[0])
    assert scales.noise < 1e-3
