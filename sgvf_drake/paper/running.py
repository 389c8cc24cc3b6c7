"""Runs a scenario into a folder: tables, logs, figures, and what they come from."""

from collections.abc import Mapping
from concurrent.futures import Executor
import json
from os import PathLike
from pathlib import Path
import time
from typing import Any

import sgvf_drake
from sgvf_drake.experiments.measured_code import code_digest
from sgvf_drake.experiments.provenance import provenance
from sgvf_drake.experiments.results import (
    SUMMARY,
    check_results,
    plain,
    result_folder,
    write_summary,
)
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.paper.experiment import save_rows
from sgvf_drake.paper.scenario import Scenario
from sgvf_drake.progress import Progress, no_progress

SCENARIO_FILE = "scenario.yaml"
ROWS_FILE = "rows.json"
TRIALS = "trials"


def run_scenario(
    scenario: Scenario,
    out: str | PathLike[str],
    *,
    trials: Path | None = None,
    jobs: int = 1,
    executor: Executor | None = None,
    overwrite: bool = False,
    resume: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Runs a scenario; leaves its exhibits, logs, rows, the scenario itself and the summary.

    Trials that were finished before, by a run that was interrupted or one that shares them,
    are not run again.

    Args:
        scenario: From `load_scenario`.
        out: The folder of the results.
        trials: The folder in which finished trials are kept; None: `trials` in `out`.
        jobs: Processes that run trials at the same time.
        executor: Runs them in place of processes of this machine; see `workers_of`.
        overwrite: Whether any file in `out` that is in the way may be replaced.
        resume: Whether the files of an earlier result may be, those that its summary names.
        progress: Told how far the trials are.

    Returns:
        The summary.

    Raises:
        OutputExistsError: If a file is in the way.  Where that is found after the work, the
            trials are kept.
        ExperimentError: If trials failed.
    """
    out = Path(out)
    _, earlier = _stored(out)
    own = earlier if resume else []
    first = [name for name in (SUMMARY, SCENARIO_FILE) if name not in own]
    check_results(out, first, overwrite=overwrite)
    begin = time.perf_counter()
    # Before the work: code that is edited meanwhile has no part in it.
    origin = _origin(scenario)
    store = out / TRIALS if trials is None else trials
    bench = Workbench(store, jobs, progress, executor=executor)
    experiment = scenario.experiment
    rows = experiment.measure(bench)
    exhibits = [*experiment.figures(rows), *experiment.tables(rows)]
    logs = experiment.logs(rows)
    summary = {
        **origin,
        "seeds": experiment.seeds,
        "exhibits": [{"file": one.file, "caption": one.caption} for one in exhibits],
        "logs": [f"{name}.parquet" for name in logs],
        "claims": [vars(finding) for finding in experiment.findings(rows)],
        # All numbers are in tables and claims.
        "figures": {},
        "trial_s": bench.trial_s,
        "wall_s": time.perf_counter() - begin,
        **provenance(),
    }
    names = _result_names(summary)
    foreign = [name for name in names if name not in own]
    check_results(out, foreign, overwrite=overwrite)
    with result_folder(out, [*names, *earlier], overwrite=overwrite or resume) as folder:
        for exhibit in exhibits:
            exhibit.save(folder)
        for name, log in logs.items():
            log.to_parquet(folder / f"{name}.parquet", index=False)
        save_rows(rows, folder / ROWS_FILE)
        (folder / SCENARIO_FILE).write_text(scenario.to_yaml(), encoding="utf-8")
        write_summary(folder, summary)
    return summary


def stored_summary(out: Path) -> dict[str, Any] | None:
    """Returns the summary of a result that is whole, else None."""
    summary, names = _stored(out)
    return summary if names and all((out / name).is_file() for name in names) else None


def is_result_of(summary: Mapping[str, Any], scenario: Scenario) -> bool:
    """Whether a stored result is what running a scenario would give, by the code as it is."""
    return all(summary.get(key) == value for key, value in plain(_origin(scenario)).items())


def _origin(scenario: Scenario) -> dict[str, Any]:
    """What a result follows from: the scenario as it is resolved, and the code."""
    kind: Any = type(scenario.experiment)
    return {**scenario.summary(), "version": sgvf_drake.__version__, "code": code_digest(kind)}


def _stored(out: Path) -> tuple[dict[str, Any], list[str]]:
    """The summary of an earlier run in a folder and its files there; empty if there is none."""
    try:
        summary: dict[str, Any] = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
        names = _result_names(summary)
    except (OSError, ValueError, KeyError, TypeError):
        return {}, []
    # Of this folder, whatever a summary says.
    return summary, [name for name in names if Path(name).name == name]


def _result_names(summary: Mapping[str, Any]) -> list[str]:
    exhibits = [entry["file"] for entry in summary["exhibits"]]
    return [SUMMARY, SCENARIO_FILE, ROWS_FILE, *exhibits, *summary["logs"]]
