"""Flights from branch to branch; each failure of a sensor, a command or a setting on the way
ends in a way that is defined.

Whole flights of Drake's plant, most of them with the noise of `SensorParameters`.  The bounds
are those of the worst of several seeds with a margin.
"""

import math

import numpy as np
from pydrake.systems.analysis import ApplySimulatorConfig, SimulatorConfig
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.experiments import fly
from sgvf_drake.paths import ReferencePath, shape_path
from systems import (
    HOLD_POSITION,
    ON_TOUR,
    Branch,
    MakeSimulator,
    Mode,
    SensorParameters,
    supervision,
)
from systems.branch_supervisor import ACCELERATION_SHARE, DEFAULT_HOLD_AFTER
from systems.controller import DEFAULT_GAINS
from systems.guidance import ALTITUDE_GAIN, MAX_CLIMB_RATE
from systems.se3_law import Body
from systems.supervision import LANDING_RATE

from .flying import (
    LANES,
    LAP,
    ONE_RING,
    PARAMETERS,
    RINGS,
    SPEED,
    TWO_RINGS,
    UNIT,
    Flight,
    Lanes,
    rms,
    spatial_rings,
)

SENSORS = SensorParameters()
BOX = ([-2.5, -2.5], [2.5, 2.5])
MAX_ACCELERATION = ACCELERATION_SHARE * PARAMETERS.max_horizontal_acceleration
FASTEST = math.sqrt(MAX_ACCELERATION)
"""m/s, to which the supervisor slows down on a circle of 1 m."""
MEASURED_WITHIN = 0.012
"""m; estimate and truth differ by noise, and by what is flown in the 10 ms of a sample."""
BLIND_DRIFT = 0.04
"""m/s; four standard deviations of an estimated velocity, with which a blind vehicle drifts."""
TO_OUTER = {"tour": (0, 1), "laps": 0.1}
"""From the inner to the outer ring, from about 1.6 s to 5.5 s."""
FOLLOW, HOLD, LAND = ("FOLLOW", 0), ("HOLD", 0), ("LAND", 0)


def noisy(**options):
    return Flight(supervisor=options.pop("supervisor", {}), sensors=SENSORS, **options)


# Tours.


@pytest.mark.parametrize("sensors", [None, SENSORS])
def test_tour_of_two_rings(sensors):
    flight = Flight(supervisor={"tour": (0, 1, 0), "laps": 0.1}, sensors=sensors).until(14.0)
    expected = [FOLLOW, ("TRANSFER", 1), ("FOLLOW", 1), ("TRANSFER", 0), FOLLOW]
    assert flight.history() == expected
    speeds = flight.speeds(1.5)
    assert 0.55 * SPEED < speeds.min() < speeds.max() < 1.35 * SPEED, "it must not stop"
    here = (flight.log("mode") == Mode.FOLLOW) & (flight.log("branch") == 1)
    assert rms(np.hypot(*flight.log("state")[here, :2].T) - 2.0) < 0.015
    assert flight.off_ring(1.0, since=13.5) < 0.01
    assert flight.excess_force(1.5) < (0.3 if sensors else 0.1)
    assert flight.steps_of_command(1.5).max() < (0.04 if sensors else 0.012)
    assert np.abs(flight.altitudes(1.5) - 1.0).max() < 0.01


@pytest.mark.parametrize(("tour", "laps", "flown"), [((0, 1), 0.4, 0.4), ((0, 0, 1), 0.1, 0.2)])
def test_laps_are_flown_before_the_next_branch(tour, laps, flown):
    flight = Flight(supervisor={"tour": tour, "laps": laps}).until(8.0)
    here = (flight.log("mode") == Mode.FOLLOW) & (flight.log("branch") == 0)
    assert flight.history()[1] == ("TRANSFER", 1)
    angle = np.unwrap(np.arctan2(*flight.log("state")[here, 1::-1].T))
    # Waiting for a place to depart from takes at most a little, see test_branches.
    assert flown - 0.02 < (angle[-1] - angle[0]) / LAP < flown + 0.1


def test_departure_waits_as_planned(monkeypatch):
    monkeypatch.setattr(supervision, "DepartureDelay", lambda *_: 0.5)
    flight = Flight(supervisor={}).until(1.0)
    flight.want(1)
    assert flight.until(1.495).mode == Mode.FOLLOW
    assert flight.until(1.515).mode == Mode.TRANSFER


def test_hand_over_is_smooth_where_the_vehicle_lags():
    flight = Flight(supervisor={"tour": (0, 1), "laps": 0.25}, speed=2.0).until(4.0)
    mode = flight.log("mode")
    end = flight.times()[np.flatnonzero((mode[:-1] == Mode.TRANSFER) & (mode[1:] == 0))[0]]
    # The command turns by 2 to 4 m/s^2, 0.02 to 0.04 m/s a sample.
    assert flight.steps_of_command(end - 0.5)[:100].max() < 0.06


def test_wanted_branch_may_change_in_a_transfer():
    flight = Flight(supervisor={}).until(1.0)
    flight.want(1)
    assert flight.until(3.0).mode == Mode.TRANSFER
    assert flight.memory.flown == 0.0
    # It may change in a transfer; then the tour goes on where it was.
    flight.want(ON_TOUR)
    assert flight.until(15.0).radius() == pytest.approx(1.0, abs=0.02)
    assert flight.history() == [FOLLOW, ("TRANSFER", 1), ("TRANSFER", 0), FOLLOW]
    assert flight.speeds(1.5).min() > 0.5 * SPEED


def test_position_is_held_on_command_and_the_branch_taken_up_again():
    flight = Flight(supervisor={}).until(1.5)
    flight.want(HOLD_POSITION)
    assert flight.until(5.0).mode == Mode.HOLD
    held = flight.state[:3]
    assert np.abs(flight.state[6:9]).max() < 2e-3
    np.testing.assert_allclose(flight.until(6.0).state[:3], held, atol=2e-3)
    flight.want(0)
    assert flight.until(10.0).mode == Mode.FOLLOW
    assert flight.radius() == pytest.approx(1.0, abs=0.01)
    # Neither the stop nor the start makes a step of the command.
    assert flight.steps_of_command(1.5).max() < 0.012


def test_spatial_field():
    points = [radius * np.column_stack([UNIT, np.ones(len(UNIT))]) for radius in (1.0, 2.0)]
    branches = [
        Branch(p, LAP * radius, True) for p, radius in zip(points, (1.0, 2.0), strict=True)
    ]
    flight = Flight(
        spatial_rings(),
        branches=branches,
        supervisor={**TO_OUTER, "landing_height": 1.5},
    ).until(9.0)
    assert flight.history() == [FOLLOW, ("TRANSFER", 1), ("FOLLOW", 1)]
    errors = [flight.radius() - 2.0, flight.state[2] - 2.0]
    np.testing.assert_allclose(errors, 0.0, atol=0.015)
    assert flight.speeds(1.5).min() > 0.55 * SPEED
    flight.set_age(2.0)
    assert flight.until(16.0).mode == Mode.LAND
    assert flight.state[2] == pytest.approx(1.5, abs=5e-3)
    assert np.linalg.norm(flight.state[6:9]) < 5e-3


# From the start it is the length that counts, from the middle the rest.
@pytest.mark.parametrize("start", [-0.2, 1.5])
def test_open_branches_end_where_the_field_rests(start):
    flight = Flight(
        Lanes(),
        (start, 0.0, 1.0),
        branches=LANES,
        supervisor={"tour": (0, 1), "laps": 5.0},
        speed=2.0 * SPEED,
    ).until(14.0)
    assert flight.history() == [FOLLOW, ("TRANSFER", 1), ("FOLLOW", 1)]
    np.testing.assert_allclose(flight.state[:2], [0.0, 2.0], atol=0.02)


@pytest.mark.parametrize(("wanted", "x", "y"), [(1, (2.69, 3.01), 2.0), (0, (1.2, 2.7), 0.0)])
def test_open_branch_is_entered_at_its_start_or_taken_up_where_it_was_left(wanted, x, y):
    flight = Flight(Lanes(), (0.5, 0.0, 1.0), branches=LANES, supervisor={}).until(2.0)
    flight.want(HOLD_POSITION)
    flight.until(4.0)
    flight.want(wanted)
    entry = flight.until(4.05).memory.control_points[-1]
    assert x[0] < entry[0] < x[1]
    assert entry[1] == pytest.approx(y, abs=0.01)


# Starts.


@pytest.mark.parametrize("supervised", [False, True])
def test_start_outside_of_the_box_flies_in(supervised):
    # Without a supervisor it is up to the field: this one leads back from everywhere.
    supervisor = {"tour": (1,), "box": BOX} if supervised else None
    flight = Flight(start=(6.0, -8.0, 1.0), speed=2.0, supervisor=supervisor).until(9.0)
    flight.assert_follows(2.0, since=8.0)
    assert flight.speeds(0.0).max() < 1.35 * flight.speed
    assert np.hypot(*flight.log("state")[:, :2].T).max() < 10.01
    if supervised:
        assert np.abs(flight.altitudes() - 1.0).max() < 0.02
        assert flight.history() == [("FOLLOW", 1), ("TRANSFER", 1), ("FOLLOW", 1)]


def test_start_beside_another_branch_flies_to_the_wanted_one():
    flight = Flight(start=(0.0, 2.1, 1.0), supervisor={}).until(6.0)
    assert flight.history()[-2:] == [("TRANSFER", 0), FOLLOW]
    assert flight.radius() == pytest.approx(1.0, abs=0.02)
    # Where that one is wanted, it needs no transfer.
    flight = Flight(start=(0.0, 2.1, 1.0), supervisor={"tour": (1,)}).until(0.5)
    assert flight.history() == [("FOLLOW", 1)]


def test_vehicle_that_is_told_to_stand_does_not_depart():
    flight = Flight(supervisor={}, speed=0.0)
    flight.want(1)
    assert flight.until(0.5).mode == Mode.FOLLOW
    assert np.abs(flight.state[6:9]).max() < 1e-6


# Contexts.


def test_clone_in_a_transfer_flies_on_alike():
    flight = Flight(supervisor={}).until(1.0)
    flight.want(1)
    assert flight.until(3.0).mode == Mode.TRANSFER
    twin = MakeSimulator(flight.diagram, flight.context.Clone())
    twin.AdvanceTo(6.0)
    np.testing.assert_array_equal(
        twin.get_context().get_continuous_state_vector().CopyToVector(),
        flight.until(6.0).state,
    )
    assert flight.history()[-1] == ("FOLLOW", 1)
    assert flight.radius() == pytest.approx(2.0, abs=0.03)


# Values that are not finite.


@pytest.mark.parametrize("error_control", [False, True])
@pytest.mark.parametrize("supervisor", [None, {}])
@pytest.mark.parametrize(("sample_period", "met"), [(0.01, r"0\.31"), (0.0, r"0\.30\d*")])
def test_nan_from_an_ideal_sensor_is_named_at_once(
    error_control, supervisor, sample_period, met
):
    flight = Flight(
        lost=[(0.3025, 0.3125)],
        entries=(0,),
        supervisor=supervisor,
        sample_period=sample_period,
    )
    if error_control:
        # It would shorten its step for ever in search of one whose error is a number.
        config = SimulatorConfig(
            integration_scheme="runge_kutta3", use_error_control=True, accuracy=1e-4
        )
        ApplySimulatorConfig(config, flight.simulator)
    message = rf"guidance: input port 'position' is not finite at t = {met} s: \[nan, "
    with pytest.raises(NonFiniteValueError, match=message):
        flight.until(1.0)


@pytest.mark.parametrize("supervisor", [None, {}])
def test_lost_attitude_is_named_at_once(supervisor):
    # Nothing can fly on without it.
    flight = Flight(lost=[(0.295, 0.305)], entries=(3,), sensors=SENSORS, supervisor=supervisor)
    message = r"controller: input port 'state' is not finite at t = 0\.296 s"
    with pytest.raises(NonFiniteValueError, match=message):
        flight.until(1.0)


# Lost measurements.


@pytest.mark.parametrize("supervisor", [None, {}])
def test_short_loss_is_bridged(supervisor):
    # Ten samples, and then a single one.
    lost = [(1.995, 2.095), (2.495, 2.505)]
    flight = Flight(lost=lost, sensors=SENSORS, supervisor=supervisor).until(3.0)
    flight.assert_follows(1.0, since=1.9)
    assert flight.estimation_error(1.9) < MEASURED_WITHIN + BLIND_DRIFT * 0.1
    if supervisor is not None:
        assert flight.history() == [FOLLOW]


@pytest.mark.parametrize(("speed", "off_path"), [(SPEED, 0.013), (2.0, 0.25)])
def test_loss_holds_until_the_measurement_is_back(speed, off_path):
    flight = noisy(lost=[(1.995, 2.195)], speed=speed, start=(1.0, 0.0, 1.0)).until(6.0)
    assert flight.history() == [FOLLOW, HOLD, ("TRANSFER", 0), FOLLOW]
    held = flight.times()[flight.log("mode") == Mode.HOLD]
    # From the age of 0.15 s on, until the first sample after the loss has arrived.
    assert held[0] == pytest.approx(1.995 + DEFAULT_HOLD_AFTER, abs=0.031)
    assert held[-1] >= 2.195
    assert flight.off_ring(1.0, since=1.9) < off_path
    speeds = flight.speeds(1.9)
    assert 0.4 * speed < speeds.min() < speeds.max() < 1.2 * speed
    assert np.abs(flight.altitudes() - 1.0).max() < 0.04
    assert flight.excess_force(1.9) < 0.6
    flight.assert_follows(1.0, since=5.5)


def test_losses_again_and_again_do_not_keep_it_from_the_path():
    lost = [(1.495 + 0.5 * k, 1.695 + 0.5 * k) for k in range(6)]
    flight = noisy(lost=lost).until(4.5)
    assert flight.history().count(HOLD) == 6
    assert flight.off_ring(1.0, since=1.4) < 0.013
    angle = np.unwrap(np.arctan2(*flight.log("state", 1.5)[:, 1::-1].T))
    assert angle[-1] - angle[0] > 0.85 * 3.0 * SPEED


def test_hardly_better_a_measurement_is_not_back():
    flight = Flight(supervisor={}).until(1.0)
    flight.set_age(DEFAULT_HOLD_AFTER)
    assert flight.until(1.2).mode == Mode.FOLLOW
    flight.set_age(DEFAULT_HOLD_AFTER + 0.01)
    assert flight.until(2.0).mode == Mode.HOLD
    flight.set_age(DEFAULT_HOLD_AFTER - 0.01)
    assert flight.until(2.2).mode == Mode.HOLD
    flight.set_age(0.0)
    assert flight.until(2.4).mode == Mode.TRANSFER


def assert_came_down(flight, since, height):
    """It landed gently and rests."""
    velocity = flight.log("state", since)[:, 8]
    # What was predicted amiss is made good when the measurement returns, in part upwards.
    assert -2.0 * LANDING_RATE < velocity.min() < -0.9 * LANDING_RATE
    assert velocity.max() < 0.1
    assert flight.excess_force(since) < 0.4
    end = flight.context.get_time() - 0.5
    # Height and speed fade at 1 1/s near the ground.
    assert np.abs(flight.altitudes(end) - height).max() < 0.02
    assert flight.speeds(end).max() < 0.02
    assert flight.altitudes().min() > height - 0.02


@pytest.mark.parametrize(
    ("supervisor", "loss", "before"),
    [
        ({"landing_height": 0.5}, 0.995, [FOLLOW, HOLD, LAND]),
        (
            {**TO_OUTER, "landing_height": 0.5},
            2.495,
            [FOLLOW, ("TRANSFER", 1), ("HOLD", 1), ("LAND", 1)],
        ),
    ],
)
def test_long_loss_lands_for_good(supervisor, loss, before):
    flight = noisy(lost=[(loss, loss + 1.2)], supervisor=supervisor).until(loss + 6.0)
    assert flight.history() == before
    assert_came_down(flight, loss, supervisor["landing_height"])
    drift = MEASURED_WITHIN + BLIND_DRIFT * 1.2
    assert flight.estimation_error(loss) < drift
    if before[-1] == LAND:
        # It stops along the tangent, over 0.3 m.
        assert flight.off_ring(1.0, since=loss) < 0.08
    flight.want(1)
    assert flight.until(loss + 6.1).mode == Mode.LAND


def test_loss_for_good_lands_blindly():
    supervisor = {"landing_height": 0.5}
    flight = noisy(lost=[(0.995, math.inf)], supervisor=supervisor).until(6.0)
    assert flight.history() == [FOLLOW, HOLD, LAND]
    drift = MEASURED_WITHIN + BLIND_DRIFT * 5.0
    assert np.abs(flight.altitudes(5.5) - 0.5).max() < drift
    assert flight.off_ring(1.0, since=1.0) < drift
    assert flight.log("state", 1.0)[:, 8].min() > -LANDING_RATE - 2.0 * BLIND_DRIFT
    assert flight.speeds(5.5).max() < BLIND_DRIFT


@pytest.mark.parametrize(
    ("duration", "between"), [(0.1, []), (0.2, [("HOLD", 1), ("TRANSFER", 1)])]
)
def test_loss_in_a_transfer(duration, between):
    flight = noisy(lost=[(3.495, 3.495 + duration)], supervisor=TO_OUTER).until(7.5)
    assert flight.history() == [FOLLOW, ("TRANSFER", 1), *between, ("FOLLOW", 1)]
    flight.assert_follows(2.0, since=7.2)
    speeds = flight.speeds(1.5)
    assert 0.55 * SPEED < speeds.min() < speeds.max() < 1.35 * SPEED


# Speeds that the thrust cannot follow.


@pytest.mark.parametrize(("speed", "raised"), [(5.0, None), (12.0, None), (SPEED, 12.0)])
def test_supervisor_slows_down_to_what_the_thrust_allows(speed, raised):
    flight = noisy(field=ONE_RING, branches=RINGS[:1], speed=speed)
    since = 0.0
    if raised:
        # It is taken up from the speed that was flown, slowly.
        flight.until(since := 1.5)
        flight.guidance.SetSpeed(flight.own(flight.guidance), raised)
    settled = since + 4.0
    flight.until(settled + 0.5)
    assert flight.history() == [FOLLOW]
    demand = np.linalg.norm(flight.log("acceleration_feedforward", since), axis=1)
    assert demand.max() < MAX_ACCELERATION
    forces = flight.log("force", since)
    assert 0.0 < forces.min() < forces.max() < 0.75 * PARAMETERS.max_propeller_force
    assert flight.off_ring(1.0, since) < 0.05
    assert np.abs(flight.altitudes(since) - 1.0).max() < 0.15
    np.testing.assert_allclose(flight.speeds(settled), FASTEST, rtol=0.02)


def outcome_of_fly(speed):
    """The summary of a flight along the inner ring, or its error."""
    reference = ReferencePath(shape_path("concentric-flight").pieces[:1])
    try:
        return fly(TWO_RINGS, reference, speed=speed, laps=4.0).summary()
    except ConfigurationError as error:
        return str(error)


@pytest.mark.parametrize("speed", [8.0, 12.0])
def test_flight_without_a_supervisor_says_that_the_thrust_does_not_suffice(speed):
    outcome = outcome_of_fly(speed)
    if isinstance(outcome, str):
        # Whether it tips over first is up to rounding: the flight is chaotic.
        assert f"lost control on piece 1 at {speed:g} m/s" in outcome
        assert "choose a lower speed" in outcome
        return
    assert outcome["acceleration_demand_m_s2"] == pytest.approx(speed**2, rel=1e-3)
    assert outcome["acceleration_limit_m_s2"] == PARAMETERS.max_horizontal_acceleration
    assert outcome["saturated_fraction_after_take_off"] > 0.1
    assert outcome["motor_force_max_n"] == PARAMETERS.max_propeller_force
    assert outcome["cross_track_rms_m"] is None
    assert outcome["laps"] < 1.0


# Settings that cannot be, or are wrong.


@pytest.mark.parametrize(
    ("name", "entry", "value"),
    [
        ("velocity_gain", 0, 0.0),
        ("attitude_bandwidth", 1, 0.0),
        ("damping_ratio", 2, 0.0),
        ("mass", 0, -0.46),
        ("mass", 0, math.nan),
    ],
)
def test_setting_of_the_controller_that_cannot_be_is_named(name, entry, value):
    flight = Flight(supervisor={}).until(0.1)
    controller, message = flight.controller, f"{name} must be finite and positive, got {value}"
    context = flight.own(controller)
    kind, index = ("Body", 1) if name == "mass" else ("Gains", 0)
    settings = getattr(controller, f"Get{kind}")(context)._replace(**{name: value})
    with pytest.raises(ConfigurationError, match=message):
        getattr(controller, f"Set{kind}")(context, settings)
    flight.until(0.2)
    flight.set_parameter(controller, index, entry, value)
    with pytest.raises(ConfigurationError, match=message):
        flight.until(0.3)
    assert flight.context.get_time() == pytest.approx(0.2)


@pytest.mark.parametrize("speed", [-1.0, math.nan])
@pytest.mark.parametrize("sensors", [None, SENSORS])
@pytest.mark.parametrize("supervisor", [None, {}])
def test_speed_that_cannot_be_ends_a_flight(speed, sensors, supervisor):
    flight = Flight(sensors=sensors, supervisor=supervisor).until(0.1)
    guidance = flight.guidance
    with pytest.raises(ConfigurationError, match="speed must be finite and not negative"):
        guidance.SetSpeed(flight.own(guidance), speed)
    flight.set_parameter(guidance, guidance.parameter_index, 0, speed)
    with pytest.raises((ConfigurationError, NonFiniteValueError), match=r"speed|command"):
        flight.until(0.2)
    assert flight.context.get_time() == pytest.approx(0.1)


def believe(flight, factor):
    body = Body(factor * PARAMETERS.mass, *PARAMETERS.inertia)
    flight.controller.SetBody(flight.own(flight.controller), body)


@pytest.mark.parametrize("factor", [1.2, 0.8])
def test_wrong_mass_costs_altitude_as_the_law_says(factor):
    # At rest the thrust, of k_v v_command + g, is the weight:
    command = PARAMETERS.gravity * (1.0 / factor - 1.0) / DEFAULT_GAINS.velocity_gain
    offset = -MAX_CLIMB_RATE / ALTITUDE_GAIN * math.atanh(command / MAX_CLIMB_RATE)
    flight = Flight(start=(1.02, 0.0, 1.0 + offset + 0.05), supervisor={})
    believe(flight, factor)
    # At 0.8 the altitude settles at a rate of 2 (1 - 0.82^2) = 0.7 1/s.
    flight.until(7.0)
    np.testing.assert_allclose(flight.altitudes(6.5), 1.0 + offset, atol=2e-3)
    assert flight.history() == [FOLLOW]
    np.testing.assert_allclose(flight.speeds(6.5), SPEED, rtol=0.02)
    assert flight.off_ring(1.0, 6.5) < 0.02


@pytest.mark.full
def test_long_loss_lands_with_a_wrong_mass_too():
    flight = noisy(lost=[(1.995, 3.995)], supervisor={"landing_height": 0.4})
    believe(flight, 1.2)
    flight.until(8.5)
    assert flight.history() == [FOLLOW, HOLD, LAND]
    assert 1.0 < flight.altitudes().max() < 1.6
    assert flight.off_ring(1.0, 1.5) < 0.1
    # The correction of the height saturates too, at 1 m/s: e = c / 2 / sqrt(1 - c^2).
    command = PARAMETERS.gravity / 6.0 / DEFAULT_GAINS.velocity_gain
    height = command / 2.0 / math.sqrt(1.0 - command**2)
    np.testing.assert_allclose(flight.altitudes(8.0), 0.4 + height, atol=0.02)


@pytest.mark.parametrize("supervisor", [None, {}])
def test_speed_of_zero_stops_and_stays(supervisor):
    flight = noisy(supervisor=supervisor).until(1.5)
    begin = flight.state[:3]
    flight.guidance.SetSpeed(flight.own(flight.guidance), 0.0)
    flight.until(4.0)
    assert flight.speeds(3.5).max() < 0.02
    places = flight.log("state", 3.5)[:, :3]
    assert np.ptp(places, axis=0).max() < 0.01
    # The velocity fades with the velocity gain.
    way = np.linalg.norm(places[-1] - begin)
    assert way == pytest.approx(SPEED / DEFAULT_GAINS.velocity_gain, rel=0.1)
    flight.guidance.SetSpeed(flight.own(flight.guidance), SPEED)
    flight.until(6.5).assert_follows(1.0, since=6.0)
