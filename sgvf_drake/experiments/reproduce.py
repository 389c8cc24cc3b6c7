"""Runs every experiment of the paper, and builds one page of what they found."""

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
import time
import traceback
from typing import Any

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.report import build_page
from sgvf_drake.experiments.reproduction import REPORT, Reproduction
from sgvf_drake.experiments.results import SUMMARY, result_folder, write_summary
from sgvf_drake.experiments.running import TRIALS, run_scenario
from sgvf_drake.experiments.scenario import load_scenario, scenario_names
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.progress import Progress, no_progress

QUICK = "quick"
"""The override of each scenario that makes it small."""


def run_reproduce(
    out: str | PathLike[str],
    *,
    quick: bool = False,
    only: Sequence[str] = (),
    jobs: int = 1,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Runs the scenarios that come with the package; leaves their results and the report.

    A scenario whose result is there, of the same options and the same code, is not run
    again; nor are trials that were finished before a run was interrupted.  One that fails
    does not stop the others.  `summary.json` and `report.html` are there from the start,
    and say after each scenario how far it is.

    Args:
        out: The folder: a result in a folder for each scenario, `trials`, and the report.
        quick: Whether the small case of each scenario is run.
        only: Names of the scenarios to run; none: all of them.
        jobs: Processes that run trials at the same time.
        overwrite: Whether files in `out` may be replaced that a reproduction like this one
            has not left there.
        progress: Told how far each scenario is.

    Returns:
        The summary; its `scenarios` say which failed, and why.

    Raises:
        ConfigurationError: There is no such scenario, or no process to run it.
        OutputExistsError: Files that are not of this reproduction are in the way.
    """
    begin = time.perf_counter()
    out = Path(out)
    names = scenario_names()
    unknown = [name for name in only if name not in names]
    if unknown:
        raise ConfigurationError(
            f"there is no scenario {unknown[0]!r} (they are {', '.join(names)})"
        )
    chosen = [name for name in names if name in only or not only]
    # Refuses the number of jobs before there is anything in the folder.
    Workbench(out / TRIALS, jobs)
    overrides = [QUICK] if quick else []
    scenarios = {name: load_scenario(name, overrides) for name in names}
    reproduction = Reproduction(out, scenarios, quick=quick, overwrite=overwrite)
    for name in chosen:
        reproduction.check_own(name)
    summary = _save(reproduction, begin)
    for name in chosen:
        if not reproduction.is_done(name):
            _run(reproduction, name, jobs, progress)
            summary = _save(reproduction, begin)
    return summary


def _run(reproduction: Reproduction, name: str, jobs: int, progress: Progress) -> None:
    """Runs a scenario; whatever it does wrong, the others are to run."""

    def report(stage: str, done: float, total: float) -> None:
        progress(f"{name}: {stage}", done, total)

    try:
        run_scenario(
            reproduction.scenarios[name],
            reproduction.folder / name,
            trials=reproduction.folder / TRIALS,
            jobs=jobs,
            overwrite=reproduction.overwrite,
            resume=True,
            progress=report,
        )
    except Exception as error:
        message = f"{type(error).__name__}: {error}"
        reproduction.set_failed(name, message, traceback.format_exc())
    else:
        reproduction.set_done(name)


def _save(reproduction: Reproduction, begin: float) -> dict[str, Any]:
    """Writes the summary and the page as it stands with the scenarios."""
    summary = reproduction.summary(time.perf_counter() - begin)
    page = build_page(summary, reproduction.folder)
    with result_folder(reproduction.folder, (SUMMARY, REPORT), overwrite=True) as folder:
        (folder / REPORT).write_text(page, encoding="utf-8")
        write_summary(folder, summary)
    return summary
