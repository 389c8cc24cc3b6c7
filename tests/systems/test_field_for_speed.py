"""Widening a field to what a vehicle can turn, and why it is done."""

import numpy as np
from pydrake.autodiffutils import InitializeAutoDiff
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import AdjustableField, Field
from systems import (
    FieldForSpeed,
    GuidanceSystem,
    MakeFlightDiagram,
    MakeSimulator,
    SetHover,
)

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


class Fixed:
    """The same field for one who can only follow it."""

    dim = 2

    def __init__(self, field):
        self._field = field

    def __call__(self, x):
        return self._field(x)

    def value_and_jacobian(self, x):
        return self._field.value_and_jacobian(x)

    def hessian(self, x):
        return self._field.hessian(x)


def errors_of_flight(field, widen):
    """Signed cross-track errors of two laps, flown with the field as it is or widened."""
    diagram = MakeFlightDiagram(field, speed=SPEED)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, (1.1, 0.0, 1.0))
    if not widen:
        guidance = diagram.GetSubsystemByName("guidance")
        guidance.SetApproachLength(
            guidance.GetMyMutableContextFromRoot(context), field.approach_length
        )
    simulator.AdvanceTo(4 * np.pi / SPEED)
    state = diagram.GetSubsystemByName("state_log").FindLog(context).data()
    return np.hypot(state[0], state[1]) - 1.0


def test_the_field_of_the_tests_is_what_it_says():
    field = NarrowCircle(0.1)
    x = np.array([0.7, 0.6])
    step = 1e-6 * np.eye(2)
    differences = (field(x + step) - field(x - step)).T / 2e-6
    np.testing.assert_allclose(field.value_and_jacobian(x)[1], differences, atol=1e-8)
    assert isinstance(field, AdjustableField)
    assert not isinstance(Fixed(field), AdjustableField)
    assert isinstance(Fixed(field), Field)


@pytest.mark.parametrize("speed", [0.1, 0.39])
def test_a_field_that_is_wide_enough_is_left_alone(speed):
    field = NarrowCircle(0.1)
    assert FieldForSpeed(field, speed) is field


@pytest.mark.parametrize("speed", [0.41, 2.0, 10.0])
def test_a_narrow_field_is_widened_to_the_rate(speed):
    field = NarrowCircle(0.1)
    wide = FieldForSpeed(field, speed)
    assert wide.approach_length == pytest.approx(speed / RATE)
    assert field.approach_length == 0.1


def test_a_field_that_cannot_be_adjusted_is_left_alone(circle_field):
    assert FieldForSpeed(circle_field, 100.0) is circle_field


def test_a_guiding_field_is_widened_and_its_path_stays(make_field):
    field = make_field("exact")
    speed = 8 * RATE * field.approach_length
    wide = FieldForSpeed(field, speed)
    assert wide.approach_length == pytest.approx(8 * field.approach_length)
    x = field.cloud.points[:5] + 0.1
    np.testing.assert_array_equal(wide.score(x), field.score(x))
    np.testing.assert_array_equal(wide.tangent(x), field.tangent(x))
    assert np.abs(wide(x) - field(x)).max() > 0.1


def test_flights_widen_their_field():
    diagram = MakeFlightDiagram(NarrowCircle(0.03), speed=SPEED)
    guidance = diagram.GetSubsystemByName("guidance")
    context = guidance.CreateDefaultContext()
    assert guidance.GetFlownField(context).approach_length == pytest.approx(SPEED / RATE)
    guidance.SetSpeed(context, 2.0)
    assert guidance.GetFlownField(context).approach_length == pytest.approx(2.0 / RATE)
    guidance.SetSpeed(context, 0.01)
    assert guidance.GetFlownField(context).approach_length == 0.03


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


def test_the_approach_length_is_a_parameter_that_takes_effect_at_once():
    field, state = NarrowCircle(0.03), np.array([1.1, *np.zeros(11)])
    system = GuidanceSystem(field, SPEED)
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, state)
    for length in (0.2, 0.05):
        system.SetApproachLength(context, length)
        expected = SPEED * field.with_approach_length(length)(state[:2])
        for owner in (context, context.Clone()):
            command = system.GetOutputPort("velocity_command").Eval(owner)
            np.testing.assert_allclose(command[:2], expected, rtol=1e-12)
    with pytest.raises(ConfigurationError, match="approach_length"):
        system.SetApproachLength(context, 0.0)


def test_there_is_no_derivative_by_the_approach_length():
    system = GuidanceSystem(NarrowCircle(0.03), SPEED).ToAutoDiffXd()
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, np.array([1.1, *np.zeros(11)]))
    parameters = InitializeAutoDiff(np.array([SPEED, 1.0, 0.5]))[:, 0]
    context.get_mutable_numeric_parameter(system.parameter_index).SetFromVector(parameters)
    with pytest.raises(ConfigurationError, match="no derivative by approach_length"):
        system.GetOutputPort("velocity_command").Eval(context)
