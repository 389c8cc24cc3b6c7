"""Monte Carlo: rows that nothing but seed and number decide, and what they say together."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
import json
import os
import shutil
import signal

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from sgvf_drake.exceptions import (
    ConfigurationError,
    ExperimentError,
    FieldFileError,
    OutputExistsError,
)
from sgvf_drake.experiments import (
    Distributions,
    DisturbanceDistributions,
    MonteCarlo,
    SensorDistributions,
    StartDistributions,
    monte_carlo,
    replay_flight,
    run_monte_carlo,
    simulate,
    workers_of,
)
from sgvf_drake.experiments.intervals import fraction_interval
from sgvf_drake.fields import load_field
from systems import Disturbance
from tests.data.make import field_file
from tests.helpers import ink, names_in, summary_of

WINDY = DisturbanceDistributions(wind=[1.0, 0.0, 0.0], gust=0.3)
FLIGHTS = 6
RESULTS = {"summary.json", "flights.parquet", "montecarlo.png", "distributions.yaml", "trials"}


@pytest.fixture(scope="module")
def experiment():
    """Short flights in wind along circles of 1 m and 2 m, half of them with late sensors."""
    sensors = SensorDistributions(delay=0.01)
    distributions = Distributions(disturbance=WINDY, sensors=sensors)
    file = str(field_file("flight"))
    return MonteCarlo(file, seed=2, duration=2.5, distributions=distributions)


@pytest.fixture(scope="module")
def flown(experiment, tmp_path_factory):
    """The folder of the results, flown one after the other in this process."""
    out = tmp_path_factory.mktemp("flown")
    run_monte_carlo(experiment, out, flights=FLIGHTS)
    return out


def table_of(out):
    return pd.read_parquet(out / "flights.parquet")


def test_it_leaves_a_row_a_flight_and_what_they_say_together(flown, experiment):
    assert names_in(flown) == RESULTS
    assert 0.005 < ink(flown / "montecarlo.png") < 0.9
    summary, table = summary_of(flown), table_of(flown)
    assert list(table["number"]) == list(range(FLIGHTS))
    assert summary["flights"] == summary["flown"] == FLIGHTS
    assert summary["flights_per_s"] == pytest.approx(FLIGHTS / summary["wall_s"])
    assert summary["success_fraction"] == table["success"].mean() == 1.0
    rms = table["cross_track_rms_m"]
    assert summary["cross_track_rms_m"] == pytest.approx(np.sqrt((rms**2).mean()))
    assert (
        summary["cross_track_rms_low_m"]
        <= summary["cross_track_rms_m"]
        <= summary["cross_track_rms_high_m"]
    )
    # The worst come first.
    assert summary["worst"] == rms.sort_values(ascending=False).index[:5].tolist()
    assert table["mass_factor"].between(0.95, 1.05).all()
    assert table["seed"].nunique() == table["mass_factor"].nunique() == FLIGHTS
    assert (table["wind_x"] == 1.0).all()


def test_rows_are_the_same_to_the_last_bit_in_threads_and_in_another_order(
    flown, experiment, tmp_path
):
    with ThreadPoolExecutor(3) as executor:
        run_monte_carlo(experiment, tmp_path, flights=FLIGHTS, executor=executor)
    pd.testing.assert_frame_equal(table_of(tmp_path), table_of(flown), check_exact=True)
    backwards = [
        monte_carlo.measure_flight(flight, tmp_path)
        for flight in experiment.plan(range(FLIGHTS))[::-1]
    ]
    again = pd.DataFrame(backwards[::-1])
    expected = table_of(flown)[list(again.columns)]
    pd.testing.assert_frame_equal(again, expected, check_exact=True)


@pytest.mark.full
@pytest.mark.parametrize("where", ["processes", "dask"])
def test_rows_are_the_same_where_a_worker_is_killed(flown, experiment, tmp_path, where):
    from distributed import LocalCluster
    import psutil

    options = {"n_workers": 2, "threads_per_worker": 1, "host": "127.0.0.1"}
    this, killed = psutil.Process(), []

    def kill_one(stage, done, total):
        """Kills one that has measured, in the middle."""
        if done == 2 and not killed:
            spawned = [
                child
                for child in this.children(recursive=True)
                if "spawn_main" in " ".join(child.cmdline())
            ]
            killed.append(spawned[-1].pid)
            os.kill(killed[0], signal.SIGKILL)

    if where == "processes":
        run_monte_carlo(experiment, tmp_path, flights=FLIGHTS, jobs=2, progress=kill_one)
    else:
        with (
            LocalCluster(**options, dashboard_address=":0") as cluster,
            workers_of(cluster.scheduler_address) as executor,
        ):
            run_monte_carlo(
                experiment, tmp_path, flights=FLIGHTS, executor=executor, progress=kill_one
            )
    assert killed
    pd.testing.assert_frame_equal(table_of(tmp_path), table_of(flown), check_exact=True)


def test_more_flights_go_on_with_those_that_are_there(flown, experiment, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(flown, out)
    with pytest.raises(OutputExistsError, match=r"summary\.json"):
        run_monte_carlo(experiment, out, flights=FLIGHTS + 1)
    summary = run_monte_carlo(experiment, out, flights=FLIGHTS + 1, overwrite=True)
    assert summary["flown"] == 1
    first = table_of(out).head(FLIGHTS)
    pd.testing.assert_frame_equal(first, table_of(flown), check_exact=True)


def test_a_shared_diagram_flies_as_one_that_was_built_for_the_flight(experiment):
    for flight in experiment.plan(range(2)):
        _, log = monte_carlo.fly_planned(flight)
        site = monte_carlo._open_site(flight.shared, experiment.speed)
        alone = simulate(site.field, site.reference, flight.spec, flight.piece)
        pd.testing.assert_frame_equal(log, alone.log, check_exact=True)


def test_flights_are_held_against_walls(experiment, planted_certificate, tmp_path):
    # The last walls are about another circle than those that are flown.
    for name, radii, e_star, came, inside in (
        ("wide", (1.0, 2.0), 2.0, 3, 3),
        ("weak", (1.0, 2.0), 1e-6, 3, 0),
        ("away", (6.0,), 2.0, 0, 0),
    ):
        file = tmp_path / f"{name}.json"
        planted_certificate(
            load_field(experiment.field), *radii, half_widths=(0.5,), e_star=(e_star,)
        ).save(file)
        held = replace(experiment, certificate=str(file))
        summary = run_monte_carlo(held, tmp_path / name, flights=3)
        assert summary["certificate"] == {
            "came_between_walls": came,
            "stayed_between_walls": came,
            "inside_margin": inside,
        }
        table = table_of(tmp_path / name)
        assert table["inside_margin"].sum() == inside
        assert table["stayed_between_walls"].notna().sum() == came


def test_starts_are_where_the_distributions_have_them(experiment):
    start = StartDistributions(beside=0.4, above=-0.2)
    drawn = replace(experiment, distributions=Distributions(start=start))
    flights = drawn.plan(range(200))
    starts = np.array([flight.spec.start for flight in flights])
    radii = np.hypot(starts[:, 0], starts[:, 1])
    # 0.4 U of 0.5 m to the left of the circles, which are travelled counter-clockwise.
    off = radii - np.where(radii > 1.5, 2.0, 1.0)
    np.testing.assert_allclose(off, -0.2, atol=1e-3)
    np.testing.assert_allclose(starts[:, 2], 0.8)
    # As often as they are long.
    outer = np.mean(radii > 1.5)
    assert stats.binomtest(round(200 * outer), 200, 2 / 3).pvalue > 1e-3
    assert {flight.piece for flight in flights} == {0, 1}


def test_a_vehicle_that_loses_control_is_a_row_and_can_be_looked_at(experiment, tmp_path):
    # Forces that lag so much have its attitude swing ever wider.
    swinging = DisturbanceDistributions(motor_lag=0.3)
    lost = replace(experiment, duration=20.0, distributions=Distributions(disturbance=swinging))
    summary = run_monte_carlo(lost, tmp_path, flights=1)
    (row,) = table_of(tmp_path).to_dict("records")
    assert row["reason"] == "lost control"
    assert not row["success"]
    assert 1.0 < row["end_time"] < 20.0
    assert summary["reasons"] == {"lost control": 1}
    assert summary["success_fraction"] == summary["success_low"] == 0.0
    assert summary["cross_track_rms_m"] is None
    again = replay_flight(tmp_path, 0)
    assert again["same"] is True
    folder = tmp_path / "replay_0"
    assert names_in(folder) == {
        "summary.json",
        *(f"flight.{kind}" for kind in ("html", "parquet", "png")),
    }
    log = pd.read_parquet(folder / "flight.parquet")
    assert log["time"].iloc[-1] == row["end_time"]


def test_a_replay_tells_whether_it_is_the_same(flown, experiment, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(flown, out)
    assert replay_flight(out, 3)["same"] is True
    stored = summary_of(out / "replay_3")
    assert stored["cross_track_rms_m"] == table_of(out)["cross_track_rms_m"][3]
    table = table_of(out)
    table.loc[4, "end_x"] = np.nextafter(table["end_x"][4], 9.0)
    table.to_parquet(out / "flights.parquet")
    assert replay_flight(out, 4)["same"] is False
    with pytest.raises(OutputExistsError):
        replay_flight(out, 4)
    # One that is not in the results can be flown as well.
    assert replay_flight(out, FLIGHTS + 3)["same"] is None


# How a flight is judged: of the circle of 2 m, U is 0.5 m.


@pytest.fixture(scope="module")
def judge(experiment):
    (flight,) = experiment.plan(range(1))
    site = monte_carlo._open_site(flight.shared, experiment.speed)

    def judged(radius, speed=0.45, duration=20.0):
        """Judges a flight whose distance from the middle is a function of time."""
        time = np.arange(0.0, duration, 0.01)
        r = np.broadcast_to(radius(time), time.shape)
        angle = speed * time / 2.0
        log = pd.DataFrame({"time": time, "x": r * np.cos(angle), "y": r * np.sin(angle)})
        log["cross_track_error"] = site.reference.project(log[["x", "y"]].to_numpy()).distance
        return monte_carlo._judged(log, site, 0.45)

    return judged


def test_a_flight_that_reaches_the_path_and_stays_is_a_success(judge):
    row = judge(lambda time: 2.0 + 0.25 * np.exp(-time))
    assert row["success"] is True
    assert row["reason"] is None
    # When the exponential falls below 0.1 U.
    assert row["reached_s"] == pytest.approx(np.log(5.0), abs=0.02)
    assert row["cross_track_max_m"] == pytest.approx(0.05, abs=1e-3)
    expected = np.sqrt(0.05**2 / 2.0 / (20.0 - np.log(5.0)))
    assert row["cross_track_rms_m"] == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize(
    ("radius", "speed", "reason"),
    [
        (lambda time: 2.2, 0.45, "never reached the path"),
        (lambda time: 2.0 + 0.2 * (np.abs(time - 15.0) < 1.0), 0.45, "left the path again"),
        (lambda time: 2.0, 0.01, "stalled"),
    ],
)
def test_a_flight_that_fails_has_its_reason(judge, radius, speed, reason):
    row = judge(radius, speed)
    assert not row.get("success")
    assert row["reason"] == reason


def test_intervals_hold_a_known_rate_as_often_as_they_say():
    rng, rate, flights = np.random.default_rng(5), 0.93, 200
    held = [
        low <= rate <= high
        for _, low, high in (
            fraction_interval(int(count), flights)
            for count in rng.binomial(flights, rate, 2000)
        )
    ]
    # Wilson's interval holds it 95 % of the time; four deviations of the count.
    assert np.mean(held) == pytest.approx(0.95, abs=0.02)
    summaries = [
        monte_carlo.summary_of(
            pd.DataFrame(
                {
                    "number": range(100),
                    "success": True,
                    "reason": None,
                    "cross_track_rms_m": np.sqrt(rng.exponential(1.0, 100)),
                }
            )
        )
        for _ in range(200)
    ]
    held = [
        one["cross_track_rms_low_m"] <= 1.0 <= one["cross_track_rms_high_m"]
        for one in summaries
    ]
    assert np.mean(held) == pytest.approx(0.93, abs=0.06)


# What cannot be.


def test_what_cannot_be_flown_is_refused_before_anything_flies(experiment, tmp_path):
    with pytest.raises(ConfigurationError, match="flights must be at least 1, not 0"):
        run_monte_carlo(experiment, tmp_path, flights=0)
    for changes, message in (
        ({"seed": -1}, "seed must not be negative, but is -1"),
        (
            {"distributions": Distributions(start=StartDistributions(along=1.5))},
            r"flight 0 as it was drawn: start.along must be from 0 to 1, not 1.5",
        ),
        (
            {"distributions": Distributions(sensors=SensorDistributions(delay=0.013))},
            "flight 0 as it was drawn: delay must be a multiple",
        ),
        ({"certificate": str(tmp_path)}, "there is no certificate in"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            run_monte_carlo(replace(experiment, **changes), tmp_path, flights=2)
    with pytest.raises(FieldFileError):
        run_monte_carlo(replace(experiment, field=str(tmp_path / "no")), tmp_path)
    assert names_in(tmp_path) == set()


def test_a_replay_needs_its_results_and_its_field(flown, experiment, tmp_path):
    with pytest.raises(ConfigurationError, match="no results of a Monte Carlo in"):
        replay_flight(tmp_path, 0)
    out = tmp_path / "out"
    shutil.copytree(flown, out)
    with pytest.raises(ExperimentError, match=r"exact.safetensors is not the field of"):
        replay_flight(out, 0, field_file("exact"))
    summary = json.loads((out / "summary.json").read_text())
    (out / "summary.json").write_text(json.dumps({**summary, "experiment": {"no": 1}}))
    with pytest.raises(ConfigurationError, match="no results of a Monte Carlo in"):
        replay_flight(out, 0)


def test_a_field_that_changes_under_the_flights_is_told(experiment, tmp_path):
    file = tmp_path / "field.safetensors"
    shutil.copy(field_file("flight"), file)
    (flight,) = replace(experiment, field=str(file)).plan(range(1))
    shutil.copy(field_file("exact"), file)
    monte_carlo._open_site.cache_clear()
    with pytest.raises(ExperimentError, match="is not the field of these flights any more"):
        monte_carlo.measure_flight(flight, tmp_path)


def test_what_is_built_in_is_all_that_a_diagram_decides():
    gusty = Disturbance(gust=0.3, motor_lag=0.02, mass_factor=1.1)
    assert gusty.structure == Disturbance(gust=0.1, motor_lag=0.5).structure
    assert gusty.structure != Disturbance(motor_lag=0.02).structure
    assert gusty.structure != Disturbance(gust=0.3).structure
