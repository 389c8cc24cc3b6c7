"""Trajectory optimisation with a guiding field in the dynamics, by Drake's DirectCollocation.

An agent drifts with its field and steers against it: p' = speed m(p) + u.  Least effort, the
integral of |u|^2, has the necessary conditions u' = -speed J(p)^T u, which SciPy solves as a
boundary value problem: a second way to the same optimum.
"""

from itertools import pairwise

import numpy as np
from pydrake.planning import DirectCollocation
from pydrake.solvers import SnoptSolver, SolverOptions
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Adder, Integrator
from pydrake.trajectories import PiecewisePolynomial
import pytest
from scipy.integrate import solve_bvp, solve_ivp

from systems import KinematicGuidance

from .flying import order

SPEED = 0.6
DURATION = 2.0
KNOTS = np.array([6, 11, 21, 41])
TIGHT = SolverOptions()
for name in ("Major feasibility tolerance", "Major optimality tolerance"):
    TIGHT.SetOption(SnoptSolver.id(), name, 1e-9)
PROBLEMS = ("across the circle", "learned")


@pytest.fixture(scope="module", params=PROBLEMS)
def problem(request, circle_field, make_field):
    """A field, a start and a goal that its flow does not lead to."""
    if request.param == "learned":
        field = make_field("robust", gain=0.4)
        points = field.cloud.points
        return field, points[0], points[0] + np.array([-0.8, 0.6])
    return circle_field, np.array([1.0, 0.0]), np.array([-0.4, 0.3])


def make_steered_agent(field):
    """The system with the input u."""
    builder = DiagramBuilder()
    guidance = builder.AddSystem(KinematicGuidance(field, speed=SPEED))
    adder = builder.AddSystem(Adder(2, field.dim))
    agent = builder.AddSystem(Integrator(field.dim))
    builder.Connect(agent.get_output_port(), guidance.get_input_port())
    builder.Connect(guidance.get_output_port(), adder.get_input_port(0))
    builder.ExportInput(adder.get_input_port(1), "u")
    builder.Connect(adder.get_output_port(), agent.get_input_port())
    return builder.Build()


def steer(field, start, goal, num_knots):
    """Returns the optimal input and state as trajectories, and the cost."""
    system = make_steered_agent(field)
    step = DURATION / (num_knots - 1)
    collocation = DirectCollocation(
        system, system.CreateDefaultContext(), num_knots, step, step
    )
    program = collocation.prog()
    program.AddBoundingBoxConstraint(start, start, collocation.initial_state())
    program.AddBoundingBoxConstraint(goal, goal, collocation.final_state())
    u = collocation.input()
    collocation.AddRunningCost(sum(u_i * u_i for u_i in u))
    line = PiecewisePolynomial.FirstOrderHold([0.0, DURATION], np.column_stack((start, goal)))
    collocation.SetInitialTrajectory(PiecewisePolynomial(), line)
    result = SnoptSolver().Solve(program, None, TIGHT)
    assert result.is_success(), result.get_solution_result()
    return (
        collocation.ReconstructInputTrajectory(result),
        collocation.ReconstructStateTrajectory(result),
        result.get_optimal_cost(),
    )


@pytest.fixture(scope="module")
def plans(problem):
    """What is found on each grid, from the coarsest to the finest."""
    return [steer(*problem, int(knots)) for knots in KNOTS]


def drive(field, start, u, breaks):
    """The end of the motion under an input, integrated piece by piece by SciPy."""
    p = start
    for begin, end in pairwise(breaks):
        p = solve_ivp(
            lambda t, p: SPEED * field(p) + u(t),
            (begin, end),
            p,
            method="DOP853",
            rtol=1e-12,
            atol=1e-12,
        ).y[:, -1]
    return p


def least_effort(field, start, goal):
    """The least integral of |u|^2, from the necessary conditions."""

    def rates(_, y):
        p, u = np.ascontiguousarray(y[:2].T), y[2:].T
        m, J = field.value_and_jacobian(p)
        return np.concatenate(((SPEED * m + u).T, -SPEED * np.einsum("nij,ni->jn", J, u)))

    t = np.linspace(0.0, DURATION, 41)
    guess = np.zeros((4, len(t)))
    guess[:2] = start[:, None] + np.outer(goal - start, t / DURATION)
    guess[2:] = ((goal - start) / DURATION)[:, None]
    found = solve_bvp(
        rates,
        lambda a, b: np.concatenate((a[:2] - start, b[:2] - goal)),
        t,
        guess,
        tol=1e-9,
        max_nodes=100_000,
    )
    assert found.success, found.message
    fine = np.linspace(0.0, DURATION, 4001)
    return np.trapezoid((found.sol(fine)[2:] ** 2).sum(axis=0), fine)


def test_simulated_again_the_agent_reaches_the_goal_ever_closer(problem, plans):
    field, start, goal = problem
    misses = []
    for u, path, _ in plans:
        assert (path.start_time(), path.end_time()) == pytest.approx((0.0, DURATION))
        np.testing.assert_allclose(path.value(0.0)[:, 0], start, atol=1e-8)
        np.testing.assert_allclose(path.value(DURATION)[:, 0], goal, atol=1e-8)
        end = drive(field, start, lambda t, u=u: u.value(t)[:, 0], u.get_segment_times())
        misses.append(np.linalg.norm(end - goal))
    # The order of the Hermite-Simpson rule.
    assert -order(KNOTS - 1, misses) == pytest.approx(4.0, abs=0.5)
    assert misses[-1] < 1e-6


def test_effort_converges_to_that_of_the_necessary_conditions(problem, plans):
    expected = least_effort(*problem)
    # Of the second order, as the trapezoidal rule that sums the effort up; on the coarsest
    # grid the error may still be small by chance.
    errors = [abs(cost / expected - 1.0) for _, _, cost in plans[1:]]
    assert -order(KNOTS[1:] - 1, errors) == pytest.approx(2.0, abs=0.25)
    assert errors[-1] < 1e-3
