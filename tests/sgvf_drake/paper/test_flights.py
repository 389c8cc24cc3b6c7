"""The flights: motion in closed form, one real flight, and verdicts."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paper import flights
from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.flights import Flights, flights_table, motion_of, parts_table
from sgvf_drake.paths import make_shape

SPEED, RADIUS, PERIOD = 0.5, 2.0, 0.01


def test_the_motion_on_a_circle_is_that_of_the_formulas_and_a_jump_shows():
    time = PERIOD * np.arange(2_000)
    angle = SPEED / RADIUS * time
    log = pd.DataFrame(
        {"time": time, "vx": -SPEED * np.sin(angle), "vy": SPEED * np.cos(angle), "vz": 0.0}
    )
    for number in (1, 2, 3, 4):
        log[f"force_{number}"] = 1.0 + 0.01 * number
    # The take-off is anything but smooth.
    log.loc[:50, ["vx", "force_1"]] = 0.0
    acceleration = SPEED**2 / RADIUS
    assert motion_of(log) == {
        "speed_min_m_s": pytest.approx(SPEED),
        "speed_max_m_s": pytest.approx(SPEED),
        "acceleration_max_m_s2": pytest.approx(acceleration, rel=1e-4),
        "jerk_rms_m_s3": pytest.approx(acceleration * SPEED / RADIUS, rel=1e-4),
        "velocity_step_m_s": pytest.approx(PERIOD * acceleration, rel=1e-4),
        "force_min_n": 1.01,
        "force_max_n": 1.04,
        "force_step_n": 0.0,
    }
    log.loc[1_000, "force_2"] += 0.5
    log.loc[1_200, "vx"] += 0.25
    jumped = motion_of(log)
    assert jumped["force_step_n"] == pytest.approx(0.5)
    assert jumped["velocity_step_m_s"] == pytest.approx(0.25, abs=0.01)


@pytest.fixture
def trained(monkeypatch, turning_field):
    """A field in closed form around both rings, as if it were trained."""
    cloud, _ = make_shape("concentric-flight")
    field = turning_field(cloud, recipe="robust")
    result = SimpleNamespace(guiding_field=field)
    monkeypatch.setattr("sgvf_drake.learning.train", lambda cloud, config: result)


def test_the_kind_flies_and_draws(trained, run_kind, tmp_path):
    # The inner ring alone; from ring to ring is flown by the tests of tours.
    kind = Flights(shapes=["concentric-flight"], tours=["1"], seeds=[0], paper_seeds=[])
    found = run_kind(kind, tmp_path)
    assert [*found.figures] == ["flight_concentric-flight_robust"]
    parts, told = found.tables.values()
    (part,) = parts.to_dict("records")
    assert part["part"] == "piece 1"
    assert 2 < part["RMS, mm mean"] < 10
    assert told["outcome"].tolist() == ["completed"]
    # The least that a circle of 1 m at 0.45 m/s asks for.
    assert 0.45**2 < told["largest acceleration, m/s^2"][0] < 1.0
    assert set(found.verdicts.values()) == {Verdict.HOLDS}


def test_lost_control_is_a_result(trained, monkeypatch, run_kind, tmp_path):
    def lost(*args, **options):
        raise ConfigurationError("the quadrotor lost control on the tour")

    monkeypatch.setattr(flights, "fly_tour", lost)
    kind = Flights(shapes=["concentric-flight"], tours=["1,2"], seeds=[], paper_seeds=[0])
    found = run_kind(kind, tmp_path)
    # There is nothing to draw, and no part to measure.
    assert found.figures == {}
    parts, told = found.tables.values()
    assert parts.empty
    assert told["outcome"].tolist() == ["lost control"]
    assert set(found.verdicts.values()) == {Verdict.FAILS}


def planted(seed=0, legs=2, **changes):
    row = {"shape": "concentric-flight", "recipe": "robust", "seed": seed, "tour": [0, 1]}
    row |= {"speed": 0.45, "error": None, "completed": True, "rms_m": 0.005, "max_m": 0.05}
    row |= {"summary": {"legs": [{}] * legs}, "tolerance_m": 0.05, "limit_n": 4.6}
    row |= {"speed_min_m_s": 0.4, "speed_max_m_s": 0.5, "velocity_step_m_s": 0.005}
    row |= {"force_min_n": 1.0, "force_max_n": 1.2, "force_step_n": 0.05}
    return row | {"acceleration_max_m_s2": 0.5, "jerk_rms_m_s3": 0.4} | changes


STUCK, ASTRAY = planted(7, legs=1, completed=False), planted(rms_m=0.06)


@pytest.mark.parametrize(
    ("flight", "branches", "smooth"),
    [
        (planted(), True, True),
        (STUCK, False, True),
        (ASTRAY, False, True),
        (planted(speed_max_m_s=0.7), True, False),
        (planted(force_min_n=0.0), True, False),
        (planted(force_max_n=4.6), True, False),
        (planted(velocity_step_m_s=0.03), True, False),
        (planted(force_step_n=0.3), True, False),
    ],
)
def test_a_verdict_follows_from_the_flights(flight, branches, smooth):
    def verdicts(*rows):
        return [found.verdict for found in kind.findings({"flights": pd.DataFrame(rows)})]

    kind = Flights(paper_seeds=[])
    alone, beside = verdicts(flight), verdicts(planted(), flight)
    for number, good in enumerate((branches, smooth)):
        assert alone[number] == (Verdict.HOLDS if good else Verdict.FAILS)
        assert beside[number] == (Verdict.HOLDS if good else Verdict.PARTLY)


def test_a_flight_that_is_not_completed_is_told_of():
    table = pd.DataFrame([planted(), STUCK, ASTRAY])
    branches, _ = Flights(paper_seeds=[]).findings({"flights": table})
    assert branches.evidence.startswith("flights that followed all of their pieces: 1 of 3; ")
    assert "the others: concentric-flight seed 7, 1 of 2 pieces, " in branches.evidence
    told = flights_table(table)
    assert told["outcome"].tolist() == ["completed", "1 of 2 pieces", "strayed"]
    assert told["RMS, mm"].tolist() == [5, 5, 60]
    assert told["speed, m/s"].tolist() == 3 * ["0.40-0.50"]
    assert told["force, %"].tolist() == 3 * ["21.7-26.1"]


def test_parts_are_told_in_the_order_of_the_flight():
    def part(piece, begin, **errors):
        figures = dict.fromkeys(("speed_min_m_s", "motor_force_min_n"), 0.4)
        figures |= dict.fromkeys(("speed_max_m_s", "motor_force_max_n"), 0.5)
        return {"piece": piece, "begin_s": begin, "end_s": begin + 2.0, **figures, **errors}

    errors = {"cross_track_rms_m": 0.005, "cross_track_max_m": 0.05}
    legs = [part(0, 0.0, **errors), part(1, 4.0, **errors), part(0, 8.0, **errors)]
    summary = {"legs": legs, "transfers": [part(1, 2.0), part(0, 6.0)]}
    table = parts_table(pd.DataFrame([planted(summary=summary)] * 2))
    names = ["piece 1", "transfer to 2", "piece 2", "transfer to 1", "piece 1 again"]
    assert table["part"].tolist() == names
    assert (table["flights"] == 2).all()
    assert table["RMS, mm mean"].isna().tolist() == [False, True, False, True, False]
    assert table["time, s mean"].tolist() == 5 * [2.0]
