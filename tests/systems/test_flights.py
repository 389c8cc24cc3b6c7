"""How the loop around a vehicle is wired, and how whole flights around a circle go."""

import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.examples import QuadrotorPlant
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import DiscreteTimeDelay
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import (
    AddGuidance,
    BranchSupervisor,
    IdealMotionCapture,
    MakeFlightDiagram,
    MakeSimulator,
    MotionCapture,
    SensorParameters,
    SetHover,
    SetNoiseSeed,
    SetVehicleState,
)
from systems.quadrotor import POSITION, VELOCITY

from .flying import LAP, PARAMETERS, RINGS, STATE, CircleField, Flight, differences, rms

SENSORS = SensorParameters()
START = (1.0, 0.0, 1.0)
MOTION = ("position", "velocity")
COMMANDS = ("velocity_command", "acceleration_feedforward")


def connections(flight):
    """From (system, input port) to (system, output port), without the logs."""
    return {
        (to.get_name(), to.get_input_port(into).get_name()): (
            source.get_name(),
            source.get_output_port(out).get_name(),
        )
        for diagram in (flight.diagram, flight.loop)
        for (to, into), (source, out) in diagram.connection_map().items()
        if to not in flight.logs.values()
    }


@pytest.mark.parametrize("lost", [None, []])
@pytest.mark.parametrize("supervisor", [None, {}])
@pytest.mark.parametrize("sensors", [None, SENSORS])
def test_everything_is_connected(circle_field, sensors, supervisor, lost):
    flight = Flight(
        circle_field, branches=RINGS[:1], supervisor=supervisor, sensors=sensors, lost=lost
    )
    seen, commander = ("guidance_loop", "state"), "guidance"
    if supervisor is not None:
        commander = "supervisor"
    expected = {
        seen: ("plant", "state"),
        **{("guidance", name): ("motion_capture", name) for name in MOTION},
        ("controller", "state"): ("motion_capture", "state"),
        **{("controller", name): (commander, name) for name in COMMANDS},
        ("plant", "propeller_force"): ("guidance_loop", "propeller_force"),
    }
    if sensors:
        expected["motion_capture", "acceleration"] = ("controller", "acceleration")
    if supervisor is not None:
        expected |= {("supervisor", name): ("motion_capture", name) for name in MOTION}
        for name in (*COMMANDS, "speed"):
            expected["supervisor", name] = ("guidance", name)
        if sensors:
            expected["supervisor", "measurement_age"] = ("motion_capture", "measurement_age")
    if lost is not None:
        expected[seen] = ("dropout", "output")
        expected["dropout", "input"] = ("plant", "state")
    assert connections(flight) == expected
    assert flight.loop.supervisor is flight.supervisor
    capture = flight.loop.motion_capture
    assert isinstance(capture, MotionCapture if sensors else IdealMotionCapture)


def test_arguments_reach_their_systems(circle_field):
    sensors = SensorParameters(delay=0.03, position_noise=0.0)
    loop = Flight(circle_field, sensors=sensors).loop
    assert loop.motion_capture.parameters is sensors
    assert loop.controller.parameters is PARAMETERS
    options = {"speed": 0.7, "altitude": 1.4, "sample_period": 0.02, "feedforward": False}
    flight = Flight(circle_field, **options)
    diagram = MakeFlightDiagram(circle_field, PARAMETERS, **options)
    for made in (flight.diagram, diagram):
        loop = made.GetSubsystemByName("guidance_loop")
        guidance = loop.guidance
        own = guidance.CreateDefaultContext()
        assert (guidance.GetSpeed(own), guidance.GetAltitude(own)) == (0.7, 1.4)
        for name, entries in (("position", POSITION), ("velocity", VELOCITY)):
            guidance.GetInputPort(name).FixValue(own, STATE[entries])
        assert not guidance.GetOutputPort("acceleration_feedforward").Eval(own).any()
        assert loop.motion_capture.GetSubsystemByName("state").period() == 0.02


def test_flight_diagram_passes_the_parts_of_the_loop_on(circle_field):
    supervisor = BranchSupervisor(circle_field, RINGS[:1])
    diagram = MakeFlightDiagram(circle_field, sensors=SENSORS, supervisor=supervisor)
    loop = diagram.GetSubsystemByName("guidance_loop")
    assert loop.motion_capture.parameters is SENSORS
    assert loop.supervisor is supervisor
    assert {"mode_log", "branch_log"} <= {s.get_name() for s in diagram.GetSystems()}
    continuous = MakeFlightDiagram(circle_field, sample_period=0.0, log_period=None)
    assert continuous.CreateDefaultContext().num_discrete_state_groups() == 0
    assert not any(s.get_name().endswith("_log") for s in continuous.GetSystems())


def test_continuous_loop_has_the_derivative_of_its_parts(circle_field):
    flight = Flight(circle_field, sample_period=0.0, speed=0.6)
    assert flight.context.num_discrete_state_groups() == 0
    SetVehicleState(flight.diagram, flight.context, STATE)
    found = flight.diagram.EvalTimeDerivatives(flight.context).CopyToVector()
    # The parts one after the other, each in a Context of its own.
    guidance, controller, plant = flight.guidance, flight.controller, flight.plant
    context = guidance.CreateDefaultContext()
    for name, entries in (("position", POSITION), ("velocity", VELOCITY)):
        guidance.GetInputPort(name).FixValue(context, STATE[entries])
    commands = {name: guidance.GetOutputPort(name).Eval(context) for name in COMMANDS}
    context = controller.CreateDefaultContext()
    for name, value in {"state": STATE, **commands}.items():
        controller.GetInputPort(name).FixValue(context, value)
    force = controller.GetOutputPort("propeller_force").Eval(context)
    context = plant.CreateDefaultContext()
    plant.get_input_port().FixValue(context, force)
    context.SetContinuousState(STATE)
    np.testing.assert_array_equal(found, plant.EvalTimeDerivatives(context).CopyToVector())


def force_of(flight):
    return flight.loop.GetOutputPort("propeller_force").Eval(flight.own(flight.loop))


@pytest.mark.parametrize("period", [0.0, 0.01])
def test_continuous_loop_answers_at_once_and_a_sampled_one_does_not(circle_field, period):
    flight = Flight(circle_field, START, sample_period=period)
    before = force_of(flight).copy()
    flight.context.SetContinuousState(STATE)
    assert (np.abs(force_of(flight) - before).max() > 0.01) == (period == 0.0)


@pytest.mark.parametrize("saturate", [True, False])
def test_forces_are_limited_only_if_saturated(circle_field, saturate):
    flight = Flight(circle_field, sample_period=0.0, saturate=saturate)
    state = [*START, 1.0, 0.0, 0.0, *np.full(6, 5.0)]
    SetVehicleState(flight.diagram, flight.context, state)
    force = force_of(flight)
    inside = np.all((force >= 0.0) & (force <= PARAMETERS.max_propeller_force))
    assert inside == saturate


def test_smooth_continuous_loop_is_differentiated_exactly(circle_field):
    flight = Flight(circle_field, sample_period=0.0, saturate=False)
    converted = flight.diagram.ToAutoDiffXd()
    context = converted.CreateDefaultContext()
    context.SetContinuousState(InitializeAutoDiff(STATE)[:, 0])
    rates = converted.EvalTimeDerivatives(context).CopyToVector()

    def derivative(state):
        flight.context.SetContinuousState(state)
        return flight.diagram.EvalTimeDerivatives(flight.context).CopyToVector()

    np.testing.assert_allclose(ExtractValue(rates)[:, 0], derivative(STATE), rtol=1e-12)
    expected = differences(derivative, STATE)
    np.testing.assert_allclose(ExtractGradient(rates), expected, atol=1e-6 * expected.max())


# Flights.  The errors are those of the last half lap.


@pytest.mark.parametrize(
    ("options", "laps", "bound"),
    [
        ({"speed": 0.45}, 1.1, 1e-4),
        ({"speed": 2.0}, 2.0, 5e-4),
        ({"speed": 4.0}, 5.0, 5e-3),
        ({"speed": 1.0, "sample_period": 0.0}, 1.5, 1e-4),
        # About twice what is measured.  With a velocity that is late by the delay alone, a
        # flight is 2 mm off at 0.45 m/s and 14 mm at 2 m/s.
        ({"speed": 0.45, "sensors": SENSORS}, 0.75, 1e-3),
        ({"speed": 2.0, "sensors": SENSORS}, 1.5, 6e-3),
        ({"speed": 1.0, "altitude": 50.0, "dim": 3}, 1.0, 1e-3),
    ],
)
def test_flight_follows_the_circle(circle_field, spatial_circle_field, options, laps, bound):
    options = dict(options)
    field = spatial_circle_field if options.pop("dim", 2) == 3 else circle_field
    lap = LAP / options["speed"]
    start = START if "sensors" in options else (1.3, 0.0, 1.0)
    flight = Flight(field, start, **options).until(laps * lap)
    state = flight.log("state", (laps - 0.5) * lap)
    assert rms(np.hypot(*state[:, :2].T) - 1.0) <= bound
    assert rms(state[:, 2] - 1.0) <= bound
    if options["speed"] == 0.45:
        force = flight.log("force", 1.0)
        assert np.all((force > 0.0) & (force < PARAMETERS.max_propeller_force))


@pytest.mark.parametrize("speed", [0.45, 2.0])
def test_flight_without_feedforward_is_visibly_worse(circle_field, speed):
    flight = Flight(circle_field, START, speed=speed, feedforward=False).until(LAP / speed)
    state = flight.log("state", 0.5 * LAP / speed)
    assert rms(np.hypot(*state[:, :2].T) - 1.0) > 0.03


@pytest.mark.parametrize("speed", [0.45, 2.0])
def test_integration_has_converged(circle_field, speed):
    ends = []
    for step in (0.005, 0.0025):
        diagram = MakeFlightDiagram(circle_field, speed=speed)
        simulator = MakeSimulator(diagram, step=step)
        SetHover(diagram, simulator.get_mutable_context(), (1.3, 0.0, 1.0))
        simulator.AdvanceTo(1.5)
        log = diagram.GetSubsystemByName("state_log").FindLog(simulator.get_context())
        ends.append(log.data()[:3].copy())
    assert np.abs(ends[0] - ends[1]).max() < 1e-5


def test_flight_bears_a_delay_of_30_ms(circle_field):
    # Three samples of the measured state lie between the vehicle and its controller.
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", PARAMETERS.MakePlant())
    delay = builder.AddNamedSystem("delay", DiscreteTimeDelay(0.01, 3, 12))
    builder.Connect(plant.GetOutputPort("state"), delay.get_input_port())
    AddGuidance(builder, circle_field, plant, measured_port=delay.get_output_port())
    diagram = builder.Build()
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    start = (*START, *np.zeros(9))
    SetVehicleState(diagram, context, start)
    buffer = delay.GetMyMutableContextFromRoot(context).get_mutable_discrete_state_vector()
    buffer.SetFromVector(np.tile(start, buffer.size() // 12))
    for time in np.linspace(8.0, 10.0, 20):
        simulator.AdvanceTo(time)
        x, y, z = context.get_continuous_state_vector().CopyToVector()[:3]
        assert math.hypot(x, y) == pytest.approx(1.0, abs=2e-3)
        assert z == pytest.approx(1.0, abs=2e-3)


@pytest.mark.parametrize("options", [{}, {"branches": RINGS[:1], "supervisor": {}}])
def test_guidance_and_controller_run_once_in_a_sample_of_theirs(options):
    # Anything that depends on the time in between would run in every integrator stage.
    field = CircleField()
    flight = Flight(field, sensors=SENSORS, log_period=0.002, **options).until(0.5)
    samples = round(0.5 / SENSORS.sample_period)
    # Before the first sample it is evaluated for the logs, and a supervisor looks ahead.
    assert samples <= field.calls <= samples + 3
    # The controller has a new attitude for each of its own.
    changes = np.any(np.diff(flight.log("force"), axis=0) != 0.0, axis=1).sum()
    assert changes >= 0.98 * 0.5 / SENSORS.onboard_period


def test_first_log_sample_already_knows_the_start(circle_field):
    # An unset hold would show a vehicle at the origin until its first sample.
    flight = Flight(circle_field, START).until(0.01)
    np.testing.assert_allclose(flight.log("state")[0, :3], START)
    np.testing.assert_allclose(*flight.log("force"))


@pytest.mark.parametrize("delay", [0.0, 0.03])
def test_sensors_start_from_their_first_measurement(make_field, delay):
    """Where the start was not told to them: what a delay holds at first is no position."""
    flight = Flight(make_field("robust"), sensors=SensorParameters(delay=delay))
    flight.context.SetTimeStateAndParametersFrom(flight.diagram.CreateDefaultContext())
    flight.context.SetContinuousState([*START, *np.zeros(9)])
    # Otherwise the noise depends on how many diagrams the process has made before.
    SetNoiseSeed(flight.diagram, flight.context, 0)
    flight.until(0.05)
    measured = flight.loop.GetOutputPort("measured_state").Eval(flight.own(flight.loop))
    # From the origin, it would be off by metres a second.
    np.testing.assert_allclose(measured[VELOCITY], flight.state[VELOCITY], atol=0.1)


def test_hover_is_an_equilibrium(circle_field):
    diagram = MakeFlightDiagram(circle_field, speed=0.0)
    context = diagram.CreateDefaultContext()
    SetHover(diagram, context, START)
    derivatives = diagram.EvalTimeDerivatives(context).CopyToVector()
    np.testing.assert_allclose(derivatives, 0.0, atol=1e-12)
    state = diagram.GetOutputPort("state").Eval(context)
    np.testing.assert_array_equal(state, [*START, *np.zeros(9)])


def test_parameters_are_those_of_drakes_plant(circle_field):
    # The README's own diagram flies with them.
    builder = DiagramBuilder()
    plant = builder.AddSystem(QuadrotorPlant())
    loop = AddGuidance(builder, circle_field, plant, speed=0.45)
    assert loop.controller.parameters.mass == plant.m()


@pytest.mark.parametrize("field_name", ["circle_field", "spatial_circle_field"])
def test_state_that_is_not_finite_stops_a_flight(request, field_name):
    diagram = MakeFlightDiagram(request.getfixturevalue(field_name))
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, START)
    simulator.AdvanceTo(0.05)
    context.get_mutable_continuous_state_vector().SetAtIndex(1, math.nan)
    message = r"::flight::guidance_loop::(guidance|controller): input port .* t = 0\.05 s"
    with pytest.raises(NonFiniteValueError, match=message):
        simulator.AdvanceTo(0.2)


# Starts and seeds.


def test_noise_seed_of_a_flight_repeats_it(circle_field):
    diagram = MakeFlightDiagram(circle_field, sensors=SENSORS)

    def end_of_flight(seed):
        simulator = MakeSimulator(diagram)
        context = simulator.get_mutable_context()
        SetHover(diagram, context, START)
        SetNoiseSeed(diagram, context, seed)
        simulator.AdvanceTo(0.3)
        return context.get_continuous_state_vector().CopyToVector()

    first = end_of_flight(3)
    np.testing.assert_array_equal(end_of_flight(3), first)
    assert np.abs(end_of_flight(4) - first).max() > 1e-5
    # Without noise it means nothing.
    diagram = MakeFlightDiagram(circle_field)
    context = diagram.CreateDefaultContext()
    SetHover(diagram, context, START)
    before = diagram.CreateDefaultContext()
    before.SetTimeStateAndParametersFrom(context)
    SetNoiseSeed(diagram, context, 3)
    for group in range(context.num_discrete_state_groups()):
        held, was = (c.get_discrete_state(group).CopyToVector() for c in (context, before))
        np.testing.assert_array_equal(held, was)


def test_bad_start_is_refused(circle_field):
    diagram = MakeFlightDiagram(circle_field)
    context = diagram.CreateDefaultContext()
    with pytest.raises(ConfigurationError, match=r"shape \(3,\)"):
        SetHover(diagram, context, (1.0, 2.0))
    with pytest.raises(ConfigurationError, match=r"shape \(12,\)"):
        SetVehicleState(diagram, context, np.zeros(11))
    with pytest.raises(NonFiniteValueError, match="finite"):
        SetHover(diagram, context, (1.0, math.nan, 0.0))


def test_start_of_cloned_sensors_is_refused_with_the_way_around(circle_field):
    diagram = MakeFlightDiagram(circle_field, sensors=SENSORS)
    clone = diagram.Clone()
    context = clone.CreateDefaultContext()
    with pytest.raises(ConfigurationError, match="SetTimeStateAndParametersFrom"):
        SetHover(clone, context, START)
    with pytest.raises(ConfigurationError, match="seed"):
        SetNoiseSeed(clone, context, 3)
    original = diagram.CreateDefaultContext()
    SetHover(diagram, original, START)
    context.SetTimeStateAndParametersFrom(original)
    state = clone.GetOutputPort("state").Eval(context)
    np.testing.assert_array_equal(state, [*START, *np.zeros(9)])
