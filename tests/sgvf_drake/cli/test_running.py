"""The commands run and scenarios: what they print and leave, and their exit status."""

import pytest

from sgvf_drake.paper import load_scenario, scenario_names
from tests.helpers import summary_of


def test_a_scenario_is_run_with_its_options(run, fake_scenarios, tmp_path, capsys):
    fake_scenarios.write("alpha", quick="seeds: [5]", verdict="holds in part")
    out = tmp_path / "out"
    options = ("--override", "quick", "--set", "size=7")
    assert run("run", "alpha", "--out", out, *options) == 0
    options = summary_of(out)["options"]
    assert (options["seeds"], options["size"]) == ([5], 7)
    assert [(trial.seed, trial.size) for trial in fake_scenarios.measured] == [(5, 7)]
    printed = capsys.readouterr()
    for words in ("holds in part", "Squares grow.", "Section IX", "They do.", "squares.png"):
        assert words in printed.out
    assert printed.out.endswith(f"results in {out}\n")
    assert max(map(len, printed.out.splitlines()[:-1])) <= 80
    assert printed.err == ""


def test_finished_trials_are_kept(run, fake_scenarios, tmp_path):
    fake_scenarios.write("alpha")
    out = tmp_path / "out"
    assert run("run", "alpha", "--out", out) == 0
    assert run("run", "alpha", "--out", out, "--overwrite", "--set", "exhibit=cubes") == 0
    assert len(fake_scenarios.measured) == 2
    assert (out / "cubes.png").exists()
    assert not (out / "squares.png").exists()


def test_a_file_can_be_run_and_claims_are_not_markup(run, fake_scenarios, tmp_path, capsys):
    statement = "It [bold]is[/bold] in [0, 1]."
    path = fake_scenarios.write("alpha", size=8, statement=statement)
    assert run("run", path.rename(tmp_path / "mine.yaml"), "--out", tmp_path / "out") == 0
    assert summary_of(tmp_path / "out")["options"]["size"] == 8
    assert "[bold]is[/bold]" in " ".join(capsys.readouterr().out.split())


def test_trials_that_fail_end_in_status_1(run, fake_scenarios, tmp_path, capsys):
    fake_scenarios.write("alpha", size=-1)
    assert run("run", "alpha", "--out", tmp_path / "out") == 1
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("error: 2 of 2 trials of squaring failed")
    assert printed.err.count("\n") == 1


BAD = [
    (("beta",), "there is no scenario 'beta' (they are alpha;"),
    (("{folder}/none.yaml",), "there is no scenario file"),
    (("alpha", "--override", "slow"), "there is no override 'slow'"),
    (("alpha", "--set", "sise=1"), "the setting 'sise=1' is not name=value"),
    (("alpha", "--set", "size=many"), "setting 'size=many'"),
    (("alpha", "--jobs", 0), "the number of jobs must be at least 1, not 0"),
]


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=[words for _, words in BAD])
def test_bad_input_is_one_line(fake_scenarios, refused, tmp_path, arguments, words):
    fake_scenarios.write("alpha")
    arguments = [str(argument).format(folder=tmp_path) for argument in arguments]
    assert words in refused("run", *arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_the_scenarios_of_the_package_are_listed(run, capsys):
    assert run("scenarios") == 0
    printed = capsys.readouterr().out
    words = " ".join(printed.split())
    for name in scenario_names():
        assert f"\n{name} " in printed
        # The title is broken into lines beside the other columns.
        assert load_scenario(name).title.split()[0] in words
    assert "Fig. 1, Section I" in printed
    assert printed.count(" quick") == len(scenario_names())
    assert max(map(len, printed.splitlines())) <= 80
