"""The course law: closed forms, invariants, any wind, and the signals for an autopilot."""

import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import (
    CourseController,
    MakeFlightDiagram,
    MakeSimulator,
    PlanarVehicleParameters,
    SetVehicleState,
    Unicycle,
)
from systems.course_controller import LEAST_PROGRESS

from .flying import ONE_RING, differences

VEHICLE = PlanarVehicleParameters(5.0, 1.5)
GAIN = 1.2
OUTPUTS = ("turn_rate", "course", "lateral_acceleration")


def outputs(state, command, feedforward=(0.0, 0.0, 0.0), vehicle=VEHICLE, autodiff=False):
    controller = CourseController(vehicle, GAIN)
    controller = controller.ToAutoDiffXd() if autodiff else controller
    context = controller.CreateDefaultContext()
    for name, value in (
        ("state", state),
        ("velocity_command", command),
        ("acceleration_feedforward", feedforward),
    ):
        controller.GetInputPort(name).FixValue(context, value)
    return np.array([controller.GetOutputPort(name).Eval(context)[0] for name in OUTPUTS])


def state(heading, wind=(0.0, 0.0)):
    ahead = VEHICLE.airspeed * np.array([math.cos(heading), math.sin(heading)])
    return np.array([1.0, 2.0, 3.0, heading, *(ahead + wind), 0.0])


def turned(vector, angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1], vector[2]])


def cases(count=20, wind=0.9):
    """Headings, winds up to a part of the airspeed, commands and feed-forwards."""
    # Straight against the wind, where the vehicle is slowest over ground.
    yield 0.0, np.array([-wind * VEHICLE.airspeed, 0.0]), np.array([1.0, 0.5, 0.0]), np.ones(3)
    rng = np.random.default_rng(4)
    for _ in range(count):
        direction, strength = rng.uniform(-np.pi, np.pi), rng.uniform(0.0, wind)
        air = strength * VEHICLE.airspeed * np.array([math.cos(direction), math.sin(direction)])
        yield rng.uniform(-np.pi, np.pi), air, rng.normal(size=3), rng.normal(size=3)


def course_of(heading, wind):
    _, _, _, _, vx, vy, _ = state(heading, wind)
    return math.atan2(vy, vx)


def test_in_any_wind_the_course_turns_as_in_still_air():
    """By m x a / |m|^2 + k sin e, at whatever angle the vehicle crabs."""
    for heading, wind, command, feedforward in cases():
        turn_rate = outputs(state(heading, wind), command, feedforward)[0]
        course, h = course_of(heading, wind), 1e-6
        turning = math.remainder(
            course_of(heading + h, wind) - course_of(heading - h, wind), 2.0 * math.pi
        ) / (2.0 * h)
        error = math.remainder(math.atan2(command[1], command[0]) - course, 2.0 * math.pi)
        error_part = math.sin(error) if abs(error) < math.pi / 2 else math.copysign(1.0, error)
        rate = np.linalg.det([command[:2], feedforward[:2]]) / np.sum(command[:2] ** 2)
        assert turning * turn_rate == pytest.approx(rate + GAIN * error_part, abs=1e-7)


def test_the_law_has_no_north_and_no_handedness():
    for heading, wind, command, feedforward in cases():
        vehicle = state(heading, wind)
        expected = outputs(vehicle, command, feedforward)
        for angle in (0.3, 2.0, -2.5):
            other = vehicle.copy()
            other[3] += angle
            other[4:] = turned(vehicle[4:], angle)
            found = outputs(other, turned(command, angle), turned(feedforward, angle))
            np.testing.assert_allclose(found[[0, 2]], expected[[0, 2]], atol=1e-9)
            shift = math.remainder(expected[1] - found[1] - angle, 2.0 * math.pi)
            assert shift == pytest.approx(0.0, abs=1e-12)
        mirror = np.array([1.0, -1.0, 1.0])
        other = vehicle * [1, -1, 1, -1, 1, -1, 1]
        found = outputs(other, command * mirror, feedforward * mirror)
        np.testing.assert_allclose(found[[0, 2]], -expected[[0, 2]], atol=1e-12)


@pytest.mark.parametrize("feedforward", [True, False])
def test_the_steady_error_on_a_ring_is_that_of_the_law(feedforward):
    """Without feed-forward v / r = k sin e with e = atan(3 (r - 1)); with it there is none."""
    unicycle = Unicycle.Make(0.45)
    diagram = MakeFlightDiagram(ONE_RING, unicycle, feedforward=feedforward)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    start = unicycle.StartState(np.array([1.1, 0.0, 0.0]), ONE_RING)
    SetVehicleState(diagram, context, start)
    simulator.AdvanceTo(12.0)
    radius = math.hypot(*diagram.GetOutputPort("state").Eval(context)[:2])
    if feedforward:
        assert radius == pytest.approx(1.0, abs=1e-6)
        return
    gain = unicycle.parameters.max_turn_rate
    remaining = 0.45 / radius - gain * math.sin(math.atan(3.0 * (radius - 1.0)))
    assert radius > 1.05
    # The sample is held for 10 ms.
    assert remaining == pytest.approx(0.0, abs=0.005)


def test_an_error_beyond_a_right_angle_turns_the_fastest():
    for error in (1.6, 2.5, -1.6, -3.1):
        command = np.array([math.cos(error), math.sin(error), 0.0])
        assert outputs(state(0.0), command)[0] == pytest.approx(math.copysign(GAIN, error))
    # Straight back: to one side, and not nowhere.
    assert abs(outputs(state(0.0), [-1.0, 0.0, 0.0])[0]) == GAIN


def test_without_a_command_it_goes_straight_on():
    assert outputs(state(0.4), np.zeros(3), np.ones(3))[0] == 0.0


@pytest.mark.parametrize("wind", [-5.0, -5.0 - 1e-9, -5.2, -40.0])
def test_wind_as_fast_as_the_vehicle_ends_in_no_error(wind):
    """It is blown back and turns, but at no rate that is not bounded."""
    command = np.array([0.0, 1.0, 0.0])
    turn_rate = outputs(state(0.0, (wind, 0.0)), command)[0]
    speed = abs(VEHICLE.airspeed + wind)
    assert abs(turn_rate) <= GAIN * speed**2 / (LEAST_PROGRESS * VEHICLE.airspeed**2)


@pytest.mark.parametrize(
    ("command", "course"),
    [((0, 2, 0), 0), ((1, 0, 0), np.pi / 2), ((-3, 0, 0), -np.pi / 2), ((1, 1, 5), np.pi / 4)],
)
def test_the_course_is_told_from_north_to_the_east(command, course):
    assert outputs(state(0.2), np.array(command, float))[1] == pytest.approx(course)


@pytest.mark.parametrize("wind", [0.0, 3.0])
def test_the_lateral_acceleration_is_that_of_the_turn_to_the_right(wind):
    """On the course, the turn is the feed-forward: airspeed times the rate of the heading."""
    vehicle = state(0.5, (wind, 0.0))
    ground = vehicle[4:]
    # A left turn of 20 m radius over ground.
    left = np.array([-ground[1], ground[0], 0.0]) / np.linalg.norm(ground)
    feedforward = left * (ground @ ground) / 20.0
    turn_rate, _, lateral = outputs(vehicle, ground, feedforward)
    assert lateral == pytest.approx(-VEHICLE.airspeed * turn_rate)
    if wind == 0.0:
        assert lateral == pytest.approx(-(VEHICLE.airspeed**2) / 20.0)


def test_derivatives_agree_with_differences():
    for heading, wind, command, feedforward in cases(8, wind=0.5):
        x = np.concatenate((state(heading, wind), command, feedforward))

        def law(values, autodiff=False):
            return outputs(values[:7], values[7:10], values[10:], autodiff=autodiff)

        exact = ExtractGradient(law(InitializeAutoDiff(x).ravel(), True))
        np.testing.assert_allclose(exact, differences(law, x), atol=1e-6)


@pytest.mark.parametrize(
    ("max_turn_rate", "turn_lag", "gain"),
    # A turn at full rate for a right angle; no more than a lag bears, or sampling.
    [
        (0.5, 0.3, 0.5),
        (4.0, 0.3, 0.5 / 0.3),
        (4.0, 0.0, 4.0),
        (9.0, 0.0, 8.0),
        (9.0, 0.01, 8.0),
    ],
)
def test_the_default_gain_is_the_largest_that_is_of_use(max_turn_rate, turn_lag, gain):
    vehicle = PlanarVehicleParameters(5.0, max_turn_rate, turn_lag)
    controller = CourseController(vehicle)
    found = controller.GetGain(controller.CreateDefaultContext())
    assert found == pytest.approx(gain)
    if turn_lag > 0.0:
        # That of e'' + e' / lag + gain e / lag = 0.
        assert 0.5 / math.sqrt(found * turn_lag) > 0.7


def test_bad_gains_and_inputs_are_refused():
    with pytest.raises(ConfigurationError, match="gain must be finite and positive"):
        CourseController(VEHICLE, 0.0)
    controller = CourseController(VEHICLE)
    context = controller.CreateDefaultContext()
    context.get_mutable_numeric_parameter(controller.parameter_index).SetAtIndex(0, -1.0)
    with pytest.raises(ConfigurationError, match="gain"):
        controller.GetOutputPort("turn_rate").Eval(context)
    with pytest.raises(NonFiniteValueError, match="velocity_command"):
        outputs(state(0.0), [np.nan, 0.0, 0.0])
