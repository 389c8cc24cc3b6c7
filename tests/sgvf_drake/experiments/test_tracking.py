"""The velocity error of flights along the circle of 1 m, and what the tube tolerates."""

from dataclasses import replace
import json
import math

from matplotlib.image import imread
import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import fly
from sgvf_drake.experiments.figures.tracking import tracking_figure
from sgvf_drake.experiments.results import write_summary
from sgvf_drake.experiments.theorem import level_set_points
from sgvf_drake.experiments.tracking import flight_tracking
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.lyapunov.margin import Margins
from sgvf_drake.paths import ReferencePath
from systems import FieldForSpeed

SPEED = 0.45
C_IN, LEVEL = 0.06, 0.5
LEVELS = np.geomspace(0.02, 8.0, 12)


@pytest.fixture(scope="module")
def V(flight_field):  # noqa: N802
    return LyapunovFunction.of(flight_field)


@pytest.fixture(scope="module")
def inner(rings):
    """The circle of 1 m alone."""
    return ReferencePath(rings.pieces[:1])


def margins_of(field, function, speed):
    """e* of the field as it is flown, at 400 random points of each level set."""
    flown, e_star = FieldForSpeed(field, speed), []
    rng = np.random.default_rng(0)
    for level in LEVELS:
        x = level_set_points(function, level, 400, rng)
        gradient = function.gradient(x)
        inward = -(gradient * flown(x)).sum(axis=1) / np.linalg.norm(gradient, axis=1)
        e_star.append(inward.min())
    return Margins(LEVELS, np.array(e_star), np.zeros((len(LEVELS), 2)), np.zeros(len(LEVELS)))


@pytest.fixture(scope="module")
def tracked(flight_field, V, inner):
    return flight_tracking(
        flight_field,
        inner,
        SPEED,
        V,
        margins_of(flight_field, V, SPEED),
        c_in=C_IN,
        level=LEVEL,
        laps=1.0,
    )


def test_the_flight_is_that_of_fly(tracked, flight_field, inner):
    (flight,), (other,) = tracked.flights, fly(flight_field, inner, SPEED, laps=1.0).flights
    shared = list(other.log.columns.drop("cross_track_error"))
    assert [*shared, "V", "V_dot", "tracking_error"] == list(flight.log.columns)
    assert flight.log[shared].equals(other.log[shared])
    assert flight.exit is None


def test_V_is_that_of_the_positions(tracked, V):  # noqa: N802
    log = tracked.flights[0].log
    x, v = log[["x", "y"]].to_numpy(), log[["vx", "vy"]].to_numpy()
    np.testing.assert_array_equal(log["V"], V(x))
    np.testing.assert_allclose(log["V_dot"], V.derivative(x, v), rtol=1e-9, atol=1e-12)


def test_the_error_is_to_the_command_that_the_flight_was_given(tracked):
    # A command holds from its sample on, so the log shows it in the next row.
    log = tracked.flights[0].log
    velocity = log[["vx", "vy"]].to_numpy()[:-1]
    command = log[["vx_command", "vy_command"]].to_numpy()[1:]
    expected = np.linalg.norm(velocity - command, axis=1)
    np.testing.assert_allclose(log["tracking_error"][:-1], expected, atol=1e-12)
    # At take-off the vehicle stands.
    assert log["tracking_error"][0] == pytest.approx(SPEED, rel=0.01)


def test_the_settled_part_begins_with_the_entry_and_lasts(tracked):
    (flight,) = tracked.flights
    first = int(np.argmax(flight.settled))
    assert 50 < first < 300
    assert flight.settled[first:].all()
    assert (flight.log["V"][:first] > C_IN).all()
    assert flight.log["V"][first] <= C_IN


def test_the_error_is_covered_by_the_margin(tracked):
    summary = tracked.summary()
    (piece,) = summary["pieces"]
    assert summary["covered"] is piece["covered"] is True
    assert summary["stayed"] is True
    assert summary["tolerated_error_m_s"] == SPEED * tracked.margins.at(LEVEL)
    # About half of the speed is tolerated, and a tenth of it occurs, on the way in.
    assert 0.3 * SPEED < summary["tolerated_error_m_s"] < 0.7 * SPEED
    assert 0.01 < summary["tracking_error_max_m_s"] < 0.1
    assert piece["tracking_error_50_percent_m_s"] < 0.001
    assert piece["tracking_error_99_percent_m_s"] <= piece["tracking_error_max_m_s"]
    settled = tracked.flights[0].log[tracked.flights[0].settled]
    assert piece["V_max_settled"] == settled["V"].max() <= C_IN
    assert piece["settled_s"] == settled["time"].iloc[0]
    # V falls wherever the error is below what its own level tolerates.
    log = tracked.flights[0].log
    within = log[(log["V"] >= LEVELS[0]) & (log["V"] <= LEVELS[-1])]
    tolerated = [SPEED * tracked.margins.at(level) for level in within["V"]]
    falling = within["tracking_error"] < tolerated
    assert falling.sum() > 50
    assert (within["V_dot"][falling] < 0.0).all()


def test_the_smallest_covering_level_is_the_first_that_tolerates_the_error(tracked):
    largest = tracked.summary()["tracking_error_max_m_s"]
    for e_star, covered, smallest in (
        (np.where(LEVELS > 1.0, 1.0, 0.0), False, LEVELS[LEVELS > 1.0][0]),
        (np.full(len(LEVELS), largest / SPEED), False, None),
        (np.full(len(LEVELS), 1.01 * largest / SPEED), True, LEVELS[0]),
    ):
        margins = Margins(LEVELS, e_star, np.zeros((len(LEVELS), 2)), np.zeros(len(LEVELS)))
        (piece,) = replace(tracked, margins=margins).summary()["pieces"]
        assert piece["covered"] is covered
        assert piece["smallest_covering_level"] == smallest


@pytest.fixture(scope="module")
def stopped(flight_field, V, inner):
    """A flight whose level is so low that V, which varies along the path, goes above it."""
    margins = Margins(
        np.array([1e-4, 1.0]), np.array([0.1, 0.1]), np.zeros((2, 2)), np.zeros(2)
    )
    return flight_tracking(
        flight_field, inner, SPEED, V, margins, c_in=2e-4, level=4e-4, laps=1.0
    )


def test_a_flight_that_leaves_its_level_ends_there(stopped, V):
    (flight,) = stopped.flights
    left = flight.exit
    assert left.level == 4e-4 < left.V
    np.testing.assert_array_equal(left.V, V(left.position[None]))
    assert flight.log["time"].iloc[-1] <= left.time < 10.0
    summary = stopped.summary()
    assert summary["stayed"] is False
    assert summary["pieces"][0]["exit"] == str(left)


def test_a_flight_that_never_settles_says_so(flight_field, V, inner, tracked):
    result = flight_tracking(
        flight_field, inner, SPEED, V, tracked.margins, c_in=1e-9, level=LEVEL, laps=1.0
    )
    summary = result.summary()
    assert not result.flights[0].settled.any()
    assert summary["tracking_error_max_m_s"] is None
    assert summary["covered"] is False
    assert summary["pieces"][0]["covered"] is None


@pytest.mark.parametrize("name", ["tracked", "stopped"])
def test_the_summary_is_plain(request, tmp_path, name):
    summary = request.getfixturevalue(name).summary()
    write_summary(tmp_path, summary)
    assert json.loads((tmp_path / "summary.json").read_text()) == summary


def test_the_figure_has_two_panels(tracked, tmp_path):
    tracking_figure(tracked).savefig(tmp_path / "a.png")
    drawn = np.any(imread(tmp_path / "a.png")[..., :3] < 0.9, axis=2)
    for panel in np.array_split(drawn, 2, axis=1):
        assert 0.005 < panel.mean() < 0.9


def test_loss_of_control_is_one_clear_error(monkeypatch, flight_field, V, inner, tracked):
    def tip_over(*_):
        raise RuntimeError("gimbal-lock")

    monkeypatch.setitem(flight_tracking.__globals__, "advance", tip_over)
    with pytest.raises(ConfigurationError, match=r"lost control on piece 1 at 0\.45 m/s"):
        flight_tracking(flight_field, inner, SPEED, V, tracked.margins, c_in=C_IN, level=LEVEL)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"speed": 0.0}, "speed must be a positive number"),
        ({"speed": math.nan}, "speed must be a positive number"),
        ({"level": 0.05}, r"at least c_in = 0\.06, .* not 0\.05"),
        ({"c_in": 0.001, "level": 0.01}, r"known, 0\.02 to 8, not 0\.01"),
        ({"level": 9.0}, r"known, 0\.02 to 8, not 9"),
        ({"level": math.nan}, "not nan"),
    ],
)
def test_bad_values_are_refused(flight_field, V, inner, tracked, values, message):
    arguments = {"speed": SPEED, "c_in": C_IN, "level": LEVEL} | values
    with pytest.raises(ConfigurationError, match=message):
        flight_tracking(flight_field, inner, function=V, margins=tracked.margins, **arguments)
