"""Derivatives of loops and of whole simulations, by Drake's linearisation and by AutoDiffXd.

A derivative is right when the error of central differences falls with the square of their
step, down to rounding: a wrong entry would leave an error that does not fall.  A fixed-step
simulation is a smooth function of its start and its parameters; its derivative is compared
with differences of the simulation in floats, which share only the code for floats, and with
the closed-form flow of the agent on a circle.
"""

import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.primitives import FirstOrderTaylorApproximation
import pytest

from systems import (
    DEFAULT_GAINS,
    Gains,
    MakeFlightDiagram,
    MakeKinematicDiagram,
    MakeSimulator,
    SetPositions,
    SetVehicleState,
)

from .flying import PARAMETERS, SPEED, differences, order

CIRCLE_GAIN = 3.0
OBSERVING_NOTHING = DEFAULT_GAINS[:4]  # Without a disturbance bandwidth.
F_MAX = PARAMETERS.max_propeller_force
# Differences with the largest steps leave the second order, with the smallest round off.
STEPS = 10.0 ** np.linspace(-1.5, -3.0, 4)
DURATION = 0.3


def make_loop(field, saturate=True):
    """Plant, guidance and controller without a hold: a continuous system without inputs."""
    return MakeFlightDiagram(
        field, speed=SPEED, sample_period=0.0, log_period=None, saturate=saturate
    )


@pytest.fixture(params=["circle", "spatial circle", "learned"])
def loop(request, circle_field, spatial_circle_field, make_field):
    """A closed loop without a hold, and a point on the path of its field."""
    if request.param == "learned":
        field = make_field("robust", gain=0.4)
        return make_loop(field), np.array([*field.cloud.points[0], 1.0])
    field = circle_field if request.param == "circle" else spatial_circle_field
    return make_loop(field), np.array([0.6, 0.8, 1.0])


def make_rate(diagram, context=None):
    """The time derivatives of a diagram as a function of its state."""
    context = context or diagram.CreateDefaultContext()

    def rate(x):
        context.SetContinuousState(x)
        return diagram.EvalTimeDerivatives(context).CopyToVector()

    return rate


def propeller_forces(diagram, context):
    loop = diagram.GetSubsystemByName("guidance_loop")
    port = loop.GetOutputPort("propeller_force")
    return port.Eval(loop.GetMyContextFromRoot(context)).copy()


def errors_of_differences(rate, x, A, steps=STEPS):
    return [np.abs(differences(rate, x, h) - A).max() / np.abs(A).max() for h in steps]


def state_at(p_WB, seed):
    """A state in flight at a position, tilted, moving and turning, far from every limit."""
    rng = np.random.default_rng(seed)
    rpy, v_WB = rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.4, 0.4, 3)
    return np.concatenate((p_WB, rpy, v_WB, rng.uniform(-0.1, 0.1, 3)))


def linearize(diagram, x):
    context = diagram.CreateDefaultContext()
    context.SetContinuousState(x)
    return FirstOrderTaylorApproximation(diagram, context)


@pytest.mark.parametrize("beside", [0.0, -0.2], ids=["on", "beside"])
def test_linearised_flight_is_the_limit_of_differences(loop, beside):
    diagram, on_path = loop
    x = state_at(on_path + beside * np.array([0.6, 0.8, 0.5]), seed=1)
    context = diagram.CreateDefaultContext()
    context.SetContinuousState(x)
    forces = propeller_forces(diagram, context)
    assert np.all((forces > 0.02) & (forces < F_MAX - 0.02)), "not smooth at a limit"
    A, rate = linearize(diagram, x).A(), make_rate(diagram)
    assert order(STEPS, errors_of_differences(rate, x, A)) == pytest.approx(2.0, abs=0.05)
    # Richardson's extrapolation takes the second order away.
    h = 1e-3
    extrapolated = (4.0 * differences(rate, x, h / 2) - differences(rate, x, h)) / 3.0
    assert np.abs(extrapolated - A).max() / np.abs(A).max() < 1e-9


def test_smooth_controller_is_linearised_beyond_the_limits(circle_field):
    """Without saturation the law has derivatives where the vehicle could not follow it."""
    diagram = make_loop(circle_field, saturate=False)
    x = state_at(np.array([0.6, 0.8, 1.0]), seed=1)
    x[3:6] = 0.4, -0.5, 0.3
    x[6:12] = 2.0, -3.0, 4.0, 3.0, -2.0, 1.0
    context = diagram.CreateDefaultContext()
    context.SetContinuousState(x)
    forces = propeller_forces(diagram, context)
    assert np.any((forces < 0.0) | (forces > F_MAX))
    errors = errors_of_differences(make_rate(diagram), x, linearize(diagram, x).A())
    assert order(STEPS, errors) == pytest.approx(2.0, abs=0.05)


def test_flight_is_linearised_about_the_parameters_of_the_context(circle_field):
    diagram, x = make_loop(circle_field), state_at(np.array([0.6, 0.8, 1.0]), seed=1)
    context = diagram.CreateDefaultContext()
    set_variables(diagram, context, np.array([*x, 2.5, 12.0, 0.7, 0.1, 0.6]))
    A = FirstOrderTaylorApproximation(diagram, context).A()
    expected = differences(make_rate(diagram, context), x, 1e-5)
    np.testing.assert_allclose(A, expected, atol=1e-8 * np.abs(expected).max())
    assert np.abs(A - linearize(diagram, x).A()).max() > 1e-3 * np.abs(A).max()


def test_linearised_agents_are_the_fields_jacobians(circle_field):
    positions = np.random.default_rng(4).uniform(0.3, 1.2, (3, 2))
    A = linearize(MakeKinematicDiagram(circle_field, 3, SPEED), positions.ravel()).A()
    expected = np.zeros((6, 6))
    for k, J in enumerate(circle_field.value_and_jacobian(positions)[1]):
        expected[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = SPEED * J
    np.testing.assert_allclose(A, expected, rtol=1e-13)


@pytest.mark.parametrize("angle", [0.0, 1.0, 4.0])
def test_deviations_from_the_circle_decay_at_the_gain_of_its_field(circle_field, angle):
    """On the path, d/dt (1 - r) = -speed gain (1 - r), and nothing pulls along the path."""
    diagram = MakeKinematicDiagram(circle_field, speed=SPEED)
    context = diagram.CreateDefaultContext()
    n = np.array([math.cos(angle), math.sin(angle)])
    SetPositions(diagram, context, n)
    A = FirstOrderTaylorApproximation(diagram, context).A()
    eigenvalues = np.sort(np.linalg.eigvals(A).real)
    np.testing.assert_allclose(eigenvalues, [-SPEED * CIRCLE_GAIN, 0.0], atol=1e-12)
    np.testing.assert_allclose(n @ A @ n, -SPEED * CIRCLE_GAIN, rtol=1e-12)


# Simulations.


def set_variables(diagram, context, variables):
    """Sets start, gains and speed, of either scalar type."""
    state, gains, speed = np.split(variables, [12, 16])
    if context.num_discrete_state_groups():
        context.SetDiscreteState(state)
    context.SetContinuousState(state)
    loop = diagram.GetSubsystemByName("guidance_loop")
    # Fused, they are one.
    names = [n for n in ("guidance", "controller") if loop.HasSubsystemNamed(n)]
    guidance, controller = (loop.GetSubsystemByName(n) for n in (names[0], names[-1]))
    controller.SetGains(controller.GetMyMutableContextFromRoot(context), Gains(*gains))
    guidance.SetSpeed(guidance.GetMyMutableContextFromRoot(context), speed[0])


def advance(diagram, context, duration=DURATION, step=0.005, watch=None):
    """Simulates either scalar type with a fixed step; returns the continuous state."""
    simulator = MakeSimulator(diagram, context, step)
    if watch is not None:
        simulator.set_monitor(watch)
    simulator.AdvanceTo(duration)
    return context.get_continuous_state_vector().CopyToVector()


def final_state(diagram, variables, watch=None):
    context = diagram.CreateDefaultContext()
    set_variables(diagram, context, variables)
    return advance(diagram, context, watch=watch)


@pytest.fixture(params=["circle", "learned"])
def problem(request, circle_field, make_field):
    """A field, and the variables: start (12), gains (4), speed (1)."""
    if request.param == "circle":
        field, on_path = circle_field, np.array([0.6, 0.8])
    else:
        field = make_field("robust", gain=0.4)
        on_path = field.cloud.points[0]
    state = np.zeros(12)
    state[:3] = on_path[0] + 0.07, on_path[1] + 0.05, 1.03
    # As fast as it is told to be: the controller is then far from every limit.
    state[6:8] = SPEED * field(state[:2])
    state[3:6] = 0.03, -0.05, 0.02
    return field, np.concatenate((state, OBSERVING_NOTHING, [SPEED]))


@pytest.mark.parametrize("sampled", [False, True])
def test_gradient_of_a_flight_is_the_limit_of_differences(problem, sampled):
    """A hold, as in the loop of `MakeFlightDiagram`, keeps derivatives as well as values."""
    field, variables = problem
    diagram = (
        MakeFlightDiagram(field, speed=SPEED, log_period=None) if sampled else make_loop(field)
    )
    forces = []
    value = final_state(
        diagram, variables, lambda c: forces.append(propeller_forces(diagram, c))
    )
    assert 0.1 < np.min(forces) < np.max(forces) < F_MAX - 0.1, "not smooth at a limit"
    # The final state and its derivative by the variables, by one AutoDiffXd simulation.
    final = final_state(diagram.ToAutoDiffXd(), InitializeAutoDiff(variables)[:, 0])
    gradient = ExtractGradient(final.reshape(-1, 1))
    np.testing.assert_allclose(
        ExtractValue(final.reshape(-1, 1))[:, 0], value, rtol=1e-12, atol=1e-12
    )
    expected = differences(lambda x: final_state(diagram, x), variables, 1e-5)
    # A column a variable: a gain moves the end less than the start does.
    scale = np.abs(expected).max(axis=0)
    assert scale.min() > 1e-5, "every variable has an influence"
    assert np.max(np.abs(gradient - expected) / np.maximum(scale, 1e-3)) < 1e-6
    direction = np.random.default_rng(0).normal(size=len(variables))
    direction /= np.linalg.norm(direction)
    steps = 10.0 ** np.array([-1.75, -2.25, -2.75])
    errors = [
        np.linalg.norm(
            differences(lambda t: final_state(diagram, variables + t * direction), [0.0], h)[
                :, 0
            ]
            - gradient @ direction
        )
        for h in steps
    ]
    assert order(steps, errors) == pytest.approx(2.0, abs=0.1)


def test_context_of_floats_is_the_start_of_a_differentiated_flight(circle_field):
    """SetTimeStateAndParametersFrom carries the start, the held sample and the parameters."""
    diagram = MakeFlightDiagram(circle_field, speed=1.0, log_period=None)
    context = diagram.CreateDefaultContext()
    variables = np.array([*state_at(np.array([0.6, 0.8, 1.0]), 1), *OBSERVING_NOTHING, SPEED])
    set_variables(diagram, context, variables)
    SetVehicleState(diagram, context, variables[:12])
    differentiated = diagram.ToAutoDiffXd()
    converted = differentiated.CreateDefaultContext()
    converted.SetTimeStateAndParametersFrom(context)
    final = advance(differentiated, converted, 0.1).reshape(-1, 1)
    expected = advance(diagram, context, 0.1)
    np.testing.assert_allclose(ExtractValue(final)[:, 0], expected, rtol=1e-12, atol=1e-12)
    # Nothing was declared a variable.
    assert ExtractGradient(final).size == 0


def flow_gradient_on_circle(angle, duration):
    """d p(T) / d (p(0), speed) of an agent that starts on the circle of its field.

    A small offset r - 1 decays as exp(-speed gain t); meanwhile the longer way round costs
    an angle of (r - 1) (1 - exp(-speed gain T)) / gain.
    """
    end = angle + SPEED * duration
    n0, t0 = _normal_and_tangent(angle)
    n1, t1 = _normal_and_tangent(end)
    decay = math.exp(-SPEED * CIRCLE_GAIN * duration)
    by_offset = decay * n1 - (1.0 - decay) / CIRCLE_GAIN * t1
    by_start = np.outer(by_offset, n0) + np.outer(t1, t0)
    return np.column_stack((by_start, duration * t1))


def _normal_and_tangent(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c, s]), np.array([-s, c])


def test_gradient_of_an_agent_converges_to_the_flow_of_the_circle(circle_field):
    """With the third order of the integrator."""
    angle, duration = 0.3, 1.0
    diagram = MakeKinematicDiagram(circle_field, speed=SPEED).ToAutoDiffXd()
    guidance = diagram.GetSubsystemByName("guidance")
    variables = InitializeAutoDiff([math.cos(angle), math.sin(angle), SPEED])[:, 0]
    expected = flow_gradient_on_circle(angle, duration)
    steps, errors = np.array([0.2, 0.1, 0.05, 0.025]), []
    for step in steps:
        context = diagram.CreateDefaultContext()
        context.SetContinuousState(variables[:2])
        guidance.SetSpeed(guidance.GetMyMutableContextFromRoot(context), variables[2])
        final = advance(diagram, context, duration, step)
        errors.append(np.abs(ExtractGradient(final.reshape(-1, 1)) - expected).max())
    assert order(steps, errors) == pytest.approx(3.0, abs=0.2)
    assert errors[-1] < 1e-5
