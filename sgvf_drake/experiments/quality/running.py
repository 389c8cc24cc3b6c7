"""Running: every case once, its row and figure stored, and the table of all of them."""

from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import asdict
from pathlib import Path
import time
from typing import Any

import pandas as pd
from rich.console import Console
from rich.table import Table

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments import clouds
from sgvf_drake.experiments.figures.runs import follow_figure
from sgvf_drake.experiments.follow import follow
from sgvf_drake.experiments.quality.cases import LABELS, Case
from sgvf_drake.experiments.quality.measures import Row, failure, following, measure_score
from sgvf_drake.experiments.results import result_folder, save_figure
from sgvf_drake.experiments.workbench import Ended, Workbench
from sgvf_drake.metrics import default_duration
from sgvf_drake.progress import Progress, no_progress

FIGURE = "follow.png"
TRIALS = "trials"
# Digits of the digest of the code which a table shows.
CODE_DIGITS = 12

MEASURES = (
    *("reach", "lap", "end", "stall", "leave", "rms_u", "max_u", "speed_min", "speed_max"),
    *("score_cosine", "score_cosine_p5", "score_bias_u", "score_curl", "orthogonality"),
    *("train_cpu_s", "wall_s", "sigma_u", "unit_length"),
)
TEXT, INTEGER = "string", "Int64"
COLUMNS = {
    **dict.fromkeys(LABELS, TEXT),
    **{"seed": INTEGER, "starts": INTEGER, "failure": TEXT},
    **dict.fromkeys(MEASURES, "float64"),
    **{"num_points": INTEGER, "restarts": INTEGER, "self_check_passed": "boolean"},
    **dict.fromkeys(("self_check_message", "error", "code", "key", "folder"), TEXT),
}
"""The columns of the table in their order, and their types."""

# What is printed of each column, of the worst case of a cloud: heading, which one, format.
PRINTED = {
    "lap": ("lap", "min", ".1%"),
    "end": ("end", "min", ".1%"),
    "rms_u": ("RMS", "max", ".4f"),
    "max_u": ("max", "max", ".3f"),
    "score_cosine": ("cosine", "min", ".3f"),
    "score_bias_u": ("bias", "max", ".4f"),
    "train_cpu_s": ("CPU s", "median", ".1f"),
}


def measure_case(case: Case, folder: Path) -> Row:
    """Trains, follows and measures; leaves the figure of following.

    Returns:
        What is measured, fractions of starts, lengths in U where the name ends in `_u`; and
        the settings and the self-check of the training.
    """
    # Imported here: the table of finished cases does not need torch.
    from sgvf_drake.learning import RECIPES, TrainingConfig, train

    begin = time.perf_counter()
    cloud, reference = clouds.make_cloud(case.cloud, case.sampling, case.seed, case.source)
    settings: dict[str, Any] = {"recipe": case.recipe, "seed": case.seed, "anyway": True}
    result = train(cloud, TrainingConfig(**settings, **dict(case.overrides)))
    field = result.guiding_field
    usual = default_duration(reference, cloud.unit_length)
    duration = RECIPES[case.recipe].patience * usual
    run = follow(field, reference, case.starts, duration)
    save_figure(follow_figure(field, run), folder / FIGURE)
    row = {
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
    }
    details = {"settings": asdict(result.settings), "self_check": asdict(result.self_check)}
    return {**row, "failure": failure(row), **details}


def run_suite(
    cases: Iterable[Case],
    folder: Path,
    progress: Progress = no_progress,
    *,
    jobs: int = 1,
    executor: Executor | None = None,
    any_code: bool = False,
) -> pd.DataFrame:
    """Runs the cases that are not finished, and saves `table.csv` and `table.parquet`.

    A case that raises becomes a row with the text of its error, and runs again the next time.

    Args:
        cases: The cases; their keys differ.
        folder: The folder of the results, with a folder in `trials` for each case.
        progress: Told of every case as it ends: its key with what it falls short in, how
            many have ended, and how many there are.
        jobs: Processes that run cases at the same time; 1: this one.
        executor: Runs them in place of processes of this machine; see `workers_of`.
        any_code: Whether finished cases of other code count as well.

    Returns:
        One row a case, sorted by `LABELS`.

    Raises:
        ConfigurationError: If two cases have the same key, or there is no process to run them.
    """
    cases = list(cases)
    keys = [case.key for case in cases]
    twice = sorted({key for key in keys if keys.count(key) > 1})
    if twice:
        raise ConfigurationError(f"several cases have the key {twice[0]}")
    bench = Workbench(folder / TRIALS, jobs, executor=executor, any_code=any_code)
    rows = []
    for ended in bench.each(measure_case, cases):
        rows.append(_row(ended))
        key, failed = ended.trial.key, rows[-1]["failure"]
        progress(f"{key}: {failed or 'ok'}", len(rows), len(cases))
    table = make_table(rows)
    with result_folder(folder, ("table.csv", "table.parquet"), overwrite=True) as temporary:
        table.to_csv(temporary / "table.csv", index=False)
        table.to_parquet(temporary / "table.parquet", index=False)
    return table


def _row(ended: Ended) -> Row:
    labels: Row = ended.trial.labels
    if ended.record is None:
        text = f"{type(ended.error).__name__}: {ended.error}"
        return {**labels, "error": text, "failure": text}
    record = ended.record
    place = {"code": record.code[:CODE_DIGITS], "folder": f"{TRIALS}/{record.folder.name}"}
    return {**labels, **record.row, **place}


def make_table(rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """Returns the rows as a table with all columns, each of one type, sorted by `LABELS`."""
    table = pd.DataFrame(list(rows)).reindex(columns=list(COLUMNS)).astype(COLUMNS)
    return table.sort_values(list(LABELS), ignore_index=True)


def print_summary(table: pd.DataFrame, console: Console) -> None:
    """Prints what failed, with its message, and then the worst of each group of cases."""
    failed = table[table["failure"].notna()]
    headline = f"{len(failed)} of {len(table)} cases fall short"
    console.print(headline, style="bold red" if len(failed) else "bold green")
    for key, message in zip(failed["key"], failed["failure"], strict=True):
        # Not as markup: a message may hold brackets.
        console.print(f"  {key}: {message}", markup=False, highlight=False, soft_wrap=True)
    if table["code"].nunique() > 1:
        console.print("these are results of several versions of the code", style="bold red")
    # Without lines, so that it fits in 80 columns.
    title = "The worst of each cloud, lengths in U, and the median time"
    printed = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    printed.add_column("cloud")
    for heading in ("recipe", "good", *(heading for heading, _, _ in PRINTED.values())):
        printed.add_column(heading, justify="right", no_wrap=True)
    for labels, group in table.groupby(list(LABELS[:-1]), sort=False):
        _, shape, sampling, recipe = map(str, labels)
        good = f"{int(group['failure'].isna().sum())}/{len(group)}"
        worst = ((group[name].agg(how), form) for name, (_, how, form) in PRINTED.items())
        values = ["-" if pd.isna(value) else format(value, form) for value, form in worst]
        printed.add_row(f"{shape} {sampling}", recipe, good, *values)
    console.print(printed)
