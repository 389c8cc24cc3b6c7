"""Every experiment of the paper runs in its quick case, and puts a claim to the test."""

import pytest

from sgvf_drake.paper import run_reproduce, scenario_names

pytestmark = pytest.mark.benchmark


def test_every_experiment_runs(save, tmp_path):
    summary = run_reproduce(tmp_path / "out", quick=True)
    entries = summary["scenarios"]
    save([{"scenario": name, **entry} for name, entry in entries.items()], "reproduce")
    errors = {name: entry["error"] for name, entry in entries.items()}
    assert errors == dict.fromkeys(scenario_names())
    assert summary["complete"] is True
    assert {claim["scenario"] for claim in summary["claims"]} == set(scenario_names())
    assert len([claim for claim in summary["claims"] if claim["of_paper"]]) > 20
