"""Runs that are pushed out of a sublevel set, against dense evaluations offline."""

import math

import numpy as np
from pydrake.systems.analysis import SimulatorStatus
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder, Integrator, LogVectorOutput, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from systems import (
    AddLyapunovMonitor,
    KinematicGuidance,
    MakeFlightDiagram,
    MakeKinematicDiagram,
    MakeSimulator,
    SetPositions,
    SetVehicleState,
    StopOnExit,
)

STEP = 0.005
LEVEL = 0.5
TERMINATED = SimulatorStatus.ReturnReason.kReachedTerminationCondition
# Times are multiples of a step up to rounding.
ROUNDING = 1e-9


@pytest.fixture
def V(ring_function):  # noqa: N802
    return ring_function


class PushedRun:
    """Agents with p' = m(p) + w(t), composed by hand, and the same ODE for SciPy.

    The wind w is to the right and the same for all: none until `calm`, then rising by
    `growth` each second.
    """

    def __init__(self, field, function, starts, calm, growth, level=LEVEL):
        self.field, self.function, self.level = field, function, level
        self.starts = np.array(starts)
        self.calm, self.growth = calm, growth
        count = len(starts)
        knots = np.array([[0.0, 0.0, 10.0 * growth], [0.0, 0.0, 0.0]])
        wind = PiecewisePolynomial.FirstOrderHold(
            [0.0, calm, calm + 10.0], np.tile(knots, (count, 1))
        )
        builder = DiagramBuilder()
        guidance = builder.AddSystem(KinematicGuidance(field, count))
        source = builder.AddSystem(TrajectorySource(wind))
        adder = builder.AddSystem(Adder(2, 2 * count))
        agents = builder.AddNamedSystem("agents", Integrator(2 * count))
        builder.Connect(guidance.get_output_port(), adder.get_input_port(0))
        builder.Connect(source.get_output_port(), adder.get_input_port(1))
        builder.Connect(adder.get_output_port(), agents.get_input_port())
        builder.Connect(agents.get_output_port(), guidance.get_input_port())
        AddLyapunovMonitor(
            builder,
            function,
            agents.get_output_port(),
            adder.get_output_port(),
            num_agents=count,
            level=level,
            log_period=0.0,
        )
        self.log = LogVectorOutput(agents.get_output_port(), builder, 0.0)
        self.diagram = builder.Build()
        self.simulator = MakeSimulator(self.diagram, step=STEP)
        self.context = self.simulator.get_mutable_context()
        agents.GetMyMutableContextFromRoot(self.context).SetContinuousState(self.starts.ravel())

    def velocity(self, t, p):
        wind = np.array([self.growth * max(t - self.calm, 0.0), 0.0])
        return self.field(p) + wind

    def crossings(self, duration):
        """For each agent the time and the place at which it first goes out, by SciPy."""
        found = []
        for start in self.starts:
            solution = solve_ivp(
                self.velocity,
                (0.0, duration),
                start,
                method="DOP853",
                rtol=1e-11,
                atol=1e-12,
                dense_output=True,
                max_step=0.05,  # The wind has a kink.
            ).sol

            def excess(t, solution=solution):
                return float(self.function(np.atleast_2d(solution(t)))[0]) - self.level

            times = np.arange(0.0, duration, 1e-3)
            outside = self.function(solution(times).T) > self.level
            out = np.flatnonzero(~outside[:-1] & outside[1:])
            if len(out) == 0:
                found.append((math.inf, None))
                continue
            time = brentq(excess, times[out[0]], times[out[0] + 1], xtol=1e-12)
            found.append((time, solution(time)))
        return found


def test_a_pushed_agent_is_stopped_within_one_step_of_the_crossing(circle_field, V):
    run = PushedRun(circle_field, V, [[0.0, -1.0]], calm=0.3, growth=1.0)
    watch = StopOnExit(run.simulator)
    status = run.simulator.AdvanceTo(10.0)
    ((time, place),) = run.crossings(4.0)
    left = watch.exit
    assert 0.5 < time < 4.0
    assert left.time_inside < time <= left.time
    assert left.time - left.time_inside <= STEP + ROUNDING
    # It moves on by less than two lengths a second.
    assert np.linalg.norm(left.position - place) <= 2.0 * STEP
    assert left.V == V(left.position[None])[0] > LEVEL
    assert (left.agent, left.level) == (0, LEVEL)
    # The status says who left, where and when.
    assert status.reason() == TERMINATED
    assert not status.succeeded()
    assert run.context.get_time() == status.return_time() == left.time
    assert status.boundary_time() == 10.0
    assert status.message() == str(left)
    assert status.system() is run.diagram.GetSubsystemByName("lyapunov")
    for part in ("agent 0", "V <= 0.5", f"t = {left.time:.6g} s", "V = 0.5"):
        assert part in status.FormatMessage()
    # The logs end where the run does.
    log = run.diagram.GetSubsystemByName("V_log").FindLog(run.context)
    assert log.sample_times()[-1] == left.time
    assert log.data()[0, -1] == left.V
    assert (log.data()[0, :-1] <= LEVEL).all()
    np.testing.assert_array_equal(run.log.FindLog(run.context).data()[:, -1], left.position)


def test_of_many_agents_the_first_to_leave_is_told(circle_field, V):
    angle = np.array([0.3, 2.0, 3.5, 5.2])
    starts = np.column_stack((np.cos(angle), np.sin(angle)))
    run = PushedRun(circle_field, V, starts, calm=0.1, growth=1.0)
    watch = StopOnExit(run.simulator)
    run.simulator.AdvanceTo(10.0)
    crossings = run.crossings(5.0)
    times = np.array([time for time, _ in crossings])
    first = int(times.argmin())
    assert np.sort(times)[1] > times[first] + 2.0 * STEP, "no tie, which would prove nothing"
    assert watch.exit.agent == first
    assert watch.exit.time_inside < times[first] <= watch.exit.time
    assert np.linalg.norm(watch.exit.position - crossings[first][1]) <= 2.0 * STEP


def test_an_agent_that_starts_outside_has_to_enter_first(circle_field, V):
    start = [1.5, 0.0]
    assert V(np.array([start]))[0] > LEVEL
    run = PushedRun(circle_field, V, [start], calm=3.0, growth=1.0)
    watch = StopOnExit(run.simulator)
    run.simulator.AdvanceTo(3.0)
    assert watch.exit is None
    assert V(run.context.get_continuous_state_vector().CopyToVector()[None])[0] < LEVEL
    status = run.simulator.AdvanceTo(10.0)
    ((time, _),) = run.crossings(7.0)
    assert status.reason() == TERMINATED
    assert watch.exit.time_inside < time <= watch.exit.time


def test_an_undisturbed_run_is_never_stopped(circle_field, V):
    starts = np.random.default_rng(5).uniform(-1.4, 1.4, (8, 2))
    diagram = MakeKinematicDiagram(circle_field, 8, lyapunov=V, level=LEVEL)
    simulator = MakeSimulator(diagram)
    watch = StopOnExit(simulator)
    SetPositions(diagram, simulator.get_mutable_context(), starts)
    status = simulator.AdvanceTo(2.0)
    assert status.reason() == SimulatorStatus.ReturnReason.kReachedBoundaryTime
    assert simulator.get_context().get_time() == 2.0
    assert watch.exit is None


def test_what_ended_stays_ended(circle_field, V):
    run = PushedRun(circle_field, V, [[0.0, -1.0]], calm=0.3, growth=1.0)
    watch = StopOnExit(run.simulator)
    run.simulator.AdvanceTo(10.0)
    left = watch.exit
    # Back on the circle, where a new watch would find nothing amiss.
    run.context.SetContinuousState([0.0, -1.0])
    for count in (1, 2):
        assert run.simulator.AdvanceTo(10.0).reason() == TERMINATED
        assert run.context.get_time() == pytest.approx(left.time + count * STEP)
        assert watch.exit is left
    renewed = StopOnExit(run.simulator)
    run.simulator.AdvanceTo(run.context.get_time() + 3 * STEP)
    assert renewed.exit is None


def test_a_lowered_level_is_no_exit(circle_field, V):
    diagram = MakeKinematicDiagram(circle_field, lyapunov=V, level=10.0)
    simulator = MakeSimulator(diagram, step=STEP)
    context = simulator.get_mutable_context()
    SetPositions(diagram, context, [1.3, 0.0])
    watch = StopOnExit(simulator, diagram.GetSubsystemByName("lyapunov"))
    simulator.AdvanceTo(0.1)
    monitor = diagram.GetSubsystemByName("lyapunov")
    own = monitor.GetMyMutableContextFromRoot(context)
    assert monitor.GetOutputPort("V").Eval(own)[0] > LEVEL
    monitor.SetLevel(own, LEVEL)
    assert simulator.AdvanceTo(3.0).reason() != TERMINATED
    # But to leave the new set is one.
    SetPositions(diagram, context, [1.3, 0.0])
    assert simulator.AdvanceTo(3.1).reason() == TERMINATED
    assert watch.exit.level == LEVEL


def test_a_kicked_flight_is_stopped_within_one_step_of_the_crossing(circle_field, V):
    def start(time, state, step, log_period):
        diagram = MakeFlightDiagram(
            circle_field, lyapunov=V, level=LEVEL, log_period=log_period
        )
        simulator = MakeSimulator(diagram, step=step)
        context = simulator.get_mutable_context()
        context.SetTime(time)
        SetVehicleState(diagram, context, state)
        return diagram, simulator, context

    diagram, simulator, context = start(0.0, [1.0, 0.0, 1.0, *np.zeros(9)], STEP, 0.01)
    watch = StopOnExit(simulator)
    simulator.AdvanceTo(0.5)
    assert watch.exit is None
    state = context.get_continuous_state_vector().CopyToVector()
    # Away from the middle.
    state[6:8] += 0.6 * state[:2] / np.linalg.norm(state[:2])
    SetVehicleState(diagram, context, state)
    assert simulator.AdvanceTo(3.0).reason() == TERMINATED

    # The same flight from the kick on, in steps fifty times smaller.
    fine, simulator, context = start(0.5, state, STEP / 50, 0.0)
    simulator.AdvanceTo(0.9)
    log = fine.GetSubsystemByName("V_log").FindLog(context)
    times, values = log.sample_times(), log.data()[0]
    after = int(np.argmax(values > LEVEL))
    assert after > 0
    time = np.interp(LEVEL, values[after - 1 : after + 1], times[after - 1 : after + 1])
    left = watch.exit
    assert left.time_inside < time <= left.time
    assert left.time - left.time_inside <= STEP + ROUNDING
    positions = fine.GetSubsystemByName("state_log").FindLog(context).data()[:2]
    place = positions[:, int(np.argmin(np.abs(times - left.time)))]
    # Halving the step moves a flight by less than 1e-5 m, see test_flights.py.
    np.testing.assert_allclose(left.position, place, atol=1e-5)
    assert left.V == V(left.position[None])[0] > LEVEL
