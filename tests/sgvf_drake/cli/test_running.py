"""The commands run, scenarios and reproduce: what they print and leave, their exit status."""

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
    ("run beta", "there is no scenario 'beta' (they are alpha;"),
    ("run none.yaml", "there is no scenario file"),
    ("run alpha --override slow", "there is no override 'slow'"),
    ("run alpha --set sise=1", "the setting 'sise=1' is not name=value"),
    ("run alpha --set size=many", "setting 'size=many'"),
    ("run alpha --jobs 0", "the number of jobs must be at least 1, not 0"),
    ("reproduce --only gamma", "there is no scenario 'gamma' (they are alpha)"),
    ("reproduce --jobs 0", "the number of jobs must be at least 1, not 0"),
]


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=[arguments for arguments, _ in BAD])
def test_bad_input_is_one_line(fake_scenarios, refused, tmp_path, arguments, words):
    fake_scenarios.write("alpha")
    assert words in refused(*arguments.split(), "--out", tmp_path / "out")
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


# reproduce


@pytest.fixture
def two(fake_scenarios):
    """Two scenarios."""
    fake_scenarios.write("alpha", verdict="does not hold")
    fake_scenarios.write("beta", size=4)
    return fake_scenarios


def rows_of(printed):
    """The rows of the printed table by their names, cell by cell."""
    cells = [
        [cell.strip() for cell in line.split("│")[1:-1]]
        for line in printed.splitlines()
        if line.startswith("│")
    ]
    return {name: rest for name, *rest in cells}


def test_everything_is_run_whatever_the_verdicts(run, two, tmp_path, capsys):
    out = tmp_path / "out"
    assert run("reproduce", "--quick", "--out", out) == 0
    printed = capsys.readouterr()
    rows = rows_of(printed.out)
    assert rows["alpha"][:4] == ["done", "", "", "1"]
    assert rows["beta"][:4] == ["done", "1", "", ""]
    assert printed.out.endswith(f"report in {out / 'report.html'}\n")
    assert max(map(len, printed.out.splitlines()[:-1])) <= 80
    assert printed.err == ""
    assert (out / "report.html").stat().st_size > 1_000
    assert summary_of(out)["quick"] is True


def test_a_part_is_run(run, two, tmp_path, capsys):
    assert run("reproduce", "--only", "beta", "--out", tmp_path / "out") == 0
    rows = rows_of(capsys.readouterr().out)
    assert rows["alpha"] == ["missing", "", "", "", ""]
    assert rows["beta"][0] == "done"
    assert run("reproduce", "--only", "beta", "--only", "alpha", "--out", tmp_path / "out") == 0
    assert rows_of(capsys.readouterr().out)["alpha"][0] == "done"
    assert len(two.measured) == 4


def test_a_scenario_that_fails_ends_in_status_1(run, two, tmp_path, capsys):
    two.write("alpha", error="no [ink]")
    assert run("reproduce", "--out", tmp_path / "out") == 1
    printed = capsys.readouterr()
    assert rows_of(printed.out)["alpha"][0] == "failed"
    assert rows_of(printed.out)["beta"][0] == "done"
    assert printed.err == "alpha failed: RuntimeError: no [ink]\n"


def test_other_results_are_not_replaced_unasked(run, two, refused, tmp_path):
    (tmp_path / "report.html").write_text("mine")
    assert "already holds report.html" in refused("reproduce", "--out", tmp_path)
    assert (tmp_path / "report.html").read_text() == "mine"
    assert run("reproduce", "--out", tmp_path, "--overwrite") == 0
