"""Following: Drake's batch against single runs, SciPy, other units and smaller steps."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.experiments import choose_reference, follow
from sgvf_drake.paths import Piece, ReferencePath
from sgvf_drake.paths.finding import find_paths
from systems import MakeKinematicDiagram, MakeSimulator, SetPositions


class LineField:
    """Comes in to the x axis and comes to rest at one end of a line of points there."""

    dim, sigma = 2, 0.1

    def __init__(self, terminal, declared=True):
        """Goes to `terminal`, 3 or -3, and says so if `declared`."""
        self.cloud = PointCloud(np.column_stack([np.linspace(-3, 3, 61), np.zeros(61)]))
        self.terminal = np.array([terminal, 0.0])
        self.ends = self.terminal[None, :] if declared else np.empty((0, 2))

    @property
    def path(self):
        return find_paths(self.cloud).path

    def __call__(self, x):
        along = np.tanh((self.terminal[0] - x[:, 0]) / 0.2) / np.cosh(3 * x[:, 1])
        return np.column_stack([along, -np.tanh(3 * x[:, 1])])


def end_positions(field, starts, duration, step):
    """Where agents (n, d) are after a time at one U a second."""
    diagram = MakeKinematicDiagram(field, len(starts), speed=field.cloud.unit_length)
    simulator = MakeSimulator(diagram, step=step)
    SetPositions(diagram, simulator.get_mutable_context(), starts)
    simulator.AdvanceTo(duration)
    state = simulator.get_context().get_continuous_state_vector().CopyToVector()
    return state.reshape(starts.shape)


def test_every_start_laps_close_to_the_circles(followed, flight_field):
    summary = followed.summary()
    unit = flight_field.cloud.unit_length
    assert set(summary) == {
        *("starts", "reach_fraction", "lap_fraction", "end_fraction", "stall_fraction"),
        *("leave_fraction", "cross_track_rms", "cross_track_max", "speed_on_path_min"),
        *("speed_on_path_max", "duration", "wall_s"),
    }
    assert summary["starts"] == 16
    assert summary["reach_fraction"] == summary["lap_fraction"] == 1.0
    assert summary["stall_fraction"] == summary["leave_fraction"] == 0.0
    assert 0.0 < summary["cross_track_rms"] <= 0.02 * unit
    assert summary["cross_track_rms"] <= summary["cross_track_max"] <= 0.03 * unit
    assert 0.98 <= summary["speed_on_path_min"] <= summary["speed_on_path_max"] <= 1.02
    assert summary["wall_s"] > 0.0


def test_a_run_covers_its_duration_from_the_grid(followed, flight_field):
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


def test_a_batch_agrees_with_single_runs_and_with_scipy(followed, flight_field):
    field, unit = flight_field, flight_field.cloud.unit_length
    step, sample = min(0.05, 0.5 * field.sigma), 150
    times = followed.times[: sample + 1]
    for agent in (0, 6):
        start = followed.positions[0, [agent]]
        alone = end_positions(field, start, times[-1] / unit, step)
        np.testing.assert_allclose(alone[0], followed.positions[sample, agent], atol=1e-9)
        solution = solve_ivp(
            lambda _, x: field(x[None])[0],
            (0.0, times[-1]),
            start[0],
            t_eval=times,
            method="DOP853",
            rtol=1e-9,
            atol=1e-11,
        )
        # 1e-3 U as measured, nearly all along the path and gathered in the way in.
        error = np.abs(followed.positions[: sample + 1, agent] - solution.y.T)
        assert error.max() <= 2e-3 * unit


def test_the_integrator_converges_with_order_three(flight_field, rings):
    points = rings.pieces[0].sample(8)
    starts = points * (1 + 0.05 / np.linalg.norm(points, axis=1, keepdims=True))
    steps = np.array([0.04, 0.02, 0.01])
    exact = end_positions(flight_field, starts, 1.0, 0.002)
    errors = [
        np.abs(end_positions(flight_field, starts, 1.0, step) - exact).max() for step in steps
    ]
    assert min(errors) > 1e-12, "too small to tell an order from rounding"
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert 2.6 <= slope <= 3.6


def test_half_the_step_and_the_unit_of_length_change_little(
    monkeypatch, followed, flight_field, rings
):
    unit, samples = flight_field.cloud.unit_length, slice(0, 101)
    expected = followed.positions[samples]
    duration = followed.times[100]
    told = []
    for factor in (1e-3, 1e3):
        field, path = flight_field.rescaled(factor), rings.rescaled(factor)
        other = follow(field, path, 16, factor * duration, lambda *call: told.append(call))
        assert told[-1][0] == "follow"
        assert told[-1][1] == told[-1][2]
        count = len(other.times)
        np.testing.assert_allclose(other.times, factor * followed.times[:count], rtol=1e-12)
        np.testing.assert_allclose(
            other.positions, factor * expected[:count], atol=1e-6 * factor
        )
        np.testing.assert_allclose(
            other.errors, factor * followed.errors[:count], atol=1e-6 * factor
        )
    module = follow.__globals__
    for name in ("STEP", "STEP_PER_SIGMA"):
        monkeypatch.setitem(module, name, module[name] / 2)
    fine = follow(flight_field, rings, 16, duration)
    count = len(fine.times)
    assert not np.array_equal(fine.positions, expected[:count])
    assert np.abs(fine.positions - expected[:count]).max() <= 1e-3 * unit


@pytest.mark.parametrize(("value", "fate"), [([1.0, 0.0], "leave"), ([0.0, 0.0], "stall")])
def test_agents_of_a_constant_field(constant_field, circle_of_points, value, fate):
    field = constant_field(circle_of_points(1.0), value)
    summary = follow(field, choose_reference(field)[0], starts=9).summary()
    for name in ("leave", "stall", "lap"):
        assert summary[f"{name}_fraction"] == (name == fate)
    assert summary["speed_on_path_max"] == value[0]
    if fate == "leave":
        assert summary["cross_track_rms"] is summary["cross_track_max"] is None


@pytest.mark.parametrize("terminal", [3.0, -3.0])
def test_agents_come_to_rest_at_the_end_of_the_field(terminal):
    field = LineField(terminal)
    reference, kind = choose_reference(field)
    assert kind == "cloud"
    line = ReferencePath((Piece(np.array([[-3.0, 0.0], [3.0, 0.0]]), closed=False),))
    for path in (reference, line):
        result = follow(field, path, starts=9)
        summary = result.summary()
        assert result.metrics.ended.all()
        assert summary["reach_fraction"] == summary["end_fraction"] == 1.0
        assert summary["lap_fraction"] is None
        assert summary["stall_fraction"] == summary["leave_fraction"] == 0.0
        assert 0.0 < summary["cross_track_rms"] <= 0.1 * field.cloud.unit_length
    # A field that declares no end ends where the reference does.
    undeclared = LineField(terminal, declared=False)
    summary = follow(undeclared, choose_reference(undeclared)[0], starts=9).summary()
    assert summary["end_fraction"] == (terminal > 0)
    assert summary["stall_fraction"] == (terminal < 0)


def test_bad_values_are_refused(flight_field, rings, constant_field, circle_of_points):
    for duration in (np.nan, np.inf, 0.0, -1.0, 1e-9):
        with pytest.raises(ConfigurationError, match=r"duration must be .* not"):
            follow(flight_field, rings, starts=4, duration=duration)
    with pytest.raises(ConfigurationError, match="starts must be at least 1, not 0"):
        follow(flight_field, rings, starts=0)
    field = constant_field(circle_of_points(1.0), [np.nan, 0.0])
    with pytest.raises(NonFiniteValueError, match="velocity of agent 0"):
        follow(field, choose_reference(field)[0], starts=4)
