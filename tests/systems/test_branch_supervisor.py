"""What a supervisor decides at a sample and what it commands; see also its flights."""

import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import HOLD_POSITION, Branch, Mode, supervision
from systems.branch_supervisor import BranchSupervisor
from systems.supervision import MAX_CORRECTION, POSITION_GAIN, Memory

from .flying import (
    LAP,
    ONE_RING,
    PARAMETERS,
    RINGS,
    SPEED,
    TWO_RINGS,
    UNIT,
    CircleField,
    Flight,
    differences,
    spatial_rings,
)

BOX = ([-2.5, -2.5], [2.5, 2.5])
LIMIT = 0.4 * PARAMETERS.max_horizontal_acceleration
COMMAND = SPEED * np.array([0.0, 1.0, 0.0])
INPUTS = {
    "position": np.array([1.1, 0.3, 1.2]),
    "velocity": np.array([0.2, 0.3, -0.1]),
    "velocity_command": np.array([0.3, -0.1, 0.2]),
    "acceleration_feedforward": np.array([0.2, 0.4, -0.1]),
    "speed": np.array([SPEED]),
    "measurement_age": np.array([0.0]),
}


def at_rest(system=None, **changed):
    """A supervisor, by default of both rings, and its Context with inputs."""
    system = system or BranchSupervisor(TWO_RINGS, RINGS)
    context = system.CreateDefaultContext()
    fix_inputs(system, context, **changed)
    return system, context


def fix_inputs(system, context, **changed):
    for name, value in {**INPUTS, **changed}.items():
        system.GetInputPort(name).FixValue(context, value)


def see(system, context):
    """The memory after the supervisor has seen its inputs once."""
    context.SetDiscreteState(0, system.EvalUniquePeriodicDiscreteUpdate(context).value(0))
    values = context.get_discrete_state(0).CopyToVector()
    return Memory.FromVector(np.array([getattr(v, "value", lambda v=v: v)() for v in values]))


def commands(system, context):
    names = ("velocity_command", "acceleration_feedforward")
    return np.concatenate([system.GetOutputPort(name).Eval(context) for name in names])


def moving(velocity, radius=1.0):
    """A vehicle on the x axis."""
    return {"position": np.array([radius, 0.0, 1.0]), "velocity": np.array(velocity)}


def test_guidance_passes_unchanged_before_anything_is_seen():
    expected = [INPUTS["velocity_command"], INPUTS["acceleration_feedforward"]]
    np.testing.assert_array_equal(commands(*at_rest()), np.concatenate(expected))


@pytest.mark.parametrize("velocity", [[0.02, SPEED - 0.03, 0.0], [0.4, 0.1, 0.0]])
def test_stop_begins_with_the_command_unless_the_vehicle_moves_otherwise(velocity):
    system, context = at_rest(**moving(velocity), velocity_command=COMMAND)
    see(system, context)
    system.SetBranch(context, HOLD_POSITION)
    memory = see(system, context)
    assert memory.mode == Mode.HOLD
    assert memory.scale_rate == 0.0
    # The speed has only begun to rise to the command.
    expected = COMMAND * memory.scale if velocity[0] < 0.1 else velocity
    np.testing.assert_allclose(memory.velocity[:2], expected[:2], atol=1e-12)


def test_landing_begins_with_the_climb_rate_that_is_commanded():
    ring = Branch(np.column_stack([UNIT, np.ones(len(UNIT))]), LAP, True)
    command = SPEED * np.array([0.0, 0.8, 0.6])
    system, context = at_rest(
        BranchSupervisor(spatial_rings(), (ring,)),
        **moving(command),
        velocity_command=command,
    )
    see(system, context)
    system.GetInputPort("measurement_age").FixValue(context, [9.0])
    memory = see(system, context)
    assert memory.mode == Mode.LAND
    # It begins to descend with 0.5 m/s^2.
    assert memory.velocity[2] == pytest.approx(0.6 * SPEED - 0.005)


def test_a_landing_speeds_up_to_its_rate_and_slows_down_at_the_ground():
    system = BranchSupervisor(TWO_RINGS, RINGS, landing_height=0.2)
    climb = np.zeros(3)
    system, context = at_rest(system, **moving(climb), velocity_command=climb)
    see(system, context)
    system.GetInputPort("measurement_age").FixValue(context, [9.0])
    landing = [see(system, context) for _ in range(800)]
    height, rate = np.array([[m.position[2] - 0.2, m.velocity[2]] for m in landing]).T
    # 0.5 m/s^2 at samples of 0.01 s, then 0.3 m/s, until the height is less than 1 s of that.
    np.testing.assert_allclose(rate[:60], -0.005 * np.arange(1, 61))
    high = height > 0.3
    np.testing.assert_allclose(rate[high][60:], -0.3)
    np.testing.assert_allclose(np.diff(height[~high]), -0.01 * height[~high][:-1], rtol=1e-9)
    assert 0.0 < height[-1] < 0.01


@pytest.mark.parametrize(("velocity", "rate"), [(0.0, 0.1 * LIMIT / 12), (12.0, -LIMIT / 12)])
def test_speed_moves_as_the_thrust_allows(velocity, rate):
    system = BranchSupervisor(ONE_RING, RINGS[:1])
    motion = moving([0.0, velocity, 0.0])
    system, context = at_rest(system, **motion, speed=np.array([12.0]))
    memory = see(system, context)
    assert memory.scale_rate == pytest.approx(rate, rel=1e-9)
    # The feed-forward is the rate of the scaled command, by the product rule.
    v, a = INPUTS["velocity_command"][:2], INPUTS["acceleration_feedforward"][:2]
    output = commands(system, context)
    np.testing.assert_allclose(output[:2], memory.scale * v)
    np.testing.assert_allclose(output[3:5], memory.scale * a + memory.scale_rate * v)


@pytest.mark.parametrize(("branch", "start"), [(0, 2.0), (1, 1.0)])
def test_transfer_is_flown_at_a_speed_that_its_branch_allows(branch, start):
    system, context = at_rest(**moving(np.zeros(3), start), speed=np.array([12.0]))
    system.SetBranch(context, branch)
    memory = see(system, context)
    assert memory.mode == Mode.TRANSFER
    expected = math.sqrt(LIMIT * (1.0 + branch))
    assert 12.0 * memory.scale == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(("radius", "flown"), [(1.1, 0.4 * 0.01), (0.5, 0.0)])
def test_distance_is_counted_on_the_branch_only(radius, flown):
    motion = moving([0.3, 0.4, 0.1], radius)
    memory = see(*at_rest(**motion, velocity_command=COMMAND))
    assert memory.flown == pytest.approx(flown, abs=1e-12)


def test_reference_is_corrected_in_proportion_and_not_without_limit():
    system, context = at_rest(**moving([0.0, 0.4, 0.0]))
    system.SetBranch(context, HOLD_POSITION)
    memory = see(system, context)
    off = moving([0.1, 0.2, 0.0])
    off["position"][:2] = memory.position[:2] + np.array([1e-5, -2e-5])
    fix_inputs(system, context, **off)
    v_ref, a_ref = memory.velocity[:2], memory.acceleration[:2]
    output = commands(system, context)
    np.testing.assert_allclose(output[:2], v_ref + POSITION_GAIN * np.array([-1e-5, 2e-5]))
    np.testing.assert_allclose(
        output[3:5], a_ref + POSITION_GAIN * (v_ref - [0.1, 0.2]), rtol=1e-6
    )
    assert output[2] == INPUTS["velocity_command"][2]
    off["position"][:2] = memory.position[:2] + np.array([300.0, 400.0])
    fix_inputs(system, context, **off)
    correction = commands(system, context)[:2] - v_ref
    np.testing.assert_allclose(correction, MAX_CORRECTION * np.array([-0.6, -0.8]), rtol=1e-4)


def test_modes_follow_the_ages_that_are_set():
    system, context = at_rest(measurement_age=np.array([0.5]))
    system.SetHoldAfter(context, 0.6)
    assert see(system, context).mode == Mode.FOLLOW
    system.SetHoldAfter(context, 0.4)
    assert see(system, context).mode == Mode.HOLD
    system.SetLandAfter(context, 0.45)
    assert see(system, context).mode == Mode.LAND
    assert system.GetOutputPort("mode").Eval(context) == Mode.LAND


def test_measurement_is_fresh_where_its_age_is_not_connected():
    system = BranchSupervisor(TWO_RINGS, RINGS)
    context = system.CreateDefaultContext()
    for name in list(INPUTS)[:5]:
        system.GetInputPort(name).FixValue(context, INPUTS[name])
    assert see(system, context).mode == Mode.FOLLOW


def test_commands_are_evaluated_once_in_a_sample(monkeypatch):
    calls = []

    def counted(*arguments):
        calls.append(arguments)
        return supervision.CalcCommands(*arguments)

    monkeypatch.setattr("systems.branch_supervisor.CalcCommands", counted)
    field = CircleField()
    flight = Flight(field, branches=RINGS[:1], supervisor={}).until(0.5)
    fields, commands = field.calls, len(calls)
    flight.until(1.0)
    # Anything that depends on the time would run in every stage of the integrator.
    assert field.calls - fields == 50
    assert len(calls) - commands <= 101


@pytest.mark.parametrize("age", [0.0, 0.5, 2.0])
def test_gradients_agree_with_differences(age):
    system, context = at_rest(measurement_age=np.array([age]))
    see(system, context)
    autodiff = system.ToAutoDiffXd()
    converted = autodiff.CreateDefaultContext()
    converted.SetTimeStateAndParametersFrom(context)
    # Off the reference, so that the correction counts.
    x = np.concatenate([INPUTS[name] for name in list(INPUTS)[:4]])
    x[:3] += [0.2, -0.3, 0.1]

    def evaluate(values, system=system, context=context):
        for name, part in zip(INPUTS, np.split(values, [3, 6, 9]), strict=False):
            system.GetInputPort(name).FixValue(context, part)
        return commands(system, context)

    output = evaluate(InitializeAutoDiff(x).ravel(), autodiff, converted)
    np.testing.assert_allclose([v.value() for v in output], evaluate(x), rtol=1e-12)
    expected = differences(evaluate, x)
    np.testing.assert_allclose(ExtractGradient(output.reshape(-1, 1)), expected, atol=1e-7)
    assert np.abs(expected[:, 3:6]).max() > 0.5 or age == 0.0


def test_autodiff_decides_as_float_does():
    age = np.array([0.5])
    arguments = {"tour": (1, 0), "laps": 1.5, "box": BOX, "landing_height": 0.2}
    system, context = at_rest(
        BranchSupervisor(TWO_RINGS, RINGS, **arguments), measurement_age=age
    )
    inputs = {n: InitializeAutoDiff(v).ravel() for n, v in INPUTS.items()}
    autodiff, converted = at_rest(
        system.ToAutoDiffXd(), **{**inputs, "measurement_age": InitializeAutoDiff(age).ravel()}
    )
    memory = see(system, context)
    np.testing.assert_array_equal(see(autodiff, converted).ToVector(), memory.ToVector())
    assert (memory.mode, memory.branch) == (Mode.HOLD, 1.0)


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_input_that_is_not_finite_is_named(name, value):
    bad = INPUTS[name].copy()
    bad[-1] = value
    system, context = at_rest(**{name: bad})
    system.set_name("pilot")
    context.SetTime(1.5)
    with pytest.raises(NonFiniteValueError, match=rf"pilot: input port '{name}'.*t = 1.5 s"):
        see(system, context)
    if name in ("velocity_command", "acceleration_feedforward"):
        with pytest.raises(NonFiniteValueError, match=f"input port '{name}'"):
            commands(system, context)


@pytest.mark.parametrize("branch", [2, -3, 0.5, math.nan])
def test_branch_that_does_not_exist_is_refused(branch):
    system, context = at_rest()
    with pytest.raises(ConfigurationError, match="branch must be one of"):
        system.SetBranch(context, branch)
    context.get_mutable_numeric_parameter(0).SetAtIndex(0, branch)
    with pytest.raises(ConfigurationError, match="branch must be one of"):
        see(system, context)


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan])
@pytest.mark.parametrize("name", ["Laps", "HoldAfter", "LandAfter"])
def test_bad_parameter_is_refused(name, value):
    system, context = at_rest()
    with pytest.raises(ConfigurationError, match="must be finite and positive"):
        getattr(system, f"Set{name}")(context, value)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tour": (2,)}, "tour"),
        ({"laps": 0.0}, "laps"),
        ({"period": 0.0}, "period"),
        ({"landing_height": math.inf}, "landing_height"),
        ({"box": ([0.0, 0.0], [1.0, 1.0])}, "branch 0 is not inside the box"),
        ({"branches": ()}, "at least one branch"),
    ],
)
def test_bad_argument_is_refused(arguments, message):
    with pytest.raises(ConfigurationError, match=message):
        BranchSupervisor(TWO_RINGS, **{"branches": RINGS, **arguments})


def test_field_of_another_dimension_is_refused():
    field = CircleField()
    field.dim = 4
    with pytest.raises(ConfigurationError, match="dimension 2 or 3, got 4"):
        BranchSupervisor(field, RINGS)
