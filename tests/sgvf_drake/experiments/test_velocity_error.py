"""The velocity error of flights: against e* sampled on a circle, and against proved walls."""

from dataclasses import replace
import json
import math

from matplotlib.patches import Polygon
import numpy as np
import pandas as pd
import pytest

from sgvf_drake.certificate import PieceResult
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import (
    CertifiedField,
    as_flown,
    flight_margin,
    flight_tracking,
    fly,
    tracking_figure,
)
from sgvf_drake.experiments.figures.certificate import certificate_figure
from sgvf_drake.experiments.fly import PieceFlight
from sgvf_drake.experiments.results import write_summary
from sgvf_drake.experiments.theorem import level_set_points
from sgvf_drake.experiments.velocity_error import NOT_COVERED, margin_summary
from sgvf_drake.fields import Perceptron
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.lyapunov import LyapunovFunction, Margins
from sgvf_drake.paths import Piece, ReferencePath
from systems import FieldForSpeed

# Against e* that is sampled: flights along the circle of 1 m.

SPEED = 0.45
C_IN, LEVEL = 0.06, 0.5
LEVELS = np.geomspace(0.02, 8.0, 12)


def margins_with(e_star, levels=LEVELS):
    return Margins(
        levels, np.asarray(e_star), np.zeros((len(levels), 2)), np.zeros(len(levels))
    )


@pytest.fixture(scope="module")
def V(flight_field):  # noqa: N802
    return LyapunovFunction.of(flight_field)


@pytest.fixture(scope="module")
def inner(rings):
    """The circle of 1 m alone."""
    return ReferencePath(rings.pieces[:1])


@pytest.fixture(scope="module")
def margins(flight_field, V):
    """e* of the field as it is flown, at 400 random points of each level set."""
    flown, rng, e_star = FieldForSpeed(flight_field, SPEED), np.random.default_rng(0), []
    for level in LEVELS:
        x = level_set_points(V, level, 400, rng)
        gradient = V.gradient(x)
        inward = -(gradient * flown(x)).sum(axis=1) / np.linalg.norm(gradient, axis=1)
        e_star.append(inward.min())
    return margins_with(e_star)


@pytest.fixture(scope="module")
def tracked(flight_field, V, inner, margins):
    values = {"c_in": C_IN, "level": LEVEL, "duration": 6.0}
    return flight_tracking(flight_field, inner, SPEED, V, margins, **values)


def test_the_error_is_to_the_command_that_the_flight_was_given(tracked, flight_field, inner, V):
    (flight,) = tracked.flights
    (other,) = fly(flight_field, inner, speed=SPEED, duration=6.0).flights
    log = flight.log
    assert set(log.columns) == {*other.log.columns, "V", "V_dot", "error"}
    pd.testing.assert_frame_equal(log[other.log.columns], other.log, check_exact=True)
    assert flight.exit is None
    x, v = log[["x", "y"]].to_numpy(), log[["vx", "vy"]].to_numpy()
    np.testing.assert_array_equal(log["V"], V(x))
    np.testing.assert_allclose(log["V_dot"], V.derivative(x, v), rtol=1e-9, atol=1e-12)
    # A command holds from its sample on, so the log shows it in the next row.
    command = log[["vx_command", "vy_command"]].to_numpy()[1:]
    expected = np.linalg.norm(v[:-1] - command, axis=1)
    np.testing.assert_allclose(SPEED * log["error"][:-1], expected, atol=1e-12)
    # At take-off the vehicle stands.
    assert log["error"][0] == pytest.approx(1.0, rel=0.01)


def test_the_error_is_covered_by_the_margin(tracked):
    summary, (flight,) = tracked.summary(), tracked.flights
    (piece,) = summary["pieces"]
    assert summary["covered"] is piece["covered"] is summary["stayed"] is True
    assert summary["tolerated_error_m_s"] == SPEED * tracked.margins.at(LEVEL)
    # About half of the speed is tolerated, and a tenth of it occurs, on the way in.
    assert 0.3 * SPEED < summary["tolerated_error_m_s"] < 0.7 * SPEED
    assert 0.01 < summary["tracking_error_max_m_s"] < 0.1
    assert piece["tracking_error_50_percent_m_s"] < 0.001
    assert piece["tracking_error_99_percent_m_s"] <= piece["tracking_error_max_m_s"]
    # The settled part begins with the entry and lasts.
    log, first = flight.log, int(np.argmax(flight.settled))
    assert 50 < first < 300
    assert flight.settled[first:].all()
    assert (log["V"][:first] > C_IN).all()
    assert piece["V_max_settled"] == log["V"][first:].max() <= C_IN
    assert piece["settled_s"] == log["time"][first]
    # V falls wherever the error is below what its own level tolerates.
    within = log[(log["V"] >= LEVELS[0]) & (log["V"] <= LEVELS[-1])]
    falling = within["error"] < [tracked.margins.at(level) for level in within["V"]]
    assert falling.sum() > 50
    assert (within["V_dot"][falling] < 0.0).all()
    over_time, over_V = tracking_figure(tracked).axes
    assert len(over_time.get_lines()[0].get_ydata()) == len(log)
    # Both are parts of the speed.
    tolerated = over_time.get_lines()[-1].get_ydata()
    np.testing.assert_allclose(tolerated, tracked.margins.at(LEVEL))
    assert sum(len(line.get_ydata()) for line in over_V.get_lines()[1:4]) == len(log)


def test_the_smallest_covering_level_is_the_first_that_tolerates_the_error(tracked):
    largest = tracked.summary()["tracking_error_max_m_s"] / SPEED
    (flight,) = tracked.flights
    never = replace(flight, settled=np.zeros_like(flight.settled))
    for settled, e_star, covered, smallest in (
        (flight, np.where(LEVELS > 1.0, 1.0, 0.0), False, LEVELS[LEVELS > 1.0][0]),
        (flight, np.full(len(LEVELS), 0.99 * largest), False, None),
        (flight, np.full(len(LEVELS), 1.01 * largest), True, LEVELS[0]),
        (never, np.ones(len(LEVELS)), None, None),
    ):
        result = replace(tracked, flights=[settled], margins=margins_with(e_star))
        summary = result.summary()
        (piece,) = summary["pieces"]
        assert summary["covered"] is bool(covered)
        assert piece["covered"] is covered
        assert piece["smallest_covering_level"] == smallest
        assert (summary["tracking_error_max_m_s"] is None) == (settled is never)


def test_a_flight_that_leaves_its_level_ends_there(flight_field, V, inner, tracked, tmp_path):
    # So low that V, which varies along the path, goes above it.
    margins = margins_with([0.1, 0.1], np.array([1e-4, 1.0]))
    result = flight_tracking(flight_field, inner, SPEED, V, margins, c_in=2e-4, level=4e-4)
    (flight,) = result.flights
    left = flight.exit
    assert left.level == 4e-4 < left.V
    np.testing.assert_array_equal(left.V, V(left.position[None]))
    assert flight.log["time"].iloc[-1] <= left.time < 10.0
    summary = result.summary()
    assert summary["stayed"] is False
    assert summary["pieces"][0]["exit"] == str(left)
    for one in (tracked.summary(), summary):
        write_summary(tmp_path, one)
        assert json.loads((tmp_path / "summary.json").read_text()) == one


def test_bad_values_are_refused(flight_field, V, inner, margins):
    arguments = {"speed": SPEED, "c_in": C_IN, "level": LEVEL}
    for values, message in (
        ({"speed": math.nan}, "speed must be a positive number"),
        ({"level": 0.05}, r"at least c_in = 0\.06, .* not 0\.05"),
        ({"c_in": 0.001, "level": 0.01}, r"known, 0\.02 to 8, not 0\.01"),
        ({"level": 9.0}, r"known, 0\.02 to 8, not 9"),
        ({"level": math.nan}, "not nan"),
    ):
        options = {**arguments, **values, "function": V, "margins": margins}
        with pytest.raises(ConfigurationError, match=message):
            flight_tracking(flight_field, inner, **options)


# Against a certificate: planted errors on a ring in closed form, and real flights.

RING_SPEED, SCALE, PERIOD = 0.5, 0.25, 0.01


@pytest.fixture
def certified(ring_field, ring_certificate):
    return CertifiedField(ring_field, ring_certificate, SCALE)


def planted(certified, radius, error):
    """The margin of a flight around a ring, at radii (units) with errors, parts of the speed.

    Errors point in a direction that turns, since only their size is to count.
    """
    count = len(error)
    time = PERIOD * np.arange(count)
    angle = 0.3 * time
    x = np.broadcast_to(radius, count)[:, None] * np.column_stack(
        [np.cos(angle), np.sin(angle)]
    )
    away = np.column_stack([np.cos(7 * angle), np.sin(7 * angle)])
    velocity = RING_SPEED * (certified.field(x) + np.asarray(error)[:, None] * away)
    log = pd.DataFrame({"time": time, "x": SCALE * x[:, 0], "y": SCALE * x[:, 1]})
    log = log.assign(vx=velocity[:, 0], vy=velocity[:, 1])
    return flight_margin(certified, PieceFlight(0, log, {}), RING_SPEED)


def test_the_error_is_the_distance_of_the_velocity_from_the_certified_field(certified):
    error = np.linspace(0.0, 0.3, 300)
    margin = planted(certified, 4.2, error)
    np.testing.assert_allclose(margin.log["error"], error, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(margin.positions, axis=1), 4.2)


def at_radii(radii):
    angle = np.linspace(0.1, 6.0, len(radii))
    return np.array(radii)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def test_walls_that_hold_a_point_and_what_the_innermost_tolerate(certified):
    x = at_radii([0.1, 3.1, 3.25, 3.65, 3.75, 3.95, 4.0, 4.05, 4.15, 4.35, 4.75, 4.85])
    (held,) = certified.pairs_around(x).T
    assert held.tolist() == [0, 0, 1, 1, 2, 3, 3, 3, 2, 1, 1, 0]
    e_star = certified.e_star(held[:, None])
    np.testing.assert_array_equal(e_star, np.array([0.0, 0.5, 0.25, 0.1])[held])


def test_each_piece_has_its_walls(certified, planted_certificate):
    inner = certified.certificate
    outer = planted_certificate(certified.field, 6.0, half_widths=(0.1, 0.3), e_star=(0.2, 0.5))
    walls = (*inner.walls, None, *outer.walls)
    pieces = (*inner.pieces, PieceResult(orbit_exists=False), *outer.pieces)
    several = replace(certified, certificate=replace(inner, walls=walls, pieces=pieces))
    pairs = several.pairs_around(at_radii([4.0, 5.0, 6.0, 6.2, 6.5]))
    assert pairs.tolist() == [[3, 0, 0], [0, 0, 0], [0, 0, 2], [0, 0, 1], [0, 0, 0]]
    np.testing.assert_array_equal(several.e_star(pairs), [0.1, 0.0, 0.2, 0.5, 0.0])


def profile(value, *steps):
    """500 samples of a value, and of others from certain samples on: (begin, value)."""
    values = np.full(500, value)
    for begin, other in steps:
        values[begin:] = other
    return values


TOLD = (
    "inside_margin",
    "settled_s",
    "error_max",
    "covering_half_width",
    "stayed_between_walls",
)
# How far from the ring the flight is; its errors; what is told of it.  The take-off takes a
# second.
PLANTED = {
    "innermost": (profile(0.0), profile(1.0, (100, 0.099)), (True, 1.0, 0.099, 0.1, True)),
    "not these": (profile(0.0), profile(1.0, (100, 0.101)), (True, 1.0, 0.101, 0.3, True)),
    "none": (profile(0.0), profile(0.501), (False, 1.0, 0.501, None, True)),
    "once": (profile(0.0), profile(0.0, (300, 0.3), (301, 0.0)), (True, 1.0, 0.3, 0.8, True)),
    # An error counts for those walls alone that the flight was between at the time.
    "on the way": (
        profile(0.5, (200, 0.2), (300, 0.0)),
        profile(1.0, (100, 0.6), (200, 0.26), (300, 0.05)),
        (True, 1.0, 0.6, 0.1, True),
    ),
    "it comes back": (
        profile(0.0, (200, 0.2), (300, 0.0)),
        profile(0.05, (200, 0.12), (300, 0.05)),
        (True, 1.0, 0.12, 0.3, True),
    ),
    "from outside": (
        profile(2.0, (200, 0.0)),
        profile(0.5, (150, 0.6), (160, 0.5), (200, 0.02)),
        (True, 2.0, 0.02, 0.1, True),
    ),
    "leaves": (
        profile(0.0, (400, 0.9), (450, 0.0)),
        profile(0.0, (390, 0.6)),
        (False, 1.0, 0.6, None, False),
    ),
    "never comes": (profile(0.9), profile(0.01), (False, None, None, None, None)),
}


@pytest.mark.parametrize(("off", "error", "told"), PLANTED.values(), ids=PLANTED)
def test_what_a_planted_flight_is_said_to_do(certified, tmp_path, off, error, told):
    margin = planted(certified, 4.0 + off, error)
    (piece,) = margin_summary([margin])["pieces"]
    expected = dict(zip(TOLD, told, strict=True))
    if expected["covering_half_width"] is not None:
        expected["covering_half_width"] *= SCALE
    assert {name: piece[name] for name in TOLD} == pytest.approx(expected, abs=1e-9)
    for pair in piece["walls"]:
        first = np.flatnonzero(SCALE * np.abs(off[100:]) < pair["half_width"])[0] + 100
        assert pair["entered_s"] == pytest.approx(PERIOD * first)
        assert pair["error_max"] == pytest.approx(error[first:].max())
    widths = np.array(certified.certificate.pieces[0].wall_half_widths)
    assert len(piece["walls"]) == (widths > np.abs(off[100:]).min()).sum()
    way_in = {"begin_s": 1.0, "end_s": 1.99, "error_max": 0.6}
    if expected["settled_s"] == 2.0:
        assert piece["way_in"] == pytest.approx(way_in)
    write_summary(tmp_path, piece)


@pytest.fixture(scope="module")
def flown(ring_field, ring_certificate):
    """Margins of flights at a scale at which the field need not be made wider."""
    path = ReferencePath((Piece(0.6 * ring_field.cloud.points, closed=True),))
    # Its tangent is turned outward by 0.3 rad: a side wind that nobody told the vehicle of.
    cos, sin = np.cos(0.3), np.sin(0.3)
    network = Perceptron((np.array([[sin, -cos], [cos, sin]]),), (np.zeros(2),))
    blown = replace(ring_field, tangent_network=network)
    certified = CertifiedField(ring_field, ring_certificate, 0.6)
    return [
        flight_margin(certified, fly(field.rescaled(0.6), path, duration=8.0).flights[0], 0.45)
        for field in (ring_field, blown)
    ]


def test_a_real_flight_is_inside_of_the_margin_and_in_a_wind_of_a_wider_one(flown, tmp_path):
    calm, windy = (margin.summary() for margin in flown)
    assert calm["error_median"] < 1e-3
    assert calm["covering_half_width"] == pytest.approx(0.6 * 0.3)
    # At the start the vehicle stands.
    assert flown[0].log["error"].iloc[0] == pytest.approx(1.0, abs=0.01)
    # What the field is turned by, of a unit length: the inner walls do not tolerate it.
    assert windy["error_median"] == pytest.approx(2 * np.sin(0.15), rel=0.1)
    assert windy["covering_half_width"] == pytest.approx(0.6 * 0.8)
    summary = margin_summary(flown[:1])
    write_summary(tmp_path, summary)
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    assert summary["what_it_does_not_cover"] == list(NOT_COVERED)
    assert summary["e_star_max"] == 0.5
    both = margin_summary(flown)
    assert both["covering_half_width"] == windy["covering_half_width"]
    assert both["error_max"] == windy["error_max"] > calm["error_max"]


def test_no_flight_leaves_walls_that_tolerate_its_errors(flown):
    for margin in flown:
        off = np.abs(np.linalg.norm(margin.positions, axis=1) - 4.0)
        covering = [pair for pair in margin.walls if pair.hold]
        assert covering
        for pair in covering:
            since = margin.log["time"] >= pair.entered_s
            assert (0.6 * off[since] < pair.half_width).all()


def test_the_figure_holds_the_flight_the_walls_and_its_errors(certified, flown):
    margin = flown[0]
    figure = certificate_figure(certified.field, certified.certificate, [margin])
    plane, near, errors = figure.axes
    for axes in (plane, near):
        assert axes.get_aspect() == 1.0
        _, flight, _ = axes.get_lines()
        walls = [patch for patch in axes.patches if isinstance(patch, Polygon)]
        for wall, radius in zip(walls, (3.9, 3.7, 3.2, 4.1, 4.3, 4.8), strict=True):
            np.testing.assert_allclose(np.hypot(*wall.get_xy().T), radius)
        np.testing.assert_allclose(np.hypot(*flight.get_data())[-100:], 4.0, atol=0.05)
    # The window from near holds the place where the flight came between the walls.
    x, y = margin.positions[margin.settled][0]
    assert near.get_xlim()[0] < x < near.get_xlim()[1]
    assert near.get_ylim()[0] < y < near.get_ylim()[1]
    tolerated, measured = errors.get_lines()
    (piece,) = certified.certificate.pieces
    expected = [piece.wall_half_widths, piece.e_star]
    np.testing.assert_allclose(tolerated.get_data(), expected)
    expected[1] = [pair.error_max for pair in margin.walls]
    np.testing.assert_allclose(measured.get_data(), expected)


# Certificates.


def test_a_certificate_may_be_of_the_field_as_flown(ring_field, ring_certificate, tmp_path):
    wide = as_flown(ring_field, RING_SPEED, SCALE)
    metric = FieldForSpeed(ring_field.rescaled(SCALE), RING_SPEED)
    assert wide.approach_length > 2 * ring_field.approach_length
    x = np.random.default_rng(0).uniform(*ring_field.cloud.box, (200, 2))
    np.testing.assert_allclose(wide(x), metric(SCALE * x), atol=1e-12)
    # Slow or large enough, it is flown as it is.
    assert as_flown(ring_field, RING_SPEED, 1.0) is ring_field
    file = tmp_path / "wide.json"
    replace(ring_certificate, field_digest=field_digest(wide)).save(file)
    opened = CertifiedField.open(ring_field, file, RING_SPEED, SCALE)
    assert opened.field(x) == pytest.approx(wide(x))
    with pytest.raises(ConfigurationError, match=r"wide\.json is the certificate of another"):
        CertifiedField.open(ring_field, file, 2 * RING_SPEED, SCALE)


def test_a_certificate_is_found_by_its_file_or_folder(ring_field, ring_certificate, tmp_path):
    for place in (tmp_path, tmp_path / "none"):
        with pytest.raises(ConfigurationError, match=f"no certificate in {place}"):
            CertifiedField.open(ring_field, place, RING_SPEED)
    file = tmp_path / "certificate.json"
    ring_certificate.save(file)
    for place in (file, tmp_path):
        opened = CertifiedField.open(ring_field, place, RING_SPEED, SCALE)
        assert opened.certificate == ring_certificate
        assert (opened.field, opened.scale) == (ring_field, SCALE)
    nothing = replace(ring_certificate, walls=(None,), reason="a sink")
    nothing.save(file, overwrite=True)
    with pytest.raises(
        ConfigurationError, match=r"certificate\.json proves nothing of walls: a sink"
    ):
        CertifiedField.open(ring_field, tmp_path, RING_SPEED)
