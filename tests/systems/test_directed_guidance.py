"""Vehicles and agents that remember their heading, on a field m(x, g) of a T and an eight."""

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, InitializeAutoDiff
from pydrake.systems.primitives import FirstOrderTaylorApproximation
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.network_metrics import network_metrics
from sgvf_drake.paths.navigator import Navigator
from sgvf_drake.paths.planning import covering
from systems import (
    GuidanceSystem,
    MakeFlightDiagram,
    MakeKinematicDiagram,
    MakeSimulator,
    SetHover,
    SetPositions,
)

from .flying import SPEED, STATE, differences, order

STEPS = 10.0 ** np.linspace(-2.0, -3.5, 4)
HEADING = np.array([0.6, -0.3])
# s, in which agents of one U a second are told where to go, and move.
STEP = 0.05


def guide(system, state, heading, intended=None):
    context = system.CreateDefaultContext()
    system.GetInputPort("position").FixValue(context, state[:3])
    system.GetInputPort("velocity").FixValue(context, state[6:9])
    if intended is not None:
        system.GetInputPort("intended_direction").FixValue(context, intended)
    system.SetHeading(context, heading)
    return context


@pytest.mark.parametrize("intended", [None, (0.0, 0.0), (0.0, 1.0)])
def test_commands_are_those_of_the_heading_and_its_rate(tee_field, intended):
    system = GuidanceSystem(tee_field, SPEED)
    context = guide(system, STATE, HEADING, intended)
    x, v = STATE[:2], STATE[6:8]
    flown = system.GetFlownField(context)
    m, J = flown.value_and_jacobian(x, HEADING)
    target = (
        tee_field.tangent(x, HEADING) if intended in (None, (0.0, 0.0)) else np.array(intended)
    )
    turn = SPEED * (target - HEADING) / tee_field.memory_length
    np.testing.assert_allclose(context_rate(system, context), turn, rtol=1e-9)
    command = system.GetOutputPort("velocity_command").Eval(context)
    acceleration = system.GetOutputPort("acceleration_feedforward").Eval(context)
    np.testing.assert_allclose(command[:2], SPEED * m, rtol=1e-9)
    expected = SPEED * (J @ v + flown.jacobian_by_direction(x, HEADING) @ turn)
    np.testing.assert_allclose(acceleration[:2], expected, rtol=1e-8)
    np.testing.assert_array_equal(system.GetOutputPort("heading").Eval(context), HEADING)


def context_rate(system, context):
    return system.EvalTimeDerivatives(context).CopyToVector()


def test_a_loop_with_a_heading_is_linearised(tee_field):
    """The error of differences falls with the square of their step, to all states."""
    diagram = MakeFlightDiagram(tee_field, speed=SPEED, sample_period=0.0, log_period=None)
    context = diagram.CreateDefaultContext()
    guidance = diagram.GetSubsystemByName("guidance_loop").guidance
    SetHover(diagram, context, [0.4, 4.4, 1.0])
    guidance.SetHeading(guidance.GetMyContextFromRoot(context), HEADING)
    x = context.get_continuous_state_vector().CopyToVector()
    x[3:12] = 0.05, -0.03, 0.02, 0.3, -0.2, 0.1, 0.02, -0.04, 0.03

    def rate(x):
        context.SetContinuousState(x)
        return diagram.EvalTimeDerivatives(context).CopyToVector()

    context.SetContinuousState(x)
    A = FirstOrderTaylorApproximation(diagram, context).A()
    errors = [np.abs(differences(rate, x, h) - A).max() / np.abs(A).max() for h in STEPS]
    assert order(STEPS, errors) == pytest.approx(2.0, abs=0.1)


def test_gradients_pass_through_the_intended_direction(tee_field):
    system = GuidanceSystem(tee_field, SPEED).ToAutoDiffXd()
    context = system.CreateDefaultContext()
    variables = InitializeAutoDiff(np.array([0.3, 0.9]))
    for name, part in (("position", STATE[:3]), ("velocity", STATE[6:9])):
        system.GetInputPort(name).FixValue(context, [AutoDiffXd(v) for v in part])
    system.GetInputPort("intended_direction").FixValue(context, variables.ravel())
    system.SetHeading(context, HEADING)
    rate = system.EvalTimeDerivatives(context).CopyToVector()
    expected = SPEED / tee_field.memory_length * np.eye(2)
    np.testing.assert_allclose(ExtractGradient(rate), expected, rtol=1e-12)


def test_bad_headings_are_refused(tee_field, circle_field):
    system = GuidanceSystem(tee_field, SPEED)
    context = system.CreateDefaultContext()
    for heading in ([1.0], [1.0, 1.0], [np.nan, 0.0], [0.0, 0.0, 1.0]):
        with pytest.raises(ConfigurationError, match="a heading is a vector"):
            system.SetHeading(context, heading)
    plain = GuidanceSystem(circle_field, SPEED)
    with pytest.raises(ConfigurationError, match="no directed one"):
        plain.SetHeading(plain.CreateDefaultContext(), [1.0, 0.0])
    context = guide(system, STATE, HEADING, [np.nan, 0.0])
    with pytest.raises(NonFiniteValueError, match="intended_direction"):
        system.GetOutputPort("velocity_command").Eval(context)


def test_an_eight_is_flown_straight_over_its_crossing(eight_field):
    field = eight_field.rescaled(2.0 / 3.0)
    diagram = MakeFlightDiagram(field, speed=SPEED, log_period=0.02)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    route = covering(field.network)
    start, ahead = route.line.at(np.array([0.0, 0.02]))
    SetHover(diagram, context, [*start, 1.0])
    guidance = diagram.GetSubsystemByName("guidance_loop").guidance
    heading = (ahead - start) / np.linalg.norm(ahead - start)
    guidance.SetHeading(guidance.GetMyContextFromRoot(context), heading)
    simulator.AdvanceTo(1.3 * route.length / SPEED + 1.0)
    log = diagram.GetSubsystemByName("state_log").FindLog(context)
    positions = log.data()[:2].T[:, None]
    metrics = network_metrics(
        log.sample_times(), positions, field.network, field.cloud.box, field.ends
    )
    assert metrics.straight_fraction == 1
    assert metrics.lapped.all()
    assert metrics.rms[0] < 0.01 * field.cloud.unit_length


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(k, marks=pytest.mark.full) for k in (1, 2))]
)
def test_agents_from_anywhere_make_every_turn_of_a_route(tee_field, seed):
    route = covering(tee_field.network)
    rng = np.random.default_rng(seed)
    lower, upper = tee_field.cloud.box
    x = rng.uniform(lower, upper, (12, 2))
    h = rng.normal(size=(12, 2))
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    unit = tee_field.cloud.unit_length
    navigator = Navigator(route, tee_field.memory_length, step=STEP * unit)
    diagram = MakeKinematicDiagram(
        *(tee_field.with_memory(), 12, unit),
        log_period=STEP,
        navigator=navigator,
        navigation_period=STEP,
    )
    simulator = MakeSimulator(diagram, step=STEP)
    context = simulator.get_mutable_context()
    SetPositions(diagram, context, np.concatenate([x, h], axis=1))
    simulator.AdvanceTo(1.2 * route.length / unit + 10)
    log = diagram.GetSubsystemByName("positions_log").FindLog(context)
    times, positions = log.sample_times() * unit, log.data().T.reshape(-1, 12, 4)[..., :2]
    metrics = network_metrics(
        times, positions, tee_field.network, tee_field.cloud.box, tee_field.ends, route
    )
    assert metrics.turn_fraction == 1
    assert not metrics.stalled.any()
    assert not metrics.left.any()


def test_only_motions_are_navigated(circle_field, tee_field):
    navigator = Navigator(covering(tee_field.network), tee_field.memory_length)
    with pytest.raises(ConfigurationError, match="only the motion of a directed field"):
        MakeKinematicDiagram(circle_field, 1, navigator=navigator)
