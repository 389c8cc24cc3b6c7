"""Runs a scenario into a folder: tables, logs, figures, and what they come from."""

from collections.abc import Sequence
import json
from os import PathLike
from pathlib import Path
import time
from typing import Any

from matplotlib.figure import Figure

from sgvf_drake.experiments.outcome import Exhibit, Outcome
from sgvf_drake.experiments.provenance import provenance
from sgvf_drake.experiments.results import (
    SUMMARY,
    check_results,
    result_folder,
    save_figure,
    write_summary,
)
from sgvf_drake.experiments.scenario import Scenario
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.progress import Progress, no_progress

SCENARIO_FILE = "scenario.yaml"
TRIALS = "trials"


def run_scenario(
    scenario: Scenario,
    out: str | PathLike[str],
    *,
    trials: Path | None = None,
    jobs: int = 1,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Runs a scenario; leaves its exhibits, logs, the scenario itself and the summary.

    Trials that were finished before, by a run that was interrupted or one that shares them,
    are not run again.

    Args:
        scenario: From `load_scenario`.
        out: The folder of the results.
        trials: The folder in which finished trials are kept; None: `trials` in `out`.
        jobs: Processes that run trials at the same time.
        overwrite: Whether results in `out` may be replaced.
        progress: Told how far the trials are.

    Returns:
        The summary.
    """
    out = Path(out)
    check_results(out, (SUMMARY, SCENARIO_FILE), overwrite=overwrite)
    begin = time.perf_counter()
    bench = Workbench(out / TRIALS if trials is None else trials, jobs, progress)
    outcome = scenario.experiment.run(bench)
    summary = {
        **scenario.summary(),
        "seeds": scenario.experiment.seeds,
        "exhibits": [_entry(exhibit) for exhibit in outcome.exhibits],
        "logs": [f"{name}.parquet" for name in outcome.logs],
        "claims": [vars(claim) for claim in outcome.claims],
        "figures": outcome.figures,
        "trial_s": bench.trial_s,
        "wall_s": time.perf_counter() - begin,
        **provenance(),
    }
    names = [SUMMARY, SCENARIO_FILE, *_result_names(summary), *_earlier_names(out)]
    with result_folder(out, names, overwrite=overwrite) as folder:
        _write(outcome, folder)
        (folder / SCENARIO_FILE).write_text(scenario.to_yaml(), encoding="utf-8")
        write_summary(folder, summary)
    return summary


def _entry(exhibit: Exhibit) -> dict[str, str]:
    suffix = "png" if isinstance(exhibit.content, Figure) else "csv"
    return {"file": f"{exhibit.name}.{suffix}", "caption": exhibit.caption}


def _result_names(summary: dict[str, Any]) -> list[str]:
    return [*(entry["file"] for entry in summary["exhibits"]), *summary["logs"]]


def _earlier_names(out: Path) -> Sequence[str]:
    """The files of an earlier run in this folder, which are replaced or go."""
    try:
        return _result_names(json.loads((out / SUMMARY).read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError):
        return ()


def _write(outcome: Outcome, folder: Path) -> None:
    for exhibit in outcome.exhibits:
        path = folder / _entry(exhibit)["file"]
        if isinstance(exhibit.content, Figure):
            save_figure(exhibit.content, path)
        else:
            exhibit.content.to_csv(path, index=False)
    for name, log in outcome.logs.items():
        log.to_parquet(folder / f"{name}.parquet", index=False)
