"""Networks that are known are found: shapes, and the kinds of clouds that people bring."""

import numpy as np
from numpy.typing import NDArray
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError, PointCloudError
from sgvf_drake.paths import Piece, ReferencePath
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.geometry import local_scatter
from tests.networks import (
    LOOP,
    SHAPES,
    STRAND,
    Topology,
    recorded_motions,
    recorded_passes,
    topology,
)

Array = NDArray[np.float64]

U = np.linspace(0, 1, 401)[:-1]
LAP = np.column_stack(
    [
        40 * np.cos(2 * np.pi * U) + 6 * np.cos(6 * np.pi * U),
        22 * np.sin(2 * np.pi * U) + 4 * np.sin(4 * np.pi * U),
    ]
)
"""One lap of a smooth course, counter-clockwise, in metres."""


def length(points: Array) -> float:
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def rms(network_line: Array, truth: ReferencePath) -> float:
    return float(np.sqrt((truth.project(network_line).distance ** 2).mean()))


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_shapes_sampled_evenly(name: str, noise: float) -> None:
    network = find_paths(PointCloud(SHAPES[name].sample(200, noise, random=False, seed=0)))
    assert topology(network) in SHAPES[name].topologies
    assert sum(edge.weight for edge in network.edges) == pytest.approx(1, abs=0.02)
    # Strands that touch or run side by side scatter about their middle.
    if not name.startswith(("two laps", "seven", "rose of four")):
        assert network.scatter / network.unit_length == pytest.approx(noise, abs=0.02)


@pytest.mark.parametrize("name", ["T", "eight", "roundabout", "trefoil in space"])
def test_the_order_of_the_points_changes_nothing(name: str) -> None:
    points = SHAPES[name].sample(300, 0.02, random=True, seed=1)
    networks = [
        find_paths(PointCloud(points[np.random.default_rng(seed).permutation(len(points))]))
        for seed in range(2)
    ]
    assert networks[0].to_json() == networks[1].to_json()


@pytest.mark.parametrize("name", ["Y", "eight", "Y in space"])
def test_the_unit_and_the_place_change_nothing(name: str) -> None:
    points = SHAPES[name].sample(300, 0.02, random=False, seed=1)
    network = find_paths(PointCloud(points))
    # As far away as coordinates of UTM, in metres.
    shift = np.array([5e5, 5.4e6, 0.0])[: points.shape[1]]
    moved = find_paths(PointCloud(20 * points + shift))
    assert topology(moved) == topology(network)
    # Rounding moves a point from one cell of a grid to another: to a hundredth of a sigma.
    assert moved.length == pytest.approx(20 * network.length, rel=1e-3)
    for here, there in zip(network.nodes, moved.nodes, strict=True):
        assert np.linalg.norm(there.place - 20 * here.place - shift) < 0.05 * network.sigma * 20


def test_a_network_in_another_unit_is_that_of_the_cloud_in_that_unit() -> None:
    points = SHAPES["roundabout"].sample(300, 0.02, random=False, seed=1)
    # A power of two: to the last bit.
    here, there = (find_paths(PointCloud(factor * points)) for factor in (1, 4))
    rescaled, found = (network.to_json() for network in (here.rescaled(4.0), there))
    del rescaled["messages"], found["messages"]
    assert rescaled == found


def test_turning_a_cloud_turns_its_network() -> None:
    points = SHAPES["roundabout"].sample(400, 0.02, random=False, seed=3)
    network = find_paths(PointCloud(points))
    for turn in np.radians([17.0, 45.0, 80.0]):
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        turned = find_paths(PointCloud(points @ rotation.T))
        assert topology(turned) == topology(network)
        for node in network.nodes:
            distances = [np.linalg.norm(n.place - rotation @ node.place) for n in turned.nodes]
            assert min(distances) < 0.15


def test_a_course_that_crosses_itself() -> None:
    points = np.column_stack([30 * np.sin(2 * np.pi * U), 16 * np.sin(4 * np.pi * U)])
    network = find_paths(PointCloud(points))
    assert topology(network) == Topology(1, 2, crossings=(4,))
    assert network.is_one_way(0)
    assert network.routes[0].closed
    assert network.length == pytest.approx(length(np.vstack([points, points[:1]])), rel=1e-3)
    np.testing.assert_allclose(network.nodes[0].place, 0, atol=0.05)
    # Straight over: what lies 2 m before and behind the crossing is 4 m apart.
    line = network.routes[0].line
    at = ReferencePath((line,)).project(np.zeros((1, 2))).arc[0]
    before, after = line.at(np.array([at - 2, at + 2]))
    assert np.linalg.norm(after - before) == pytest.approx(4, rel=0.01)


def test_streets() -> None:
    """A grid of blocks with a street missing and a dead end, 1 m of scatter, shuffled."""
    rng = np.random.default_rng(3)
    u = np.arange(0, 301, 6.0)
    streets = [
        np.column_stack([np.full_like(u, 100 * i), u])[u <= (200 if i == 2 else 300)]
        for i in range(4)
    ]
    streets += [np.column_stack([u, np.full_like(u, 100 * i)]) for i in range(4)]
    dead_end = np.column_stack([300 + np.arange(6, 90, 6.0), np.full(14, 150.0)])
    points = np.concatenate([*streets, dead_end])
    points = rng.permutation(points + rng.normal(0, 1, points.shape))
    network = find_paths(PointCloud(points))
    assert network.unsure is None
    assert (network.count("junction"), network.count("crossing")) == (9, 3)
    assert (network.count("end"), network.cycles) == (1, 8)
    assert network.length == pytest.approx(2384, rel=0.02)
    truth = [(300, 150), (100, 100), (200, 200), (0, 100), (300, 200), (100, 300)]
    for place in truth:
        assert min(np.linalg.norm(n.place - place) for n in network.nodes) < 6
    assert not network.is_one_way(0)


def test_no_line_turns_back_at_its_end() -> None:
    """Single points of the ridge before an end are joined in their order."""
    network = find_paths(PointCloud(SHAPES["Y"].sample(600, 0.02, random=False, seed=4)))
    for edge in network.edges:
        chord = np.linalg.norm(edge.line.vertices[-1] - edge.line.vertices[0])
        assert edge.length < 1.03 * chord


def test_a_letter_whose_apex_is_no_junction() -> None:
    rng = np.random.default_rng(1)
    legs = [np.linspace(a, b, 60) for a, b in (((-20, -40), (0, 40)), ((0, 40), (20, -40)))]
    points = np.concatenate([*legs, np.linspace((-10, 0), (10, 0), 30)])
    network = find_paths(PointCloud(rng.permutation(points + rng.normal(0, 0.2, points.shape))))
    assert topology(network) == Topology(1, 1, ends=2, junctions=(3, 3))
    tip = max(edge.line.vertices[:, 1].max() for edge in network.edges)
    assert tip == pytest.approx(40, abs=1.5)


def demonstrations(seed: int) -> list[Array]:
    """Nine passes of one motion to a common end, whose spread falls to nothing."""
    rng = np.random.default_rng(seed)
    u = np.linspace(0, 1, 100)
    passes = []
    for _ in range(9):
        offset, scale = rng.normal(0, 3, 2), rng.uniform(0.9, 1.1)
        motion = np.column_stack([-50 * (1 - u), 18 * np.sin(5.5 * (1 - u))])
        passes.append(scale * motion + np.outer(1 - u, offset))
    return passes


def test_handwriting_whose_demonstrations_are_far_apart() -> None:
    """Lines run between strands at all scales but the finest, which is a tangle."""
    network = find_paths(PointCloud(np.concatenate(thinned("CShape"))))
    assert "passes of one path (passes)" in str(network.unsure)


def assert_is_the_course_of(passes: list[Array]) -> None:
    """Whether passes are one path, as long as they are, that ends where they end."""
    band = find_paths(PointCloud(np.concatenate(passes)), passes=True)
    assert band.unsure is None
    assert topology(band) == STRAND
    assert band.length == pytest.approx(np.mean([length(p) for p in passes]), rel=0.1)
    tips = band.routes[0].line.vertices[[0, -1]]
    for k in (0, -1):
        places = np.array([p[k] for p in passes])
        reach = np.linalg.norm(places - places.mean(axis=0), axis=1).max()
        away = np.linalg.norm(tips - places.mean(axis=0), axis=1).min()
        assert away < reach + band.sigma


def thinned(motion: str) -> list[Array]:
    return [points[::10] for points in recorded_passes(motion)]


@pytest.mark.parametrize("name", ["CShape", "WShape"])
def test_the_line_of_a_recorded_motion(name: str) -> None:
    assert_is_the_course_of(thinned(name))


@pytest.mark.full
def test_the_lines_of_all_recorded_motions() -> None:
    names = recorded_motions()
    assert len(names) == 26
    for name in names:
        assert_is_the_course_of(thinned(name))


def test_demonstrations_of_one_motion() -> None:
    passes = demonstrations(0)
    mean = np.mean([length(p) for p in passes])
    network = find_paths(PointCloud(np.concatenate(passes)))
    assert topology(network) == STRAND
    assert network.unsure is None
    assert network.length == pytest.approx(mean, rel=0.1)
    # In the direction in which they were recorded, to the common end.
    np.testing.assert_allclose(network.routes[0].line.vertices[-1], 0, atol=1)
    assert any("passes" in message for message in network.messages)
    # Without their order the spread may be of several paths: that is said, or decided.
    shuffled = np.random.default_rng(0).permutation(np.concatenate(passes))
    decided = find_paths(PointCloud(shuffled), passes=True)
    assert topology(decided) == STRAND
    assert decided.unsure is None
    assert decided.length == pytest.approx(mean, rel=0.1)


def test_the_line_of_passes_side_by_side_reaches_both_of_their_ends() -> None:
    x = np.linspace(0, 8, 200)
    passes = [np.column_stack([x, np.full(200, y)]) for y in np.linspace(-0.3, 0.3, 7)]
    network = find_paths(PointCloud(np.concatenate(passes)), passes=True)
    assert topology(network) == STRAND
    line = network.routes[0].line.vertices
    assert line[:, 0].min() < network.sigma
    assert line[:, 0].max() > 8 - network.sigma


def fan(seed: int, bend: float) -> list[Array]:
    """Seven passes round a bend to one end, from places side by side, where they are slow."""
    rng = np.random.default_rng(seed)
    u = np.linspace(0, 1, 250) ** 1.5
    along, angle = 60 * u, np.radians(bend) * np.clip(2 * u - 0.8, 0, 1)
    step = np.gradient(along)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    motion = np.cumsum(step, axis=0)
    offsets = rng.permutation(np.linspace(-5, 5, 7)) + rng.normal(0, 0.5, 7)
    return [
        motion - motion[-1] + np.outer((1 - u) ** 0.7, (rng.normal(0, 1), offset))
        for offset in offsets
    ]


@pytest.mark.parametrize("bend", [0.0, 80.0, -150.0])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.full)])
def test_no_line_turns_across_the_end_of_a_fan(seed: int, bend: float) -> None:
    passes = fan(seed, bend)
    network = find_paths(PointCloud(np.concatenate(passes)), passes=True)
    assert topology(network) == STRAND
    assert network.length == pytest.approx(np.mean([length(p) for p in passes]), rel=0.1)


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.full) for k in (1, 2, 3))]
)
def test_a_fanned_bundle_is_one_path_or_unsure(seed: int) -> None:
    points = np.concatenate(demonstrations(seed))
    network = find_paths(PointCloud(points))
    assert topology(network) == STRAND or network.unsure is not None
    assert topology(find_paths(PointCloud(points), passes=True)) == STRAND


@pytest.mark.parametrize("shuffled", [False, True])
def test_motions_from_several_sides_to_one_end_are_unsure(shuffled: bool) -> None:
    rng = np.random.default_rng(0)
    u = np.linspace(0, 1, 200)[:, None]
    motions = [np.hstack([side * 50 * (1 - u), 15 * np.sin(4 * (1 - u))]) for side in (-1, 1)]
    passes = [m + (1 - u) * rng.normal(0, 1, 2) for m in motions for _ in range(4)]
    points = np.concatenate(passes)
    network = find_paths(PointCloud(rng.permutation(points) if shuffled else points))
    assert network.unsure is not None


def test_two_laps() -> None:
    rng = np.random.default_rng(2)
    normal = np.gradient(LAP, axis=0) @ np.array([[0, 1], [-1, 0]])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    laps = np.concatenate([LAP, LAP + 0.3 * normal])
    network = find_paths(PointCloud(laps + rng.normal(0, 0.03, laps.shape)))
    assert topology(network) == LOOP
    assert network.length == pytest.approx(214.9, rel=0.01)
    middle = ReferencePath((Piece(LAP + 0.15 * normal, closed=True),))
    assert rms(network.routes[0].line.vertices, middle) < 0.1


def test_a_spiral_is_never_closed_across_its_turns() -> None:
    angle = [0.0]
    while angle[-1] < 13:
        angle.append(angle[-1] + (0.6 + 3 * angle[-1] / 13) / (1.5 + 1.4 * angle[-1]))
    t = np.array(angle)
    points = (1.5 + 1.4 * t)[:, None] * np.column_stack([np.cos(t), np.sin(t)])
    network = find_paths(PointCloud(points))
    assert topology(network) == STRAND
    np.testing.assert_allclose(
        network.routes[0].line.vertices[[0, -1]], points[[0, -1]], atol=0.5
    )
    turned = find_paths(PointCloud(points[::-1]))
    np.testing.assert_allclose(turned.routes[0].line.vertices[0], points[-1], atol=0.5)
    assert (
        topology(find_paths(PointCloud(np.random.default_rng(0).permutation(points)))) == STRAND
    )


def test_an_open_recording_is_cut_where_it_ends() -> None:
    recording = LAP[:394]
    assert topology(find_paths(PointCloud(recording), closed=True)) == LOOP
    network = find_paths(PointCloud(recording), closed=False)
    assert topology(network) == STRAND
    ends = network.routes[0].line.vertices[[0, -1]]
    np.testing.assert_allclose(ends, recording[[0, -1]], atol=1e-6)
    # Without the order, in its widest gap.
    shuffled = find_paths(
        PointCloud(np.random.default_rng(1).permutation(recording)), closed=False
    )
    found = sorted(shuffled.routes[0].line.vertices[[0, -1]].tolist())
    np.testing.assert_allclose(found, sorted(recording[[0, -1]].tolist()), atol=1e-6)


def test_an_open_path_that_is_to_be_closed() -> None:
    half = LAP[:300]
    assert topology(find_paths(PointCloud(half))) == STRAND
    network = find_paths(PointCloud(half), closed=True)
    assert topology(network) == LOOP
    gap = np.linalg.norm(half[-1] - half[0])
    assert network.length == pytest.approx(length(half) + gap, rel=0.01)


def coverage(rows: int, step: float, distance: float) -> Array:
    x = np.arange(0, 1.8, step)
    return np.concatenate(
        [
            np.column_stack([x if row % 2 == 0 else x[::-1], np.full_like(x, distance * row)])
            for row in range(rows)
        ]
    )


def test_rows_of_a_coverage_are_joined_by_their_order() -> None:
    points = coverage(14, 0.05, 0.13)
    network = find_paths(PointCloud(points))
    assert topology(network) == STRAND
    assert network.length == pytest.approx(length(points), rel=1e-6)
    # The rows alone are as many paths.
    rows = find_paths(PointCloud(np.random.default_rng(0).permutation(points)))
    assert topology(rows) == Topology(14, 0, ends=28)
    # Where points lie as far apart as rows, the points do not tell.
    square = np.random.default_rng(0).permutation(coverage(14, 0.13, 0.13))
    assert is_unsure(square)


def is_unsure(points: Array) -> bool:
    """Whether no network is found, or one that is flagged."""
    try:
        return find_paths(PointCloud(points)).unsure is not None
    except PointCloudError:
        return True


def test_an_open_eight_that_is_to_be_closed_keeps_its_crossing() -> None:
    points = np.column_stack([30 * np.sin(2 * np.pi * U), 16 * np.sin(4 * np.pi * U)])
    # From the right, all around but for a tenth.
    recording = np.roll(points, -100, axis=0)[:360]
    opened = find_paths(PointCloud(recording))
    assert topology(opened) == Topology(1, 1, ends=2, crossings=(4,))
    closed = find_paths(PointCloud(recording), closed=True)
    assert topology(closed) == Topology(1, 2, crossings=(4,))
    assert closed.is_one_way(0)
    assert closed.routes[0].closed
    # And back: it is cut where it was recorded from.
    again = find_paths(PointCloud(points), closed=False)
    assert topology(again) == Topology(1, 1, ends=2, crossings=(4,))
    assert again.is_one_way(0)


def test_directions() -> None:
    lap, strand = PointCloud(LAP), PointCloud(LAP[:150])
    mixed = np.random.default_rng(4).permutation(LAP)

    def turns_left(cloud: PointCloud, **options: object) -> bool:
        x, y = find_paths(cloud, **options).routes[0].line.vertices.T  # type: ignore[arg-type]
        return bool(x @ np.roll(y, -1) - y @ np.roll(x, -1) > 0)

    assert turns_left(lap)
    assert not turns_left(PointCloud(LAP[::-1]))
    assert turns_left(PointCloud(mixed))
    assert not turns_left(PointCloud(mixed), direction="cw")
    assert turns_left(PointCloud(LAP[::-1]), direction="reverse")
    velocities = np.roll(LAP[::-1], -1, axis=0) - LAP[::-1]
    assert not turns_left(PointCloud(LAP[::-1], velocities=velocities))
    assert turns_left(PointCloud(LAP, velocities=np.roll(LAP, -1, axis=0) - LAP))
    assert not turns_left(PointCloud(LAP, velocities=LAP - np.roll(LAP, -1, axis=0)))
    start = find_paths(strand, start=LAP[149]).routes[0].line.vertices[0]
    np.testing.assert_allclose(start, LAP[149], atol=1e-6)
    with pytest.raises(ConfigurationError, match="closed paths in the plane"):
        find_paths(strand, direction="cw")
    with pytest.raises(ConfigurationError, match="2 entries, but the path has 1 piece"):
        find_paths(lap, direction=("cw", None))
    streets = PointCloud(SHAPES["T"].sample(200, 0.02, random=False, seed=0))
    with pytest.raises(ConfigurationError, match="is a network"):
        find_paths(streets, direction="reverse")


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.full)])
@pytest.mark.parametrize("share", [0.01, 0.03])
def test_strays_are_left_out_and_counted(share: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = SHAPES["eight"].sample(500, 0.02, random=False, seed=seed)
    strays = rng.uniform(-4, 4, (round(share * 500), 2))
    network = find_paths(PointCloud(np.concatenate([points, strays])))
    if network.unsure is None:
        assert topology(network) in SHAPES["eight"].topologies
    # Those that fall on the path or beside it are no strays.
    edges = ReferencePath(tuple(edge.line for edge in network.edges))
    far = edges.project(strays).distance > 4 * network.sigma
    assert far.sum() <= network.dropped <= len(strays)


def test_strands_that_nearly_touch_are_two() -> None:
    circles = [
        1.9 * np.column_stack([np.cos(2 * np.pi * U), np.sin(2 * np.pi * U)]) + [x, 0]
        for x in (-2, 2)
    ]
    network = find_paths(PointCloud(np.concatenate(circles)[::2]))
    assert topology(network) == Topology(2, 2)


@pytest.mark.parametrize("noise", [0.02, pytest.param(0.05, marks=pytest.mark.full)])
def test_lines_come_nearer_to_the_path_with_more_points(noise: float) -> None:
    truth = ReferencePath((Piece(SHAPES["circle"].strands[0][:-1], closed=True),))
    errors = []
    for count in (200, 3200):
        cloud = PointCloud(SHAPES["circle"].sample(count, noise, random=True, seed=0))
        # The extent of a noisy cloud is a little more than that of its circle.
        errors.append(rms(find_paths(cloud).routes[0].line.vertices, truth))
    assert errors[0] < noise
    assert errors[1] < 0.8 * errors[0]


@pytest.mark.parametrize("dim", [2, 3])
def test_scatter_is_that_of_the_noise_wherever_a_lap_begins(dim: int) -> None:
    """It is told in each direction across, and a lap has no first waypoint."""
    angle, noise = 2 * np.pi * np.arange(800) / 800, 0.01
    outward = np.column_stack([np.cos(angle), np.sin(angle)])
    across = noise * np.random.default_rng(0).standard_normal((800, dim - 1))
    points = np.column_stack([(1 + across[:, :1]) * outward, across[:, 1:]])
    scatter = local_scatter(angle, points, 2 * np.pi)
    assert np.mean(scatter) == pytest.approx(noise, rel=0.1)
    again = local_scatter(angle, np.roll(points, 300, axis=0), 2 * np.pi)
    np.testing.assert_allclose(again, np.roll(scatter, 300), atol=1e-9)


def test_corners_of_clean_points_are_kept() -> None:
    points = SHAPES["square"].sample(200, 0.0, random=False, seed=0)
    vertices = find_paths(PointCloud(points)).routes[0].line.vertices
    for corner in ((-4, -4), (-4, 4), (4, -4), (4, 4)):
        assert np.linalg.norm(vertices - corner, axis=1).min() < 1e-9


def test_many_points_in_space() -> None:
    points = SHAPES["trefoil in space"].sample(30_000, 0.02, random=True, seed=0)
    network = find_paths(PointCloud(points))
    assert topology(network) == LOOP


@pytest.mark.parametrize(
    "points", [np.random.default_rng(0).uniform(-1, 1, (300, 2)), np.eye(2)]
)
def test_clouds_without_a_path_are_unsure_or_refused(points: Array) -> None:
    assert is_unsure(points)


@pytest.mark.parametrize(
    ("name", "seed", "count", "reason"),
    [
        ("rose of four", 3, 120, "only 1 of 9 scales show these paths"),
        ("rose of three", 3, 120, "only 1 of 10 scales show these paths"),
        ("trefoil", 4, 100, "only 1 of 8 scales show these paths"),
    ],
)
def test_what_few_scales_show_is_unsure(name: str, seed: int, count: int, reason: str) -> None:
    """Of these clouds of few noisy points at random none is found right."""
    network = find_paths(PointCloud(SHAPES[name].sample(count, 0.05, random=True, seed=seed)))
    assert topology(network) not in SHAPES[name].topologies
    assert reason in str(network.unsure)


@pytest.mark.parametrize(
    ("height", "reason"),
    [(1.0, "None"), (0.4, "as many scales show 1 piece, 2 loops, 1 crossing")],
)
def test_a_bridge_that_is_low_may_be_a_crossing(height: float, reason: str) -> None:
    t = 2 * np.pi * np.arange(300) / 300
    course = np.column_stack([4 * np.sin(t), 2 * np.sin(2 * t), height / 2 * np.cos(t)])
    course += 0.02 * np.random.default_rng(0).normal(size=course.shape)
    network = find_paths(PointCloud(course))
    assert topology(network) == LOOP
    assert reason in str(network.unsure)
