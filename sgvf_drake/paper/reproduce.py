"""Runs every experiment of the paper, and builds one page of what they found."""

from collections import Counter
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from enum import StrEnum
import hashlib
import json
from os import PathLike
from pathlib import Path
import time
import traceback
from typing import Any

from sgvf_drake.exceptions import OutputExistsError
from sgvf_drake.experiments.provenance import provenance
from sgvf_drake.experiments.results import SUMMARY, check_results, result_folder, write_summary
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.paper.claims import Verdict
from sgvf_drake.paper.experiment import check_names
from sgvf_drake.paper.report import build_page
from sgvf_drake.paper.scenario import (
    SCENARIO_FILE,
    TRIALS,
    Scenario,
    is_result_of,
    load_scenario,
    run_scenario,
    scenario_names,
    stored_summary,
)
from sgvf_drake.progress import Progress, no_progress

REPORT = "report.html"
QUICK = "quick"
"""The override of each scenario that makes it small."""

MARKER = {"made_by": "sgvf reproduce"}
"""What tells the summary of a reproduction from those of other commands."""

Entry = dict[str, Any]
"""What `summary.json` says of a scenario: title, source, status, error, traceback, digest."""


class Status(StrEnum):
    """How far a scenario has come."""

    DONE = "done"
    OUTDATED = "outdated"
    """It has a result, of other code or of other options than now."""
    FAILED = "failed"
    MISSING = "missing"


def run_reproduce(
    out: str | PathLike[str],
    *,
    quick: bool = False,
    only: Sequence[str] = (),
    jobs: int = 1,
    executor: Executor | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Runs the scenarios that come with the package; leaves their results and the report.

    Trials that were finished before are taken from the store, so that an interrupted run goes
    on where it was, and a second one only draws again.  A scenario that fails does not stop
    the others.  `summary.json` and `report.html` are there from the start, and say after each
    scenario how far it is.

    Args:
        out: The folder: a result in a folder for each scenario, `trials`, and the report.
        quick: Whether the small case of each scenario is run.
        only: Names of the scenarios to run; none: all of them.
        jobs: Processes that run trials at the same time.
        executor: Runs them in place of processes of this machine; see `workers_of`.
        overwrite: Whether files in `out` may be replaced that a reproduction like this one
            has not left there.
        progress: Told how far each scenario is.

    Returns:
        The summary; its `scenarios` say which failed, and why.

    Raises:
        ConfigurationError: If there is no such scenario, or no process to run it.
        OutputExistsError: If files that are not of this reproduction are in the way.
    """
    begin = time.perf_counter()
    out = Path(out)
    check_names("scenario", only, scenario_names())
    overrides = [QUICK] if quick else []
    scenarios = {name: load_scenario(name, overrides) for name in scenario_names()}
    chosen = [name for name in scenarios if name in only or not only]
    # Refuses the number of jobs before there is anything in the folder.
    Workbench(out / TRIALS, jobs)
    earlier = _earlier(out, scenarios, quick=quick, overwrite=overwrite)
    entries = {
        name: _entry(out / name, scenario, earlier.get(name, {}))
        for name, scenario in scenarios.items()
    }
    for name in chosen:
        if entries[name]["digest"] is None:
            check_results(out / name, (SUMMARY, SCENARIO_FILE), overwrite=overwrite)
    summary = _save(out, entries, quick, begin)
    options = {"jobs": jobs, "executor": executor, "overwrite": overwrite}
    for name in chosen:
        entries[name] = _run(
            out / name, scenarios[name], entries[name], progress, trials=out / TRIALS, **options
        )
        summary = _save(out, entries, quick, begin)
    return summary


def _run(
    folder: Path, scenario: Scenario, entry: Entry, progress: Progress, **options: Any
) -> Entry:
    """Runs a scenario; returns its entry then, with the error if it has failed."""

    def report(stage: str, done: float, total: float) -> None:
        progress(f"{folder.name}: {stage}", done, total)

    try:
        run_scenario(scenario, folder, resume=True, progress=report, **options)
    # Whatever it does wrong, the others are to run.
    except Exception as error:
        return entry | {
            "status": Status.FAILED,
            "error": f"{type(error).__name__}: {error}",
            "traceback": traceback.format_exc(),
        }
    return _entry(folder, scenario, {})


def _earlier(
    out: Path, scenarios: Mapping[str, Scenario], *, quick: bool, overwrite: bool
) -> Mapping[str, Entry]:
    """Returns the entries of an earlier run in this folder, if it may be gone on with.

    Raises:
        OutputExistsError: If the folder holds files in the way that are not of a
            reproduction, or one of the other kind, quick or full.
        ConfigurationError: If the folder cannot be one.
    """
    try:
        summary = json.loads((out / SUMMARY).read_text(encoding="utf-8"))
        own = all(summary[key] == value for key, value in MARKER.items())
        entries, was_quick = summary["scenarios"], summary["quick"]
    except (OSError, ValueError, KeyError, TypeError):
        own, entries, was_quick = False, {}, quick
    if not own:
        check_results(out, (SUMMARY, REPORT, TRIALS, *scenarios), overwrite=overwrite)
        return {}
    if was_quick != quick and not overwrite:
        kind, option = ("a quick", "with") if was_quick else ("a full", "without")
        raise OutputExistsError(
            f"{out} holds {kind} reproduction; go on with it {option} --quick, "
            "choose another --out, or pass --overwrite to replace it"
        )
    return entries


def _entry(folder: Path, scenario: Scenario, earlier: Mapping[str, Any]) -> Entry:
    """Returns what is to say of a scenario, by its folder and what was said before.

    Its `digest` is that of the summary in its folder, by which that is known as its own; it
    is None if there is none, or one that came otherwise.
    """
    entry: Entry = {
        "title": scenario.title,
        "source": scenario.source,
        "status": Status.MISSING,
        "error": None,
        "traceback": None,
        "digest": None,
    }
    summary, result = folder / SUMMARY, stored_summary(folder)
    digest = hashlib.sha256(summary.read_bytes()).hexdigest() if summary.is_file() else None
    if result is not None and is_result_of(result, scenario):
        return entry | {"status": Status.DONE, "digest": digest}
    if digest == earlier.get("digest"):
        entry["digest"] = digest
        if result is not None:
            entry["status"] = Status.OUTDATED
    if earlier.get("status") == Status.FAILED:
        entry |= {key: earlier[key] for key in ("status", "error", "traceback")}
    return entry


def _save(out: Path, entries: Mapping[str, Entry], quick: bool, begin: float) -> dict[str, Any]:
    """Writes the summary and the page of what the scenarios have left so far."""
    results = {
        name: result
        for name, entry in entries.items()
        if entry["status"] in (Status.DONE, Status.OUTDATED)
        and (result := stored_summary(out / name)) is not None
    }
    claims = [
        {"scenario": name, **claim}
        for name, result in results.items()
        for claim in result["claims"]
    ]
    counts = Counter(claim["verdict"] for claim in claims if claim["of_paper"])
    summary = {
        **MARKER,
        "quick": quick,
        "complete": all(entry["status"] == Status.DONE for entry in entries.values()),
        "counts": {verdict.value: counts[verdict.value] for verdict in Verdict},
        "claims": claims,
        "scenarios": {
            name: entry | {key: results.get(name, {}).get(key) for key in ("seeds", "trial_s")}
            for name, entry in entries.items()
        },
        "trial_s": sum(result["trial_s"] for result in results.values()),
        "wall_s": time.perf_counter() - begin,
        **provenance(),
    }
    page = build_page(summary, out)
    with result_folder(out, (SUMMARY, REPORT), overwrite=True) as folder:
        (folder / REPORT).write_text(page, encoding="utf-8")
        write_summary(folder, summary)
    return summary
