"""Advancing a simulation: as Drake does at once, told of, and ended by a monitor."""

import math

import numpy as np
import pytest

from sgvf_drake.experiments.simulation import advance, read_log
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.progress import no_progress
from systems import MakeKinematicDiagram, MakeSimulator, SetPositions, StopOnExit

STEP = 0.01


class OutwardField:
    """The field m(x) = x, which leaves every circle about the origin."""

    dim = 2

    def __call__(self, x):
        return x


# One waypoint: V = |x|^2 / 2.
BOWL = LyapunovFunction(GaussianMixture(np.zeros((1, 2)), 1.0))


def outward(level=math.inf):
    """A diagram and its simulation from |x| = 1, along x(t) = e^t x(0)."""
    diagram = MakeKinematicDiagram(OutwardField(), log_period=STEP, lyapunov=BOWL, level=level)
    simulator = MakeSimulator(diagram, step=STEP)
    SetPositions(diagram, simulator.get_mutable_context(), [1.0, 0.0])
    return diagram, simulator


def test_it_goes_where_one_call_of_drake_goes():
    diagram, simulator = outward()
    wall_s = advance(simulator, 2.003, STEP, "out", no_progress)
    assert wall_s > 0.0
    other_diagram, other = outward()
    other.AdvanceTo(2.003)
    assert simulator.get_context().get_time() == 2.003
    for name in ("positions_log", "V_log"):
        times, values = read_log(diagram, simulator.get_context(), name)
        expected = read_log(other_diagram, other.get_context(), name)
        np.testing.assert_array_equal(times, expected[0])
        np.testing.assert_array_equal(values, expected[1])


def test_logs_are_read_one_row_a_sample():
    diagram, simulator = outward()
    advance(simulator, 1.0, STEP, "out", no_progress)
    times, positions = read_log(diagram, simulator.get_context(), "positions_log")
    assert (times.shape, positions.shape) == ((101,), (101, 2))
    np.testing.assert_allclose(times, np.arange(101) * STEP, atol=1e-12)
    # The integrator's error is h^3 e / 24 or so.
    np.testing.assert_allclose(positions[:, 0], np.exp(times), atol=2e-7)


def test_progress_is_told_of_a_hundred_parts():
    calls = []
    _, simulator = outward()
    advance(simulator, 4.0, STEP, "out", lambda *call: calls.append(call))
    assert len(calls) == 101
    assert calls[-1] == ("out", 4.0, 4.0)
    assert [call[1] for call in calls] == sorted(call[1] for call in calls)


@pytest.mark.parametrize("duration", [2.0, 3.0])
def test_it_stops_where_a_monitor_ends_the_simulation(duration):
    # |x| passes 2 at t = log 2.
    calls = []
    _, simulator = outward(level=2.0)
    watch = StopOnExit(simulator)
    advance(simulator, duration, STEP, "out", lambda *call: calls.append(call))
    assert watch.exit.time_inside < math.log(2.0) <= watch.exit.time
    assert watch.exit.time - watch.exit.time_inside == pytest.approx(STEP)
    # Not a step further, whatever was left to report.
    assert simulator.get_context().get_time() == watch.exit.time
    assert calls
    assert all(call[1] < math.log(2.0) for call in calls)


def test_a_monitor_that_does_not_end_it_changes_nothing():
    calls = []
    _, simulator = outward(level=100.0)
    watch = StopOnExit(simulator)
    advance(simulator, 2.0, STEP, "out", lambda *call: calls.append(call))
    assert watch.exit is None
    assert calls[-1] == ("out", 2.0, 2.0)
