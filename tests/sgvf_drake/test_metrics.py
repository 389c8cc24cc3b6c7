"""How well agents followed a path: known trajectories, on either side of each threshold."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.metrics import (
    default_duration,
    follow_metrics,
    grid_starts,
    least_separation,
)
from sgvf_drake.paths import Piece, ReferencePath, make_shape, shape_path

CLOUD, CIRCLE = make_shape("circle")  # radius 3, U = 0.75
U, BOX = CLOUD.unit_length, CLOUD.box
LAP = CIRCLE.longest
SAGITTA = 1e-6  # the circle is a polygon


def times_for(duration, step=0.05):
    return np.linspace(0, duration, round(duration / step) + 1)


def around(times, radius=3.0, speed=1.0, center=(0.0, 0.0)):
    """One agent on a circle at a given speed along it; (T, 1, 2)."""
    angle = speed * times / radius
    orbit = radius * np.column_stack([np.cos(angle), np.sin(angle)]) + np.asarray(center)
    return orbit[:, None, :]


def measure(times, positions, reference=CIRCLE, **kwargs):
    return follow_metrics(times, positions, U, BOX, reference, **kwargs)


def flags_of(metrics):
    """What holds of each agent: reached, settled, lapped, ended, at a stop (x), out."""
    names = ("reached", "settled", "lapped", "ended", "stalled", "left")
    held = np.array([getattr(metrics, name) for name in names]).T
    letters = np.array(list("rslexo"))
    return ["".join(letters[row]) for row in held]


TIPPED = np.arctan2(0.8, 0.6)
# Duration, radius and angle over time; what holds of the agent, see `flags_of`, its laps, and
# the root mean square of its error.
AGENTS = {
    "a perfect lap": (LAP, lambda t: (3, t / 3), "rsl", 1, 0),
    "at an offset": (1.5 * LAP, lambda t: (3.05, t / 3), "rsl", 1.5, 0.05),
    "clockwise": (2 * LAP, lambda t: (3, -t / 3), "rsl", -2, 0),
    "most of a lap": (0.99 * LAP, lambda t: (3, t / 3), "r", 0.99, np.nan),
    "back and forth": (4 * LAP, lambda t: (3.02, 1.6 * np.sin(t / 3)), "rs", None, 0.02),
    # By arc length, not by time.
    "a slow one": (3 * LAP, lambda t: (3, 0.4 * t / 3), "rsl", 1.2, 0),
    "at rest": (7.9 * U, lambda t: (3, 0), "r", 0, np.nan),
    "at rest for 8 U": (8.1 * U, lambda t: (3, 0), "rx", 0, np.nan),
    "at rest for long": (100 * U, lambda t: (3, 0), "rsx", 0, 0),
    # The span is a diagonal: each coordinate spans its part of it.
    "spans .48 U": (20.0, lambda t: (0.24 * U * np.sin(7 * t), TIPPED), "x", None, np.nan),
    "spans .52 U": (20.0, lambda t: (0.26 * U * np.sin(7 * t), TIPPED), "", None, np.nan),
    "comes to .09 U": (5.0, lambda t: (3 + 0.09 * U, t / 3), "r", None, np.nan),
    "comes to .11 U": (5.0, lambda t: (3 + 0.11 * U, t / 3), "", None, np.nan),
    "stays at .29 U": (2 * LAP, lambda t: (3 + 0.29 * U, t / 3), "sl", 2, 0.29 * U),
    "stays at .31 U": (2 * LAP, lambda t: (3 + 0.31 * U, t / 3), "", None, np.nan),
    "goes to 1.49 boxes": (
        *(10.0, lambda t: (1.49 * 3.75 * np.sin(np.pi * t / 10), -np.pi / 2)),
        *("r", None, np.nan),
    ),
    "goes to 1.51 boxes": (
        *(10.0, lambda t: (1.51 * 3.75 * np.sin(np.pi * t / 10), -np.pi / 2)),
        *("ro", None, np.nan),
    ),
}


@pytest.mark.parametrize("name", AGENTS)
def test_an_agent_on_a_circle(name):
    duration, motion, flags, laps, rms = AGENTS[name]
    times = times_for(duration)
    radius, angle = (np.broadcast_to(value, times.shape) for value in motion(times))
    positions = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    metrics = measure(times, positions[:, None, :])
    assert flags_of(metrics) == [flags]
    np.testing.assert_allclose(metrics.rms, rms, atol=SAGITTA)
    np.testing.assert_allclose(metrics.maximum, rms, atol=SAGITTA)
    assert (metrics.samples[0] == 0) == np.isnan(rms)
    if laps is not None:
        np.testing.assert_allclose(metrics.laps, laps, rtol=1e-6)
    error = None if np.isnan(rms) else pytest.approx(rms, abs=SAGITTA)
    assert metrics.summary() == {
        "reach_fraction": float("r" in flags),
        "lap_fraction": float("l" in flags),
        "end_fraction": None,
        "stall_fraction": float("x" in flags),
        "leave_fraction": float("o" in flags),
        "cross_track_rms": error,
        "cross_track_max": error,
    }


def test_a_lap_of_equal_steps_begins_and_ends_at_one_place():
    corners = np.array([[2.0, -2.0], [2.0, 2.0], [-2.0, 2.0], [-2.0, -2.0]])
    square = ReferencePath((Piece(corners, closed=True),))
    times = 0.05 * np.arange(500)
    metrics = measure(times, square.pieces[0].at(times % 16)[:, None], square)
    assert metrics.lapped.tolist() == [True]
    assert metrics.samples.tolist() == [16 / 0.05 + 1]


def test_the_error_is_that_of_the_last_lap_only():
    times = times_for(3 * LAP)
    radius = 3 + np.where(times < 1.5 * LAP, 0.2, 0.01 * np.sin(5 * times / 3))
    angle = times / 3
    positions = (radius * np.array([np.cos(angle), np.sin(angle)])).T[:, None, :]
    metrics = measure(times, positions)
    np.testing.assert_allclose(metrics.rms, 0.01 / np.sqrt(2), rtol=1e-2)
    np.testing.assert_allclose(metrics.maximum, 0.01, rtol=1e-2)
    np.testing.assert_allclose(metrics.laps, 3, rtol=1e-6)
    # One lap of samples, and the two at its ends; more where the agent is slow.
    assert abs(metrics.samples[0] - LAP / 0.05) <= 2
    slow = measure(times, around(times, speed=0.4))
    assert slow.samples[0] == pytest.approx(LAP / 0.4 / 0.05, abs=2)


def test_the_given_speed_scales_the_windows():
    times = times_for(LAP / 2, step=0.02)
    fast = around(times, speed=2.0)
    assert measure(times, fast, speed=2.0).lapped.all()
    # A lap in less time than expected is a lap all the same.
    early = measure(times, fast, speed=1.0)
    assert early.lapped.all()
    assert early.settled.all()
    assert np.isfinite(early.rms).all()
    # The same half-turn back and forth needs the time of a lap to be settled.
    half = np.abs(np.pi - np.linspace(0, 2 * np.pi, len(times)))
    sway = 3 * np.column_stack([np.cos(half), np.sin(half)])[:, None, :]
    assert measure(times, sway, speed=2.0).settled.all()
    assert not measure(times, sway, speed=1.0).settled.any()


def test_a_jump_between_pieces_and_an_excursion_begin_the_tail_anew():
    reference = shape_path("separated-circles")
    lap = reference.longest
    times = times_for(2 * lap)
    jump = times >= 1.5 * lap
    circles = (around(times, 1.5, center=(x, 0)) for x in (2, -2))
    positions = np.where(jump[:, None, None], *circles)
    metrics = measure(times, positions, reference)
    assert not (metrics.lapped | metrics.settled).any()
    np.testing.assert_array_equal(metrics.piece, 1)
    np.testing.assert_allclose(metrics.laps, 0.5, atol=0.01)
    late = times >= 0.9 * lap
    assert measure(times[~jump], positions[~jump], reference).lapped.all()
    assert not measure(times[late], positions[late], reference).settled.any()
    times = times_for(1.8 * LAP)
    positions = around(times)
    positions[len(times) // 2] *= 1.2
    metrics = measure(times, positions)
    assert not metrics.lapped.any()
    np.testing.assert_allclose(metrics.laps, 0.9, atol=0.01)


def test_passing_an_open_polyline_is_neither_a_lap_nor_an_end():
    times = times_for(6.0)
    whole = np.linspace(-3, 3, len(times))
    metrics = measure(times, on_line(whole, np.maximum(whole, -2.8), y=0.03), LINE)
    assert metrics.settled.tolist() == [True, True]
    assert not metrics.lapped.any()
    assert not metrics.ended.any()
    np.testing.assert_allclose(metrics.rms, 0.03)
    np.testing.assert_allclose(metrics.laps, [1, 5.8 / 6], rtol=1e-6)


# Open paths: to the end, and to rest there.

LINE = ReferencePath((Piece(np.array([[-3.0, 0.0], [3.0, 0.0]]), closed=False),))
# Time for a stall of 8 U = 6 s after the line of 6 s.
OPEN_TIMES = times_for(20.0)


def on_line(*x, y=0.0):
    """Agents with these coordinates over time on a line along the x axis; (T, n, 2)."""
    return np.stack([np.column_stack([one, np.full_like(one, y)]) for one in x], axis=1)


def travel(start, stop, times=OPEN_TIMES):
    """From `start` at unit speed until `stop`, and still from then on."""
    return start + np.sign(stop - start) * np.minimum(times, abs(stop - start))


def out_and_back(far):
    """To the end, so many U beyond it, and back."""
    return np.interp(OPEN_TIMES, [0, 6, 6.3, 6.6], [-3, 3, 3 + far * U, 3])


def aside(far):
    """So many U beside the line for a second on the way."""
    return far * U * np.interp(OPEN_TIMES, [2, 2.5, 3, 3.5], [0, 1, 1, 0])


# Coordinates over time, and what holds of the agent.
ON_LINE = {
    "from the start": (travel(-3, 3), 0, "rse"),
    "from the middle": (travel(0.5, 3), 0, "rse"),
    "rests .09 U short": (travel(-3, 3 - 0.09 * U), 0, "rse"),
    "rests .09 U beyond": (travel(-3, 3 + 0.09 * U), 0, "rse"),
    "rests .11 U short": (travel(-3, 3 - 0.11 * U), 0, "rsx"),
    "rests .11 U beyond": (travel(-3, 3 + 0.11 * U), 0, "rsx"),
    "rests .2 U short": (travel(-3, 3 - 0.2 * U), 0, "rsx"),
    "runs past it": (-3 + OPEN_TIMES, 0, "ro"),
    "returns from .35 U": (out_and_back(0.35), 0, "rsx"),
    "returns from .25 U": (out_and_back(0.25), 0, "rse"),
    "starts at the end": (travel(3, 3), 0, "rse"),
    # What it leaves on the way, it skips.
    "leaves by .4 U": (travel(-3, 3), aside(0.4), "rsx"),
    "leaves by .28 U": (travel(-3, 3), aside(0.28), "rse"),
}


def test_only_who_comes_to_rest_at_the_end_has_ended():
    agents = [np.column_stack(np.broadcast_arrays(x, y)) for x, y, _ in ON_LINE.values()]
    metrics = measure(OPEN_TIMES, np.stack(agents, axis=1), LINE)
    found = dict(zip(ON_LINE, flags_of(metrics), strict=True))
    assert found == {name: flags for name, (_, _, flags) in ON_LINE.items()}
    assert metrics.open.all()
    assert metrics.summary()["lap_fraction"] is None
    assert metrics.summary()["end_fraction"] == pytest.approx(7 / 13)
    start = [*ON_LINE].index("starts at the end")
    assert (metrics.samples[start], metrics.rms[start]) == (1, 0.0)
    # To be at the end in the last sample, on the way past it, is no end.
    passing = OPEN_TIMES <= 6.0
    metrics = measure(OPEN_TIMES[passing], on_line(-3 + OPEN_TIMES)[passing], LINE)
    assert not metrics.ended.any()


def test_rest_lasts_two_units_of_time_and_spans_a_twentieth_of_a_unit():
    for rest, ended in ((1.9, False), (2.1, True)):
        # Rest counts from the stop, not from coming within a tenth of a unit of the end.
        times = times_for(6 + rest * U, step=0.01)
        metrics = measure(times, on_line(travel(-3, 3, times)), LINE)
        assert metrics.ended.tolist() == [ended]
        # Entered half-way, the run is shorter than the time of the whole line.
        half = times_for(3 + rest * U, step=0.01)
        metrics = measure(half, on_line(travel(0, 3, half)), LINE)
        assert metrics.ended.tolist() == metrics.settled.tolist() == [ended]
        # At twice the speed the same rest takes half of the time.
        metrics = measure(times / 2, on_line(travel(-3, 3, times)), LINE, speed=2.0)
        assert metrics.ended.tolist() == [ended]
    for span, ended in ((0.048, True), (0.052, False)):
        sway = 0.5 * span * U * np.sin(7 * OPEN_TIMES)[:, None] * np.array([0.6, 0.8])
        positions = on_line(travel(-3, 3)) + sway[:, None, :]
        assert measure(OPEN_TIMES, positions, LINE).ended.tolist() == [ended]


def test_resting_does_not_dilute_the_error():
    # Comes in from 1 U off, sways about the line over its whole length, and rests on it.
    x = travel(-3, 3)
    way_in = np.maximum(U - 2 * OPEN_TIMES, 0)
    y = np.where(OPEN_TIMES < 6, way_in + 0.05 * np.sin(2 * np.pi * OPEN_TIMES), 0.0)
    metrics = measure(OPEN_TIMES, np.column_stack([x, y])[:, None, :], LINE)
    assert metrics.ended.all()
    reach = np.argmax(np.abs(y) <= 0.1 * U)
    arrival = np.argmax(np.hypot(x - 3, y) <= 0.1 * U)
    assert metrics.samples.tolist() == [arrival - reach + 1]
    expected = np.sqrt(np.mean(y[reach : arrival + 1] ** 2))
    assert expected > 0.03
    np.testing.assert_allclose(metrics.rms, expected, rtol=1e-9)
    np.testing.assert_allclose(metrics.maximum, np.abs(y[reach : arrival + 1]).max())
    assert metrics.summary()["cross_track_rms"] == pytest.approx(expected)


def test_the_wrong_end_is_none_unless_the_field_ends_there():
    positions = on_line(travel(2, -3), travel(-2, 3))
    for ends, ended in (
        (None, [False, True]),
        (np.empty((0, 2)), [False, True]),
        ([], [False, True]),
        ([[3.0, 0.0]], [False, True]),
        ([[-3.0, 0.0]], [True, False]),
        # The nearer one, however far; and the nearest of several.
        ([[-9.0, 4.0]], [True, False]),
        ([[-2.0, 0.0], [3.5, 0.0]], [False, True]),
        ([[2.0, 0.0], [-3.5, 0.0]], [True, False]),
    ):
        metrics = measure(OPEN_TIMES, positions, LINE, ends=ends)
        assert metrics.ended.tolist() == ended, ends
        assert metrics.stalled.tolist() == [not one for one in ended]


def test_an_arc_ends_in_its_direction_of_travel():
    # A C that opens to the right; its ends are 0.5 U apart, the terminal one below.
    gap = 0.25 * U / 3
    angles = np.linspace(gap, 2 * np.pi - gap, 800)
    arc = 3 * np.column_stack([np.cos(angles), np.sin(angles)])
    path = ReferencePath((Piece(arc, closed=False),))
    times = times_for(30.0)
    angle = np.stack([np.minimum(gap + times / 3, angles[-1]), np.full_like(times, gap)], 1)
    positions = 3.04 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    metrics = measure(times, positions, path)
    # The start is not far from the end, but is not the end.
    assert metrics.ended.tolist() == [True, False]
    assert metrics.rms[0] == pytest.approx(0.04, abs=1e-4)
    np.testing.assert_allclose(metrics.laps, [1, 0], atol=1e-4)
    # Beginning within a tenth of a unit of the end and going all the way is not one sample.
    close = ReferencePath((Piece(np.vstack([arc, arc[0] - [0, 0.06]]), closed=False),))
    spot = close.pieces[0].vertices[-1]
    whole = np.concatenate([close.pieces[0].sample(600), np.tile(spot, (200, 1))])[:, None, :]
    metrics = measure(np.linspace(0, 25, 800), whole, close)
    assert metrics.ended.all()
    assert 550 < metrics.samples[0] <= 600


def hairpin(width):
    """A hairpin path of two strands of 6 and a gap, and its turn at x = 3."""
    vertices = np.array([[-3.0, 0.0], [3.0, 0.0], [3.0, width], [-3.0, width]])
    return ReferencePath((Piece(vertices, closed=False),))


def test_a_shortcut_across_a_hairpin_is_no_end():
    for width in (0.5 * U, 1.5 * U):
        path = hairpin(width)
        times = times_for(24.0)
        # Half-way along the first strand, straight over to the second one; and entered there.
        cut = Piece(np.array([[-3.0, 0], [0, 0], [0, width], [-3, width]]), closed=False)
        late = Piece(np.array([[0.0, 1.2 + width], [0, width], [-3, width]]), closed=False)
        ways = (path.pieces[0], cut, late)
        agents = [way.at(np.minimum(times, way.length)) for way in ways]
        metrics = measure(times, np.stack(agents, axis=1), path)
        assert metrics.ended.tolist() == [True, False, True]
        assert metrics.stalled.tolist() == [False, True, False]
        np.testing.assert_array_equal(metrics.summary()["end_fraction"], 2 / 3)


MIXED = ReferencePath((Piece(LINE.pieces[0].vertices - [0, 3.5], False), CIRCLE.pieces[0]))


def test_open_and_closed_pieces_count_apart():
    times = times_for(22.0)
    x = travel(-3, 3, times)
    agents = [
        on_line(x, travel(-3, 2, times), travel(-3, 2, times), y=-3.5),
        around(times),
        np.tile([[3.0, 0.0]], (len(times), 1, 1)),
    ]
    metrics = measure(times, np.concatenate(agents, axis=1), MIXED)
    assert metrics.open.tolist() == [True, True, True, False, False]
    assert metrics.ended.tolist() == [True, False, False, False, False]
    assert metrics.lapped.tolist() == [False, False, False, True, False]
    summary = metrics.summary()
    assert summary["end_fraction"] == pytest.approx(1 / 3)
    assert summary["lap_fraction"] == 0.5
    assert summary["stall_fraction"] == pytest.approx(3 / 5)
    only_open = measure(times, agents[0], MIXED).summary()
    assert only_open["lap_fraction"] is None
    assert only_open["end_fraction"] == pytest.approx(1 / 3)
    only_closed = measure(times, agents[1], MIXED).summary()
    assert only_closed["lap_fraction"] == 1.0
    assert only_closed["end_fraction"] is None


def test_ends_mean_nothing_to_closed_pieces():
    times = times_for(1.5 * LAP)
    rest = np.tile([[3.0, 0.0]], (len(times), 1, 1))
    positions = np.concatenate([around(times), rest], axis=1)
    without, given = (measure(times, positions, ends=ends) for ends in (None, [[3.0, 0.0]]))
    assert without.summary() == given.summary()
    assert given.summary()["lap_fraction"] == 0.5
    assert given.summary()["end_fraction"] is None
    assert given.stalled.tolist() == [False, True]
    assert not given.ended.any()
    assert not given.open.any()


def test_pooled_error_weighs_each_sample():
    times = times_for(2 * LAP)
    agents = [around(times, 3.03), around(times, 3.1, speed=0.75), around(times, 3.9)]
    metrics = measure(times, np.concatenate(agents, axis=1))
    assert metrics.settled.tolist() == [True, True, False]
    n = metrics.samples
    expected = np.sqrt((n[0] * 0.03**2 + n[1] * 0.1**2) / (n[0] + n[1]))
    summary = metrics.summary()
    assert summary["cross_track_rms"] == pytest.approx(expected, abs=SAGITTA)
    assert summary["cross_track_max"] == pytest.approx(0.1, abs=SAGITTA)
    assert summary["lap_fraction"] == pytest.approx(2 / 3)


@settings(max_examples=10, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    angle=st.floats(0, 2 * np.pi),
    scale=st.floats(1e-3, 1e3),
    offset=st.floats(-10, 10),
)
def test_rigid_motion_and_scaling_change_nothing(seed, angle, scale, offset):
    rng = np.random.default_rng(seed)
    times = times_for(25.0, step=0.1)
    speeds = rng.uniform(0.1, 1.2, 6)
    # Outside a convex polygon the projection is continuous, so rounding cannot move it.
    radii = 3.02 + rng.uniform(0, 0.5, 6) * np.exp(-times[:, None] / 5)
    angles = times[:, None] * speeds / 3
    positions = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=-1)
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, s], [-s, c]])

    def move(x):
        return scale * (x @ turn + offset)

    # A polygon, as rotating a circle's own vertices onto each other would prove less.
    vertices = CIRCLE.pieces[0].vertices[::64]
    paths = [ReferencePath((Piece(v, closed=True),)) for v in (vertices, move(vertices))]
    # The box is a square along the axes: it moves along, but cannot turn.
    center = move(np.zeros((1, 2)))[0]
    boxes = [BOX, (center + scale * BOX[0], center + scale * BOX[1])]
    before = follow_metrics(times, positions, U, boxes[0], paths[0])
    after = follow_metrics(
        times * scale, move(positions), U * scale, boxes[1], paths[1], speed=1.0
    )
    for name in ("reached", "settled", "lapped", "stalled", "left", "piece", "samples"):
        np.testing.assert_array_equal(getattr(after, name), getattr(before, name))
    np.testing.assert_allclose(after.rms, before.rms * scale, rtol=1e-4, atol=1e-6 * scale)
    np.testing.assert_allclose(after.laps, before.laps, rtol=1e-6, atol=1e-6)


def test_default_duration():
    assert default_duration(CIRCLE, U) == pytest.approx(1.5 * 6 * np.pi + 15 * 0.75)
    assert default_duration(CIRCLE, U, speed=2.0) == pytest.approx(
        default_duration(CIRCLE, U) / 2
    )


def test_starts_are_a_grid_of_distinct_points_over_the_box():
    starts = grid_starts((np.array([-5.0, -4]), np.array([5.0, 4])), 400, 2)
    assert starts.shape == (400, 2)
    for axis, half in enumerate((5, 4)):
        np.testing.assert_allclose(np.unique(starts[:, axis]), np.linspace(-half, half, 20))
    for n, dim in ((1, 2), (2, 2), (5, 2), (145, 2), (27, 3), (30, 3)):
        box = (-np.ones(dim), np.ones(dim))
        starts = grid_starts(box, n, dim)
        assert starts.shape == (n, dim)
        assert len(np.unique(starts, axis=0)) == n
        assert np.abs(starts).max() <= 1
        np.testing.assert_array_equal(starts, grid_starts(box, n, dim))
        corners = [np.zeros(dim)] * 2 if n == 1 else box
        np.testing.assert_array_equal(starts[[0, -1]], corners)


def test_bad_input_is_refused():
    good = {
        "times": np.arange(5.0),
        "positions": np.zeros((5, 1, 2)),
        "unit_length": U,
        "box": BOX,
        "reference": CIRCLE,
    }
    for change, match in (
        ({"times": np.zeros(5)}, "increasing"),
        ({"times": np.arange(1.0)}, "at least 2"),
        ({"positions": np.zeros((5, 2))}, r"must be \(5, n, 2\)"),
        ({"positions": np.zeros((4, 1, 2))}, r"not \(4, 1, 2\)"),
        ({"positions": np.zeros((5, 1, 3))}, r"not \(5, 1, 3\)"),
        ({"unit_length": 0.0}, "unit_length must be positive"),
        ({"speed": np.nan}, "speed must be positive"),
        ({"ends": np.zeros((2, 3))}, r"ends must be \(E, 2\), not \(2, 3\)"),
        ({"ends": np.zeros(2)}, r"ends must be \(E, 2\), not \(2,\)"),
    ):
        with pytest.raises(ConfigurationError, match=match):
            follow_metrics(**(good | change))
    positions = np.zeros((5, 3, 2))
    positions[4, 1, 0] = np.nan
    with pytest.raises(NonFiniteValueError, match="agent 1 is not finite at time 2"):
        measure(np.linspace(0, 2, 5), positions)
    with pytest.raises(NonFiniteValueError, match="end 1 of the field is not finite"):
        measure(np.linspace(0, 2, 5), 0 * positions[:, :1], ends=[[0, 0], [0, np.inf]])
    for n, dim, match in ((0, 2, "at least 1"), (4, 3, "corners")):
        with pytest.raises(ConfigurationError, match=match):
            grid_starts(BOX, n, dim)


def test_the_nearest_two_are_told_at_each_time():
    """Three on a line that move apart, and a fourth that passes between two of them."""
    times = times_for(1.0)
    x = np.stack([np.zeros_like(times), 1.0 + times, 3.0 + times, 0.5 + 2.0 * times], axis=1)
    positions = np.stack([x, np.zeros_like(x)], axis=2)
    expected = np.minimum(0.5 + 2.0 * times, np.abs(0.5 - times))
    np.testing.assert_allclose(least_separation(positions), expected)


def test_one_agent_alone_has_no_separation():
    with pytest.raises(ConfigurationError, match="n >= 2"):
        least_separation(np.zeros((5, 1, 2)))
    with pytest.raises(NonFiniteValueError, match="not finite"):
        least_separation(np.full((5, 2, 2), np.nan))
