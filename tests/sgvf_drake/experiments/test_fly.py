"""Flights of Drake's quadrotor along the two circles of the paper's first flight."""

from dataclasses import replace
import math

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import check_feasibility, choose_reference, fly
from sgvf_drake.experiments.fly import flight_duration, flown_pieces, hover_start
from sgvf_drake.paths import Piece, PointCloud, ReferencePath
from systems import FieldForSpeed, QuadrotorParameters

FIGURES = {
    *("cross_track_rms_m", "cross_track_max_m", "speed_mean_m_s", "altitude_rms_m"),
    *("motor_force_max_n", "saturated_fraction", "laps", "real_time_factor"),
}
RADII = (1.0, 2.0)


def radius_of(log):
    return np.hypot(log["x"], log["y"]).to_numpy()


def test_slow_flights_stay_within_a_centimetre(flown):
    summary = flown.slow.summary()
    assert 0.0 < summary["cross_track_rms_m"] <= 0.01
    assert summary["cross_track_rms_m"] <= summary["cross_track_max_m"] <= 0.03
    assert summary["saturated_fraction_after_take_off"] == 0.0
    assert summary["speed_mean_m_s"] == pytest.approx(0.45, rel=0.01)
    assert summary["altitude_rms_m"] <= 0.001
    assert summary["laps"] >= 1.0


def test_fast_flights_stay_within_two_centimetres(flown):
    summary = flown.fast.summary()
    assert 0.0 < summary["cross_track_rms_m"] <= 0.02
    assert summary["saturated_fraction_after_take_off"] == 0.0
    assert summary["speed_mean_m_s"] == pytest.approx(2.0, rel=0.01)
    assert summary["laps"] >= 1.0


def test_summary_has_its_names_and_the_worst_of_the_pieces(flown):
    summary = flown.fast.summary()
    pieces = summary["pieces"]
    assert set(summary) >= FIGURES
    assert [piece["piece"] for piece in pieces] == [0, 1]
    for piece in pieces:
        assert set(piece) >= FIGURES
    for key in ("cross_track_rms_m", "cross_track_max_m", "motor_force_max_n"):
        assert summary[key] == max(piece[key] for piece in pieces), key
    for key in ("laps", "real_time_factor"):
        assert summary[key] == min(piece[key] for piece in pieces), key
    assert summary["speed_mean_m_s"] in [piece["speed_mean_m_s"] for piece in pieces]


def test_the_log_holds_the_whole_flight(flown):
    for flight, radius in zip(flown.slow.flights, RADII, strict=True):
        log = flight.log
        assert list(log.columns) == [
            *("time", "x", "y", "z", "roll", "pitch", "yaw"),
            *("vx", "vy", "vz", "roll_rate", "pitch_rate", "yaw_rate"),
            *("vx_command", "vy_command", "vz_command"),
            *("force_1", "force_2", "force_3", "force_4", "cross_track_error"),
        ]
        assert np.isfinite(log.to_numpy()).all()
        np.testing.assert_allclose(np.diff(log["time"]), 0.01, atol=1e-9)
        # 1.2 laps and a way in of 4 U, of 0.5 m each.
        duration = 1.0 + (1.2 * 2 * np.pi * radius + 2.0) / 0.45
        assert log["time"].iloc[-1] == pytest.approx(duration, abs=0.01)


def test_the_log_agrees_with_itself(flown):
    log = flown.fast.flights[0].log
    settled = log[log["time"] > 1.0]
    for axis in "xyz":
        rate = np.gradient(settled[axis], settled["time"])
        np.testing.assert_allclose(rate[1:-1], settled[f"v{axis}"][1:-1], atol=2e-3)
    command = np.hypot(settled["vx_command"], settled["vy_command"])
    np.testing.assert_allclose(command, 2.0, rtol=0.02)


def test_flights_start_from_a_hover_beside_the_path(flown):
    for flight, radius in zip(flown.slow.flights, RADII, strict=True):
        first = flight.log.iloc[0]
        assert flight.summary["start_m"] == [first["x"], first["y"], first["z"]]
        assert math.hypot(first["x"], first["y"]) == pytest.approx(radius + 0.25, abs=1e-3)
        assert first["z"] == 1.0
        assert not first[["roll", "pitch", "yaw", "vx", "vy", "vz"]].any()


def test_errors_are_those_of_the_true_circle(flown):
    for flight, radius in zip(flown.slow.flights, RADII, strict=True):
        distance = np.abs(radius_of(flight.log) - radius)
        np.testing.assert_allclose(flight.log["cross_track_error"], distance, atol=3e-6)
        # The last lap, found here by the angle that is left to go.
        angle = np.unwrap(np.arctan2(flight.log["y"], flight.log["x"]))
        lap = distance[np.abs(angle - angle[-1]) <= 2 * np.pi]
        assert len(lap) < len(distance)
        expected = math.sqrt(np.mean(lap**2))
        assert flight.summary["cross_track_rms_m"] == pytest.approx(expected, rel=0.01)
        assert flight.summary["cross_track_max_m"] == pytest.approx(lap.max(), rel=0.01)


def test_forces_are_those_of_the_log(flown):
    flight = flown.fast.flights[0]
    forces = flight.log[[f"force_{number}" for number in (1, 2, 3, 4)]].to_numpy()
    assert flight.summary["motor_force_max_n"] == forces.max()
    assert 0.0 <= forces.min() <= forces.max() <= QuadrotorParameters().max_propeller_force
    hover = QuadrotorParameters().hover_force
    assert forces.mean() == pytest.approx(hover, rel=0.1)


def test_a_planar_flight_holds_its_altitude(flight_field, rings):
    inner = ReferencePath(rings.pieces[:1])
    (flight,) = fly(flight_field, inner, speed=2.0, laps=1.0, altitude=3.5).flights
    np.testing.assert_allclose(flight.log["z"], 3.5, atol=0.03)


def test_a_cloud_can_be_the_reference(flight_field):
    # In another unit the name of the shape is gone, and with it the true path.
    field = flight_field.rescaled(0.5)
    reference, kind = choose_reference(field)
    assert kind == "cloud"
    summary = fly(field, reference, speed=1.0, laps=1.2).summary()
    assert sorted(round(p["duration_s"]) for p in summary["pieces"]) == [6, 10]
    assert summary["laps"] >= 1.0
    assert summary["cross_track_rms_m"] <= 0.01


def test_a_flight_that_never_settles_says_so(flight_field, rings):
    # It is over before the quadrotor has the speed.
    summary = fly(flight_field, ReferencePath(rings.pieces[:1]), speed=50.0).summary()
    assert summary["cross_track_rms_m"] is None
    assert summary["cross_track_max_m"] is None
    assert summary["pieces"][0]["duration_s"] < 1.5
    assert summary["laps"] < 1.0


def lose_control(*_):
    """What Drake's plant does when it tips over."""
    plant = QuadrotorParameters().MakePlant()
    context = plant.CreateDefaultContext()
    plant.get_input_port().FixValue(context, np.ones(4))
    context.SetContinuousState([0, 0, 1, 0, np.pi / 2, 0, 0, 0, 0, 0, 1, 0])
    plant.EvalTimeDerivatives(context)
    pytest.fail("Drake minds a pitch of 90 degrees no longer")


def test_loss_of_control_is_one_clear_error(monkeypatch, flight_field, rings):
    monkeypatch.setitem(fly.__globals__, "simulate", lose_control)
    message = r"lost control on piece 1 at 3 m/s, .* demands [89]\.\d m/s\^2 .* lower speed"
    with pytest.raises(ConfigurationError, match=message):
        fly(flight_field, rings, speed=3.0)


def test_other_errors_in_flight_are_not_hidden(monkeypatch, flight_field, rings):
    def fail(*_):
        raise RuntimeError("a mistake")

    monkeypatch.setitem(fly.__globals__, "simulate", fail)
    with pytest.raises(RuntimeError, match="a mistake"):
        fly(flight_field, rings)


# Open pieces.


def test_an_open_piece_is_flown_to_its_end_and_rested_at(flown_to_the_end, open_field_of_arc):
    (flight,) = flown_to_the_end.flights
    log, summary = flight.log, flight.summary
    unit = open_field_of_arc.cloud.unit_length
    np.testing.assert_allclose(open_field_of_arc.ends, [[-4.0, 0.0]], atol=0.1 * unit)
    last = log.iloc[-1]
    assert math.hypot(last["x"] + 4.0, last["y"]) <= 0.1 * unit
    assert np.linalg.norm(last[["vx", "vy", "vz"]]) <= 0.01
    assert summary["open"] is True
    assert summary["ended"] is True
    assert summary["laps"] is None
    # From before the other end, over the whole of the arc.
    np.testing.assert_allclose(summary["start_m"], [4.06, -0.5, 1.0], atol=0.07)
    angle = np.arctan2(log["y"], log["x"])
    assert angle.max() - angle.min() >= np.pi - 0.1


def test_the_figures_of_an_open_piece_are_from_reach_to_arrival(
    flown_to_the_end, open_field_of_arc
):
    (flight,) = flown_to_the_end.flights
    log, unit = flight.log, open_field_of_arc.cloud.unit_length
    reach = int(np.argmax(log["cross_track_error"] <= 0.1 * unit))
    away = np.hypot(log["x"] + 4.0, log["y"]) > 0.1 * unit
    arrival = int(np.flatnonzero(away)[-1]) + 1
    assert 0 < reach < arrival < len(log) - 100
    way = log.iloc[reach : arrival + 1]
    rms = float(np.sqrt((way["cross_track_error"] ** 2).mean()))
    speed = float(np.linalg.norm(way[["vx", "vy", "vz"]], axis=1).mean())
    altitude = float(np.sqrt(((way["z"] - 1.0) ** 2).mean()))
    assert flight.summary["cross_track_rms_m"] == pytest.approx(rms, rel=1e-3)
    assert flight.summary["speed_mean_m_s"] == pytest.approx(speed, rel=1e-3)
    assert flight.summary["altitude_rms_m"] == pytest.approx(altitude, rel=1e-3)
    # The rest at the end counts in none of them.
    assert speed == pytest.approx(0.2, rel=0.02)
    assert flight.summary["cross_track_rms_m"] <= 0.02 * unit


def test_the_summary_tells_ends_from_laps(flown_to_the_end, flown):
    arc, rings = flown_to_the_end.summary(), flown.slow.summary()
    assert (arc["laps"], arc["ended"]) == (None, True)
    assert rings["ended"] is None
    assert [piece["ended"] for piece in rings["pieces"]] == [None, None]
    assert not any(piece["open"] for piece in rings["pieces"])
    both = replace(
        flown.slow, flights=[*flown.slow.flights, *flown_to_the_end.flights]
    ).summary()
    assert (both["laps"], both["ended"]) == (rings["laps"], True)
    (flight,) = flown_to_the_end.flights
    failed = replace(flight, summary={**flight.summary, "ended": False})
    missed = replace(flown.slow, flights=[flight, failed]).summary()
    assert (missed["laps"], missed["ended"]) == (None, False)


def test_a_field_without_the_end_does_not_end(open_field_of_arc, half_circle):
    # The same arc the other way around: the field rests where this reference begins, and a
    # reference that is twice as long is not at its end there.
    longer = np.concatenate([[[-4.0, -8.0]], half_circle.pieces[0].vertices])
    reference = ReferencePath((Piece(longer, closed=False),))
    summary = fly(open_field_of_arc, reference, speed=0.2).summary()
    assert summary["ended"] is False
    assert summary["laps"] is None


def test_an_open_piece_has_time_to_come_to_rest(rings, half_circle):
    length = 4 * np.pi
    # A take-off, ways in and at rest of 4 U and 2 U, and 3 s.
    expected = 1.0 + (length + 6 * 0.5) / 0.2 + 3.0
    for laps in (1.0, 5.0):
        found = flight_duration(half_circle, 0, 0.5, 0.2, laps)
        assert found == pytest.approx(expected, rel=1e-3)
    found = flight_duration(rings, 0, 0.5, 0.2, 3.0)
    assert found == pytest.approx(1.0 + (3 * 2 * np.pi + 4 * 0.5) / 0.2, rel=1e-3)


# Feasibility.


@pytest.mark.parametrize("speed", [0.45, 2.0, 3.0])
@pytest.mark.parametrize("piece", [0, 1])
def test_the_demand_is_that_of_the_circle(flight_field, rings, speed, piece):
    circle = ReferencePath(rings.pieces[piece : piece + 1])
    found = check_feasibility(flight_field, circle, speed, QuadrotorParameters())
    centripetal = speed**2 / RADII[piece]
    assert centripetal * 0.9 <= found.demand <= centripetal * 1.25
    assert found.is_feasible


def test_the_demand_grows_with_the_square_of_the_speed(flight_field, rings):
    vehicle = QuadrotorParameters()
    demands = [check_feasibility(flight_field, rings, v, vehicle).demand for v in (2.0, 4.0)]
    assert demands[1] / demands[0] == pytest.approx(4.0, rel=0.1)


def test_a_speed_beyond_the_thrust_is_told(flight_field, rings):
    vehicle = QuadrotorParameters()
    limit = 9.81 * math.sqrt(4.1**2 - 1.0)
    for speed, feasible in ((0.9, True), (1.1, False)):
        fast = speed * math.sqrt(limit * RADII[0])
        found = check_feasibility(flight_field, rings, fast, vehicle)
        assert found.limit == pytest.approx(limit)
        assert found.is_feasible is feasible


def test_a_stronger_vehicle_may_fly_faster(flight_field, rings):
    weak = QuadrotorParameters(thrust_to_weight=1.02)
    assert not check_feasibility(flight_field, rings, 2.0, weak).is_feasible
    assert check_feasibility(flight_field, rings, 0.45, weak).is_feasible


def test_the_demand_is_that_of_the_widened_field(flight_field, rings):
    speed = 3.0
    assert FieldForSpeed(flight_field, speed) is not flight_field
    found = check_feasibility(flight_field, rings, speed, QuadrotorParameters())
    points = np.concatenate([piece.sample(500) for piece in rings.pieces])
    m, J = flight_field.value_and_jacobian(points)
    narrow = speed**2 * np.linalg.norm((J @ m[:, :, None])[:, :, 0], axis=1).max()
    assert found.demand < narrow


# What cannot be flown.


@pytest.mark.parametrize("value", [math.nan, math.inf, 0.0, -1.0])
@pytest.mark.parametrize("name", ["speed", "laps", "altitude"])
def test_bad_values_are_refused(flight_field, rings, name, value):
    with pytest.raises(ConfigurationError, match=f"{name} must be .* not {value}"):
        fly(flight_field, rings, **{name: value})


def test_less_than_a_lap_is_refused(flight_field, rings):
    with pytest.raises(ConfigurationError, match=r"laps must be at least 1, not 0\.5"):
        fly(flight_field, rings, laps=0.5)


def test_a_field_in_four_dimensions_is_refused(constant_field):
    cloud = PointCloud(np.random.default_rng(0).uniform(-1, 1, (20, 4)))
    field = constant_field(cloud, np.ones(4))
    with pytest.raises(ConfigurationError, match="dimension 2 or 3, got 4"):
        fly(field, choose_reference(field)[0])


def test_a_reference_in_another_unit_is_refused(flight_field):
    short = ReferencePath((Piece(np.array([[0.0, 0.0], [0.004, 0.0]]), closed=False),))
    with pytest.raises(ConfigurationError, match=r"only 0\.004 m long, .* span 3\.99972 m"):
        fly(flight_field, short)


# Where flights begin.


def test_stray_points_are_not_flown(circle_of_points):
    points = np.concatenate([circle_of_points(1.0).points, [[3.0, 0.0]]])
    cloud = PointCloud(points)
    reference, _ = choose_reference(FieldOf(cloud))
    assert len(reference.lengths) == 2
    assert flown_pieces(reference, cloud.unit_length) == [int(np.argmax(reference.lengths))]


def test_the_hover_is_half_a_unit_outside(rings):
    start = hover_start(rings, 1, unit_length=0.5, altitude=1.5)
    np.testing.assert_allclose(start, [2.25, 0.0, 1.5], atol=1e-12)


def test_the_hover_beside_a_spatial_path_ignores_the_altitude():
    line = ReferencePath((Piece(np.array([[0.0, 0.0, 5.0], [2.0, 0.0, 5.0]]), closed=False),))
    np.testing.assert_allclose(hover_start(line, 0, 1.0, altitude=9.0), [-0.5, 0.0, 5.0])


@pytest.mark.parametrize(
    ("ends", "expected"),
    [
        (None, [-0.5, 1.0]),
        (np.empty((0, 2)), [-0.5, 1.0]),
        ([[4.0, 1.0]], [-0.5, 1.0]),
        ([[0.1, 1.0]], [4.0, 5.5]),
        # The end of another piece is farther from both.
        ([[9.0, 9.0], [0.1, 1.0]], [4.0, 5.5]),
    ],
)
def test_the_hover_is_before_the_end_that_an_open_piece_starts_at(ends, expected):
    corner = np.array([[0.0, 1.0], [3.0, 1.0], [4.0, 1.0], [4.0, 2.0], [4.0, 5.0]])
    path = ReferencePath((Piece(corner, closed=False),))
    ends = None if ends is None else np.asarray(ends)
    start = hover_start(path, 0, unit_length=1.0, altitude=2.0, ends=ends)
    np.testing.assert_allclose(start, [*expected, 2.0], atol=1e-12)


class FieldOf:
    """What `choose_reference` asks of a field."""

    def __init__(self, cloud):
        self.cloud = cloud
        self.dim = cloud.dim
        self.ends = np.empty((0, cloud.dim))
