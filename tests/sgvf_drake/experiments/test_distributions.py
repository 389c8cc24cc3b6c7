"""What differs between flights: its distributions, how they are drawn, how they are read."""

from dataclasses import asdict

import numpy as np
from pydrake.common.schema import Deterministic, Gaussian, Uniform, UniformDiscrete
import pytest
from scipy import stats

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import (
    Distributions,
    DisturbanceDistributions,
    SensorDistributions,
    StartDistributions,
    load_distributions,
)
from systems import Disturbance, SensorParameters

DRAWS = 10_000
DELAYS = (0.0, 0.01, 0.03)


@pytest.fixture(scope="module")
def drawn():
    """Values of 10,000 flights, each of a distribution of another kind."""
    distributions = Distributions(
        start=StartDistributions(along=Uniform(0.2, 0.7), beside=Gaussian(-0.1, 0.3)),
        disturbance=DisturbanceDistributions(
            wind=[Gaussian(1.0, 0.2), Gaussian(1.0, 0.2), Deterministic(3.0)], gust=0.25
        ),
        sensors=SensorDistributions(delay=UniformDiscrete(list(DELAYS))),
    )
    flights = [distributions.draw(7, number) for number in range(DRAWS)]
    return {name: np.array([flight[name] for flight in flights]) for name in flights[0]}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("start.along", stats.uniform(0.2, 0.5)),
        ("start.beside", stats.norm(-0.1, 0.3)),
        ("disturbance.wind_x", stats.norm(1.0, 0.2)),
        ("disturbance.wind_y", stats.norm(1.0, 0.2)),
        ("disturbance.mass_factor", stats.uniform(0.95, 0.1)),
    ],
)
def test_draws_have_their_distribution(drawn, name, expected):
    # Of draws that have it, one seed of a thousand is less likely.
    assert stats.kstest(drawn[name], expected.cdf).pvalue > 1e-3


def test_values_that_are_listed_are_equally_likely_and_fixed_ones_are_fixed(drawn):
    values, counts = np.unique(drawn["sensors.delay"], return_counts=True)
    assert tuple(values) == DELAYS
    assert stats.chisquare(counts).pvalue > 1e-3
    assert set(drawn["disturbance.wind_z"]) == {3.0}
    assert set(drawn["disturbance.gust"]) == {0.25}


def test_values_are_independent(drawn):
    names = ("start.along", "start.beside", "disturbance.wind_x", "disturbance.wind_y")
    table = np.array([drawn[name] for name in names])
    off_diagonal = np.corrcoef(table)[~np.eye(len(names), dtype=bool)]
    # Five deviations of the correlation of what is independent.
    assert np.abs(off_diagonal).max() < 5.0 / np.sqrt(DRAWS)
    # Neither does a flight depend on the one before it.
    for values in table:
        assert abs(np.corrcoef(values[1:], values[:-1])[0, 1]) < 5.0 / np.sqrt(DRAWS)


def test_a_flight_is_drawn_without_those_before_and_values_without_each_other():
    distributions = Distributions()
    assert distributions.draw(3, 41) == distributions.draw(3, 41)
    other_seed, other_flight = distributions.draw(4, 41), distributions.draw(3, 42)
    drawn = distributions.draw(3, 41)
    random = {name for name, value in drawn.items() if value != other_seed[name]}
    assert random == {name for name, value in drawn.items() if value != other_flight[name]}
    assert random == {
        *("start.along", "start.beside"),
        *(f"disturbance.{name}_factor" for name in ("mass", "inertia", "thrust")),
    }
    distributions.disturbance.mass_factor = Gaussian(1.0, 0.01)
    changed = distributions.draw(3, 41)
    assert {name for name in drawn if drawn[name] != changed[name]} == {
        "disturbance.mass_factor"
    }


def test_the_keys_are_those_of_the_systems():
    assert asdict(DisturbanceDistributions()).keys() == asdict(Disturbance()).keys()
    assert asdict(SensorDistributions()).keys() < asdict(SensorParameters()).keys()


def test_a_file_says_what_differs_and_the_rest_stays(tmp_path):
    file = tmp_path / "some.yaml"
    file.write_text(
        "disturbance: {wind: [!Uniform {min: 0, max: 2}, 0, 0], gust: 0.30000000000000004}\n"
        "sensors: {delay: !UniformDiscrete {values: [0, 0.02]}}\n"
    )
    loaded, default = load_distributions(file), load_distributions()
    assert loaded.disturbance.gust == 0.30000000000000004
    assert default.sensors is None
    drawn, usual = loaded.draw(0, 5), default.draw(0, 5)
    assert drawn["sensors.delay"] in (0.0, 0.02)
    differ = {name for name in usual if usual[name] != drawn[name]}
    assert differ == {"disturbance.wind_x", "disturbance.gust"}
    # It is written as it was read.
    again = tmp_path / "again.yaml"
    again.write_text(loaded.to_yaml())
    assert load_distributions(again).draw(0, 5) == drawn


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("disturbance: {winds: 1}", r"\['winds'\] were unknown"),
        ("weather: 1", r"\['weather'\] were unknown"),
        ("start: {along: !Uniform {min: 0, maxx: 1}}", r"\['maxx'\] were unknown"),
        ("start: {along: !Uniform {min: 2, max: 1}}", r"start.along: min 2.0 is above max 1.0"),
        (
            "disturbance: {gust: !Gaussian {mean: 1, stddev: -1}}",
            "disturbance.gust: stddev -1.0 is negative",
        ),
        ("sensors: {delay: !UniformDiscrete {values: []}}", "sensors.delay: there are no"),
        ("start: {above: .nan}", r"start.above: \[nan\] is not finite"),
        ("disturbance: {wind: [1, 2]}", "disturbance.wind must have 3 values, not 2"),
        ("start: {along: !Normal {mean: 0}}", "tag value 'Normal' did not match"),
        ("start: {along: far}", "could not convert string to float: 'far'"),
        ("start: 3", "3 is not made of keys and values"),
        ("", "NoneType"),
        ("[", "while parsing"),
    ],
)
def test_what_cannot_be_read_is_named_with_its_file(tmp_path, text, message):
    file = tmp_path / "some.yaml"
    file.write_text(text)
    with pytest.raises(ConfigurationError, match=rf"some\.yaml: .*{message}"):
        load_distributions(file)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigurationError, match=r"cannot read .*no\.yaml: No such file"):
        load_distributions(tmp_path / "no.yaml")
