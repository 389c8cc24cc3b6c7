"""Flights of Drake's quadrotor along the two circles of the paper's first flight."""

from dataclasses import replace
import math
from types import SimpleNamespace

import numpy as np
import pytest

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import (
    FlightSpec,
    check_feasibility,
    choose_reference,
    fly,
    fly_tour,
    follow,
    simulate,
)
from sgvf_drake.experiments.flight import TAKE_OFF_S, flown_pieces, hover_start
from sgvf_drake.learning import TrainingConfig, train
from sgvf_drake.paths import Piece, ReferencePath
from systems import FieldForSpeed, QuadrotorParameters

FORCES = [f"force_{number}" for number in (1, 2, 3, 4)]
RADII = (1.0, 2.0)
VEHICLE = QuadrotorParameters()


def test_flights_stay_near_the_circles(flown):
    for result, speed, rms, largest in (
        (flown.slow, 0.45, 0.01, 0.03),
        (flown.fast, 2, 0.02, 1),
    ):
        summary = result.summary()
        assert 0.0 < summary["cross_track_rms_m"] <= rms
        assert summary["cross_track_rms_m"] <= summary["cross_track_max_m"] <= largest
        assert summary["saturated_fraction_after_take_off"] == 0.0
        assert summary["speed_mean_m_s"] == pytest.approx(speed, rel=0.01)
        assert summary["laps"] >= 1.0
        assert summary["ended"] is None
    # The worst of the pieces.
    pieces = summary["pieces"]
    assert [piece["piece"] for piece in pieces] == [0, 1]
    for pick, keys in (
        (
            max,
            ("cross_track_rms_m", "cross_track_max_m", "altitude_rms_m", "motor_force_max_n"),
        ),
        (min, ("laps", "real_time_factor")),
    ):
        for key in keys:
            assert summary[key] == pick(piece[key] for piece in pieces), key
    error = [abs(piece["speed_mean_m_s"] - 2.0) for piece in pieces]
    assert abs(summary["speed_mean_m_s"] - 2.0) == max(error)


def test_the_log_holds_the_whole_flight_and_agrees_with_itself(flown):
    for result, speed, laps in ((flown.slow, 0.45, 1.0), (flown.fast, 2.0, 1.5)):
        for flight in result.flights:
            log, radius = flight.log, RADII[flight.piece]
            assert list(log.columns) == [
                *("time", "x", "y", "z", "roll", "pitch", "yaw"),
                *("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate"),
                *("vx_command", "vy_command", "vz_command", *FORCES, "cross_track_error"),
            ]
            assert np.isfinite(log.to_numpy()).all()
            np.testing.assert_allclose(np.diff(log["time"]), 0.01, atol=1e-9)
            # The laps, and a way in of 4 U, of 0.5 m each.
            duration = 1.0 + (laps * 2 * np.pi * radius + 2.0) / speed
            assert log["time"].iloc[-1] == pytest.approx(duration, abs=0.01)
            first = log.iloc[0]
            assert flight.summary["start_m"] == [first["x"], first["y"], first["z"]]
            assert math.hypot(first["x"], first["y"]) == pytest.approx(radius + 0.25, abs=1e-3)
            assert first["z"] == 1.0
            assert not first[["roll", "pitch", "yaw", "vx", "vy", "vz"]].any()
    settled = log[log["time"] > 1.0]
    for axis in "xyz":
        rate = np.gradient(settled[axis], settled["time"])
        np.testing.assert_allclose(rate[1:-1], settled[f"v{axis}"][1:-1], atol=2e-3)
    command = np.hypot(settled["vx_command"], settled["vy_command"])
    np.testing.assert_allclose(command, 2.0, rtol=0.02)
    forces = log[FORCES].to_numpy()
    assert flight.summary["motor_force_max_n"] == forces.max()
    assert 0.0 <= forces.min() <= forces.max() <= VEHICLE.max_propeller_force
    assert forces.mean() == pytest.approx(VEHICLE.hover_force, rel=0.1)


def test_errors_are_those_of_the_last_lap_around_the_true_circle(flown):
    for flight in flown.fast.flights:
        x, y = flight.log["x"], flight.log["y"]
        distance = np.abs(np.hypot(x, y) - RADII[flight.piece])
        np.testing.assert_allclose(flight.log["cross_track_error"], distance, atol=3e-6)
        # The last lap, found here by the angle that is left to go.
        angle = np.unwrap(np.arctan2(y, x))
        lap = distance[np.abs(angle - angle[-1]) <= 2 * np.pi]
        assert len(lap) < len(distance)
        expected = math.sqrt(np.mean(lap**2))
        assert flight.summary["cross_track_rms_m"] == pytest.approx(expected, rel=0.01)
        assert flight.summary["cross_track_max_m"] == pytest.approx(lap.max(), rel=0.01)


def test_a_cloud_can_be_the_reference_and_the_altitude_is_held(flight_field):
    # In another unit the name of the shape is gone, and with it the true path.
    field = flight_field.rescaled(0.5)
    reference, kind = choose_reference(field)
    assert kind == "cloud"
    result = fly(field, reference, speed=1.0, laps=1.2, altitude=3.5)
    summary = result.summary()
    assert summary["laps"] >= 1.0
    assert summary["cross_track_rms_m"] <= 0.01
    for flight in result.flights:
        np.testing.assert_allclose(flight.log["z"], 3.5, atol=0.03)


def test_a_flight_that_never_settles_says_so(flight_field, rings):
    # It is over before the quadrotor has the speed.
    summary = fly(flight_field, ReferencePath(rings.pieces[:1]), speed=50.0).summary()
    assert summary["cross_track_rms_m"] is summary["cross_track_max_m"] is None
    assert summary["pieces"][0]["duration_s"] < 1.5
    assert summary["laps"] < 1.0


def lose_control(*_, **__):
    """What Drake's plant does when it tips over."""
    plant = VEHICLE.MakePlant()
    context = plant.CreateDefaultContext()
    plant.get_input_port().FixValue(context, np.ones(4))
    context.SetContinuousState([0, 0, 1, 0, np.pi / 2, 0, 0, 0, 0, 0, 1, 0])
    plant.EvalTimeDerivatives(context)
    pytest.fail("Drake minds a pitch of 90 degrees no longer")


def fail(*_, **__):
    raise RuntimeError("a mistake")


def test_loss_of_control_is_one_clear_error(monkeypatch, flight_field, rings):
    places = {"advance": lose_control, "_advance_until": lose_control}
    for name, stand_in in places.items():
        monkeypatch.setitem(simulate.__globals__, name, stand_in)
    told = r"lost control on {} at 3 m/s, .* demands [89]\.\d m/s\^2 .* lower speed"
    with pytest.raises(ConfigurationError, match=told.format("piece 1")):
        fly(flight_field, rings, speed=3.0)
    with pytest.raises(ConfigurationError, match=told.format("the tour")):
        fly_tour(flight_field, rings, (1,), speed=3.0)
    # Other errors are not hidden.
    monkeypatch.setitem(simulate.__globals__, "advance", fail)
    with pytest.raises(RuntimeError, match="a mistake"):
        fly(flight_field, rings, speed=3.0)


# Open pieces.


def test_an_open_piece_is_flown_to_its_end_and_rested_at(flown_to_the_end, half_circle_field):
    (flight,) = flown_to_the_end.flights
    log, unit = flight.log, half_circle_field.cloud.unit_length
    summary = flight.summary
    np.testing.assert_allclose(half_circle_field.ends, [[-4.0, 0.0]], atol=0.1 * unit)
    last = log.iloc[-1]
    assert math.hypot(last["x"] + 4.0, last["y"]) <= 0.1 * unit
    assert np.linalg.norm(last[["vx", "vy", "vz"]]) <= 0.01
    assert (summary["open"], summary["ended"], summary["laps"]) == (True, True, None)
    # From before the other end, over the whole of the arc.
    np.testing.assert_allclose(summary["start_m"], [4.06, -0.5, 1.0], atol=0.07)
    assert np.ptp(np.arctan2(log["y"], log["x"])) >= np.pi - 0.1
    # The figures are from the reach to the arrival; the rest at the end counts in none.
    reach = int(np.argmax(log["cross_track_error"] <= 0.1 * unit))
    away = np.hypot(log["x"] + 4.0, log["y"]) > 0.1 * unit
    arrival = int(np.flatnonzero(away)[-1]) + 1
    assert 0 < reach < arrival < len(log) - 100
    way = log.iloc[reach : arrival + 1]
    speed = np.linalg.norm(way[["vx", "vy", "vz"]], axis=1).mean()
    for name, expected in (
        ("cross_track_rms_m", math.sqrt((way["cross_track_error"] ** 2).mean())),
        ("altitude_rms_m", math.sqrt(((way["z"] - 1.0) ** 2).mean())),
        ("speed_mean_m_s", speed),
    ):
        assert summary[name] == pytest.approx(expected, rel=1e-3)
    assert speed == pytest.approx(summary["speed_command_m_s"], rel=0.02)
    assert summary["cross_track_rms_m"] <= 0.02 * unit


def test_the_summary_tells_ends_from_laps(flown_to_the_end, flown):
    (arc,) = flown_to_the_end.flights
    failed = replace(arc, summary={**arc.summary, "ended": False})
    laps = flown.slow.summary()["laps"]
    for flights, expected in (
        ([arc], (None, True)),
        ([*flown.slow.flights, arc], (laps, True)),
        ([arc, failed], (None, False)),
    ):
        summary = replace(flown.slow, flights=flights).summary()
        assert (summary["laps"], summary["ended"]) == expected


def test_a_field_without_the_end_does_not_end(half_circle_field, half_circle):
    # The same arc the other way around: the field rests where this reference begins, and a
    # reference that is twice as long is not at its end there.
    longer = np.concatenate([[[-4.0, -8.0]], half_circle.pieces[0].vertices])
    reference = ReferencePath((Piece(longer, closed=False),))
    summary = fly(half_circle_field, reference, speed=2.0).summary()
    assert (summary["ended"], summary["laps"]) == (False, None)


# Other vehicles.


def test_a_unicycle_has_the_figures_that_it_can_have(flight_field, rings):
    inner = ReferencePath(rings.pieces[:1])
    result = fly(flight_field, inner, vehicle="unicycle", laps=1.0)
    (flight,), summary = result.flights, result.summary()
    columns = ("time", "x", "y", "z", "heading", "vx", "vy", "vz")
    assert tuple(flight.log.columns[:8]) == columns
    assert tuple(flight.log.columns[-2:]) == ("turn_rate", "cross_track_error")
    assert summary["vehicle"] == "unicycle"
    for name in ("altitude_rms_m", "motor_force_max_n", "motor_force_limit_n"):
        assert summary[name] is None
    assert summary["acceleration_demand_m_s2"] is summary["acceleration_limit_m_s2"] is None
    assert summary["curvature_limit_1_m"] == pytest.approx(2.0 / 0.45)
    assert summary["curvature_demand_1_m"] == pytest.approx(1.0, rel=0.1)
    assert summary["laps"] >= 1.0
    assert summary["cross_track_rms_m"] < 0.004
    np.testing.assert_allclose(np.hypot(flight.log["vx"], flight.log["vy"]), 0.45)
    # It starts along the field as it is flown, where a quadrotor hovers.
    m = FieldForSpeed(flight_field, 0.45, 4.0)(flight.log[["x", "y"]].to_numpy()[0])
    direction = m / np.linalg.norm(m)
    np.testing.assert_allclose(flight.log[["vx", "vy"]].iloc[0], 0.45 * direction)


def test_a_vehicle_that_cannot_rest_is_watched_until_it_is_at_the_end(
    half_circle_field, half_circle
):
    result = fly(half_circle_field, half_circle, vehicle="unicycle", speed=2.0, turn_radius=0.5)
    (flight,), unit = result.flights, half_circle_field.cloud.unit_length
    log, summary = flight.log, flight.summary
    assert (summary["ended"], summary["laps"]) == (True, None)
    assert math.hypot(log["x"].iloc[-1] + 4.0, log["y"].iloc[-1]) < 0.25 * unit
    assert np.hypot(log["vx"].iloc[-1], log["vy"].iloc[-1]) == pytest.approx(2.0)
    reach = int(np.argmax(log["cross_track_error"] <= 0.1 * unit))
    # What it flies beyond the end until it is noticed counts in none.
    arrival = int(np.argmin(np.hypot(log["x"] + 4.0, log["y"])))
    assert reach < arrival < len(log) - 1
    errors = log["cross_track_error"].iloc[reach : arrival + 1]
    assert summary["cross_track_rms_m"] == pytest.approx(math.sqrt((errors**2).mean()))
    assert summary["cross_track_max_m"] == errors.max() < 0.1 * unit


def test_tours_and_circles_that_are_too_tight_are_refused(flight_field, rings):
    with pytest.raises(ConfigurationError, match="a unicycle can neither slow down nor stop"):
        fly_tour(flight_field, rings, [0], vehicle="unicycle")
    with pytest.raises(ConfigurationError, match="a turn radius of 1"):
        fly(flight_field, rings, vehicle="unicycle", turn_radius=1.1)


# Feasibility.


def test_the_demand_is_that_of_the_circles_and_the_limit_that_of_the_thrust(
    flight_field, rings
):
    for piece, radius in enumerate(RADII):
        circle = ReferencePath(rings.pieces[piece : piece + 1])
        for speed in (0.45, 3.0):
            found = check_feasibility(flight_field, circle, speed, VEHICLE)
            assert 0.9 <= found.demand * radius / speed**2 <= 1.25
    limit = 9.81 * math.sqrt(4.1**2 - 1.0)
    assert found.limit == pytest.approx(limit)
    weak = QuadrotorParameters(thrust_to_weight=1.02)
    for vehicle, speed, feasible in (
        (VEHICLE, math.sqrt(0.8 * limit * RADII[0]), True),
        (VEHICLE, math.sqrt(1.2 * limit * RADII[0]), False),
        (weak, 0.45, True),
        (weak, 2.0, False),
    ):
        found = check_feasibility(flight_field, rings, speed, vehicle)
        assert found.is_feasible is feasible
    # It is that of the field as it is flown, which is wider.
    assert FieldForSpeed(flight_field, 3.0) is not flight_field
    m, J = flight_field.value_and_jacobian(rings.pieces[0].sample(500))
    narrow = 3.0**2 * np.linalg.norm((J @ m[:, :, None])[:, :, 0], axis=1).max()
    assert check_feasibility(flight_field, rings, 3.0, VEHICLE).demand < narrow


# What cannot be flown.


@pytest.mark.parametrize("name", ["speed", "laps", "altitude", "duration"])
def test_bad_values_are_refused(flight_field, rings, name):
    for value in (
        math.nan,
        math.inf,
        0.0,
        -1.0,
        *([0.5] if name in ("laps", "duration") else []),
    ):
        with pytest.raises(ConfigurationError, match=f"{name} must be .* not {value}"):
            fly(flight_field, rings, **{name: value})


def test_fields_and_references_that_cannot_be_flown(flight_field, constant_field):
    points = np.random.default_rng(0).uniform(-1, 1, (20, 4))
    field = constant_field(PointCloud(points), np.ones(4))
    with pytest.raises(ConfigurationError, match="dimension 2 or 3, got 4"):
        fly(field, ReferencePath((Piece(points, closed=False),)))
    # In another unit.
    short = ReferencePath((Piece(np.array([[0.0, 0.0], [0.004, 0.0]]), closed=False),))
    with pytest.raises(ConfigurationError, match=r"only 0\.004 m long, .* span 3\.99972 m"):
        fly(flight_field, short)


# Where flights begin, and how long they take.


def field_of(ends=(), unit_length=1.0):
    """What a start asks of a field."""
    cloud = SimpleNamespace(unit_length=unit_length)
    return SimpleNamespace(cloud=cloud, ends=np.reshape(ends, (-1, 2)))


def test_short_pieces_are_not_flown(circle_of_points, constant_field, rings):
    field = constant_field(circle_of_points(1.0), np.zeros(2))
    short = Piece(0.9 * field.cloud.unit_length * np.eye(2)[[0, 0]] * [[0], [1]], closed=False)
    assert flown_pieces(field, ReferencePath((short, rings.pieces[0]))) == [1]


CORNER = [[0.0, 1.0], [3.0, 1.0], [4.0, 1.0], [4.0, 2.0], [4.0, 5.0]]


@pytest.mark.parametrize(
    ("points", "ends", "expected"),
    [
        # A spatial path ignores the altitude.
        ([[0.0, 0.0, 5.0], [2.0, 0.0, 5.0]], [], [-0.5, 0.0, 5.0]),
        # Before the end that the field does not come to rest at.
        (CORNER, [], [-0.5, 1.0, 2.0]),
        (CORNER, [4.0, 1.0], [-0.5, 1.0, 2.0]),
        (CORNER, [0.1, 1.0], [4.0, 5.5, 2.0]),
        # The end of another piece is farther from both.
        (CORNER, [[9.0, 9.0], [0.1, 1.0]], [4.0, 5.5, 2.0]),
    ],
)
def test_an_open_piece_is_entered_in_its_direction(points, ends, expected):
    path = ReferencePath((Piece(np.array(points), closed=False),))
    start = hover_start(field_of(ends), path, 0, altitude=2.0)
    np.testing.assert_allclose(start, expected, atol=1e-12)


def test_a_flight_has_a_start_and_time(rings, half_circle):
    field, spec = field_of(unit_length=0.5), FlightSpec(speed=0.2, laps=3.0, altitude=1.5)
    closed, open_ = spec.along(field, rings, 1), spec.along(field, half_circle, 0)
    # Half a unit outside of the circle of 2 m.
    np.testing.assert_allclose(closed.start, [2.25, 0.0, 1.5], atol=1e-12)
    # A take-off, the laps, ways in and at rest of 4 U and 2 U, and 3 s.
    assert closed.duration == pytest.approx(1.0 + (3 * 4 * np.pi + 2.0) / 0.2, rel=1e-3)
    assert open_.duration == pytest.approx(1.0 + (4 * np.pi + 3.0) / 0.2 + 3.0, rel=1e-3)
    own = replace(spec, start=(0.0, 0.0, 1.0), duration=2.0)
    assert own.along(field, rings, 0) == own


def test_a_course_over_a_bridge_and_under_it_is_flown():
    """The plan of this eight crosses itself; its strands pass 1.5 m above each other there."""
    t = 2 * np.pi * np.arange(200) / 200
    points = np.column_stack([3 * np.sin(t), 1.5 * np.sin(2 * t), 1.5 + 0.75 * np.cos(t)])
    cloud = PointCloud(np.random.default_rng(0).permutation(points))
    few = TrainingConfig(recipe="exact", tangent_iterations=400, max_restarts=0)
    result = train(cloud, few)
    assert result.network.kind(0) == "closed path"
    assert result.network.is_simple(0)
    true = ReferencePath((Piece(points, closed=True),))
    summary = follow(result.guiding_field, true, starts=30).summary()
    assert summary["lap_fraction"] == 1.0
    (flight,) = fly(result.guiding_field, true, speed=0.45, laps=1.0).flights
    assert flight.summary["laps"] >= 1.0
    assert flight.summary["cross_track_rms_m"] <= 0.02 * cloud.unit_length
    flying = flight.log[flight.log["time"] > TAKE_OFF_S]
    assert np.linalg.norm(flying[["vx", "vy", "vz"]], axis=1).min() > 0.8 * 0.45
