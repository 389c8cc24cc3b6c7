"""The command reproduce: what it prints, and its exit status."""

import pytest

from tests.helpers import summary_of


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


BAD = [
    (("--only", "gamma"), "there is no scenario 'gamma' (they are alpha, beta)"),
    (("--jobs", 0), "the number of jobs must be at least 1, not 0"),
]


@pytest.mark.parametrize(("arguments", "words"), BAD, ids=[words for _, words in BAD])
def test_bad_input_is_one_line(two, refused, tmp_path, arguments, words):
    assert words in refused("reproduce", *arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_other_results_are_not_replaced_unasked(run, two, refused, tmp_path):
    (tmp_path / "report.html").write_text("mine")
    assert "already holds report.html" in refused("reproduce", "--out", tmp_path)
    assert (tmp_path / "report.html").read_text() == "mine"
    assert run("reproduce", "--out", tmp_path, "--overwrite") == 0
