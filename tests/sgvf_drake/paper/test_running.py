"""A scenario into a folder: what is left there, what is replaced, and what is told apart."""

import json

from matplotlib.image import imread
import numpy as np
import pandas as pd
import pytest

from sgvf_drake.exceptions import ConfigurationError, ExperimentError, OutputExistsError
from sgvf_drake.paper import load_scenario, run_scenario
from sgvf_drake.paper import scenario as scenario_module
from sgvf_drake.paper.experiment import load_rows
from sgvf_drake.paper.scenario import is_result_of, stored_summary
from tests.helpers import content_of, names_in

FILES = {
    *("summary.json", "scenario.yaml", "squares.png", "squares_table.csv", "log.parquet"),
    *("rows.json", "trials"),
}
KEYS = {
    *("title", "source", "kind", "options", "seeds", "version", "code", "exhibits", "logs"),
    *("claims", "figures", "trial_s", "wall_s", "versions", "commit"),
}


@pytest.fixture
def load(fake_scenarios):
    """Loads a fake scenario with given options, a file for each: (options) -> Scenario."""

    def load(**options):
        name = f"scenario{len(list(fake_scenarios.folder.iterdir()))}"
        return load_scenario(fake_scenarios.write(name, **options))

    return load


def test_a_run_leaves_exhibits_logs_scenario_and_summary(load, tmp_path):
    scenario = load(seeds=[1, 2, 4], verdict="holds in part")
    out, calls = tmp_path / "deep" / "out", []
    summary = run_scenario(scenario, out, progress=lambda *call: calls.append(call))
    assert calls == [("squaring", done, 3) for done in range(4)]
    assert names_in(out) == FILES
    assert names_in(tmp_path / "deep") == {"out"}
    assert load_scenario(out / "scenario.yaml") == scenario
    table = pd.read_csv(out / "squares_table.csv")
    assert table["square"].tolist() == [3, 12, 48]
    pd.testing.assert_frame_equal(pd.read_parquet(out / "log.parquet"), table)
    assert np.ptp(imread(out / "squares.png")) > 0.5
    stored = stored_summary(out)
    assert json.loads((out / "summary.json").read_text()) == stored
    assert stored.keys() == summary.keys() == KEYS
    assert stored.items() >= scenario.summary().items()
    assert stored["seeds"] == [1, 2, 4]
    assert load_rows(out / "rows.json")["squares"].equals(table)
    assert stored["claims"] == [
        {
            **{"key": "grow", "source": "Section IX", "statement": "Squares grow."},
            **{"verdict": "holds in part", "evidence": "They do.", "of_paper": True},
        }
    ]
    assert stored["exhibits"] == [
        {"file": "squares.png", "caption": "How squares grow."},
        {"file": "squares_table.csv", "caption": "The same in numbers."},
    ]
    assert stored["logs"] == ["log.parquet"]
    assert 0.0 < stored["trial_s"] < stored["wall_s"]


# What is in the way.


def test_results_are_replaced_only_if_asked_and_nothing_stale_stays(
    load, fake_scenarios, tmp_path
):
    out = tmp_path / "out"
    run_scenario(load(), out)
    (out / "notes.txt").write_text("mine")
    # A summary names files of its own folder only, whatever it says.
    (tmp_path / "precious.txt").write_text("mine")
    summary = json.loads((out / "summary.json").read_text())
    summary["logs"] += ["../precious.txt", str(tmp_path / "precious.txt")]
    (out / "summary.json").write_text(json.dumps(summary))
    before = content_of(tmp_path)
    with pytest.raises(OutputExistsError, match=r"already holds summary\.json, scenario\.yaml"):
        run_scenario(load(size=9), out)
    assert content_of(tmp_path) == before
    assert len(fake_scenarios.measured) == 2
    run_scenario(load(exhibit="cubes"), out, overwrite=True)
    others = FILES - {"squares.png", "squares_table.csv"}
    assert names_in(out) == {*others, "cubes.png", "cubes_table.csv", "notes.txt"}
    assert names_in(tmp_path) == {"out", "precious.txt"}


@pytest.mark.parametrize("name", ["squares.png", "log.parquet", "summary.json"])
@pytest.mark.parametrize("resume", [False, True])
def test_foreign_files_stay(load, tmp_path, name, resume):
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_text("mine")
    with pytest.raises(OutputExistsError, match=name):
        run_scenario(load(), out, resume=resume)
    assert (out / name).read_text() == "mine"
    assert names_in(out) <= {name, "trials"}


def test_resuming_replaces_an_earlier_result_and_nothing_else(load, tmp_path):
    run_scenario(load(), tmp_path)
    (tmp_path / "cubes.png").write_text("mine")
    before = content_of(tmp_path)
    with pytest.raises(OutputExistsError, match=r"already holds cubes\.png"):
        run_scenario(load(exhibit="cubes"), tmp_path, resume=True)
    assert content_of(tmp_path) == before
    run_scenario(load(exhibit="more"), tmp_path, resume=True)
    assert {"more.png", "cubes.png"} < names_in(tmp_path)
    assert "squares.png" not in names_in(tmp_path)
    assert (tmp_path / "cubes.png").read_text() == "mine"


def test_a_failure_leaves_the_trials_and_nothing_else(load, fake_scenarios, tmp_path):
    with pytest.raises(RuntimeError, match="no ink"):
        run_scenario(load(error="no ink"), tmp_path)
    assert names_in(tmp_path) == {"trials"}
    run_scenario(load(), tmp_path)
    assert names_in(tmp_path) == FILES
    assert len(fake_scenarios.measured) == 2


def test_bad_input_and_failing_trials_are_errors(load, fake_scenarios, tmp_path):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(ConfigurationError, match="file is not a folder"):
        run_scenario(load(), tmp_path / "file" / "out")
    with pytest.raises(ConfigurationError, match="jobs must be at least 1"):
        run_scenario(load(), tmp_path / "out", jobs=0)
    assert fake_scenarios.measured == []
    assert names_in(tmp_path) == {"file"}
    with pytest.raises(ExperimentError, match=r"2 of 2 trials .* the size cannot be -1"):
        run_scenario(load(size=-1), tmp_path / "out")


# Results that are there.


def test_a_result_is_known_by_its_scenario_and_its_code(load, tmp_path, monkeypatch):
    scenario = load(size=5)
    run_scenario(scenario, tmp_path)
    summary = stored_summary(tmp_path)
    assert is_result_of(summary, scenario)
    assert is_result_of(summary, load_scenario(tmp_path / "scenario.yaml"))
    other = load(size=6)
    other.title = scenario.title
    assert not is_result_of(summary, other)
    other.experiment.size = 5
    assert is_result_of(summary, other)
    other.title = "Another title"
    assert not is_result_of(summary, other)
    monkeypatch.setattr(scenario_module, "code_digest", lambda *roots: "other")
    assert not is_result_of(summary, scenario)


def test_a_result_that_is_damaged_or_misses_a_file_is_none(load, tmp_path):
    scenario = load()
    for name in FILES - {"trials"}:
        run_scenario(scenario, tmp_path, overwrite=True)
        assert stored_summary(tmp_path) is not None
        (tmp_path / name).unlink()
        assert stored_summary(tmp_path) is None, name
    run_scenario(scenario, tmp_path, overwrite=True)
    for text in ("", "{", "[1]", "{}", "null", '{"exhibits": 1}'):
        (tmp_path / "summary.json").write_text(text)
        assert stored_summary(tmp_path) is None, text
    assert stored_summary(tmp_path / "nowhere") is None


@pytest.mark.full
def test_a_sweep_of_the_paper_has_the_same_rows_on_a_cluster(tmp_path):
    from distributed import LocalCluster

    from sgvf_drake.experiments import workers_of

    stein = load_scenario("section2_stein", ["quick"])
    run_scenario(stein, tmp_path / "processes", jobs=2)
    options = {"n_workers": 2, "threads_per_worker": 1, "host": "127.0.0.1"}
    with (
        LocalCluster(**options, dashboard_address=":0") as cluster,
        workers_of(cluster.scheduler_address) as executor,
    ):
        run_scenario(stein, tmp_path / "dask", executor=executor)
    rows = [(tmp_path / name / "rows.json").read_text() for name in ("processes", "dask")]
    assert rows[0] == rows[1]
    assert len(rows[0]) > 1000
