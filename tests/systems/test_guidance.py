import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import GuidanceSystem
from systems.guidance import ALTITUDE_GAIN, MAX_CLIMB_RATE

PORTS = ("velocity_command", "acceleration_feedforward")


class ConstantField:
    """A field of any dimension with one value everywhere."""

    def __init__(self, dim, value=1.0):
        self.dim, self._value = dim, value

    def __call__(self, x):
        return np.full(x.shape, self._value)

    def value_and_jacobian(self, x):
        return self(x), np.zeros((*x.shape, self.dim))

    def hessian(self, x):
        return np.zeros((*x.shape, self.dim, self.dim))


def random_states(count, seed=0):
    rng = np.random.default_rng(seed)
    states = rng.uniform(-0.5, 0.5, (count, 12))
    angle, radius = rng.uniform(0.0, 2.0 * math.pi, count), rng.uniform(0.5, 1.6, count)
    states[:, 0], states[:, 1] = radius * np.cos(angle), radius * np.sin(angle)
    states[:, 2] += 1.0
    return states


def evaluate(system, state):
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, state)
    return [system.GetOutputPort(name).Eval(context) for name in PORTS]


def test_planar_field_guides_the_plane_and_holds_the_altitude(circle_field):
    state = random_states(1)[0]
    command, acceleration = evaluate(GuidanceSystem(circle_field, 0.7, 1.2), state)
    m, J = circle_field.value_and_jacobian(state[:2])
    np.testing.assert_allclose(command[:2], 0.7 * m, rtol=1e-14)
    assert np.linalg.norm(command[:2]) == pytest.approx(0.7)
    climb = MAX_CLIMB_RATE * math.tanh(ALTITUDE_GAIN * (1.2 - state[2]) / MAX_CLIMB_RATE)
    assert command[2] == pytest.approx(climb)
    np.testing.assert_allclose(acceleration[:2], 0.7 * J @ state[6:8], rtol=1e-14)
    slope = -ALTITUDE_GAIN * (1.0 - (climb / MAX_CLIMB_RATE) ** 2)
    assert acceleration[2] == pytest.approx(slope * state[8])


def test_small_altitude_errors_are_answered_in_proportion(circle_field):
    state = random_states(1)[0]
    command, acceleration = evaluate(GuidanceSystem(circle_field, 0.7, state[2] + 1e-4), state)
    assert command[2] == pytest.approx(ALTITUDE_GAIN * 1e-4)
    assert acceleration[2] == pytest.approx(-ALTITUDE_GAIN * state[8])


def test_spatial_field_guides_all_three(spatial_circle_field):
    state = random_states(1)[0]
    command, acceleration = evaluate(GuidanceSystem(spatial_circle_field, 0.7, 50.0), state)
    m, J = spatial_circle_field.value_and_jacobian(state[:3])
    np.testing.assert_allclose(command, 0.7 * m, rtol=1e-14)
    np.testing.assert_allclose(acceleration, 0.7 * J @ state[6:9], rtol=1e-13)


@pytest.mark.parametrize(
    ("altitude", "climb"), [(50.0, MAX_CLIMB_RATE), (-30.0, -MAX_CLIMB_RATE)]
)
def test_climb_rate_is_limited_and_its_feedforward_with_it(circle_field, altitude, climb):
    state = random_states(1)[0]
    command, acceleration = evaluate(GuidanceSystem(circle_field, 0.45, altitude), state)
    assert command[2] == climb
    assert acceleration[2] == 0.0


def test_feedforward_is_the_rate_of_the_command_along_the_motion(circle_field):
    system, h = GuidanceSystem(circle_field), 1e-6
    for state in random_states(5, seed=1):
        step = np.zeros(12)
        step[:3] = h * state[6:9]
        ahead, behind = evaluate(system, state + step)[0], evaluate(system, state - step)[0]
        np.testing.assert_allclose(
            evaluate(system, state)[1], (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-8
        )


def test_feedforward_can_be_left_out(circle_field):
    _, acceleration = evaluate(GuidanceSystem(circle_field, feedforward=False), np.ones(12))
    np.testing.assert_array_equal(acceleration, 0.0)


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_agree_with_differences(circle_field, spatial_circle_field, dim):
    system = GuidanceSystem(circle_field if dim == 2 else spatial_circle_field)
    autodiff, h = system.ToAutoDiffXd(), 1e-6
    for state in random_states(6, seed=2):
        outputs = evaluate(autodiff, InitializeAutoDiff(state))
        for k, output in enumerate(outputs):
            expected = np.column_stack(
                [
                    (evaluate(system, state + e)[k] - evaluate(system, state - e)[k]) / (2 * h)
                    for e in h * np.eye(12)
                ]
            )
            gradient = ExtractGradient(output.reshape(-1, 1))
            np.testing.assert_allclose(
                ExtractValue(output.reshape(-1, 1)).ravel(),
                evaluate(system, state)[k],
                rtol=1e-14,
            )
            np.testing.assert_allclose(gradient, expected, atol=1e-5 * np.abs(expected).max())


def test_gradient_with_respect_to_the_speed(circle_field):
    system = GuidanceSystem(circle_field)
    autodiff, state = system.ToAutoDiffXd(), random_states(1)[0]
    context = autodiff.CreateDefaultContext()
    autodiff.get_input_port().FixValue(context, InitializeAutoDiff(state, np.zeros((12, 0))))
    autodiff.SetSpeed(context, InitializeAutoDiff(np.array([0.45]))[0, 0])
    command = autodiff.GetOutputPort("velocity_command").Eval(context)
    gradient = ExtractGradient(command[:2].reshape(-1, 1))
    np.testing.assert_allclose(gradient.ravel(), circle_field(state[:2]), rtol=1e-14)


def test_both_outputs_share_one_evaluation_of_the_field(circle_field):
    system, state = GuidanceSystem(circle_field), random_states(1)[0]
    before = circle_field.calls
    evaluate(system, state)
    assert circle_field.calls == before + 1


def test_changed_parameters_take_effect_at_once(circle_field):
    system = GuidanceSystem(circle_field, speed=0.45, altitude=1.0)
    context, state = system.CreateDefaultContext(), random_states(1)[0]
    state[2] = 1.0
    system.get_input_port().FixValue(context, state)
    ports = [system.GetOutputPort(name) for name in PORTS]
    slow = [port.Eval(context).copy() for port in ports]
    calls = circle_field.calls
    system.SetSpeed(context, 0.9)
    system.SetAltitude(context, 1.1)
    assert (system.GetSpeed(context), system.GetAltitude(context)) == (0.9, 1.1)
    command, acceleration = (port.Eval(context) for port in ports)
    np.testing.assert_allclose(command[:2], 2.0 * slow[0][:2])
    np.testing.assert_allclose(acceleration[:2], 2.0 * slow[1][:2])
    assert slow[0][2] == 0.0
    assert command[2] == pytest.approx(math.tanh(0.1 * ALTITUDE_GAIN))
    assert system.GetOutputPort("speed").Eval(context) == 0.9
    assert circle_field.calls == calls + 1


def test_outputs_follow_the_state(circle_field):
    system = GuidanceSystem(circle_field)
    context, states = system.CreateDefaultContext(), random_states(2)
    for state in states:
        system.get_input_port().FixValue(context, state)
        command = system.GetOutputPort("velocity_command").Eval(context)
        np.testing.assert_allclose(command[:2], 0.45 * circle_field(state[:2]))


def test_clone_and_scalar_conversion_keep_the_parameters(circle_field):
    system = GuidanceSystem(circle_field)
    context = system.CreateDefaultContext()
    system.SetSpeed(context, 1.7)
    assert system.GetSpeed(context.Clone()) == 1.7
    autodiff = system.ToAutoDiffXd()
    converted = autodiff.CreateDefaultContext()
    converted.SetTimeStateAndParametersFrom(context)
    assert autodiff.GetSpeed(converted).value() == 1.7


def test_scalar_conversion_keeps_the_arguments(circle_field):
    system = GuidanceSystem(circle_field, 1.7, 2.5, feedforward=False).ToAutoDiffXd()
    context = system.CreateDefaultContext()
    assert system.GetSpeed(context).value() == 1.7
    assert system.GetAltitude(context).value() == 2.5
    system.get_input_port().FixValue(context, InitializeAutoDiff(random_states(1)[0]))
    acceleration = system.GetOutputPort("acceleration_feedforward").Eval(context)
    assert [a.value() for a in acceleration] == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("dim", [1, 4])
def test_other_dimensions_are_refused(dim):
    with pytest.raises(ConfigurationError, match=f"dimension 2 or 3, got {dim}"):
        GuidanceSystem(ConstantField(dim))


@pytest.mark.parametrize("speed", [-1.0, math.nan, math.inf])
def test_bad_speed_is_refused(circle_field, speed):
    with pytest.raises(ConfigurationError, match="speed"):
        GuidanceSystem(circle_field, speed=speed)
    system = GuidanceSystem(circle_field)
    with pytest.raises(ConfigurationError, match="speed"):
        system.SetSpeed(system.CreateDefaultContext(), speed)


def test_bad_altitude_is_refused(circle_field):
    with pytest.raises(ConfigurationError, match="altitude"):
        GuidanceSystem(circle_field, altitude=math.nan)


@pytest.mark.parametrize("index", [0, 5, 11])
def test_state_that_is_not_finite_is_named(circle_field, index):
    system = GuidanceSystem(circle_field)
    system.set_name("pilot")
    state = random_states(1)[0]
    state[index] = math.nan
    for scalar_system in (system, system.ToAutoDiffXd()):
        with pytest.raises(NonFiniteValueError, match=r"pilot: input port 'state'.*t = 0 s"):
            evaluate(scalar_system, state)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_field_that_is_not_finite_is_named(value):
    with pytest.raises(NonFiniteValueError, match=r"GuidanceSystem.*the field's value"):
        evaluate(GuidanceSystem(ConstantField(2, value)), np.zeros(12))


def test_a_fixed_field_has_no_approach_length_to_set(circle_field):
    system = GuidanceSystem(circle_field)
    context = system.CreateDefaultContext()
    assert system.GetApproachLength(context) == 0.0
    assert system.GetFlownField(context) is circle_field
    with pytest.raises(ConfigurationError, match="approach length"):
        system.SetApproachLength(context, 0.1)
