"""Running: every case once, its result stored, and the table of all of them."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
import json
from pathlib import Path
import time
import traceback
from typing import Any

from matplotlib.figure import Figure
import pandas as pd

import sgvf_drake
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import clouds
from sgvf_drake.experiments.figures import follow_figure
from sgvf_drake.experiments.follow import PATIENCE, follow
from sgvf_drake.experiments.measured_code import code_digest
from sgvf_drake.experiments.processes import each_finished
from sgvf_drake.experiments.quality.case import LABELS, Case
from sgvf_drake.experiments.quality.measures import Row, failure, following, measure_score
from sgvf_drake.experiments.results import SUMMARY, result_folder, save_figure, write_summary
from sgvf_drake.metrics import default_duration
from sgvf_drake.progress import Progress, no_progress

# Raised when this package measures something else under the name of a column.
RESULTS_VERSION = 1
# Digits of the digest of that code which a table shows.
CODE_DIGITS = 12

TEXTS = (
    *("name", "shape", "sampling", "recipe", "key"),
    *("self_check_message", "failure", "error", "code"),
)
INTEGERS = ("seed", "starts", "num_points", "restarts")
MEASURES = (
    *("reach", "lap", "end", "stall", "leave", "rms_u", "max_u", "speed_min", "speed_max"),
    *("score_cosine", "score_cosine_p5", "score_bias_u", "score_curl", "orthogonality"),
    *("train_cpu_s", "wall_s", "sigma_u", "unit_length"),
)
COLUMNS = (
    *(*LABELS, "starts", "failure", *MEASURES, "num_points", "restarts"),
    *("self_check_passed", "self_check_message", "error", "code", "key"),
)


def run_case(case: Case, folder: Path) -> Row:
    """Trains, follows and measures; leaves `KEY.json` and `KEY.png`, whole or not at all.

    Returns:
        The row of the table; fractions of starts, lengths in U where the name ends in `_u`.
    """
    # Imported here: the table of finished cases does without torch.
    from sgvf_drake.learning import TrainingConfig, train

    begin = time.perf_counter()
    cloud, reference = clouds.make_cloud(case.cloud, case.sampling, case.seed, case.source)
    settings: dict[str, Any] = {"recipe": case.recipe, "seed": case.seed}
    result = train(cloud, TrainingConfig(**settings, **dict(case.overrides)))
    field = result.field
    duration = PATIENCE.get(case.recipe, 1.0) * default_duration(reference, cloud.unit_length)
    run = follow(field, reference, case.starts, duration)
    row = {
        **_labels(case),
        "num_points": cloud.num_points,
        "unit_length": cloud.unit_length,
        "sigma_u": field.sigma,
        **following(run, cloud.unit_length),
        **measure_score(field, reference, case.seed),
        "train_cpu_s": result.cpu_s,
        "restarts": result.restarts,
        "self_check_passed": result.self_check.passed,
        "self_check_message": result.self_check.message,
        "wall_s": time.perf_counter() - begin,
        "error": None,
    }
    row["failure"] = failure(row)
    details = {"settings": asdict(result.settings), "self_check": asdict(result.self_check)}
    _write(case, row, folder, details, follow_figure(field, run))
    return row


def run_suite(
    cases: Iterable[Case],
    folder: Path,
    progress: Progress = no_progress,
    *,
    jobs: int = 1,
    any_code: bool = False,
) -> pd.DataFrame:
    """Runs the cases that are not finished, and saves `table.csv` and `table.parquet`.

    A case is finished if its files are there, for the same fields of the case, from the same
    code.  A case that raises becomes a row with the text of its error, and runs again the
    next time.

    Args:
        cases: The cases; their keys differ.
        folder: The folder of the results.
        progress: Told of every case as it ends: its key with what it falls short in, how
            many have ended, and how many there are.
        jobs: Processes that run cases at the same time; 1: this one.
        any_code: Whether results of other code count as well.

    Returns:
        One row a case, sorted by `LABELS`.

    Raises:
        ConfigurationError: Two cases have the same key, or there is no process to run them.
    """
    cases = list(cases)
    _check_suite(cases, jobs)
    folder.mkdir(parents=True, exist_ok=True)
    stored = {case.key: finished_row(case, folder, any_code=any_code) for case in cases}
    rows = {key: row for key, row in stored.items() if row is not None}
    if rows:
        progress("finished before", len(rows), len(cases))
    todo = [case for case in cases if case.key not in rows]
    for finished in each_finished(partial(run_case, folder=folder), todo, jobs):
        case, row = finished.item, finished.result
        if finished.error is not None:
            row = _record(finished.error, case, folder)
        assert row is not None
        rows[case.key] = row
        progress(f"{case.key}: {row['failure'] or 'ok'}", len(rows), len(cases))
    table = make_table(rows.values())
    with result_folder(folder, ("table.csv", "table.parquet"), overwrite=True) as temporary:
        table.to_csv(temporary / "table.csv", index=False)
        table.to_parquet(temporary / "table.parquet", index=False)
    return table


def finished_row(case: Case, folder: Path, *, any_code: bool = False) -> Row | None:
    """Returns the row of a case that was finished in this folder, else None."""
    try:
        stored = json.loads((folder / f"{case.key}.json").read_text(encoding="utf-8"))
        identity, row = stored["identity"], stored["row"]
        if row["error"] is not None or not (folder / f"{case.key}.png").is_file():
            return None
    except (OSError, ValueError, TypeError, KeyError):
        return None
    expected = _identity(case)
    if any_code:
        expected["code"] = identity.get("code")
    return row if identity == expected else None


def make_table(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Returns the rows as a table with all columns, each of one type, sorted by `LABELS`."""
    types = dict.fromkeys(MEASURES, "float64") | dict.fromkeys(INTEGERS, "Int64")
    types |= dict.fromkeys(TEXTS, "string") | {"self_check_passed": "boolean"}
    records = [{name: row.get(name) for name in COLUMNS} for row in rows]
    table = pd.DataFrame(records, columns=list(COLUMNS)).astype(types)
    return table.sort_values(list(LABELS), ignore_index=True)


def _check_suite(cases: Sequence[Case], jobs: int) -> None:
    keys = [case.key for case in cases]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise ConfigurationError(f"several cases have the key {twice[0]}")
    if jobs < 1:
        raise ConfigurationError(f"the number of jobs must be at least 1, not {jobs}")


def _record(error: BaseException, case: Case, folder: Path) -> Row:
    text = f"{type(error).__name__}: {error}"
    row = {**_labels(case), "error": text, "failure": text}
    # Not the figure of an earlier result beside an error.
    (folder / f"{case.key}.png").unlink(missing_ok=True)
    _write(case, row, folder, {"traceback": traceback.format_exception(error)})
    return row


def _labels(case: Case) -> Row:
    return {**case.labels, "code": code_digest()[:CODE_DIGITS]}


def _write(
    case: Case,
    row: Row,
    folder: Path,
    details: Mapping[str, Any],
    figure: Figure | None = None,
) -> None:
    names = (f"{case.key}.json", f"{case.key}.png")
    content = {"identity": _identity(case), "row": row, **details}
    with result_folder(folder, names, overwrite=True) as temporary:
        if figure is not None:
            save_figure(figure, temporary / names[1])
        write_summary(temporary, content)
        (temporary / SUMMARY).rename(temporary / names[0])


def _identity(case: Case) -> dict[str, Any]:
    """What a stored result has to agree with, as plain JSON values."""
    return {
        **case.identity(),
        "results": RESULTS_VERSION,
        "version": sgvf_drake.__version__,
        "code": code_digest(),
    }
