import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.fields import AdjustableField
from systems import FieldForSpeed, GuidanceSystem, MakeFlightDiagram, MakeSimulator, SetHover
from systems.guidance import ALTITUDE_GAIN, MAX_CLIMB_RATE
from systems.quadrotor import POSITION, VELOCITY

from .flying import differences

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
    for name, part in (("position", POSITION), ("velocity", VELOCITY)):
        system.GetInputPort(name).FixValue(context, state[part])
    return [system.GetOutputPort(name).Eval(context) for name in PORTS]


@pytest.mark.parametrize("altitude", [1.2, 0.98, 50.0, -30.0])
@pytest.mark.parametrize("feedforward", [True, False])
def test_planar_field_guides_the_plane_and_holds_the_altitude(
    circle_field, altitude, feedforward
):
    state = random_states(1)[0]
    calls = circle_field.calls
    system = GuidanceSystem(circle_field, 0.7, altitude, feedforward)
    command, acceleration = evaluate(system, state)
    # Both outputs share one evaluation of the field.
    assert circle_field.calls == calls + 1
    m, J = circle_field.value_and_jacobian(state[:2])
    np.testing.assert_allclose(command[:2], 0.7 * m, rtol=1e-14)
    assert np.linalg.norm(command[:2]) == pytest.approx(0.7)
    climb = MAX_CLIMB_RATE * math.tanh(ALTITUDE_GAIN * (altitude - state[2]) / MAX_CLIMB_RATE)
    assert command[2] == pytest.approx(climb)
    slope = -ALTITUDE_GAIN * (1.0 - (climb / MAX_CLIMB_RATE) ** 2)
    expected = feedforward * np.array([*(0.7 * J @ state[6:8]), slope * state[8]])
    np.testing.assert_allclose(acceleration, expected, rtol=1e-13, atol=1e-15)
    if abs(altitude) > 10.0:
        # The climb rate is limited, and its feed-forward with it.
        assert (abs(command[2]), acceleration[2]) == (MAX_CLIMB_RATE, 0.0)


def test_spatial_field_guides_all_three(spatial_circle_field):
    state = random_states(1)[0]
    command, acceleration = evaluate(GuidanceSystem(spatial_circle_field, 0.7, 50.0), state)
    m, J = spatial_circle_field.value_and_jacobian(state[:3])
    np.testing.assert_allclose(command, 0.7 * m, rtol=1e-14)
    np.testing.assert_allclose(acceleration, 0.7 * J @ state[6:9], rtol=1e-13)


@pytest.mark.parametrize("dim", [2, 3])
def test_gradients_agree_with_differences(circle_field, spatial_circle_field, dim):
    system = GuidanceSystem(circle_field if dim == 2 else spatial_circle_field)
    autodiff = system.ToAutoDiffXd()
    for state in random_states(3, seed=2):
        column = np.concatenate(evaluate(autodiff, InitializeAutoDiff(state))).reshape(-1, 1)
        values = np.concatenate(evaluate(system, state))
        np.testing.assert_allclose(ExtractValue(column).ravel(), values, rtol=1e-14)
        expected = differences(lambda x: np.concatenate(evaluate(system, x)), state)
        np.testing.assert_allclose(
            ExtractGradient(column), expected, atol=1e-5 * np.abs(expected[:3]).max()
        )


@pytest.mark.parametrize("dim", [2, 3])
def test_the_derivatives_are_those_of_the_command_along_the_motion(
    circle_field, spatial_circle_field, dim
):
    """Of places p + t v, the command's Taylor series, whose higher terms vanish with t."""
    field = circle_field if dim == 2 else spatial_circle_field
    system, t = GuidanceSystem(field, 0.7, 1.0), 0.02
    for state in random_states(5, seed=2):
        v = state[VELOCITY]
        U, a = evaluate(system, state)
        second, third, DU, D2U_v = np.split(derivatives(system, state), [3, 6, 15])
        np.testing.assert_allclose(DU.reshape(3, 3) @ v, a, atol=1e-12)
        np.testing.assert_allclose(D2U_v.reshape(3, 3) @ v, second, atol=1e-4)
        for time in (t, t / 2):
            moved = state.copy()
            moved[POSITION] += time * v
            series = U + time * a + time**2 / 2 * second + time**3 / 6 * third
            assert np.abs(evaluate(system, moved)[0] - series).max() < 60 * time**4


def derivatives(system, state):
    context = system.CreateDefaultContext()
    for name, part in (("position", POSITION), ("velocity", VELOCITY)):
        system.GetInputPort(name).FixValue(context, state[part])
    return system.GetOutputPort("command_derivatives").Eval(context)


def test_the_derivatives_have_gradients(circle_field):
    system = GuidanceSystem(circle_field, 0.7, 1.0)
    state = random_states(1, seed=3)[0]
    converted = system.ToAutoDiffXd()
    found = derivatives(converted, InitializeAutoDiff(state).ravel())
    expected = differences(lambda x: derivatives(system, x), state, 1e-5)
    gradient = ExtractGradient(found.reshape(-1, 1))
    size = np.abs(expected).max()
    np.testing.assert_allclose(gradient, expected, atol=1e-4 * size)


def test_feedforward_is_the_rate_of_the_command_along_the_motion(circle_field):
    system, h = GuidanceSystem(circle_field), 1e-6
    for state in random_states(5, seed=1):
        step = np.zeros(12)
        step[:3] = h * state[6:9]
        ahead, behind = evaluate(system, state + step)[0], evaluate(system, state - step)[0]
        np.testing.assert_allclose(
            evaluate(system, state)[1], (ahead - behind) / (2 * h), rtol=1e-6, atol=1e-8
        )


@pytest.mark.parametrize(("index", "port"), [(0, "position"), (8, "velocity")])
def test_input_that_is_not_finite_is_named(circle_field, index, port):
    system = GuidanceSystem(circle_field)
    system.set_name("pilot")
    state = random_states(1)[0]
    state[index] = math.nan
    for scalar_system in (system, system.ToAutoDiffXd()):
        with pytest.raises(NonFiniteValueError, match=rf"pilot: input port '{port}'.*t = 0 s"):
            evaluate(scalar_system, state)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_field_that_is_not_finite_is_named(value):
    with pytest.raises(NonFiniteValueError, match=r"GuidanceSystem.*the field's value"):
        evaluate(GuidanceSystem(ConstantField(2, value)), np.zeros(12))


def test_bad_arguments_are_refused(circle_field):
    system = GuidanceSystem(circle_field)
    context = system.CreateDefaultContext()
    for dim in (1, 4):
        with pytest.raises(ConfigurationError, match=f"dimension 2 or 3, got {dim}"):
            GuidanceSystem(ConstantField(dim))
    for speed in (-1.0, math.nan, math.inf):
        with pytest.raises(ConfigurationError, match="speed"):
            GuidanceSystem(circle_field, speed=speed)
        with pytest.raises(ConfigurationError, match="speed"):
            system.SetSpeed(context, speed)
    with pytest.raises(ConfigurationError, match="altitude"):
        GuidanceSystem(circle_field, altitude=math.nan)
    # A fixed field has no approach length to set.
    assert system.GetApproachLength(context) == 0.0
    assert system.GetFlownField(context) is circle_field
    with pytest.raises(ConfigurationError, match="approach length"):
        system.SetApproachLength(context, 0.1)


# Widening a field to what a vehicle can turn, and why it is done.

RATE = 4.0
SPEED = 2.0


class NarrowCircle:
    """A field of unit length around the unit circle, with an approach length.

    At a distance r from the path it is n tanh(r / length) + t sech(r / length), with n the
    direction to the path and t the tangent.
    """

    dim = 2

    def __init__(self, approach_length):
        self.approach_length = approach_length

    def with_approach_length(self, length):
        return NarrowCircle(length)

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x):
        radius = np.linalg.norm(x, axis=-1)[..., None]
        n = x / radius
        t = np.stack([-n[..., 1], n[..., 0]], axis=-1)
        z = (1.0 - radius) / self.approach_length
        tanh, sech = np.tanh(z), 1.0 / np.cosh(z)
        m = tanh * n + sech * t
        by_radius = (-(sech**2) * n + sech * tanh * t) / self.approach_length
        by_angle = (tanh * t - sech * n) / radius
        J = by_radius[..., :, None] * n[..., None, :] + by_angle[..., :, None] * t[..., None, :]
        return m, J

    def hessian(self, x):
        raise NotImplementedError


def errors_of_flight(field, widen):
    """Signed cross-track errors of two laps, flown with the field as it is or widened."""
    diagram = MakeFlightDiagram(field, speed=SPEED)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, (1.1, 0.0, 1.0))
    if not widen:
        guidance = diagram.GetSubsystemByName("guidance_loop").guidance
        guidance.SetApproachLength(
            guidance.GetMyMutableContextFromRoot(context), field.approach_length
        )
    simulator.AdvanceTo(4 * np.pi / SPEED)
    state = diagram.GetSubsystemByName("state_log").FindLog(context).data()
    return np.hypot(state[0], state[1]) - 1.0


def test_the_field_of_the_tests_is_what_it_says():
    field, x = NarrowCircle(0.1), np.array([0.7, 0.6])
    np.testing.assert_allclose(field.value_and_jacobian(x)[1], differences(field, x), atol=1e-8)
    assert isinstance(field, AdjustableField)


def test_a_narrow_field_is_widened_to_the_rate(circle_field):
    field = NarrowCircle(0.1)
    assert not isinstance(circle_field, AdjustableField)
    assert FieldForSpeed(circle_field, 100.0) is circle_field
    for speed in (0.1, 0.39, 0.41, 2.0, 10.0):
        wide = FieldForSpeed(field, speed)
        assert (wide is field) == (speed < 0.4)
        assert wide.approach_length == pytest.approx(max(speed / RATE, 0.1))
    # As a system flies it too.
    system = GuidanceSystem(field, SPEED)
    context = system.CreateDefaultContext()
    for speed, expected in ((SPEED, SPEED / RATE), (3.0, 3.0 / RATE), (0.01, 0.1)):
        system.SetSpeed(context, speed)
        assert system.GetFlownField(context).approach_length == pytest.approx(expected)
    with pytest.raises(ConfigurationError, match="approach_length"):
        system.SetApproachLength(context, 0.0)


def test_without_widening_a_flight_oscillates_across_the_path():
    field = NarrowCircle(0.03)
    second_lap = slice(int(2 * np.pi / SPEED / 0.01), None)
    wide = errors_of_flight(field, widen=True)[second_lap]
    narrow = errors_of_flight(field, widen=False)[second_lap]
    crossings = np.count_nonzero(np.diff(np.sign(narrow)))
    assert np.sqrt(np.mean(wide**2)) < 0.002
    assert np.sqrt(np.mean(narrow**2)) > 0.01
    assert crossings >= 6


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_the_unit_of_length_does_not_matter(make_field, factor):
    field = make_field("robust")
    expected = FieldForSpeed(field, 10.0)
    found = FieldForSpeed(field.rescaled(factor), factor * 10.0)
    assert expected.approach_length == pytest.approx(2.5)
    assert found.approach_length == pytest.approx(factor * 2.5)
    x = field.cloud.points[:5] + 0.1
    np.testing.assert_allclose(found(factor * x), expected(x), atol=1e-9)


def test_there_is_no_derivative_by_the_approach_length():
    system = GuidanceSystem(NarrowCircle(0.03), SPEED).ToAutoDiffXd()
    context = system.CreateDefaultContext()
    for name, value in (("position", [1.1, 0.0, 0.0]), ("velocity", np.zeros(3))):
        system.GetInputPort(name).FixValue(context, value)
    parameters = InitializeAutoDiff(np.array([SPEED, 1.0, 0.5]))[:, 0]
    context.get_mutable_numeric_parameter(system.parameter_index).SetFromVector(parameters)
    with pytest.raises(ConfigurationError, match="no derivative by approach_length"):
        system.GetOutputPort("velocity_command").Eval(context)
