"""All experiments into one folder: resumed, each on its own, and nothing of others lost."""

import json

import pytest

from sgvf_drake.exceptions import ConfigurationError, OutputExistsError
from sgvf_drake.paper import load_scenario, run_reproduce, run_scenario
from sgvf_drake.paper import scenario as scenario_module
from sgvf_drake.paper.reproduce import REPORT
from tests.helpers import content_of, names_in, summary_of

NAMES = ("alpha", "beta", "gamma")


@pytest.fixture
def three(fake_scenarios):
    """Three scenarios that share no trial, and what was measured of them."""
    for size, name in enumerate(NAMES, start=3):
        fake_scenarios.write(name, quick="seeds: [2]", size=size, statement=f"{name} grows.")
    return fake_scenarios


def statuses(summary):
    return {name: entry["status"] for name, entry in summary["scenarios"].items()}


def test_everything_is_run_into_one_folder(three, tmp_path):
    out = tmp_path / "deep" / "out"
    calls = []
    summary = run_reproduce(out, progress=lambda *call: calls.append(call))
    assert names_in(out) == {"summary.json", REPORT, "trials", *NAMES}
    assert names_in(out.parent) == {"out"}
    assert summary_of(out) == json.loads(json.dumps(summary))
    assert summary.keys() == {
        *("made_by", "quick", "complete", "counts", "claims", "scenarios"),
        *("trial_s", "wall_s", "versions", "commit"),
    }
    assert statuses(summary) == dict.fromkeys(NAMES, "done")
    assert (summary["complete"], summary["quick"]) == (True, False)
    assert summary["counts"] == {"holds": 3, "holds in part": 0, "does not hold": 0}
    assert [claim["scenario"] for claim in summary["claims"]] == list(NAMES)
    assert summary["claims"][1]["statement"] == "beta grows."
    trials = [summary_of(out / name)["trial_s"] for name in NAMES]
    assert summary["trial_s"] == pytest.approx(sum(trials))
    for name in NAMES:
        assert load_scenario(out / name / "scenario.yaml") == load_scenario(name)
        entry = summary["scenarios"][name]
        assert (entry["seeds"], entry["error"], entry["traceback"]) == ([0, 1], None, None)
        assert (entry["title"], entry["source"]) == (f"Title of {name}", "Fig. 9")
    assert [stage for stage, done, _ in calls if done == 0] == [
        f"{name}: squaring" for name in NAMES
    ]


def test_quick_runs_the_small_case(three, tmp_path):
    summary = run_reproduce(tmp_path, quick=True)
    assert summary["quick"] is True
    assert summary["scenarios"]["alpha"]["seeds"] == [2]
    assert [trial.seed for trial in three.measured] == [2, 2, 2]
    assert summary_of(tmp_path / "beta")["options"]["size"] == 4


def test_a_part_can_be_run_and_the_rest_is_named(three, tmp_path):
    summary = run_reproduce(tmp_path, only=["gamma", "alpha"])
    assert statuses(summary) == {"alpha": "done", "beta": "missing", "gamma": "done"}
    assert summary["complete"] is False
    assert [claim["scenario"] for claim in summary["claims"]] == ["alpha", "gamma"]
    assert not (tmp_path / "beta").exists()
    # The rest comes beside it.
    summary = run_reproduce(tmp_path, only=["beta"])
    assert statuses(summary) == dict.fromkeys(NAMES, "done")
    assert len(three.measured) == 6


# Resuming.


def test_a_second_run_measures_nothing(three, tmp_path):
    first = run_reproduce(tmp_path)
    second = run_reproduce(tmp_path)
    assert len(three.measured) == 6
    for summary in (first, second):
        summary["wall_s"] = 0
        for entry in summary["scenarios"].values():
            # Of a summary with the time of the run in it.
            entry.pop("digest")
    assert second == first


def test_an_interrupted_run_goes_on(three, tmp_path):
    def interrupt(stage, done, total):
        if (stage, done) == ("beta: squaring", 1):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_reproduce(tmp_path, progress=interrupt)
    assert len(three.measured) == 3
    found = statuses(summary_of(tmp_path))
    assert found == {"alpha": "done", "beta": "missing", "gamma": "missing"}
    assert "beta" in (tmp_path / REPORT).read_text()
    assert run_reproduce(tmp_path)["complete"] is True
    assert len(three.measured) == 6


def test_a_result_whose_note_was_lost_is_taken_up(three, tmp_path):
    # As where a run was killed between the result and the note of it.
    run_reproduce(tmp_path, only=["beta"])
    run_scenario(load_scenario("alpha"), tmp_path / "alpha", trials=tmp_path / "trials")
    assert statuses(run_reproduce(tmp_path, only=["beta"]))["alpha"] == "done"
    assert run_reproduce(tmp_path)["complete"] is True
    assert len(three.measured) == 6


def test_a_changed_scenario_is_out_of_date_until_it_is_run(three, tmp_path):
    run_reproduce(tmp_path)
    three.write("alpha", size=7, exhibit="cubes")
    summary = run_reproduce(tmp_path, only=["beta"])
    assert statuses(summary) == {"alpha": "outdated", "beta": "done", "gamma": "done"}
    assert summary["complete"] is False
    assert len(summary["claims"]) == 3
    page = (tmp_path / REPORT).read_text()
    assert "Out of date." in page
    assert 'id="alpha.grow"' in page, "what was found before is shown yet"
    assert (tmp_path / "alpha" / "squares.png").exists()
    assert run_reproduce(tmp_path)["complete"] is True
    assert (tmp_path / "alpha" / "cubes.png").exists()
    assert not (tmp_path / "alpha" / "squares.png").exists()
    assert len(three.measured) == 8


def test_changed_code_renews_results_from_their_trials(three, tmp_path, monkeypatch):
    run_reproduce(tmp_path)
    monkeypatch.setattr(scenario_module, "code_digest", lambda *roots: "other")
    found = statuses(run_reproduce(tmp_path, only=["alpha"]))
    assert found == {"alpha": "done", "beta": "outdated", "gamma": "outdated"}
    (tmp_path / "alpha" / "squares.png").unlink()
    assert run_reproduce(tmp_path)["complete"] is True
    assert {summary_of(tmp_path / name)["code"] for name in NAMES} == {"other"}
    # The trials themselves are of the same code, and a lost file is drawn again.
    assert len(three.measured) == 6
    assert (tmp_path / "alpha" / "squares.png").exists()


# Failing.


def test_a_scenario_that_fails_does_not_stop_the_others(three, tmp_path):
    three.write("alpha", size=-1)
    three.write("beta", size=4, error="no <ink>")
    summary = run_reproduce(tmp_path)
    assert statuses(summary) == {"alpha": "failed", "beta": "failed", "gamma": "done"}
    assert summary["complete"] is False
    error = summary["scenarios"]["alpha"]["error"]
    assert error.startswith("ExperimentError: 2 of 2 trials of squaring failed")
    entry = summary["scenarios"]["beta"]
    assert entry["error"] == "RuntimeError: no <ink>"
    assert "Traceback" in entry["traceback"]
    assert "no &lt;ink&gt;" in (tmp_path / REPORT).read_text()
    assert not (tmp_path / "beta").exists()
    # It stays so until it is run again, and then only what is left of it is measured.
    assert statuses(run_reproduce(tmp_path, only=["gamma"]))["beta"] == "failed"
    three.write("alpha", size=3)
    three.write("beta", size=4)
    assert run_reproduce(tmp_path)["complete"] is True
    assert len(three.measured) == 2 + 6


def test_a_failure_does_not_show_an_older_result_but_keeps_it(three, tmp_path):
    run_reproduce(tmp_path)
    three.write("beta", size=4, error="no ink", statement="beta grows.")
    summary = run_reproduce(tmp_path)
    assert [claim["scenario"] for claim in summary["claims"]] == ["alpha", "gamma"]
    assert "beta grows." not in (tmp_path / REPORT).read_text()
    assert (tmp_path / "beta" / "squares.png").exists()
    three.write("beta", size=5)
    assert run_reproduce(tmp_path)["complete"] is True


# What belongs to others.


@pytest.mark.parametrize("name", ["summary.json", REPORT, "trials", "beta"])
def test_a_folder_of_something_else_is_left_alone(three, tmp_path, name):
    if "." in name:
        (tmp_path / name).write_text('{"quick": false, "scenarios": {}}')
    else:
        (tmp_path / name).mkdir()
        (tmp_path / name / "notes.txt").write_text("mine")
    before = content_of(tmp_path)
    with pytest.raises(OutputExistsError, match=f"already holds {name}"):
        run_reproduce(tmp_path)
    assert content_of(tmp_path) == before
    assert three.measured == []
    (tmp_path / "notes.txt").write_text("mine")
    assert run_reproduce(tmp_path, overwrite=True)["complete"] is True
    assert (tmp_path / "notes.txt").read_text() == "mine"
    if "." not in name:
        assert (tmp_path / name / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize("first", [["alpha"], list(NAMES)])
def test_a_result_that_came_otherwise_is_not_replaced_unasked(three, tmp_path, first):
    run_reproduce(tmp_path, only=first)
    mine = load_scenario("beta", settings=["size=50"])
    run_scenario(mine, tmp_path / "beta", overwrite=True)
    before = content_of(tmp_path / "beta")
    assert statuses(run_reproduce(tmp_path, only=["alpha"]))["beta"] == "missing"
    with pytest.raises(OutputExistsError, match=r"beta already holds summary\.json"):
        run_reproduce(tmp_path)
    assert content_of(tmp_path / "beta") == before
    assert run_reproduce(tmp_path, overwrite=True)["complete"] is True
    assert summary_of(tmp_path / "beta")["options"]["size"] == 4


@pytest.mark.parametrize("quick", [True, False])
def test_quick_and_full_results_do_not_replace_each_other(three, tmp_path, quick):
    run_reproduce(tmp_path, quick=quick)
    before = content_of(tmp_path)
    kind = "a quick" if quick else "a full"
    with pytest.raises(OutputExistsError, match=f"holds {kind} reproduction; .*--overwrite"):
        run_reproduce(tmp_path, quick=not quick)
    assert content_of(tmp_path) == before
    summary = run_reproduce(tmp_path, quick=not quick, overwrite=True)
    assert summary["complete"] is True
    assert summary["quick"] is not quick


def test_bad_input_leaves_nothing(three, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(ConfigurationError, match=r"no scenario 'delta' \(they are alpha, beta"):
        run_reproduce(out, only=["alpha", "delta"])
    with pytest.raises(ConfigurationError, match="jobs must be at least 1, not 0"):
        run_reproduce(out, jobs=0)
    (three.folder / "zeta.yaml").write_text("scenario: {}\n")
    with pytest.raises(ConfigurationError, match=r"zeta.*needs a kind"):
        run_reproduce(out)
    (tmp_path / "file").write_text("mine")
    (three.folder / "zeta.yaml").unlink()
    with pytest.raises(ConfigurationError, match="file is not a folder"):
        run_reproduce(tmp_path / "file")
    assert names_in(tmp_path) == {"file"}
    assert three.measured == []
