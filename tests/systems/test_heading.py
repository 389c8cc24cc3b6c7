"""Where a quadrotor looks: along its path, towards a point, and from wherever it looked."""

import math

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import (
    DEFAULT_GAINS,
    CourseController,
    GuidanceLoop,
    GuidanceSystem,
    HeadingSystem,
    IdealMotionCapture,
    PlanarVehicleParameters,
    Se3Controller,
    SensorParameters,
    SetHover,
    SetVehicleState,
)
from systems.se3_law import MAX_HEADING_ERROR, LimitHeading

from .flying import ONE_RING, Flight, Lanes

START = (1.05, 0.0, 1.0)


def turned(angle):
    """An angle less its whole turns, from -pi to pi."""
    return np.angle(np.exp(1j * np.asarray(angle)))


def test_a_heading_within_the_limit_is_kept_to_the_last_bit():
    for heading, yaw in ((0.3, 0.1), (0.1 + 6 * math.pi, 0.3), (-3.0, 3.1)):
        assert LimitHeading(heading, yaw) is heading


@pytest.mark.parametrize("seed", range(3))
def test_a_limited_heading_is_on_the_shorter_way(seed):
    rng = np.random.default_rng(seed)
    for heading, yaw in rng.uniform(-10.0, 10.0, (50, 2)).tolist():
        turn = float(turned(heading - yaw))
        expected = min(max(turn, -MAX_HEADING_ERROR), MAX_HEADING_ERROR)
        found = LimitHeading(heading, yaw)
        assert turned(found - yaw - expected) == pytest.approx(0.0, abs=1e-12)


def test_a_limited_heading_turns_with_the_yaw():
    """Its derivative is 1 by the heading or by the yaw."""
    heading, yaw = AutoDiffXd(2.0, [1.0, 0.0]), AutoDiffXd(0.0, [0.0, 1.0])
    np.testing.assert_array_equal(LimitHeading(heading, yaw).derivatives(), [0.0, 1.0])
    near = LimitHeading(AutoDiffXd(0.1, [1.0, 0.0]), yaw)
    np.testing.assert_array_equal(near.derivatives(), [1.0, 0.0])


def displacement(flight, other):
    """How far the vehicles of two flights are apart at most, m."""
    apart = flight.log("state")[:, :3] - other.log("state")[:, :3]
    return np.linalg.norm(apart, axis=1).max()


@pytest.mark.parametrize("sensors", [None, SensorParameters()])
def test_half_a_turn_takes_a_second_and_moves_the_vehicle_by_a_millimetre(sensors):
    """The sine of the attitude error is zero there, and the vehicle looked back for seconds."""
    flight, straight = (
        Flight(ONE_RING, START, branches=None, sensors=sensors).until(4.0) for _ in range(2)
    )
    own = flight.own(flight.controller)
    flight.controller.SetGains(own, DEFAULT_GAINS._replace(heading=-3 * math.pi))
    flight.until(5.5)
    late = flight.times() > 5.0
    assert np.abs(turned(flight.log("state")[late, 5] - math.pi)).max() < 0.03
    assert displacement(flight, straight.until(5.5)) < 0.001


def test_a_start_that_looks_backwards_turns_at_once():
    gains = DEFAULT_GAINS._replace(heading=math.pi)
    flight = Flight(ONE_RING, START, branches=None, gains=gains).until(1.0)
    assert abs(turned(flight.state[5] - math.pi)) < 0.03
    assert displacement(flight, Flight(ONE_RING, START, branches=None).until(1.0)) < 0.01


@pytest.mark.parametrize("point", [None, (0.2, 0.1)])
def test_the_vehicle_looks_along_its_path_or_towards_a_point(point):
    flight = Flight(ONE_RING, START, branches=None, heading=HeadingSystem(point)).until(5.0)
    state = flight.log("state", 2.0)
    wanted = np.arctan2(state[:, 7], state[:, 6])
    if point is not None:
        wanted = np.arctan2(point[1] - state[:, 1], point[0] - state[:, 0])
    lag = turned(wanted - state[:, 5])
    # The law takes the heading to be at rest: it follows 2 zeta / wn later.
    rate = np.gradient(np.unwrap(wanted), 0.01)
    delay = 2.0 * DEFAULT_GAINS.damping_ratio / DEFAULT_GAINS.attitude_bandwidth
    np.testing.assert_allclose(lag, delay * rate, atol=0.01)
    assert displacement(flight, Flight(ONE_RING, START, branches=None).until(5.0)) < 0.01


def test_a_vehicle_at_rest_keeps_its_heading():
    flight = Flight(Lanes(), speed=1.0, branches=None, heading=HeadingSystem())
    rest = [3.0, 0.0, 1.0, 0.0, 0.0, 2.0, *np.zeros(6)]
    SetVehicleState(flight.diagram, flight.context, rest)
    assert flight.until(1.0).state[5] == pytest.approx(2.0, abs=1e-3)
    # It flies along x, comes to rest, and looks there from then on.
    SetHover(flight.diagram, flight.context, (0.5, 0.0, 1.0))
    assert flight.until(5.0).state[0] == pytest.approx(3.0, abs=0.05)
    assert abs(flight.state[5]) < 1e-3


def test_nearer_than_known_the_heading_is_kept():
    system = HeadingSystem((1.0, 2.0))
    context = system.CreateDefaultContext()
    system.SetHeading(context, 0.7)
    system.GetInputPort("velocity_command").FixValue(context, [0.0, 0.0, 0.0])
    for position, expected in (
        ([1.05, 2.0, 1.0], 0.7),
        ([1.2, 2.0, 1.0], math.pi),
        ([1.0, 1.0, 9.0], math.pi / 2),
    ):
        system.GetInputPort("position").FixValue(context, position)
        (heading,) = system.GetOutputPort("heading").Eval(context)
        assert heading == pytest.approx(expected)


def test_a_user_commands_the_heading_at_the_port_of_the_loop():
    flight = Flight(ONE_RING, START, branches=None)
    flight.loop.GetInputPort("heading").FixValue(flight.own(flight.loop), [1.0])
    assert flight.until(2.0).state[5] == pytest.approx(1.0, abs=0.01)
    flight.loop.GetInputPort("heading").FixValue(flight.own(flight.loop), [math.nan])
    with pytest.raises(NonFiniteValueError, match="heading"):
        flight.until(2.1)


@pytest.mark.parametrize("point", [(1.0,), (1.0, math.inf)])
def test_what_is_no_point_is_refused(point):
    with pytest.raises(ConfigurationError, match="point"):
        HeadingSystem(point)


def test_a_controller_without_a_heading_is_refused():
    with pytest.raises(
        ConfigurationError, match=r"told a heading needs .* CourseController has none"
    ):
        GuidanceLoop(
            GuidanceSystem(ONE_RING),
            CourseController(PlanarVehicleParameters(0.45, 1.0)),
            IdealMotionCapture(),
            heading=HeadingSystem(),
            actuation="turn_rate",
        )
    assert Se3Controller().HasInputPort("heading")
