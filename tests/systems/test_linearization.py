"""Drake's linearisation of whole loops, against differences of the loops' time derivatives.

A derivative is right when the error of central differences falls with the square of their
step, down to rounding: a wrong entry would leave an error that does not fall.
"""

import math

import numpy as np
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import FirstOrderTaylorApproximation
import pytest

from systems import (
    GuidanceSystem,
    MakeKinematicDiagram,
    QuadrotorParameters,
    Se3Controller,
    SetPositions,
)

SPEED = 0.45
CIRCLE_GAIN = 3.0
F_MAX = QuadrotorParameters().max_propeller_force
# Differences with the largest steps leave the second order, with the smallest round off.
STEPS = 10.0 ** np.linspace(-1.5, -3.0, 4)
FIELDS = ("circle", "spatial circle", "learned")


@pytest.fixture(params=FIELDS)
def loop(request, circle_field, spatial_circle_field, make_field):
    """A closed loop without a hold, and a point on the path of its field."""
    if request.param == "learned":
        field = make_field("robust", gain=0.4)
        return make_loop(field), np.array([*field.cloud.points[0], 1.0])
    field = circle_field if request.param == "circle" else spatial_circle_field
    return make_loop(field), np.array([0.6, 0.8, 1.0])


def make_loop(field, saturate=True):
    """Plant, guidance and controller: a continuous system without inputs."""
    builder = DiagramBuilder()
    parameters = QuadrotorParameters()
    plant = builder.AddNamedSystem("plant", parameters.MakePlant())
    guidance = builder.AddNamedSystem("guidance", GuidanceSystem(field, SPEED))
    controller = builder.AddNamedSystem(
        "controller", Se3Controller(parameters, saturate=saturate)
    )
    for system in (guidance, controller):
        builder.Connect(plant.GetOutputPort("state"), system.GetInputPort("state"))
    for name in ("velocity_command", "acceleration_feedforward"):
        builder.Connect(guidance.GetOutputPort(name), controller.GetInputPort(name))
    builder.Connect(controller.GetOutputPort("propeller_force"), plant.get_input_port())
    return builder.Build()


def state_at(p_WB, seed):
    """A state in flight at a position, tilted, moving and turning, far from every limit."""
    rng = np.random.default_rng(seed)
    rpy, v_WB = rng.uniform(-0.1, 0.1, 3), rng.uniform(-0.4, 0.4, 3)
    return np.concatenate((p_WB, rpy, v_WB, rng.uniform(-0.1, 0.1, 3)))


def make_rate(diagram):
    """The time derivatives of a diagram as a function of its state."""
    context = diagram.CreateDefaultContext()

    def rate(x):
        context.SetContinuousState(x)
        return diagram.EvalTimeDerivatives(context).CopyToVector()

    return rate


def linearize(diagram, x):
    context = diagram.CreateDefaultContext()
    context.SetContinuousState(x)
    return FirstOrderTaylorApproximation(diagram, context)


def differences(function, x, h):
    return np.column_stack(
        [(function(x + e) - function(x - e)) / (2.0 * h) for e in h * np.eye(len(x))]
    )


def order(steps, errors):
    """The exponent of a power law."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


def propeller_forces(diagram, x):
    context = diagram.CreateDefaultContext()
    context.SetContinuousState(x)
    controller = diagram.GetSubsystemByName("controller")
    return controller.GetOutputPort("propeller_force").Eval(
        controller.GetMyContextFromRoot(context)
    )


def check_limits(diagram, x):
    forces = propeller_forces(diagram, x)
    assert np.all((forces > 0.02) & (forces < F_MAX - 0.02)), "not smooth at a limit"


@pytest.mark.parametrize("beside", [0.0, 0.05, -0.2], ids=["on", "near", "beside"])
def test_linearised_flight_is_the_limit_of_differences(loop, beside):
    diagram, on_path = loop
    x = state_at(on_path + beside * np.array([0.6, 0.8, 0.5]), seed=1)
    check_limits(diagram, x)
    A, rate = linearize(diagram, x).A(), make_rate(diagram)
    scale = np.abs(A).max()
    errors = [np.abs(differences(rate, x, h) - A).max() / scale for h in STEPS]
    assert order(STEPS, errors) == pytest.approx(2.0, abs=0.05)
    # Richardson's extrapolation takes the second order away.
    h = 1e-3
    extrapolated = (4.0 * differences(rate, x, h / 2) - differences(rate, x, h)) / 3.0
    assert np.abs(extrapolated - A).max() / scale < 1e-9


def test_linearised_flight_predicts_the_rates_to_second_order(loop):
    diagram, on_path = loop
    x = state_at(on_path, seed=2)
    check_limits(diagram, x)
    linear, rate = linearize(diagram, x), make_rate(diagram)
    np.testing.assert_allclose(linear.A() @ x + linear.f0(), rate(x), atol=1e-11)
    direction = np.random.default_rng(3).normal(size=12)
    direction /= np.linalg.norm(direction)
    errors = []
    for h in STEPS:
        moved = x + h * direction
        errors.append(np.linalg.norm(linear.A() @ moved + linear.f0() - rate(moved)))
    assert order(STEPS, errors) == pytest.approx(2.0, abs=0.1)


def test_smooth_controller_is_linearised_beyond_the_limits(circle_field):
    """Without saturation the law has derivatives where the vehicle could not follow it."""
    diagram = make_loop(circle_field, saturate=False)
    x = state_at(np.array([0.6, 0.8, 1.0]), seed=1)
    x[3:6] = 0.4, -0.5, 0.3
    x[6:12] = 2.0, -3.0, 4.0, 3.0, -2.0, 1.0
    forces = propeller_forces(diagram, x)
    assert np.any((forces < 0.0) | (forces > F_MAX))
    A, rate = linearize(diagram, x).A(), make_rate(diagram)
    scale = np.abs(A).max()
    errors = [np.abs(differences(rate, x, h) - A).max() / scale for h in STEPS]
    assert order(STEPS, errors) == pytest.approx(2.0, abs=0.05)


def test_flight_is_linearised_about_the_parameters_of_the_context(circle_field):
    diagram, x = make_loop(circle_field), state_at(np.array([0.6, 0.8, 1.0]), seed=1)
    context = diagram.CreateDefaultContext()
    context.SetContinuousState(x)
    guidance, controller = (
        diagram.GetSubsystemByName(name) for name in ("guidance", "controller")
    )
    guidance.SetSpeed(guidance.GetMyMutableContextFromRoot(context), 0.6)
    own = controller.GetMyMutableContextFromRoot(context)
    controller.SetGains(own, controller.GetGains(own)._replace(velocity_gain=2.5, heading=0.1))
    A = FirstOrderTaylorApproximation(diagram, context).A()

    def rate(state):
        context.SetContinuousState(state)
        return diagram.EvalTimeDerivatives(context).CopyToVector()

    expected = differences(rate, x, 1e-5)
    np.testing.assert_allclose(A, expected, atol=1e-8 * np.abs(expected).max())
    assert np.abs(A - linearize(diagram, x).A()).max() > 1e-3 * np.abs(A).max()


def test_linearised_agents_are_the_fields_jacobians(circle_field):
    positions = np.random.default_rng(4).uniform(0.3, 1.2, (3, 2))
    A = linearize(MakeKinematicDiagram(circle_field, 3, SPEED), positions.ravel()).A()
    expected = np.zeros((6, 6))
    for k, J in enumerate(circle_field.value_and_jacobian(positions)[1]):
        expected[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = SPEED * J
    np.testing.assert_allclose(A, expected, rtol=1e-13)


@pytest.mark.parametrize("recipe", ["robust", "exact", "paper"])
def test_linearised_agent_on_a_learned_field_is_the_limit_of_differences(make_field, recipe):
    field = make_field(recipe)
    diagram = MakeKinematicDiagram(field, speed=SPEED)
    # In units of the cloud, over which the field changes.
    steps = field.cloud.unit_length * STEPS
    for x in field.cloud.points[:3] + 0.1 * field.cloud.unit_length:
        A, rate = linearize(diagram, x).A(), make_rate(diagram)
        scale = np.abs(A).max()
        errors = [np.abs(differences(rate, x, h) - A).max() / scale for h in steps]
        assert order(steps, errors) == pytest.approx(2.0, abs=0.1)


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
