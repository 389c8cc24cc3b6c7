"""The quality of learning, measured: many clouds, followed from many starts, in one table.

A case is a cloud, a recipe and a seed.  It is trained, followed in Drake, and compared with
its true path and with the exact score.  Each case leaves a JSON file and a figure when it is
finished, so that a run that was interrupted goes on where it was.

    python -m sgvf_drake.experiments.quality --out build/bench-learning --suite full
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from enum import StrEnum
from functools import cache, partial
import hashlib
import json
from multiprocessing import get_context
from pathlib import Path
import re
import sys
import time
import traceback
from typing import Annotated, Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table
import typer

import sgvf_drake
from sgvf_drake.exceptions import ConfigurationError, SgvfError
from sgvf_drake.experiments import clouds
from sgvf_drake.experiments.figures import follow_figure
from sgvf_drake.experiments.follow import FollowResult, follow
from sgvf_drake.experiments.results import SUMMARY, result_folder, write_summary
from sgvf_drake.fields import FloatArray, GuidingField
from sgvf_drake.metrics import default_duration
from sgvf_drake.paths import SHAPES, ReferencePath
from sgvf_drake.progress import Progress, no_progress
import systems

# Raised when this file measures something else under the name of a column.
RESULTS_VERSION = 1
# What decides the numbers, besides this file: folders and files of the two packages.
MEASURED_CODE = (
    *("paths", "fields", "learning", "metrics.py"),
    *("experiments/clouds.py", "experiments/follow.py", "experiments/simulation.py"),
)
# Digits of the digest of that code which a table shows.
CODE_DIGITS = 12

# The paper's fields are slow on their path (|m| 0.3 to 0.6), so they get as much more time.
PATIENCE = {"paper": 4.0}
# Where the learned score is compared with the exact one: distances from the path, U.
NEAR_PATH = (0.03, 0.3)
# Points drawn there (some land outside), and points on the path; the percentiles of more
# agree with these to the digits that are printed.
NEAR_SAMPLES = 1_500
PATH_SAMPLES = 200
LOW_PERCENTILE = 0.05

HEADLINE = ("concentric-circles", "separated-circles")
# Shapes of the size for which a noise of 0.05 is meant.
LARGE_SHAPES = (*HEADLINE, "circle", "square", "hexagon", "octagon", "triangle", "star")
RECIPES = ("paper", "robust", "exact")
# Seeds and starts of the suites, unless given.
CLOSED_SEEDS, CLOSED_STARTS = 5, 400
ROBUSTNESS_SEEDS, ROBUSTNESS_STARTS = 3, 100

LABELS = ("name", "shape", "sampling", "recipe", "seed")
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
# What every start has to do; a path without closed (open) pieces has no laps (ends).
WANTED = {"reach": 1.0, "lap": 1.0, "end": 1.0, "stall": 0.0, "leave": 0.0}

Row = dict[str, Any]
Outcome = tuple["Case", Row]


@dataclass(frozen=True)
class Case:
    """One training and what it is measured with.

    Attributes:
        name: The group of cases it belongs to.
        cloud: Path of the cloud, one of `clouds.PATHS`; with a source, a name for it.
        sampling: One of `clouds.SAMPLINGS`.
        recipe: Of the training.
        seed: Of the cloud and of the training.
        starts: Number of starts on a grid over the box.
        overrides: Names and values of a `TrainingConfig`, beside recipe and seed.
        source: A file with the ordered path.
    """

    name: str
    cloud: str
    sampling: str = "uniform"
    recipe: str = "robust"
    seed: int = 0
    starts: int = ROBUSTNESS_STARTS
    overrides: tuple[tuple[str, Any], ...] = ()
    source: str | None = None

    @property
    def key(self) -> str:
        """The stem of its files; it leaves out starts, overrides and source."""
        raw = "-".join([self.name, self.cloud, self.sampling, self.recipe, f"seed{self.seed}"])
        safe = re.sub(r"[^A-Za-z0-9_.-]", "_", raw)
        if safe == raw:
            return raw
        return f"{safe}-{hashlib.sha256(raw.encode()).hexdigest()[:8]}"


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
        **_following(run, cloud.unit_length),
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
    _write(case, row, folder, details, partial(follow_figure, field, run))
    return row


def _following(run: FollowResult, unit_length: float) -> Row:
    summary = run.summary()

    def in_units(key: str) -> float | None:
        value = summary[key]
        return None if value is None else value / unit_length

    fractions = {name: summary.get(f"{name}_fraction") for name in WANTED}
    return {
        **fractions,
        "rms_u": in_units("cross_track_rms"),
        "max_u": in_units("cross_track_max"),
        "speed_min": summary["speed_on_path_min"],
        "speed_max": summary["speed_on_path_max"],
    }


def measure_score(field: GuidingField, reference: ReferencePath, seed: int = 0) -> Row:
    """Compares the learned score with the exact one, near the path.

    Args:
        field: The field; its `mixture` is the exact score.
        reference: The true path.
        seed: Of the points.

    Returns:
        score_cosine, score_cosine_p5: mean and 5th percentile of the cosine between the
            scores, at distances `NEAR_PATH`.
        score_bias_u: the error of the score, averaged over a small circle about a point of
            the path, times sigma^2: how far it moves the path, U; mean over the path.
        score_curl: median of the antisymmetric over the whole part of the score's Jacobian
            (in the plane |dSx/dy - dSy/dx| / |J|); a true gradient has none.
        orthogonality: mean |cosine| between score and tangent.
    """
    rng = np.random.default_rng(seed)
    oracle = field.mixture
    x = _near_path(field, reference, rng)
    S = field.score(x)
    cosine = _cosine(S, oracle.score(x))
    J = field.score_model.score_and_jacobian(field.cloud.normalize(x))[1]
    turning = np.linalg.norm(J - np.swapaxes(J, 1, 2), axis=(1, 2)) / np.sqrt(2)
    return {
        "score_cosine": float(cosine.mean()),
        "score_cosine_p5": float(np.quantile(cosine, LOW_PERCENTILE)),
        "score_bias_u": _bias(field, reference),
        "score_curl": float(np.median(turning / np.linalg.norm(J, axis=(1, 2)))),
        "orthogonality": float(np.abs(_cosine(S, field.tangent(x))).mean()),
    }


def _near_path(
    field: GuidingField, reference: ReferencePath, rng: np.random.Generator
) -> FloatArray:
    near, far = (bound * field.cloud.unit_length for bound in NEAR_PATH)
    points = _on_path(reference, NEAR_SAMPLES)
    away = rng.standard_normal(points.shape)
    away *= rng.uniform(near, far, (len(away), 1)) / np.linalg.norm(away, axis=1)[:, None]
    x = points + away
    distance = reference.project(x).distance
    return x[(near <= distance) & (distance <= far)]


def _bias(field: GuidingField, reference: ReferencePath) -> float:
    unit, dim = field.cloud.unit_length, field.dim
    circle = NEAR_PATH[0] * unit * np.concatenate([np.eye(dim), -np.eye(dim)])
    x = (_on_path(reference, PATH_SAMPLES)[:, None] + circle).reshape(-1, dim)
    error = field.score(x) - field.mixture.score(x)
    mean = error.reshape(-1, len(circle), dim).mean(axis=1)
    return float(np.linalg.norm(mean, axis=1).mean() * field.sigma**2 * unit)


def _on_path(reference: ReferencePath, count: int) -> FloatArray:
    """Returns about `count` points (n, d) at equal steps of arc length."""
    shares = np.ceil(count * reference.lengths / reference.lengths.sum()).astype(int)
    pairs = zip(reference.pieces, shares, strict=True)
    return np.concatenate([piece.sample(int(share)) for piece, share in pairs])


def _cosine(a: FloatArray, b: FloatArray) -> FloatArray:
    norms = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
    # Where one of them is zero there is no angle; it counts as a right one.
    return np.asarray((a * b).sum(axis=1) / np.maximum(norms, np.finfo(np.float64).tiny))


def failure(row: Mapping[str, Any]) -> str | None:
    """Returns what a row falls short in, in words; None where it does not."""
    if row.get("error"):
        return str(row["error"])
    parts = [
        f"{name} {row[name]:.1%}"
        for name, wanted in WANTED.items()
        if row[name] is not None and row[name] != wanted
    ]
    if not row["self_check_passed"]:
        parts.append(f"self-check: {row['self_check_message']}")
    elif parts:
        parts.append("self-check passed")
    return ", ".join(parts) or None


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
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    stored = {case.key: finished_row(case, folder, any_code=any_code) for case in cases}
    rows = {key: row for key, row in stored.items() if row is not None}
    if rows:
        progress("finished before", len(rows), len(cases))
    todo = [case for case in cases if case.key not in rows]
    for case, row in _outcomes(todo, folder, jobs):
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


def _outcomes(cases: Sequence[Case], folder: Path, jobs: int) -> Iterator[Outcome]:
    """Runs cases and gives each with its row when it ends."""
    if jobs == 1:
        yield from ((case, _attempt(case, folder)) for case in cases)
        return
    # Spawned: a fork would copy the threads and locks of torch and Drake.
    pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"))
    try:
        futures = {pool.submit(_attempt, case, folder): case for case in cases}
        for future in as_completed(futures):
            yield futures[future], _row_of(future, futures[future], folder)
    finally:
        pool.shutdown(cancel_futures=True)


def _attempt(case: Case, folder: Path) -> Row:
    try:
        return run_case(case, folder)
    # Whatever one case does wrong, the others are to be measured.
    except Exception as error:
        return _record(error, case, folder)


def _row_of(future: Future[Row], case: Case, folder: Path) -> Row:
    """The row of a case from its process; an error where the process itself died."""
    error = future.exception()
    return future.result() if error is None else _record(error, case, folder)


def _record(error: BaseException, case: Case, folder: Path) -> Row:
    text = f"{type(error).__name__}: {error}"
    row = {**_labels(case), "error": text, "failure": text}
    # Not the figure of an earlier result beside an error.
    (folder / f"{case.key}.png").unlink(missing_ok=True)
    _write(case, row, folder, {"traceback": traceback.format_exception(error)})
    return row


def _labels(case: Case) -> Row:
    return {
        "name": case.name,
        "shape": case.cloud,
        "sampling": case.sampling,
        "recipe": case.recipe,
        "seed": case.seed,
        "starts": case.starts,
        "key": case.key,
        "code": code_digest()[:CODE_DIGITS],
    }


def _write(
    case: Case,
    row: Row,
    folder: Path,
    details: Mapping[str, Any] | None = None,
    draw: Callable[[Path], None] | None = None,
) -> None:
    names = (f"{case.key}.json", f"{case.key}.png")
    content = {"identity": _identity(case), "row": row, **(details or {})}
    with result_folder(folder, names, overwrite=True) as temporary:
        if draw is not None:
            draw(temporary / names[1])
        write_summary(temporary, content)
        (temporary / SUMMARY).rename(temporary / names[0])


def _identity(case: Case) -> dict[str, Any]:
    """What a stored result has to agree with, as plain JSON values."""
    source = None
    if case.source is not None and Path(case.source).is_file():
        source = hashlib.sha256(Path(case.source).read_bytes()).hexdigest()
    identity = {
        "case": asdict(case),
        "source": source,
        "results": RESULTS_VERSION,
        "version": sgvf_drake.__version__,
        "code": code_digest(),
    }
    plain: dict[str, Any] = json.loads(json.dumps(identity))
    return plain


@cache
def code_digest() -> str:
    """Returns a digest of the code that decides the numbers, as it is when first asked."""
    package = Path(sgvf_drake.__file__).parent
    places = [*(package / name for name in MEASURED_CODE), Path(systems.__file__).parent]
    digest = hashlib.sha256()
    for place in places:
        for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(f"{file.relative_to(place.parent)}\n".encode() + file.read_bytes())
    return digest.hexdigest()


class Suite(StrEnum):
    """The suites, as the command line offers them."""

    SMALL = "small"
    CLOSED = "closed"
    ROBUSTNESS = "robustness"
    RECIPES = "recipes"
    HANDWRITING = "handwriting"
    FULL = "full"


def suite_cases(
    suite: str,
    seeds: int | None = None,
    starts: int | None = None,
    circuits: str | Path | None = None,
) -> list[Case]:
    """Returns the cases of a suite.

    Args:
        suite: small (a minute or two), closed (every named shape), robustness (hard clouds,
            and the recipes side by side), recipes, handwriting, or full (all of them but
            small).
        seeds: Number of seeds, from 0; None: the suite's own.
        starts: Number of starts; None: the suite's own.
        circuits: A folder; every .csv file in it is an ordered path and becomes a case.

    Raises:
        ConfigurationError: There is no such suite, a number is not positive, or the folder
            holds no .csv file.
    """
    for name, number in (("seeds", seeds), ("starts", starts)):
        if number is not None and number < 1:
            raise ConfigurationError(f"the number of {name} must be at least 1, not {number}")
    if suite not in _SUITES:
        raise ConfigurationError(f"no suite {suite!r}; choose one of {', '.join(_SUITES)}")
    cases = [
        case
        for part, default_seeds, default_starts in _SUITES[suite]
        for seed in range(seeds or default_seeds)
        for case in part(seed, starts or default_starts)
    ]
    if circuits is not None:
        own = range(seeds or ROBUSTNESS_SEEDS)
        cases += _file_cases(Path(circuits), own, starts or ROBUSTNESS_STARTS)
    return cases


def _small(seed: int, starts: int) -> list[Case]:
    clean = ("concentric-circles", "separated-circles", "square", "star")
    cases = [Case("small", name, seed=seed, starts=starts) for name in clean]
    hard = (("circle", "forty"), ("star", "random-noisy"), ("hairpin", "uniform"))
    return cases + [Case("small", *cloud, seed=seed, starts=starts) for cloud in hard]


def _closed(seed: int, starts: int) -> list[Case]:
    return [Case("closed", name, seed=seed, starts=starts) for name in SHAPES]


def _robustness(seed: int, starts: int) -> list[Case]:
    hard = (
        *((name, "forty") for name in LARGE_SHAPES),
        *((name, "random-noisy") for name in SHAPES),
        ("circle", "uneven"),
        *((name, "duplicates") for name in ("concentric-circles", "square")),
        *((name, "outliers") for name in ("concentric-circles", "square")),
        ("concentric-circles", "dense"),
        *((name, "uniform") for name in ("millimetres", "kilometres")),
        *((name, "uniform") for name in ("two-sizes", "near-touch", "hairpin")),
        *((name, "fine") for name in clouds.CIRCUITS),
    )
    return [Case("robustness", *cloud, seed=seed, starts=starts) for cloud in hard]


def _recipes(seed: int, starts: int) -> list[Case]:
    return [
        Case("recipes", name, recipe=recipe, seed=seed, starts=starts)
        for name in HEADLINE
        for recipe in RECIPES
    ]


def _handwriting(seed: int, starts: int) -> list[Case]:
    overrides = (("open", True),)
    return [
        Case("handwriting", name, "recorded", seed=seed, starts=starts, overrides=overrides)
        for name in clouds.HANDWRITING
    ]


def _file_cases(folder: Path, seeds: Iterable[int], starts: int) -> list[Case]:
    files = sorted(folder.glob("*.csv"))
    if not files:
        raise ConfigurationError(f"{folder} holds no .csv file")
    return [
        Case("circuits", file.stem, "recorded", seed=seed, starts=starts, source=str(file))
        for seed in seeds
        for file in files
    ]


_Part = tuple[Callable[[int, int], list[Case]], int, int]
_CLOSED: _Part = (_closed, CLOSED_SEEDS, CLOSED_STARTS)
_ROBUSTNESS: _Part = (_robustness, ROBUSTNESS_SEEDS, ROBUSTNESS_STARTS)
_RECIPES: _Part = (_recipes, ROBUSTNESS_SEEDS, ROBUSTNESS_STARTS)
_HANDWRITING: _Part = (_handwriting, 1, ROBUSTNESS_STARTS)
_SUITES: dict[str, tuple[_Part, ...]] = {
    Suite.SMALL: ((_small, 1, ROBUSTNESS_STARTS),),
    Suite.CLOSED: (_CLOSED,),
    Suite.ROBUSTNESS: (_ROBUSTNESS, _RECIPES),
    Suite.RECIPES: (_RECIPES,),
    Suite.HANDWRITING: (_HANDWRITING,),
    Suite.FULL: (_CLOSED, _ROBUSTNESS, _RECIPES, _HANDWRITING),
}


def print_summary(table: pd.DataFrame, console: Console) -> None:
    """Prints what failed, with its message, and then the table by groups of cases."""
    failed = table[table["failure"].notna()]
    headline = f"{len(failed)} of {len(table)} cases fall short"
    console.print(headline, style="bold red" if len(failed) else "bold green")
    for key, message in zip(failed["key"], failed["failure"], strict=True):
        # Not as markup: a message may hold brackets.
        console.print(f"  {key}: {message}", markup=False, highlight=False, soft_wrap=True)
    if table["code"].nunique() > 1:
        console.print("these are results of several versions of the code", style="bold red")
    columns = {
        "lap": ("lap", "min", ".1%"),
        "end": ("end", "min", ".1%"),
        "RMS": ("rms_u", "max", ".4f"),
        "max": ("max_u", "max", ".3f"),
        "cosine": ("score_cosine", "min", ".3f"),
        "bias": ("score_bias_u", "max", ".4f"),
        "CPU s": ("train_cpu_s", "median", ".1f"),
    }
    # Without lines, so that it fits in 80 columns.
    title = "The worst of each cloud, lengths in U, and the median time"
    printed = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    printed.add_column("cloud")
    for heading in ("recipe", "good", *columns):
        printed.add_column(heading, justify="right", no_wrap=True)
    for labels, group in table.groupby(list(LABELS[:-1]), sort=False):
        _, shape, sampling, recipe = map(str, labels)
        good = f"{int(group['failure'].isna().sum())}/{len(group)}"
        values = [_format(group[name].agg(how), to) for name, how, to in columns.values()]
        printed.add_row(f"{shape} {sampling}", recipe, good, *values)
    console.print(printed)


def _format(value: float, form: str) -> str:
    return "-" if pd.isna(value) else format(value, form)


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


@app.command()
def _run(
    out: Annotated[Path, typer.Option(help="Folder of the results.")],
    suite: Annotated[Suite, typer.Option(help="Which cases to run.")] = Suite.SMALL,
    seeds: Annotated[int | None, typer.Option(help="Number of seeds, from 0.")] = None,
    starts: Annotated[int | None, typer.Option(help="Number of starts of each case.")] = None,
    jobs: Annotated[int, typer.Option(help="Processes that run cases.")] = 1,
    circuits: Annotated[
        Path | None, typer.Option(help="Folder of ordered paths, .csv, to add as cases.")
    ] = None,
    any_code: Annotated[
        bool, typer.Option("--any-code", help="Keep finished cases of other code.")
    ] = False,
) -> None:
    """Measures the quality of learning; what is finished in --out is not run again."""
    console = Console()

    def report(stage: str, done: float, total: float) -> None:
        line = f"[{done:.0f}/{total:.0f}] {stage}"
        console.print(line, markup=False, highlight=False, soft_wrap=True)

    cases = suite_cases(suite, seeds, starts, circuits)
    table = run_suite(cases, out, report, jobs=jobs, any_code=any_code)
    print_summary(table, console)
    if table["error"].notna().any():
        raise typer.Exit(1)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs the command line; bad input ends in one line on stderr and exit status 2."""
    try:
        app(arguments)
    except (SgvfError, OSError) as error:
        Console(stderr=True).print(f"error: {error}", markup=False, soft_wrap=True)
        sys.exit(2)


if __name__ == "__main__":
    main()
