"""Advancing a simulation: as Drake does at once, told of, and ended by a monitor."""

import math

import numpy as np
import pytest

from sgvf_drake.experiments.simulation import advance, read_log
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
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
    """A simulator from |x| = 1, along x(t) = e^t x(0)."""
    diagram = MakeKinematicDiagram(OutwardField(), log_period=STEP, lyapunov=BOWL, level=level)
    simulator = MakeSimulator(diagram, step=STEP)
    SetPositions(diagram, simulator.get_mutable_context(), [1.0, 0.0])
    return simulator


def log_of(simulator, name):
    return read_log(simulator.get_system(), simulator.get_context(), name)


def test_it_goes_where_one_call_of_drake_goes():
    calls = []
    simulator, other = outward(), outward()
    assert advance(simulator, 2.003, STEP, "out", lambda *call: calls.append(call)) > 0.0
    other.AdvanceTo(2.003)
    assert simulator.get_context().get_time() == 2.003
    for name in ("positions_log", "V_log"):
        for found, expected in zip(log_of(simulator, name), log_of(other, name), strict=True):
            np.testing.assert_array_equal(found, expected)
    times, positions = log_of(simulator, "positions_log")
    assert (times.shape, positions.shape) == ((201,), (201, 2))
    np.testing.assert_allclose(times, np.arange(201) * STEP, atol=1e-12)
    # The integrator's error is h^3 e^2 / 24 or so.
    np.testing.assert_allclose(positions[:, 0], np.exp(times), atol=1e-6)
    # Told of a hundred parts.
    assert len(calls) == 101
    assert calls[-1] == ("out", 2.003, 2.003)
    assert [call[1] for call in calls] == sorted(call[1] for call in calls)


@pytest.mark.parametrize(("level", "duration"), [(2.0, 2.0), (2.0, 3.0), (100.0, 2.0)])
def test_it_stops_where_a_monitor_ends_the_simulation(level, duration):
    # |x| passes 2 at t = log 2.
    calls = []
    simulator = outward(level)
    watch = StopOnExit(simulator)
    advance(simulator, duration, STEP, "out", lambda *call: calls.append(call))
    if level > 2.0:
        assert watch.exit is None
        assert calls[-1] == ("out", duration, duration)
        return
    assert watch.exit.time_inside < math.log(2.0) <= watch.exit.time
    assert watch.exit.time - watch.exit.time_inside == pytest.approx(STEP)
    # Not a step further, whatever was left to report.
    assert simulator.get_context().get_time() == watch.exit.time
    assert calls
    assert all(call[1] < math.log(2.0) for call in calls)
