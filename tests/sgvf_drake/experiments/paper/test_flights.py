"""The flights: motion in closed form, one real flight, and verdicts."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.outcome import Verdict
from sgvf_drake.experiments.paper.flights.claims import Flight, flights_claims
from sgvf_drake.experiments.paper.flights.experiment import Flights, flights_table
from sgvf_drake.experiments.paper.flights.measures import Motion, motion_of
from sgvf_drake.experiments.workbench import Workbench

SPEED, RADIUS, PERIOD = 0.5, 2.0, 0.01


@pytest.fixture
def circling():
    """The log of a perfect circle, after a take-off that is anything but smooth."""
    time = PERIOD * np.arange(2_000)
    angle = SPEED / RADIUS * time
    log = pd.DataFrame(
        {"time": time, "vx": -SPEED * np.sin(angle), "vy": SPEED * np.cos(angle), "vz": 0.0}
    )
    for number in (1, 2, 3, 4):
        log[f"force_{number}"] = 1.0 + 0.01 * number
    log.loc[:50, ["vx", "force_1"]] = 0.0
    return log


def test_the_motion_on_a_circle_is_that_of_the_formulas(circling):
    motion = motion_of(circling)
    assert motion.speed_min_m_s == pytest.approx(SPEED)
    assert motion.speed_max_m_s == pytest.approx(SPEED)
    assert motion.acceleration_max_m_s2 == pytest.approx(SPEED**2 / RADIUS, rel=1e-4)
    assert motion.velocity_step_m_s == pytest.approx(PERIOD * SPEED**2 / RADIUS, rel=1e-4)
    assert motion.jerk_rms_m_s3 == pytest.approx(SPEED**3 / RADIUS**2, rel=1e-4)
    assert (motion.force_min_n, motion.force_max_n) == (1.01, 1.04)
    assert motion.force_step_n == 0.0


def test_one_sample_off_is_a_jump(circling):
    circling.loc[1_000, "force_2"] += 0.5
    circling.loc[1_200, "vx"] += 0.25
    motion = motion_of(circling)
    assert motion.force_step_n == pytest.approx(0.5)
    assert motion.velocity_step_m_s == pytest.approx(0.25, abs=0.01)


@pytest.fixture
def outcome(flight_result, tmp_path, monkeypatch):
    """The inner ring alone; from ring to ring is flown by the tests of tours."""
    monkeypatch.setattr("sgvf_drake.learning.train", lambda cloud, config: flight_result)
    kind = Flights(shapes=["concentric-flight"], tours=["1"], seeds=[0], paper_seeds=[])
    return kind.run(Workbench(tmp_path))


def test_the_kind_flies_and_draws(outcome):
    names = [exhibit.name for exhibit in outcome.exhibits]
    assert names == ["flight_concentric-flight_robust", "flights_parts", "flights_all"]
    _, parts, flights = (exhibit.content for exhibit in outcome.exhibits)
    (part,) = parts.to_dict("records")
    assert part["part"] == "piece 1"
    assert 2 < part["RMS, mm mean"] < 10
    assert flights["outcome"].tolist() == ["completed"]
    # The least that a circle of 1 m at 0.45 m/s asks for.
    assert 0.45**2 < flights["largest acceleration, m/s^2"][0] < 1.0
    assert [claim.verdict for claim in outcome.claims] == [Verdict.HOLDS, Verdict.HOLDS]


def test_lost_control_is_a_result(flight_result, tmp_path, monkeypatch):
    def lost(*args, **options):
        raise ConfigurationError("the quadrotor lost control on the tour")

    monkeypatch.setattr("sgvf_drake.learning.train", lambda cloud, config: flight_result)
    monkeypatch.setattr("sgvf_drake.experiments.paper.flights.trials.fly_tour", lost)
    kind = Flights(shapes=["concentric-flight"], tours=["1,2"], seeds=[], paper_seeds=[0])
    outcome = kind.run(Workbench(tmp_path))
    # There is nothing to draw, and no part to measure.
    assert [exhibit.name for exhibit in outcome.exhibits] == ["flights_parts", "flights_all"]
    assert outcome.exhibits[-1].content["outcome"].tolist() == ["lost control"]
    assert [claim.verdict for claim in outcome.claims] == [Verdict.FAILS, Verdict.FAILS]


@pytest.mark.parametrize(
    ("tours", "said"),
    [
        (["1"], "there are 2 shapes to fly, but 1 tours"),
        (["1,a", "1"], "as in '1,2,1', not '1,a'"),
        (["1,2", "1,3"], "pieces from 1 to 2 as in '1,2,1', not '1,3'"),
        (["0", "1"], "not '0'"),
    ],
)
def test_a_tour_that_is_none_is_an_error(tours, said, tmp_path):
    with pytest.raises(ConfigurationError, match=said):
        Flights(tours=tours).run(Workbench(tmp_path))


MOTION = Motion(
    speed_min_m_s=0.4,
    speed_max_m_s=0.5,
    acceleration_max_m_s2=0.5,
    jerk_rms_m_s3=0.4,
    velocity_step_m_s=0.005,
    force_min_n=1.0,
    force_max_n=1.2,
    force_step_n=0.05,
)
FLIGHT = Flight(
    shape="concentric-flight",
    recipe="robust",
    seed=0,
    error=None,
    completed=True,
    legs=(2, 2),
    rms_m=0.005,
    max_m=0.05,
    motion=MOTION,
    tolerance_m=0.05,
    speed_m_s=0.45,
    limit_n=4.6,
)


@pytest.mark.parametrize(
    ("change", "follows"),
    [({}, True), ({"completed": False, "legs": (1, 2)}, False), ({"rms_m": 0.06}, False)],
)
def test_who_follows(change, follows):
    flight = replace(FLIGHT, **change)
    assert flight.follows == follows
    branches, _ = flights_claims([flight])
    assert branches.verdict == (Verdict.HOLDS if follows else Verdict.FAILS)
    branches, _ = flights_claims([FLIGHT, flight])
    assert branches.verdict == (Verdict.HOLDS if follows else Verdict.PARTLY)


@pytest.mark.parametrize(
    "change",
    [
        {"speed_max_m_s": 0.7},
        {"force_min_n": 0.0},
        {"force_max_n": 4.6},
        {"velocity_step_m_s": 0.03},
        {"force_step_n": 0.3},
    ],
)
def test_what_is_not_smooth(change):
    assert FLIGHT.is_smooth
    rough = replace(FLIGHT, motion=replace(MOTION, **change))
    assert not rough.is_smooth
    assert flights_claims([FLIGHT])[1].verdict == Verdict.HOLDS
    assert flights_claims([FLIGHT, rough])[1].verdict == Verdict.PARTLY
    assert flights_claims([rough])[1].verdict == Verdict.FAILS


def test_a_flight_that_is_not_completed_is_told_of():
    stuck = replace(FLIGHT, seed=7, completed=False, legs=(1, 2))
    branches, _ = flights_claims([FLIGHT, stuck])
    assert "concentric-flight seed 7, 1 of 2 pieces" in branches.evidence
    astray = replace(FLIGHT, rms_m=0.06)
    table = flights_table([FLIGHT, stuck, astray])
    assert table["outcome"].tolist() == ["completed", "1 of 2 pieces", "strayed"]
