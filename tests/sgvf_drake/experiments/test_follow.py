"""Following: Drake's batch against single runs, SciPy, other units and smaller steps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError, PointCloudError
from sgvf_drake.experiments import choose_reference, figures, follow, scale_reference
from sgvf_drake.paths import Piece, PointCloud, ReferencePath, TreeReference
from systems import MakeKinematicDiagram, MakeSimulator, SetPositions

SUMMARY_KEYS = {
    *("starts", "reach_fraction", "lap_fraction", "stall_fraction", "leave_fraction"),
    *("cross_track_rms", "cross_track_max", "speed_on_path_min", "speed_on_path_max"),
    "end_fraction",
}


class LineField:
    """Comes in to the x axis and comes to rest at one end of a line of points there."""

    dim, sigma = 2, 0.1
    recipe, seed = "none", 0

    def __init__(self, terminal, declared=True):
        """Goes to `terminal`, 3 or -3, and says so if `declared`."""
        self.cloud = PointCloud(np.column_stack([np.linspace(-3, 3, 61), np.zeros(61)]))
        self.terminal = np.array([terminal, 0.0])
        self.ends = self.terminal[None, :] if declared else np.empty((0, 2))

    def __call__(self, x):
        along = np.tanh((self.terminal[0] - x[:, 0]) / 0.2) / np.cosh(3 * x[:, 1])
        return np.column_stack([along, -np.tanh(3 * x[:, 1])])


@pytest.fixture
def constant_field(constant_field):
    """Makes constant fields that come to rest nowhere in particular: (cloud, value)."""

    def make(cloud, value):
        field = constant_field(cloud, value)
        field.ends = np.empty((0, cloud.dim))
        return field

    return make


def end_positions(field, starts, duration, step):
    """Where agents (n, d) are after a time at one U a second."""
    diagram = MakeKinematicDiagram(field, len(starts), speed=field.cloud.unit_length)
    simulator = MakeSimulator(diagram, step=step)
    SetPositions(diagram, simulator.get_mutable_context(), starts)
    simulator.AdvanceTo(duration)
    state = simulator.get_context().get_continuous_state_vector().CopyToVector()
    return state.reshape(starts.shape)


def on_the_path(field, piece, offset):
    """Eight starts beside a circle."""
    points = piece.sample(8)
    return points * (1 + offset / np.linalg.norm(points, axis=1, keepdims=True))


def test_every_start_laps_close_to_the_circles(followed, flight_field):
    summary = followed.summary()
    unit = flight_field.cloud.unit_length
    assert summary["reach_fraction"] == summary["lap_fraction"] == 1.0
    assert summary["stall_fraction"] == summary["leave_fraction"] == 0.0
    assert 0.0 < summary["cross_track_rms"] <= 0.02 * unit
    assert summary["cross_track_rms"] <= summary["cross_track_max"] <= 0.03 * unit
    assert 0.98 <= summary["speed_on_path_min"] <= summary["speed_on_path_max"] <= 1.02


def test_summary_has_its_names(followed):
    assert set(followed.summary()) == {*SUMMARY_KEYS, "duration", "wall_s"}
    assert followed.summary()["starts"] == 16
    assert followed.wall_s > 0.0


def test_a_run_covers_its_duration_from_the_grid(followed, flight_field, rings):
    unit = flight_field.cloud.unit_length
    lower, upper = flight_field.cloud.box
    np.testing.assert_allclose(followed.positions[0].min(axis=0), lower)
    np.testing.assert_allclose(followed.positions[0].max(axis=0), upper)
    assert followed.times[0] == 0.0
    # Sampled every 0.05 U, so the last sample lies less than that before the end.
    duration = 1.5 * 2 * np.pi * 2.0 + 15 * unit
    assert followed.times[-1] == pytest.approx(duration, abs=0.05 * unit)
    radius = np.linalg.norm(followed.positions, axis=2)
    truth = np.minimum(abs(radius - 1.0), abs(radius - 2.0))
    np.testing.assert_allclose(followed.errors, truth, atol=2e-6)


def test_a_batch_equals_single_runs_in_drake(followed, flight_field, rings):
    field, unit = flight_field, flight_field.cloud.unit_length
    step = min(0.05, 0.5 * field.sigma)
    sample = len(followed.times) // 2
    duration = followed.times[sample] / unit
    for agent in (0, 6, 9, 15):
        alone = end_positions(field, followed.positions[0, [agent]], duration, step)
        np.testing.assert_allclose(alone[0], followed.positions[sample, agent], atol=1e-9)


def test_a_batch_agrees_with_scipy(followed, flight_field, rings):
    field, unit = flight_field, flight_field.cloud.unit_length
    agents = [0, 5, 10, 15]
    starts = followed.positions[0, agents]
    solution = solve_ivp(
        lambda _, state: field(state.reshape(-1, 2)).ravel(),
        (0.0, followed.times[-1]),
        starts.ravel(),
        t_eval=followed.times,
        method="DOP853",
        rtol=1e-9,
        atol=1e-11,
    )
    exact = solution.y.T.reshape(-1, len(agents), 2)
    # 1e-3 U as measured, nearly all along the path and gathered in the way in.
    assert np.abs(followed.positions[:, agents] - exact).max() <= 2e-3 * unit
    last = slice(len(exact) // 2, None)
    distance = rings.project(exact[last].reshape(-1, 2)).distance.reshape(-1, len(agents))
    np.testing.assert_allclose(followed.errors[last][:, agents], distance, atol=1e-4 * unit)


def test_the_integrator_converges_with_order_three(flight_field, rings):
    starts = on_the_path(flight_field, rings.pieces[0], 0.05)
    steps = np.array([0.04, 0.02, 0.01])
    exact = end_positions(flight_field, starts, 2.0, 0.001)
    errors = [
        np.abs(end_positions(flight_field, starts, 2.0, step) - exact).max() for step in steps
    ]
    assert min(errors) > 1e-12, "too small to tell an order from rounding"
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 2.6 <= slope <= 3.6


def test_half_the_step_changes_little(monkeypatch, followed, flight_field, rings):
    module = follow.__globals__
    for name in ("STEP", "STEP_PER_SIGMA"):
        monkeypatch.setitem(module, name, module[name] / 2)
    fine = follow(flight_field, rings, starts=16)
    assert not np.array_equal(fine.positions, followed.positions)
    unit = flight_field.cloud.unit_length
    assert np.abs(fine.positions - followed.positions).max() <= 1e-3 * unit


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_the_unit_of_length_does_not_matter(followed, flight_field, rings, factor):
    other = follow(flight_field.rescaled(factor), scale_reference(rings, factor), starts=16)
    np.testing.assert_allclose(other.times, factor * followed.times, rtol=1e-12)
    np.testing.assert_allclose(other.positions, factor * followed.positions, atol=1e-6 * factor)
    expected, found = followed.summary(), other.summary()
    for key in SUMMARY_KEYS:
        scaled = expected[key] * factor if key.startswith("cross_track") else expected[key]
        assert found[key] == (scaled and pytest.approx(scaled, rel=1e-6)), key


def test_agents_of_a_constant_field_leave(constant_field, circle_of_points):
    cloud = circle_of_points(1.0)
    field = constant_field(cloud, [1.0, 0.0])
    summary = follow(field, choose_reference(field)[0], starts=9).summary()
    assert summary["leave_fraction"] == 1.0
    assert summary["lap_fraction"] == summary["stall_fraction"] == 0.0
    assert summary["cross_track_rms"] is None
    assert summary["cross_track_max"] is None


def test_agents_of_a_zero_field_stall(constant_field, circle_of_points):
    field = constant_field(circle_of_points(1.0), [0.0, 0.0])
    summary = follow(field, choose_reference(field)[0], starts=9).summary()
    assert summary["stall_fraction"] == 1.0
    assert summary["leave_fraction"] == summary["lap_fraction"] == 0.0
    assert summary["speed_on_path_max"] == 0.0


@pytest.mark.parametrize("terminal", [3.0, -3.0])
def test_agents_come_to_rest_at_the_end_of_the_field(terminal):
    field = LineField(terminal)
    reference, kind = choose_reference(field)
    assert kind == "cloud"
    line = ReferencePath((Piece(np.array([[-3.0, 0.0], [3.0, 0.0]]), closed=False),))
    for path in (reference, line):
        result = follow(field, path, starts=25)
        summary = result.summary()
        assert result.metrics.ended.all()
        assert summary["reach_fraction"] == summary["end_fraction"] == 1.0
        assert summary["lap_fraction"] is None
        assert summary["stall_fraction"] == summary["leave_fraction"] == 0.0
        assert 0.0 < summary["cross_track_rms"] <= 0.1 * field.cloud.unit_length


@pytest.mark.parametrize(("terminal", "ended"), [(3.0, 1.0), (-3.0, 0.0)])
def test_a_field_without_ends_ends_where_the_reference_does(terminal, ended):
    field = LineField(terminal, declared=False)
    summary = follow(field, choose_reference(field)[0], starts=9).summary()
    assert summary["end_fraction"] == ended
    assert summary["stall_fraction"] == 1.0 - ended


@pytest.mark.parametrize(
    ("open_", "title"),
    [
        ([False] * 3, "2 of 3 starts complete a lap"),
        ([True] * 3, "2 of 3 starts come to rest at the end"),
        ([False, True, True], "2 of 3 starts complete a lap or come to rest at the end"),
    ],
)
def test_the_figure_says_what_the_agents_are_to_do(monkeypatch, open_, title):
    field = LineField(3.0)
    result = follow(field, choose_reference(field)[0], starts=3, duration=1.0)
    is_open, good = np.array(open_), np.array([True, True, False])
    metrics = replace(
        result.metrics, open=is_open, lapped=good & ~is_open, ended=good & is_open
    )
    seen = []
    module = figures.follow_figure.__globals__["plotting"]
    for name in ("plane_axes", "plot_trajectories"):
        monkeypatch.setattr(module, name, lambda *args: seen.append(args[-1]))
    figures.follow_figure(field, replace(result, metrics=metrics))
    followed, shown = seen
    assert followed.tolist() == good.tolist()
    assert shown == title


def test_a_field_that_is_not_finite_stops_the_run(constant_field, circle_of_points):
    field = constant_field(circle_of_points(1.0), [np.nan, 0.0])
    with pytest.raises(NonFiniteValueError, match="velocity of agent 0"):
        follow(field, choose_reference(field)[0], starts=4)


@pytest.mark.parametrize("duration", [np.nan, np.inf, 0.0, -1.0, 1e-9])
def test_a_bad_duration_is_refused(flight_field, rings, duration):
    with pytest.raises(ConfigurationError, match=r"duration must be .* not"):
        follow(flight_field, rings, starts=4, duration=duration)


def test_no_starts_are_refused(flight_field, rings):
    with pytest.raises(ConfigurationError, match="starts must be at least 1, not 0"):
        follow(flight_field, rings, starts=0)


def test_progress_ends_with_the_run(flight_field, rings):
    calls = []
    follow(flight_field, rings, 1, 2.0, lambda *call: calls.append(call))
    done = [call[1] for call in calls]
    assert {call[0] for call in calls} == {"follow"}
    assert len(done) > 10
    assert done == sorted(done)
    assert done[-1] == calls[-1][2]


# The reference.


def test_a_named_shape_is_measured_against_the_truth(flight_field):
    reference, kind = choose_reference(flight_field)
    assert kind == "shape"
    np.testing.assert_allclose(reference.lengths, 2 * np.pi * np.array([1.0, 2.0]), rtol=1e-5)


def test_other_clouds_are_measured_against_their_tree(flight_field):
    reference, kind = choose_reference(flight_field.rescaled(2.0))
    assert kind == "cloud"
    assert isinstance(reference, TreeReference)
    np.testing.assert_allclose(
        sorted(reference.lengths), 4 * np.pi * np.array([1.0, 2.0]), rtol=1e-2
    )


def test_a_file_comes_first(tmp_path, flight_field):
    file = tmp_path / "path.csv"
    file.write_text("x_m,y_m,speed\n0,0,1\n1,0,1\n1,1,1\n")
    reference, kind = choose_reference(flight_field, file)
    assert kind == "file"
    assert isinstance(reference, ReferencePath)
    assert reference.longest == 2.0
    closed, _ = choose_reference(flight_field, file, closed=True)
    assert closed.longest == pytest.approx(2.0 + np.sqrt(2.0))
    swapped, _ = choose_reference(flight_field, file, ["speed", "x_m"])
    assert swapped.pieces[0].vertices[0].tolist() == [1.0, 0.0]


def test_a_file_of_another_dimension_is_refused(tmp_path, flight_field):
    file = tmp_path / "path.csv"
    file.write_text("0 0 0\n1 0 0\n1 1 1\n")
    with pytest.raises(ConfigurationError, match=r"path.csv: .* 3 coordinates, the field 2"):
        choose_reference(flight_field, file)


def test_a_missing_file_is_refused(tmp_path, flight_field):
    with pytest.raises(PointCloudError, match=r"none.csv"):
        choose_reference(flight_field, tmp_path / "none.csv")


def test_references_scale(flight_field, rings, circle_of_points):
    tree, _ = choose_reference(flight_field.rescaled(1.0))
    for reference in (rings, tree):
        np.testing.assert_allclose(
            scale_reference(reference, 3.0).lengths, 3.0 * reference.lengths, rtol=1e-12
        )
    with pytest.raises(TypeError, match="cannot scale a PointCloud"):
        scale_reference(circle_of_points(1.0), 2.0)
