"""All experiments into one folder: resumed, each on its own, and nothing of others lost."""

import json
from pathlib import Path

import pytest
from sgvf_drake.experiments.reproduction import REPORT, Status

from sgvf_drake.exceptions import ConfigurationError, OutputExistsError
from sgvf_drake.experiments import load_scenario, run_reproduce, run_scenario, running

NAMES = ("alpha", "beta", "gamma")


@pytest.fixture
def three(fake_scenarios):
    """Three scenarios that share no trial, and what was measured of them."""
    for size, name in enumerate(NAMES, start=3):
        fake_scenarios.write(name, quick="seeds: [2]", size=size, statement=f"{name} grows.")
    return fake_scenarios


def statuses(summary):
    return {name: entry["status"] for name, entry in summary["scenarios"].items()}


def summary_of(folder):
    return json.loads((Path(folder) / "summary.json").read_text())


def names_in(folder):
    return {path.name for path in folder.iterdir()}


def content_of(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


# What is left.


def test_everything_is_run_into_one_folder(three, tmp_path):
    out = tmp_path / "deep" / "out"
    calls = []
    summary = run_reproduce(out, progress=lambda *call: calls.append(call))
    assert names_in(out) == {"summary.json", REPORT, "trials", *NAMES}
    assert names_in(out.parent) == {"out"}
    assert statuses(summary) == dict.fromkeys(NAMES, "done")
    assert summary_of(out) == json.loads(json.dumps(summary))
    assert summary["complete"] is True
    assert summary["quick"] is False
    assert summary["counts"] == {"holds": 3, "holds in part": 0, "does not hold": 0}
    assert [claim["scenario"] for claim in summary["claims"]] == list(NAMES)
    assert summary["claims"][1]["statement"] == "beta grows."
    trials = [summary_of(out / name)["trial_s"] for name in NAMES]
    assert summary["trial_s"] == pytest.approx(sum(trials))
    assert summary["versions"]["sgvf_drake"]
    for name in NAMES:
        assert load_scenario(out / name / "scenario.yaml") == load_scenario(name)
        assert summary["scenarios"][name]["seeds"] == [0, 1]
    assert len(list((out / "trials").iterdir())) == 6
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


def test_what_is_there_is_not_run_again(three, tmp_path, monkeypatch):
    first = run_reproduce(tmp_path)
    before = {name: content_of(tmp_path / name) for name in NAMES}
    monkeypatch.setattr(type(three).kind, "run", None)
    second = run_reproduce(tmp_path)
    assert len(three.measured) == 6
    assert {name: content_of(tmp_path / name) for name in NAMES} == before
    assert {**second, "wall_s": 0} == {**first, "wall_s": 0}


def test_an_interrupted_run_goes_on(three, tmp_path):
    def interrupt(stage, done, total):
        if (stage, done) == ("beta: squaring", 1):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_reproduce(tmp_path, progress=interrupt)
    assert len(three.measured) == 3
    assert statuses(summary_of(tmp_path)) == {
        **{"alpha": "done", "beta": "missing", "gamma": "missing"}
    }
    assert "beta" in (tmp_path / REPORT).read_text()
    assert run_reproduce(tmp_path)["complete"] is True
    assert len(three.measured) == 6


def test_a_result_whose_note_was_lost_is_taken_up(three, tmp_path):
    # As where a run was killed between the result and the note of it.
    run_reproduce(tmp_path, only=["beta"])
    run_scenario(load_scenario("alpha"), tmp_path / "alpha", trials=tmp_path / "trials")
    summary = run_reproduce(tmp_path)
    assert summary["complete"] is True
    assert len(three.measured) == 6


def test_a_changed_scenario_is_run_again_and_out_of_date_until_then(three, tmp_path):
    run_reproduce(tmp_path)
    three.write("alpha", size=7, exhibit="cubes")
    summary = run_reproduce(tmp_path, only=["beta"])
    assert statuses(summary) == {"alpha": "outdated", "beta": "done", "gamma": "done"}
    assert summary["complete"] is False
    assert len(summary["claims"]) == 3
    assert (tmp_path / "alpha" / "squares.png").exists()
    assert len(three.measured) == 6
    summary = run_reproduce(tmp_path)
    assert summary["complete"] is True
    assert (tmp_path / "alpha" / "cubes.png").exists()
    assert not (tmp_path / "alpha" / "squares.png").exists()
    assert len(three.measured) == 8


def test_changed_code_renews_results_from_their_trials(three, tmp_path, monkeypatch):
    run_reproduce(tmp_path)
    monkeypatch.setattr(running, "code_digest", lambda *modules, drawing: "other")
    assert set(statuses(run_reproduce(tmp_path, only=["alpha"])).values()) == {
        *("done", "outdated")
    }
    assert run_reproduce(tmp_path)["complete"] is True
    assert {summary_of(tmp_path / name)["code"] for name in NAMES} == {"other"}
    assert len(three.measured) == 6


def test_a_result_that_misses_a_file_is_run_again(three, tmp_path):
    run_reproduce(tmp_path)
    (tmp_path / "alpha" / "squares.png").unlink()
    assert run_reproduce(tmp_path)["complete"] is True
    assert (tmp_path / "alpha" / "squares.png").exists()


# Failing.


def test_a_scenario_that_fails_does_not_stop_the_others(three, tmp_path):
    three.write("beta", size=4, error="no <ink>")
    summary = run_reproduce(tmp_path)
    assert statuses(summary) == {"alpha": "done", "beta": "failed", "gamma": "done"}
    entry = summary["scenarios"]["beta"]
    assert entry["error"] == "RuntimeError: no <ink>"
    assert "Traceback" in entry["traceback"]
    assert summary["complete"] is False
    assert "no &lt;ink&gt;" in (tmp_path / REPORT).read_text()
    assert not (tmp_path / "beta").exists()
    # It stays so until it is run again, and then only what is left of it runs.
    assert statuses(run_reproduce(tmp_path, only=["alpha"]))["beta"] == "failed"
    assert statuses(run_reproduce(tmp_path))["beta"] == "failed"
    three.write("beta", size=4)
    assert run_reproduce(tmp_path)["complete"] is True
    assert len(three.measured) == 6


def test_trials_that_fail_are_told(three, tmp_path):
    three.write("beta", size=-1)
    entry = run_reproduce(tmp_path)["scenarios"]["beta"]
    assert entry["error"].startswith("ExperimentError: 2 of 2 trials of squaring failed")


def test_a_failure_does_not_show_an_older_result(three, tmp_path):
    run_reproduce(tmp_path)
    three.write("beta", size=4, error="no ink", statement="beta grows.")
    summary = run_reproduce(tmp_path)
    assert [claim["scenario"] for claim in summary["claims"]] == ["alpha", "gamma"]
    assert "beta grows." not in (tmp_path / REPORT).read_text()
    # But it keeps it, and it is still its own.
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
    assert run_reproduce(tmp_path, overwrite=True)["complete"] is True
    if "." not in name:
        assert (tmp_path / name / "notes.txt").read_text() == "mine"


def test_other_files_stay(three, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    run_reproduce(tmp_path, only=["alpha"])
    (tmp_path / "alpha" / "notes.txt").write_text("mine")
    three.write("alpha", size=9)
    run_reproduce(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"
    assert (tmp_path / "alpha" / "notes.txt").read_text() == "mine"


def test_a_result_that_came_otherwise_is_not_replaced_unasked(three, tmp_path):
    run_reproduce(tmp_path, only=["alpha"])
    mine = load_scenario("beta", settings=["size=50"])
    run_scenario(mine, tmp_path / "beta")
    before = content_of(tmp_path)
    assert statuses(run_reproduce(tmp_path, only=["alpha"]))["beta"] == "missing"
    with pytest.raises(OutputExistsError, match=r"beta already holds summary\.json"):
        run_reproduce(tmp_path)
    after = content_of(tmp_path)
    assert {path for path in after if after[path] != before.get(path)} <= {
        *(tmp_path / "summary.json", tmp_path / REPORT)
    }
    assert run_reproduce(tmp_path, overwrite=True)["complete"] is True
    assert summary_of(tmp_path / "beta")["options"]["size"] == 4


def test_an_own_result_that_was_run_over_is_not_replaced_unasked(three, tmp_path):
    run_reproduce(tmp_path)
    mine = load_scenario("beta", settings=["size=50"])
    run_scenario(mine, tmp_path / "beta", overwrite=True)
    with pytest.raises(OutputExistsError, match="beta already holds"):
        run_reproduce(tmp_path)
    assert summary_of(tmp_path / "beta")["options"]["size"] == 50


def test_a_file_in_the_way_of_a_new_exhibit_fails_its_scenario(three, tmp_path):
    run_reproduce(tmp_path)
    (tmp_path / "alpha" / "cubes.png").write_text("mine")
    three.write("alpha", exhibit="cubes")
    summary = run_reproduce(tmp_path)
    assert statuses(summary)["alpha"] == Status.FAILED
    assert "already holds cubes.png" in summary["scenarios"]["alpha"]["error"]
    assert (tmp_path / "alpha" / "cubes.png").read_text() == "mine"


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


# Bad input is found before there is anything in the folder.


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
