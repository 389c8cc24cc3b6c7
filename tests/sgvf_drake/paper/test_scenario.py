"""Scenarios: what is in the package, how overrides are applied, and what bad files say."""

from dataclasses import asdict

import pytest

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.paper import load_scenario, override_names, scenario, scenario_names
from sgvf_drake.paper.scenario import KINDS

QUICK = "quick"


def experiment_of(name, *overrides, settings=()):
    return asdict(load_scenario(name, overrides, settings).experiment)


# The scenarios of the package.


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_is_whole_and_has_a_quick_case(name, tmp_path):
    full, quick = load_scenario(name), load_scenario(name, [QUICK])
    for loaded in (full, quick):
        assert loaded.title
        assert loaded.source
        assert isinstance(loaded.experiment, KINDS)
        assert loaded.experiment.seeds
        # What is run can be written and read back.
        path = tmp_path / "scenario.yaml"
        path.write_text(loaded.to_yaml())
        assert load_scenario(path) == loaded
    assert (full.title, full.source) == (quick.title, quick.source)
    assert full.experiment != quick.experiment
    assert len(quick.experiment.seeds) <= len(full.experiment.seeds)


@pytest.mark.full
@pytest.mark.parametrize("name", scenario_names())
def test_every_quick_case_is_measured_drawn_and_told(name, tmp_path, run_kind):
    found = run_kind(load_scenario(name, [QUICK]).experiment, tmp_path)
    assert found.figures
    assert found.tables
    assert found.verdicts


@pytest.mark.parametrize("overrides", [[], [QUICK]])
@pytest.mark.parametrize("name", scenario_names())
def test_the_options_of_every_scenario_can_be_used(name, overrides, tmp_path, monkeypatch):
    def begin(*_):
        raise RuntimeError("the work begins")

    monkeypatch.setattr(Workbench, "run", begin)
    with pytest.raises(RuntimeError, match="the work begins"):
        load_scenario(name, overrides).experiment.measure(Workbench(tmp_path))


def test_every_kind_has_a_scenario():
    used = {type(load_scenario(name).experiment) for name in scenario_names()}
    assert used == set(KINDS)
    assert len({kind.__name__ for kind in KINDS}) == len(KINDS)
    assert scenario.NoExperiment not in KINDS


@pytest.mark.parametrize(
    ("name", "setting", "said"),
    [
        ("baselines", "cases=[circles]", r"no case 'circles' \(they are ordered"),
        ("baselines", "methods=[spline]", "no method 'spline'"),
        ("baselines", "methods=[]", "needs a method"),
        ("fig3_flights", "tours=['1']", "there are 2 shapes to fly, but 1 tours"),
        ("fig3_flights", "tours=['1,a', '1']", "as in '1,2,1', not '1,a'"),
        ("fig3_flights", "tours=['1,2', '1,3']", "pieces from 1 to 2 .* not '1,3'"),
        ("fig3_flights", "tours=['0', '1']", "not '0'"),
        ("fig4_robust_recipe", "variants=[no-hope]", "no variant 'no-hope'"),
        ("fig4_robust_recipe", "variants=[complete]", "no variant 'complete'"),
        ("fig6_corners", "angle_polygons=[3, 6]", r"not \[3, 6\]"),
        ("section2_stein", "draws=0", "a positive multiple of 20000, not 0"),
        ("section2_stein", "draws=20001", "a positive multiple of 20000, not 20001"),
    ],
)
def test_an_option_that_cannot_be_used_is_refused_before_anything_runs(
    tmp_path, name, setting, said
):
    kind = load_scenario(name, settings=[setting]).experiment
    with pytest.raises(ConfigurationError, match=said):
        kind.measure(Workbench(tmp_path / "trials"))
    assert not list(tmp_path.iterdir())


# Overrides and settings.


def test_an_override_keeps_what_it_does_not_name(fake_scenarios):
    fake_scenarios.write("a", quick="size: 1", seeds=[7, 8], exhibit="other")
    full, quick = experiment_of("a"), experiment_of("a", QUICK)
    assert (full["size"], full["seeds"], full["exhibit"]) == (3, [7, 8], "other")
    assert quick == {**full, "size": 1}


def test_overrides_are_applied_in_their_order(fake_scenarios):
    path = fake_scenarios.write("a", quick="size: 1")
    more = "more:\n  experiment: !FakeExperiment\n    size: 5\n    seeds: [9]\n"
    path.write_text(path.read_text() + more)
    fake_scenarios.write("b")
    assert scenario_names() == ["a", "b"]
    base = experiment_of("a")
    assert override_names("a") == [QUICK, "more"]
    assert experiment_of("a", "more", QUICK) == {**base, "size": 1, "seeds": [9]}
    assert experiment_of("a", QUICK, "more") == {**base, "size": 5, "seeds": [9]}


def test_settings_come_last(fake_scenarios):
    fake_scenarios.write("a", quick="size: 1")
    settings = ["size=4", "seeds=[5, 6]", "size=8", "exhibit=x=y"]
    changed = {"size": 8, "seeds": [5, 6], "exhibit": "x=y"}
    base = experiment_of("a", QUICK)
    assert experiment_of("a", QUICK, settings=settings) == {**base, **changed}


# What cannot be used: the message names the file and what is wrong in it.

KIND = "experiment: !FakeExperiment"
BAD = [
    (f"scenario:\n  sorce: x\n  {KIND} {{}}", [], ("scenario", "sorce")),
    (f"scenario:\n  {KIND} {{sise: 3}}", [], ("scenario", "sise")),
    (f"scenario:\n  {KIND} {{}}\nquick:\n  {KIND} {{sise: 3}}", [QUICK], ("quick", "sise")),
    (f"scenario:\n  {KIND} {{size: many}}", [], ("scenario", "many")),
    (f"scenario:\n  {KIND} {{size: [1]}}", [], ("scenario", "size")),
    ("scenario:\n  experiment: !Nothing {}", [], ("scenario", "Nothing")),
    ("scenario: {title: x}", [], ("needs a kind", "!FakeExperiment")),
    ("scenario: 5", [], ("scenario",)),
    (f"other:\n  {KIND} {{}}", [], ("there is no part 'scenario'",)),
    ("", [], ("there is no part 'scenario'",)),
    ("[1, 2]", [], ("there is no part 'scenario'",)),
    ("scenario: [", [], ("line",)),
    (f"scenario:\n  {KIND} {{}}", ["slow"], ("no override 'slow'", "it has none")),
    (f"scenario:\n  {KIND} {{}}\nquick: {{}}", ["slow"], ("'slow'", "it has quick")),
    (f"scenario:\n  {KIND} {{}}", ["scenario"], ("no override 'scenario'",)),
]


@pytest.mark.parametrize(("text", "overrides", "words"), BAD)
def test_a_bad_file_is_named_with_what_is_wrong(
    fake_scenarios, tmp_path, text, overrides, words
):
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigurationError) as error:
        load_scenario(path, overrides)
    message = str(error.value)
    assert str(path) in message
    assert "\n" not in message
    for word in words:
        assert word in message


@pytest.mark.parametrize("setting", ["size", "sise=1", "size=many", "size=2.5", "size=[1"])
def test_a_bad_setting_is_named(fake_scenarios, setting):
    fake_scenarios.write("a")
    with pytest.raises(ConfigurationError) as error:
        load_scenario("a", settings=[setting])
    assert repr(setting) in str(error.value)


@pytest.mark.parametrize("seeds", ["[]", "[0, 1, 0]", "[-1]"])
def test_seeds_that_are_none_or_the_same_are_refused(fake_scenarios, seeds):
    fake_scenarios.write("a")
    with pytest.raises(ConfigurationError) as error:
        load_scenario("a", settings=[f"seeds={seeds}"])
    assert f"seeds must be different numbers from 0 on, at least one, not {seeds}" in str(
        error.value
    )


def test_a_scenario_that_is_not_there_is_named(fake_scenarios, tmp_path):
    fake_scenarios.write("a")
    with pytest.raises(ConfigurationError, match=r"no scenario 'b' \(they are a; "):
        load_scenario("b")
    with pytest.raises(ConfigurationError, match=r"no scenario file .*none\.yaml"):
        load_scenario(tmp_path / "none.yaml")


def test_a_file_need_not_be_of_the_package(fake_scenarios, tmp_path):
    path = fake_scenarios.write("a", size=6).rename(tmp_path / "own.yaml")
    assert scenario_names() == []
    assert load_scenario(str(path)).experiment.size == 6
    assert override_names(path) == [QUICK]
