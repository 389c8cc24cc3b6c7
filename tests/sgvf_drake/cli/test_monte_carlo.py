"""The command `montecarlo`: its results, a flight again, and what it refuses."""

import pandas as pd
import pytest

from sgvf_drake.experiments import load_distributions
from tests.helpers import names_in, summary_of


@pytest.fixture(scope="module")
def flown(run, trained, tmp_path_factory):
    """The folder of three flights in wind."""
    folder = tmp_path_factory.mktemp("flown")
    file = folder / "some.yaml"
    file.write_text("start: {beside: 0.3}\ndisturbance: {wind: [5, 5, 5], drag: 0.2}\n")
    options = ("--flights", 3, "--duration", 2, "--wind", "1,0", "--gust", 0.2, "--seed", 4)
    out = folder / "out"
    more = ("--distributions", file, "--compensate", "--out", out)
    assert run("montecarlo", trained, *options, *more) == 0
    return out


def test_options_stand_above_the_file(flown):
    table = pd.read_parquet(flown / "flights.parquet")
    assert (table["wind_x"] == 1.0).all()
    assert not table[["wind_y", "wind_z"]].to_numpy().any()
    assert (table["drag"] == 0.2).all()
    assert (table["gust"] == 0.2).all()
    assert load_distributions(flown / "distributions.yaml").start.beside == 0.3
    summary = summary_of(flown)
    assert summary["experiment"]["seed"] == 4
    assert summary["experiment"]["compensate"] is True
    keys = "flights success_fraction success_low success_high cross_track_rms_m wall_s"
    assert {*keys.split(), "flights_per_s", "worst"} <= summary.keys()


def test_it_prints_what_it_found_and_flies_one_again(run, trained, flown, capsys):
    number = summary_of(flown)["worst"][0]
    again = ("montecarlo", trained, "--out", flown, "--replay", number)
    assert run(*again) == 0
    printed = capsys.readouterr()
    assert "yes, to the last bit" in printed.out
    rms = summary_of(flown / f"replay_{number}")["cross_track_rms_m"]
    assert f"{1000 * rms:.3g} mm" in printed.out
    assert printed.err == ""
    names = {f"flight.{kind}" for kind in ("html", "parquet", "png")}
    assert names_in(flown / f"replay_{number}") == {"summary.json", *names}
    more = ("--flights", 3, "--duration", 2, "--wind", "1,0", "--gust", 0.2, "--seed", 4)
    assert run("montecarlo", trained, *more, "--out", flown, "--overwrite") == 0
    printed = capsys.readouterr().out
    for words in ("successes", "cross-track RMS", "worst flights", "flown now"):
        assert words in printed


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--wind", "fast"), "--wind fast is no velocity"),
        (("--flights", 0), "at least 1, not 0"),
        (("--duration", 0.5), "longer than 1 s"),
        (("--distributions", "no.yaml"), "cannot read no.yaml"),
        (("--replay", 1), "no results of a Monte Carlo"),
        (("--jobs", 2, "--scheduler", "tcp://a:1"), "either the jobs or the scheduler"),
        (("--jobs", 0), "jobs must be at least 1"),
    ],
)
def test_what_cannot_be_is_refused(refused, trained, tmp_path, options, message):
    assert message in refused("montecarlo", trained, "--out", tmp_path / "out", *options)
    assert names_in(tmp_path) == set()
