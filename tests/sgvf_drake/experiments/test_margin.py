"""Flights against a certificate: planted errors on a ring in closed form, and real flights."""

from dataclasses import replace
import json

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.certificate import Conditions
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import CertifiedField, as_flown, flight_margin, fly
from sgvf_drake.experiments.figures.certificate import certificate_figure
from sgvf_drake.experiments.fly import PieceFlight
from sgvf_drake.experiments.margin import NOT_COVERED, margin_summary
from sgvf_drake.experiments.results import write_summary
from sgvf_drake.fields import Perceptron
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.paths import Piece, ReferencePath
from systems import FieldForSpeed

SPEED, SCALE, PERIOD = 0.5, 0.25, 0.01


@pytest.fixture
def certified(ring_field, ring_certificate):
    return CertifiedField(ring_field, ring_certificate, SCALE)


def planted(field, radius, error, scale=SCALE):
    """A flight in m around a ring, at these radii (units) with these errors, parts of SPEED.

    Errors point in a direction that turns, since only their size is to count.
    """
    count = len(error)
    time = PERIOD * np.arange(count)
    angle = 0.3 * time
    x = np.broadcast_to(radius, count)[:, None] * np.column_stack(
        [np.cos(angle), np.sin(angle)]
    )
    away = np.column_stack([np.cos(7 * angle), np.sin(7 * angle)])
    velocity = SPEED * (field(x) + np.asarray(error)[:, None] * away)
    log = pd.DataFrame({"time": time, "x": scale * x[:, 0], "y": scale * x[:, 1]})
    return PieceFlight(0, log.assign(vx=velocity[:, 0], vy=velocity[:, 1]), {})


def radius_at(certified, level):
    """The radius outside of the ring at which V is a level, on the first ray."""
    r = np.linspace(4.0, 5.5, 20_001)
    V = certified.V(np.column_stack([r, 0 * r]))
    return r[np.argmin(np.abs(V - level))]


def test_the_error_is_the_distance_of_the_velocity_from_the_field(certified):
    error = np.linspace(0.0, 0.3, 300)
    table = flight_margin(certified, planted(certified.field, 4.2, error), SPEED).table
    np.testing.assert_allclose(table["error"], error, atol=1e-12)
    x = table[["x", "y"]].to_numpy()
    np.testing.assert_allclose(np.linalg.norm(x, axis=1), 4.2)
    V = LyapunovFunction.of(certified.field, certified.certificate.sigma)
    np.testing.assert_allclose(table["V"], V(x), atol=1e-9)
    np.testing.assert_allclose(table["ratio"], table["error"] / table["e_star"])


def test_each_level_has_the_margin_of_its_interval(certified):
    # Below c_in that of the tube's border, above c_out none.
    levels = np.array([0.0, 0.01, 0.05, 0.19, 0.21, 0.9, 1.1, 5.9, 6.1])
    expected = [0.1, 0.1, 0.1, 0.1, 0.25, 0.25, 0.4, 0.4, 0.0]
    np.testing.assert_array_equal(certified.e_star(levels), expected)


@pytest.mark.parametrize(("error", "inside"), [(0.0, True), (0.099, True), (0.101, False)])
def test_in_the_tube_the_margin_is_that_of_its_border(certified, error, inside):
    margin = flight_margin(certified, planted(certified.field, 4.0, [error] * 500), SPEED)
    summary = margin.summary()
    assert margin.inside is summary["inside_margin"] is inside
    assert summary["worst_ratio"] == pytest.approx(error / 0.1, abs=1e-9)
    # Counted from the end of the take-off on, a second.
    assert summary["settled_s"] == 1.0
    assert summary["time_outside_s"] == pytest.approx(0.0 if inside else 4.0)
    assert summary["stayed_in_tube"] is True
    assert summary["inside_from_s"] == (0.0 if inside else None)


@pytest.mark.parametrize(
    ("error", "level"), [(0.05, 0.04), (0.15, 0.2), (0.3, 1.0), (0.5, None)]
)
def test_the_lowest_level_that_tolerates_the_error(certified, error, level):
    profile = np.zeros(500)
    profile[300] = error
    summary = flight_margin(certified, planted(certified.field, 4.0, profile), SPEED).summary()
    assert summary["covering_level"] == level
    assert summary["error_max"] == pytest.approx(error)
    assert summary["error_median"] == pytest.approx(0.0, abs=1e-12)


def test_the_way_in_is_told_apart(certified):
    # At V = 0.5 until 2 s with what this level tolerates, and a moment of more; then in.
    radius = np.full(500, radius_at(certified, 0.5))
    radius[200:] = 4.0
    error = np.full(500, 0.2)
    error[:100], error[150:160], error[200:] = 1.0, 0.26, 0.02
    summary = flight_margin(certified, planted(certified.field, radius, error), SPEED).summary()
    assert summary["settled_s"] == 2.0
    assert summary["inside_margin"] is True
    assert summary["error_max"] == pytest.approx(0.02)
    assert summary["inside_from_s"] == pytest.approx(1.6)
    way = summary["way_in"]
    assert (way["begin_s"], way["end_s"]) == (1.0, pytest.approx(1.99))
    assert way["worst_ratio"] == pytest.approx(0.26 / 0.25)
    assert way["time_outside_s"] == pytest.approx(0.1)


def test_a_flight_that_leaves_the_set_has_no_margin_there(certified):
    radius = np.full(500, 4.0)
    radius[400:450] = radius_at(certified, 6.5)
    summary = flight_margin(
        certified, planted(certified.field, radius, np.full(500, 0.01)), SPEED
    ).summary()
    assert summary["stayed_in_certified_set"] is False
    assert summary["stayed_in_tube"] is False
    assert summary["inside_margin"] is False
    assert summary["worst_ratio"] == np.inf
    assert summary["time_outside_s"] == pytest.approx(0.5)
    assert summary["covering_level"] is None


def test_a_flight_that_never_settles_says_so(certified, tmp_path):
    flight = planted(certified.field, radius_at(certified, 0.5), np.full(300, 0.01))
    summary = margin_summary([flight_margin(certified, flight, SPEED)])
    assert summary["inside_margin"] is False
    assert summary["error_max"] is None
    assert summary["pieces"][0]["settled_s"] is None
    write_summary(tmp_path, summary)


@pytest.fixture(scope="module")
def flown(ring_field):
    """Flights of a lap at the scale at which the field need not be made wider."""
    path = ReferencePath((Piece(0.6 * ring_field.cloud.points, closed=True),))
    # Its tangent is turned outward by 0.3 rad: a side wind that nobody told the vehicle of.
    cos, sin = np.cos(0.3), np.sin(0.3)
    network = Perceptron((np.array([[sin, -cos], [cos, sin]]),), (np.zeros(2),))
    blown = replace(ring_field, tangent_network=network)
    return {
        name: fly(field.rescaled(0.6), path, 0.45, laps=1.0).flights[0]
        for name, field in (("as certified", ring_field), ("blown", blown))
    }


def test_a_real_flight_settles_inside_the_margin(certified, flown):
    margin = flight_margin(replace(certified, scale=0.6), flown["as certified"], 0.45)
    summary = margin.summary()
    # The last of the take-off is brought into the tube; from then on it is far inside.
    assert summary["inside_from_s"] < 2.0
    assert summary["error_median"] < 1e-3
    assert summary["covering_level"] is not None
    assert summary["stayed_in_tube"] is True
    # At the start the vehicle stands.
    assert margin.table["error"].iloc[0] == pytest.approx(1.0, abs=0.01)


def test_in_a_wind_it_is_outside(certified, flown):
    summary = flight_margin(replace(certified, scale=0.6), flown["blown"], 0.45).summary()
    assert summary["inside_margin"] is False
    assert summary["inside_from_s"] is None
    # What the field is turned by, of a unit length.
    assert summary["error_median"] == pytest.approx(2 * np.sin(0.15), rel=0.1)


def test_the_summary_is_plain_and_names_its_limits(certified, flown, tmp_path):
    margin = flight_margin(replace(certified, scale=0.6), flown["as certified"], 0.45)
    summary = margin_summary([margin])
    write_summary(tmp_path, summary)
    assert json.loads((tmp_path / "summary.json").read_text()) == summary
    assert summary["what_it_does_not_cover"] == list(NOT_COVERED)
    assert (summary["e_star_tube"], summary["e_star_max"]) == (0.1, 0.4)


def test_the_figure_holds_the_flight_and_its_error(certified, flown):
    margin = flight_margin(replace(certified, scale=0.6), flown["as certified"], 0.45)
    figure = certificate_figure(certified.field, certified.certificate, [margin])
    plane, near, errors = figure.axes
    for axes in (plane, near):
        assert axes.get_aspect() == 1.0
        x, y = axes.get_lines()[1].get_data()
        np.testing.assert_allclose(np.hypot(x, y)[-100:], 4.0, atol=0.05)
    # The window from near holds the place where the flight entered the tube.
    entry = margin.table[margin.settled].iloc[0]
    assert near.get_xlim()[0] < entry["x"] < near.get_xlim()[1]
    assert near.get_ylim()[0] < entry["y"] < near.get_ylim()[1]
    *parts, covering = errors.get_lines()
    drawn = np.concatenate([line.get_ydata() for line in parts])
    assert len(drawn) == len(margin.table)
    assert drawn.max() == pytest.approx(1.0, abs=0.01)
    assert covering.get_xdata()[0] == margin.summary()["covering_level"]
    alone = certificate_figure(certified.field, certified.certificate)
    assert len(alone.axes) == 2


def test_a_certificate_is_found_by_its_file_or_folder(ring_field, ring_certificate, tmp_path):
    file = tmp_path / "certificate.json"
    ring_certificate.save(file)
    for place in (file, tmp_path):
        opened = CertifiedField.open(ring_field, place, SPEED, SCALE)
        assert opened.certificate == ring_certificate
        assert opened.field is ring_field
        assert opened.scale == SCALE


def test_a_certificate_may_be_of_the_field_as_flown(ring_field, ring_certificate, tmp_path):
    wide = as_flown(ring_field, SPEED, SCALE)
    metric = FieldForSpeed(ring_field.rescaled(SCALE), SPEED)
    assert wide.approach_length > 2 * ring_field.approach_length
    x = np.random.default_rng(0).uniform(*ring_field.cloud.box, (200, 2))
    np.testing.assert_allclose(wide(x), metric(SCALE * x), atol=1e-12)
    # Slow or large enough, it is flown as it is.
    assert as_flown(ring_field, SPEED, 1.0) is ring_field
    file = tmp_path / "wide.json"
    replace(ring_certificate, field_digest=field_digest(wide)).save(file)
    assert CertifiedField.open(ring_field, file, SPEED, SCALE).field(x) == pytest.approx(
        wide(x)
    )
    with pytest.raises(ConfigurationError, match=r"wide\.json is the certificate of another"):
        CertifiedField.open(ring_field, file, 2 * SPEED, SCALE)


def test_what_is_no_certificate(ring_field, ring_certificate, tmp_path):
    for place in (tmp_path, tmp_path / "none"):
        with pytest.raises(ConfigurationError, match=f"no certificate in {place}"):
            CertifiedField.open(ring_field, place, SPEED)
    file = tmp_path / "certificate.json"
    replace(ring_certificate, levels=(), e_star=(), reason="a sink").save(file)
    with pytest.raises(ConfigurationError, match=r"certificate\.json proves nothing: a sink"):
        CertifiedField.open(ring_field, tmp_path, SPEED)


def test_levels_are_those_of_the_certificate(certified):
    # What the certificate takes off is not found anew.
    x = np.random.default_rng(0).uniform(-4.5, 4.5, (2500, 2))
    conditions = certified.certificate.conditions
    shifted = Conditions(**{**vars(conditions), "lowest": conditions.lowest - 0.5})
    other = replace(certified, certificate=replace(certified.certificate, conditions=shifted))
    np.testing.assert_allclose(other.V(x), certified.V(x) + 0.5)
