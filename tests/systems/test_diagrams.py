"""Whole flights around a circle of 1 m."""

import math

import numpy as np
from pydrake.autodiffutils import InitializeAutoDiff
from pydrake.examples import QuadrotorPlant
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import DiscreteTimeDelay, LogVectorOutput, ZeroOrderHold
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import (
    AddGuidance,
    AddMotionCapture,
    GuidanceSystem,
    MakeFlightDiagram,
    MakeSimulator,
    QuadrotorParameters,
    Se3Controller,
    SensorParameters,
    SetHover,
    SetNoiseSeed,
    SetVehicleState,
)

START = (1.3, 0.0, 1.0)
LAP = 2.0 * math.pi


def fly(field, speed, duration, step=0.005, **options):
    """The times, the logged states (12, n) and the logged forces (4, n)."""
    diagram = MakeFlightDiagram(field, speed=speed, **options)
    simulator = MakeSimulator(diagram, step=step)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, START)
    simulator.AdvanceTo(duration)
    state, force = (
        diagram.GetSubsystemByName(name).FindLog(context)
        for name in ("state_log", "propeller_force_log")
    )
    return state.sample_times().copy(), state.data().copy(), force.data().copy()


def last_lap(times, state, speed):
    """The cross-track error of the last lap in m."""
    return np.hypot(*state[:2, times > times[-1] - LAP / speed]) - 1.0


def rms(x):
    return math.sqrt(np.mean(np.square(x)))


@pytest.mark.parametrize(("speed", "bound"), [(0.45, 1e-4), (2.0, 5e-4), (4.0, 5e-3)])
def test_flight_follows_the_circle(circle_field, speed, bound):
    times, state, force = fly(circle_field, speed, 5.0 * LAP / speed)
    assert rms(last_lap(times, state, speed)) <= bound
    assert np.abs(state[2, times > times[-1] - LAP / speed] - 1.0).max() <= 2.0 * bound
    if speed == 0.45:
        f_max = QuadrotorParameters().max_propeller_force
        settled = force[:, times >= 1.0]
        assert np.all((settled > 0.0) & (settled < f_max))


@pytest.mark.parametrize("speed", [0.45, 2.0])
def test_flight_without_feedforward_is_visibly_worse(circle_field, speed):
    times, state, _ = fly(circle_field, speed, 3.0 * LAP / speed, feedforward=False)
    assert rms(last_lap(times, state, speed)) > 0.03


def test_flight_in_three_dimensions(spatial_circle_field):
    times, state, _ = fly(spatial_circle_field, 1.0, 2.0 * LAP, altitude=50.0)
    assert rms(last_lap(times, state, 1.0)) <= 1e-3
    assert abs(state[2, -1] - 1.0) <= 1e-3


@pytest.mark.parametrize("speed", [0.45, 2.0])
def test_integration_has_converged(circle_field, speed):
    _, coarse, _ = fly(circle_field, speed, 3.0)
    _, fine, _ = fly(circle_field, speed, 3.0, step=0.0025)
    assert np.abs(coarse[:3] - fine[:3]).max() < 1e-5


def test_flight_repeats_exactly(circle_field):
    np.testing.assert_array_equal(
        fly(circle_field, 1.0, 1.0)[1], fly(circle_field, 1.0, 1.0)[1]
    )


def test_flight_bears_a_delay_of_30_ms(circle_field):
    # Three samples of the measured state lie between the vehicle and its controller.
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", QuadrotorParameters().MakePlant())
    measured = AddMotionCapture(builder, plant.GetOutputPort("state"))
    delay = builder.AddSystem(DiscreteTimeDelay(0.01, 3, 12))
    guidance = builder.AddSystem(GuidanceSystem(circle_field, 0.45))
    controller = builder.AddSystem(Se3Controller())
    builder.Connect(measured.get_output_port(), delay.get_input_port())
    for system in (guidance, controller):
        builder.Connect(delay.get_output_port(), system.GetInputPort("state"))
    for name in ("velocity_command", "acceleration_feedforward"):
        builder.Connect(guidance.GetOutputPort(name), controller.GetInputPort(name))
    builder.Connect(controller.GetOutputPort("propeller_force"), plant.get_input_port())
    log = LogVectorOutput(plant.get_output_port(), builder, 0.01)
    diagram = builder.Build()
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, START)
    buffer = delay.GetMyMutableContextFromRoot(context).get_mutable_discrete_state_vector()
    buffer.SetFromVector(np.tile((*START, *np.zeros(9)), buffer.size() // 12))
    simulator.AdvanceTo(2.0 * LAP / 0.45)
    record = log.FindLog(context)
    assert rms(last_lap(record.sample_times(), record.data(), 0.45)) <= 1e-3


def test_hover_is_an_equilibrium(circle_field):
    diagram = MakeFlightDiagram(circle_field, speed=0.0)
    context = diagram.CreateDefaultContext()
    SetHover(diagram, context, START)
    derivatives = diagram.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(derivatives, 0.0, atol=1e-12)
    np.testing.assert_array_equal(
        diagram.GetOutputPort("state").Eval(context), [*START, *np.zeros(9)]
    )


def test_first_log_sample_already_knows_the_start(circle_field):
    # An unset hold would show a vehicle at the origin until its first sample.
    _, state, force = fly(circle_field, 0.45, 0.01)
    np.testing.assert_allclose(state[:3, 0], START)
    np.testing.assert_allclose(force[:, 0], force[:, 1])


def test_guidance_joins_a_users_own_diagram(circle_field):
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant())  # Drake's own parameters, which are read.
    parts = AddGuidance(builder, circle_field, plant, speed=0.45)
    assert parts.controller.parameters.mass == plant.m()
    assert isinstance(parts.motion_capture, ZeroOrderHold)
    diagram = builder.Build()
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    context.SetContinuousState([*START, *np.zeros(9)])
    simulator.AdvanceTo(2.0 * LAP / 0.45)
    x, y, z = context.get_continuous_state_vector().CopyToVector()[:3]
    assert math.hypot(x, y) == pytest.approx(1.0, abs=1e-3)
    assert z == pytest.approx(1.0, abs=1e-3)


def test_other_plants_need_parameters(circle_field):
    builder = DiagramBuilder()
    plant = builder.AddSystem(ZeroOrderHold(0.1, 12))
    with pytest.raises(ConfigurationError, match="parameters"):
        AddGuidance(builder, circle_field, plant)


def test_speed_can_be_changed_in_flight_and_is_cloned(circle_field):
    diagram = MakeFlightDiagram(circle_field, speed=0.45)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, (1.0, 0.0, 1.0))
    simulator.AdvanceTo(2.0)
    guidance = diagram.GetSubsystemByName("guidance")
    guidance.SetSpeed(guidance.GetMyMutableContextFromRoot(context), 1.0)
    clone = context.Clone()
    assert guidance.GetSpeed(guidance.GetMyContextFromRoot(clone)) == 1.0
    simulator.AdvanceTo(5.0)
    velocity = context.get_continuous_state_vector().CopyToVector()[6:9]
    assert np.linalg.norm(velocity) == pytest.approx(1.0, abs=0.01)


def test_controller_runs_once_in_a_sample(circle_field):
    # Anything that depends on the time in between would run in every integrator stage.
    calls = circle_field.calls
    fly(circle_field, 0.45, 1.0, log_period=0.01)
    assert circle_field.calls - calls <= 102


def test_diagram_converts_and_gives_gradients(circle_field):
    diagram = MakeFlightDiagram(circle_field, speed=0.6)
    context = diagram.CreateDefaultContext()
    state = np.array([1.1, 0.2, 0.9, 0.05, -0.02, 0.1, 0.1, 0.4, 0.0, 0.1, 0.0, 0.05])
    SetVehicleState(diagram, context, state)
    autodiff = diagram.ToAutoDiffXd()
    converted = autodiff.CreateDefaultContext()
    converted.SetTimeStateAndParametersFrom(context)
    hold = autodiff.GetSubsystemByName("motion_capture")
    hold.SetVectorState(
        hold.GetMyMutableContextFromRoot(converted), InitializeAutoDiff(state)[:, 0]
    )
    rates = autodiff.EvalTimeDerivatives(converted).CopyToVector()
    expected = diagram.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose([rate.value() for rate in rates], expected, rtol=1e-12)
    # The thrust, and so the climb, depends on the measured altitude.
    assert abs(rates[8].derivatives()[2]) > 0.1


@pytest.mark.parametrize("field_name", ["circle_field", "spatial_circle_field"])
def test_state_that_is_not_finite_stops_a_flight(request, field_name):
    diagram = MakeFlightDiagram(request.getfixturevalue(field_name))
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, START)
    simulator.AdvanceTo(0.05)
    context.get_mutable_continuous_state_vector().SetAtIndex(1, math.nan)
    message = r"::flight::(guidance|controller): input port 'state' .* t = 0\.05 s"
    with pytest.raises(NonFiniteValueError, match=message):
        simulator.AdvanceTo(0.2)


def test_bad_start_is_refused(circle_field):
    diagram = MakeFlightDiagram(circle_field)
    context = diagram.CreateDefaultContext()
    with pytest.raises(ConfigurationError, match=r"shape \(3,\)"):
        SetHover(diagram, context, (1.0, 2.0))
    with pytest.raises(ConfigurationError, match=r"shape \(12,\)"):
        SetVehicleState(diagram, context, np.zeros(11))
    with pytest.raises(NonFiniteValueError, match="finite"):
        SetHover(diagram, context, (1.0, math.nan, 0.0))


def test_noise_seed_of_a_flight_repeats_it(circle_field):
    diagram = MakeFlightDiagram(circle_field, sensors=SensorParameters())

    def end_of_flight(seed):
        simulator = MakeSimulator(diagram)
        context = simulator.get_mutable_context()
        SetHover(diagram, context, START)
        SetNoiseSeed(diagram, context, seed)
        simulator.AdvanceTo(0.5)
        return context.get_continuous_state_vector().CopyToVector()

    np.testing.assert_array_equal(end_of_flight(3), end_of_flight(3))
    assert np.abs(end_of_flight(3) - end_of_flight(4)).max() > 1e-5


def test_noise_seed_means_nothing_without_noise(circle_field):
    diagram = MakeFlightDiagram(circle_field)
    context = diagram.CreateDefaultContext()
    SetHover(diagram, context, START)
    before = context.get_discrete_state_vector().CopyToVector()
    SetNoiseSeed(diagram, context, 3)
    np.testing.assert_array_equal(context.get_discrete_state_vector().CopyToVector(), before)


def test_hover_of_the_continuous_loop_can_be_set_in_autodiff(circle_field):
    loop = MakeFlightDiagram(circle_field, sample_period=0.0, saturate=False)
    autodiff = loop.ToAutoDiffXd()
    context = autodiff.CreateDefaultContext()
    SetHover(autodiff, context, START)
    state = [x.value() for x in context.get_continuous_state_vector().CopyToVector()]
    np.testing.assert_array_equal(state, [*START, *np.zeros(9)])


def test_start_of_cloned_sensors_is_refused_with_the_way_around(circle_field):
    diagram = MakeFlightDiagram(circle_field, sensors=SensorParameters())
    clone = diagram.Clone()
    context = clone.CreateDefaultContext()
    with pytest.raises(ConfigurationError, match="SetTimeStateAndParametersFrom"):
        SetHover(clone, context, START)
    with pytest.raises(ConfigurationError, match="seed"):
        SetNoiseSeed(clone, context, 3)
    original = diagram.CreateDefaultContext()
    SetHover(diagram, original, START)
    context.SetTimeStateAndParametersFrom(original)
    np.testing.assert_array_equal(
        clone.GetOutputPort("state").Eval(context), [*START, *np.zeros(9)]
    )
