"""Derivatives of whole simulations by the start and by parameters, with AutoDiffXd.

A fixed-step simulation is a smooth function of its start and its parameters.  Its derivative
is compared with differences of the simulation in floats, which share only the code for
floats, and with the closed-form flow of the agent on a circle.
"""

import math

import numpy as np
from pydrake.autodiffutils import (
    ExtractGradient,
    ExtractValue,
    InitializeAutoDiff,
)
from pydrake.systems.framework import DiagramBuilder
import pytest

from systems import (
    DEFAULT_GAINS,
    Gains,
    GuidanceSystem,
    MakeFlightDiagram,
    MakeKinematicDiagram,
    MakeSimulator,
    QuadrotorParameters,
    Se3Controller,
    SetVehicleState,
)

SPEED = 0.45
CIRCLE_GAIN = 3.0
STEP = 0.005
DURATION = 0.5
F_MAX = QuadrotorParameters().max_propeller_force
NUM_GAINS = len(DEFAULT_GAINS)
OFF_THE_PATH = np.array([0.07, 0.05, 0.03])


@pytest.fixture(params=["circle", "learned"])
def problem(request, circle_field, make_field):
    """A field, and the variables: start (12), gains (4), speed (1)."""
    if request.param == "circle":
        field, on_path = circle_field, np.array([0.6, 0.8])
    else:
        field = make_field("robust", gain=0.4)
        on_path = field.cloud.points[0]
    state = np.zeros(12)
    state[:3] = *on_path, 1.0
    state[:3] += OFF_THE_PATH
    # As fast as it is told to be: the controller is then far from every limit.
    state[6:8] = SPEED * field(state[:2])
    state[3:6] = 0.03, -0.05, 0.02
    return field, np.concatenate((state, DEFAULT_GAINS, [SPEED]))


def make_loop(field):
    """Plant, guidance and controller without a hold."""
    builder = DiagramBuilder()
    parameters = QuadrotorParameters()
    plant = builder.AddNamedSystem("plant", parameters.MakePlant())
    guidance = builder.AddNamedSystem("guidance", GuidanceSystem(field, SPEED))
    controller = builder.AddNamedSystem("controller", Se3Controller(parameters))
    for system in (guidance, controller):
        builder.Connect(plant.GetOutputPort("state"), system.GetInputPort("state"))
    for name in ("velocity_command", "acceleration_feedforward"):
        builder.Connect(guidance.GetOutputPort(name), controller.GetInputPort(name))
    builder.Connect(controller.GetOutputPort("propeller_force"), plant.get_input_port())
    return builder.Build()


def advance(diagram, context, duration, step=STEP, watch=None):
    """Simulates either scalar type with a fixed step; returns the continuous state."""
    simulator = MakeSimulator(diagram, context, step)
    if watch is not None:
        simulator.set_monitor(watch)
    simulator.AdvanceTo(duration)
    return context.get_continuous_state_vector().CopyToVector()


def set_variables(diagram, context, variables):
    """Sets start, gains and speed, of either scalar type."""
    state, gains, speed = np.split(variables, [12, 12 + NUM_GAINS])
    if "motion_capture" in [system.get_name() for system in diagram.GetSystems()]:
        hold = diagram.GetSubsystemByName("motion_capture")
        hold.SetVectorState(hold.GetMyMutableContextFromRoot(context), state)
    context.SetContinuousState(state)
    controller = diagram.GetSubsystemByName("controller")
    controller.SetGains(controller.GetMyMutableContextFromRoot(context), Gains(*gains))
    guidance = diagram.GetSubsystemByName("guidance")
    guidance.SetSpeed(guidance.GetMyMutableContextFromRoot(context), speed[0])


def final_state(diagram, variables, duration=DURATION, watch=None):
    context = diagram.CreateDefaultContext()
    set_variables(diagram, context, variables)
    return advance(diagram, context, duration, watch=watch)


def value_and_gradient(diagram, variables, duration=DURATION):
    """The final state and its derivative by the variables, by one AutoDiffXd simulation."""
    final = final_state(diagram.ToAutoDiffXd(), InitializeAutoDiff(variables)[:, 0], duration)
    column = final.reshape(-1, 1)
    return ExtractValue(column).ravel(), ExtractGradient(column)


def differences(function, x, h):
    return np.column_stack(
        [(function(x + e) - function(x - e)) / (2.0 * h) for e in h * np.eye(len(x))]
    )


def order(steps, errors):
    """The exponent of a power law."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


def test_problem_stays_far_from_the_limits_of_the_propellers(problem):
    """Where a force is limited, the simulation is not smooth."""
    field, variables = problem
    diagram, forces = make_loop(field), []
    controller = diagram.GetSubsystemByName("controller")

    def watch(context):
        port = controller.GetOutputPort("propeller_force")
        forces.append(port.Eval(controller.GetMyContextFromRoot(context)).copy())

    final_state(diagram, variables, watch=watch)
    assert len(forces) > DURATION / STEP
    assert np.min(forces) > 0.1
    assert np.max(forces) < F_MAX - 0.1


def test_gradient_of_a_flight_agrees_with_differences(problem):
    field, variables = problem
    diagram = make_loop(field)
    value, gradient = value_and_gradient(diagram, variables)
    np.testing.assert_allclose(value, final_state(diagram, variables), rtol=1e-12, atol=1e-12)
    expected = differences(lambda x: final_state(diagram, x), variables, 1e-5)
    # A column a variable: a gain moves the end less than the start does.
    scale = np.abs(expected).max(axis=0)
    assert scale.min() > 1e-4, "every variable has an influence"
    assert np.max(np.abs(gradient - expected) / scale) < 1e-6


def test_differences_of_a_flight_converge_to_its_gradient(problem):
    field, variables = problem
    diagram = make_loop(field)
    _, gradient = value_and_gradient(diagram, variables)
    direction = np.random.default_rng(0).normal(size=len(variables))
    direction /= np.linalg.norm(direction)
    steps = 10.0 ** np.array([-1.75, -2.25, -2.75])
    errors = []
    for h in steps:
        ahead = final_state(diagram, variables + h * direction)
        behind = final_state(diagram, variables - h * direction)
        errors.append(np.linalg.norm((ahead - behind) / (2 * h) - gradient @ direction))
    assert order(steps, errors) == pytest.approx(2.0, abs=0.1)


def test_gradient_goes_through_the_samples_of_the_motion_capture(problem):
    """The loop of `MakeFlightDiagram`, whose hold keeps derivatives as well as values."""
    field, variables = problem
    diagram = MakeFlightDiagram(field, speed=SPEED, log_period=None)
    duration = 0.2
    value, gradient = value_and_gradient(diagram, variables, duration)
    expected_value = final_state(diagram, variables, duration)
    np.testing.assert_allclose(value, expected_value, rtol=1e-12, atol=1e-12)
    expected = differences(lambda x: final_state(diagram, x, duration), variables, 1e-5)
    scale = np.abs(expected).max(axis=0)
    # In so short a time the gains have hardly any influence yet.
    assert np.max(np.abs(gradient - expected) / np.maximum(scale, 1e-3)) < 1e-6


def test_context_of_floats_is_the_start_of_a_differentiated_flight(problem):
    """SetTimeStateAndParametersFrom carries the start, the held sample and the parameters."""
    field, variables = problem
    diagram = MakeFlightDiagram(field, speed=1.0, log_period=None)
    context = diagram.CreateDefaultContext()
    set_variables(diagram, context, variables)
    SetVehicleState(diagram, context, variables[:12])
    differentiated = diagram.ToAutoDiffXd()
    converted = differentiated.CreateDefaultContext()
    converted.SetTimeStateAndParametersFrom(context)
    final = advance(differentiated, converted, 0.1)
    np.testing.assert_allclose(
        ExtractValue(final.reshape(-1, 1)).ravel(),
        advance(diagram, context, 0.1),
        rtol=1e-12,
        atol=1e-12,
    )
    # Nothing was declared a variable.
    assert ExtractGradient(final.reshape(-1, 1)).size == 0


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
