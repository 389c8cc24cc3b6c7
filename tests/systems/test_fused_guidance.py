"""Guidance and controller in one are the two one after the other, for every kind of field."""

import inspect
import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
import pytest

from sgvf_drake.compiling import digest
from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import (
    DEFAULT_GAINS,
    Body,
    FusedGuidance,
    GuidanceSystem,
    MakeFlightDiagram,
    MakeSimulator,
    Se3Controller,
    SensorParameters,
    SetNoiseSeed,
    SetVehicleState,
    fused_guidance,
)
from systems.fused_guidance import EVALUATED
from systems.quadrotor import POSITION, VELOCITY

from .flying import SPEED, STATE

OBSERVING = DEFAULT_GAINS._replace(disturbance_bandwidth=6.0)
OPTIONS = {
    "plain": {},
    "sensors": {"sensors": SensorParameters()},
    "observer": {"gains": OBSERVING},
    "both": {"sensors": SensorParameters(), "gains": OBSERVING},
    "without feed-forward": {"feedforward": False},
    "continuous": {"sample_period": 0.0},
}


def near(field, rng):
    """A state in flight near a waypoint."""
    state = np.concatenate((np.zeros(3), rng.uniform(-0.2, 0.2, 9)))
    waypoint = field.cloud.points[rng.integers(field.cloud.num_points)]
    beside = rng.uniform(-0.2, 0.2, field.dim) * field.cloud.unit_length
    state[: field.dim] = waypoint + beside
    state[2] += 1.0
    return state


def advance(field, start, duration, heading=None, **options):
    """The diagram of a flight, its loop, and its Context at the end."""
    diagram = MakeFlightDiagram(field, speed=SPEED, **options)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetVehicleState(diagram, context, start)
    SetNoiseSeed(diagram, context, 3)
    loop = diagram.GetSubsystemByName("guidance_loop")
    if heading is not None:
        own = loop.guidance.GetMyMutableContextFromRoot(context)
        loop.guidance.SetHeading(own, heading)
    simulator.AdvanceTo(duration)
    return diagram, loop, context


def fly(*flight, **options):
    """The loop, and the states and commands that a flight logs."""
    diagram, loop, context = advance(*flight, **options)
    logs = ("state_log", "velocity_command_log", "propeller_force_log")
    found = [diagram.GetSubsystemByName(name).FindLog(context).data() for name in logs]
    return loop, np.concatenate(found)


@pytest.fixture(params=["flight", "half_circle", "spatial", "paper", "directed"])
def flown(request, make_field):
    """A field: of a mixture, with ends, in space, of networks, with a heading."""
    if request.param == "spatial":
        return make_field("robust", dim=3, ends=1, gain=0.4)
    if request.param == "paper":
        return make_field("paper")
    if request.param == "directed":
        return request.getfixturevalue("tee_field")
    return request.getfixturevalue(f"{request.param}_field")


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_a_flight_is_that_of_two_systems(flown, options):
    start = near(flown, np.random.default_rng(0))
    heading = None if flown.dim == 3 or not hasattr(flown, "heading") else [0.8, 0.3]
    loop, found = fly(flown, start, 0.4, heading, **options)
    assert loop.guidance is loop.controller
    assert isinstance(loop.guidance, FusedGuidance)
    two, expected = fly(flown, start, 0.4, heading, fused=False, **options)
    assert not isinstance(two.guidance, FusedGuidance)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_the_loop_tells_what_it_does_with_two_systems(flight_field, options):
    """At all of its ports, also those that no flight asks for."""
    start, told = near(flight_field, np.random.default_rng(0)), []
    for fused in (True, False):
        _, loop, context = advance(flight_field, start, 0.1, fused=fused, **options)
        own = loop.GetMyContextFromRoot(context)
        ports = [loop.get_output_port(index) for index in range(loop.num_output_ports())]
        told.append({port.get_name(): port.Eval(own) for port in ports})
    assert {"measured_state", "position", *EVALUATED} - told[0].keys() == {"acceleration"}
    assert told[0].keys() == told[1].keys()
    for name, value in told[0].items():
        np.testing.assert_allclose(value, told[1][name], rtol=0, atol=1e-9, err_msg=name)


def evaluated(system, state, **inputs):
    """The Context in which all inputs are fixed."""
    context = system.CreateDefaultContext()
    for name, value in {"state": state, **inputs}.items():
        system.GetInputPort(name).FixValue(context, value)
    return context


def outputs(system, context):
    """The values of the evaluation by their names, and those of the ports of these names."""
    evaluation = system.GetOutputPort("evaluation").Eval(context)
    ports = {name: system.GetOutputPort(name).Eval(context) for name in EVALUATED}
    return {name: evaluation[part] for name, part in EVALUATED.items()}, ports


def test_the_evaluation_is_what_the_ports_have(flown):
    system = FusedGuidance(flown, SPEED, gains=OBSERVING)
    rng = np.random.default_rng(1)
    for _ in range(5):
        state = near(flown, rng)
        context = evaluated(
            system, state, heading=[0.3], speed=[0.2], predicted_velocity=state[VELOCITY] + 0.1
        )
        found, expected = outputs(system, context)
        for name in EVALUATED:
            np.testing.assert_allclose(found[name], expected[name], rtol=1e-9, atol=1e-10)
    # And the ports are those of the two systems.
    guidance, controller = GuidanceSystem(flown, SPEED), Se3Controller(gains=OBSERVING)
    own = guidance.CreateDefaultContext()
    for name, part in (("position", POSITION), ("velocity", VELOCITY)):
        guidance.GetInputPort(name).FixValue(own, state[part])
    guidance.GetInputPort("speed").FixValue(own, [0.2])
    told = controller.CreateDefaultContext()
    for name in ("velocity_command", "acceleration_feedforward"):
        value = guidance.GetOutputPort(name).Eval(own)
        np.testing.assert_array_equal(value, expected[name])
        controller.GetInputPort(name).FixValue(told, value)
    controller.GetInputPort("state").FixValue(told, state)
    controller.GetInputPort("heading").FixValue(told, [0.3])
    controller.GetInputPort("predicted_velocity").FixValue(told, state[VELOCITY] + 0.1)
    force = controller.GetOutputPort("propeller_force").Eval(told)
    np.testing.assert_array_equal(force, expected["propeller_force"])


def test_it_is_the_compiled_call_that_flies(flight_field, monkeypatch):
    """The comparison would be one of a thing with itself if it fell back on the ports."""
    system = FusedGuidance(flight_field)
    monkeypatch.setattr(type(system), "_CalcInTwo", None)
    context = evaluated(system, STATE)
    assert np.isfinite(system.GetOutputPort("evaluation").Eval(context)).all()


@pytest.mark.parametrize("name", ["Speed", "Altitude", "ApproachLength", "Gains", "Body"])
def test_parameters_of_the_context_act_at_once(flight_field, name):
    value = {
        "Speed": 0.9,
        "Altitude": 1.3,
        "ApproachLength": 0.9,
        "Gains": DEFAULT_GAINS._replace(heading=0.4, velocity_gain=2.0),
        "Body": Body(0.5, 5e-4, 7e-4, 9e-4),
    }[name]
    system = FusedGuidance(flight_field)
    context, other = evaluated(system, STATE), evaluated(system, STATE)
    before, _ = outputs(system, context)
    getattr(system, f"Set{name}")(context, value)
    after, expected = outputs(system, context)
    assert np.abs(after["propeller_force"] - before["propeller_force"]).max() > 1e-4
    for part in EVALUATED:
        np.testing.assert_allclose(after[part], expected[part], rtol=1e-9, atol=1e-10)
        np.testing.assert_array_equal(outputs(system, other)[0][part], before[part])


def test_the_field_is_evaluated_only_where_the_motion_is_another(flight_field, monkeypatch):
    calls = []

    def counted(evaluation, state, *arguments):
        kept = evaluation.copy()
        good = compiled(evaluation, state, *arguments)
        calls.append(not np.array_equal(kept[-9:], evaluation[-9:]))
        return good

    compiled = fused_guidance._CalcFused
    monkeypatch.setattr(fused_guidance, "_CalcFused", counted)
    fly(flight_field, near(flight_field, np.random.default_rng(0)), 0.2, **OPTIONS["sensors"])
    # Five attitudes for each position, and one sample before the first.
    assert len(calls) == pytest.approx(100, abs=3)
    assert sum(calls) == pytest.approx(20, abs=3)


def test_what_is_remembered_is_forgotten_after_an_error(flight_field):
    system = FusedGuidance(flight_field)
    context = evaluated(system, STATE)
    expected, _ = outputs(system, context)
    bad = STATE.copy()
    bad[3] = math.nan
    system.GetInputPort("state").FixValue(context, bad)
    with pytest.raises(NonFiniteValueError):
        system.GetOutputPort("evaluation").Eval(context)
    system.GetInputPort("state").FixValue(context, STATE)
    for name, value in outputs(system, context)[0].items():
        np.testing.assert_array_equal(value, expected[name])


@pytest.mark.parametrize("entry", range(12))
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_state_that_is_not_finite_is_named(flight_field, entry, value):
    system = FusedGuidance(flight_field)
    state = STATE.copy()
    state[entry] = value
    context = evaluated(system, state)
    with pytest.raises(NonFiniteValueError, match=r"FusedGuidance.*'state' is not finite"):
        system.GetOutputPort("evaluation").Eval(context)


@pytest.mark.parametrize(("port", "value"), [("heading", math.nan), ("speed", math.inf)])
def test_an_input_that_is_not_finite_is_named(flight_field, port, value):
    system = FusedGuidance(flight_field)
    context = evaluated(system, STATE, **{port: [value]})
    with pytest.raises(NonFiniteValueError, match=f"'{port}' is not finite"):
        system.GetOutputPort("evaluation").Eval(context)


@pytest.mark.parametrize(
    ("group", "entry", "value", "message"),
    [
        ("parameter_index", 0, -1.0, "speed"),
        ("gains_index", 0, 0.0, "velocity_gain"),
        ("gains_index", 4, -1.0, "disturbance_bandwidth"),
        ("body_index", 0, -1.0, "mass"),
    ],
)
def test_parameters_that_cannot_be_used_are_named(flight_field, group, entry, value, message):
    """Where they were set in the Context itself, as the two systems do."""
    system = FusedGuidance(flight_field)
    context = evaluated(system, STATE)
    index = getattr(system, group)
    context.get_mutable_numeric_parameter(index).SetAtIndex(entry, value)
    with pytest.raises(ConfigurationError, match=message):
        system.GetOutputPort("evaluation").Eval(context)


def test_gradients_are_those_of_the_two_systems(flown):
    """By state and speed, through the whole loop without a hold."""
    gradients = []
    for fused in (True, False):
        diagram = MakeFlightDiagram(
            flown, speed=SPEED, sample_period=0.0, log_period=None, fused=fused
        ).ToAutoDiffXd()
        context = diagram.CreateDefaultContext()
        size = context.num_continuous_states()
        state = np.zeros(size)
        state[:12] = near(flown, np.random.default_rng(2))
        state[12:] = 0.3
        variables = InitializeAutoDiff(np.append(state, SPEED))[:, 0]
        context.SetContinuousState(variables[:size])
        guidance = diagram.GetSubsystemByName("guidance_loop").GetSubsystemByName("guidance")
        guidance.SetSpeed(guidance.GetMyMutableContextFromRoot(context), variables[size])
        rates = diagram.EvalTimeDerivatives(context).CopyToVector()
        gradients.append(ExtractGradient(rates.reshape(-1, 1)))
    assert np.abs(gradients[0]).max() > 1.0
    np.testing.assert_allclose(*gradients, rtol=1e-12, atol=1e-12)


def functions_in(function, found):
    """The modules of all functions of this project that a function calls, in the end."""
    for name in function.__code__.co_names:
        callee = function.__globals__.get(name)
        callee = getattr(callee, "py_func", callee)
        if inspect.isfunction(callee) and callee not in found:
            found.add(callee)
            functions_in(callee, found)
    return {callee.__module__ for callee in found}


@pytest.mark.parametrize("name", ["_CalcFused", "_CalcFusedTurning"])
def test_everything_compiled_is_in_the_key_of_the_cache(name):
    compiled = getattr(fused_guidance, name).py_func
    modules = functions_in(compiled, set())
    assert {"systems.se3_law", "sgvf_drake.fields.compiled.networks"} <= modules
    sources = {module.__name__ for module in fused_guidance._SOURCES}
    assert modules <= sources | {fused_guidance.__name__}
    (enclosed,) = compiled.__closure__
    assert enclosed.cell_contents == digest(*fused_guidance._SOURCES)
