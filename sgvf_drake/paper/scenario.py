"""Scenarios: an experiment with its options in a YAML file, and what runs it into a folder."""

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from functools import reduce
from importlib.resources import files
import json
import operator
from os import PathLike
from pathlib import Path
import time
from typing import Any

from pydrake.common.yaml import yaml_dump_typed, yaml_load_file, yaml_load_typed
import yaml

import sgvf_drake
from sgvf_drake.exceptions import ConfigurationError
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
from sgvf_drake.paper.baselines import BaselineComparison
from sgvf_drake.paper.corners import Corners
from sgvf_drake.paper.experiment import save_rows
from sgvf_drake.paper.flights import Flights
from sgvf_drake.paper.indexing import Indexing
from sgvf_drake.paper.loss_ablation import LossAblation
from sgvf_drake.paper.overview import Overview
from sgvf_drake.paper.recipe_ablation import RecipeAblation
from sgvf_drake.paper.stein import SteinIdentity
from sgvf_drake.paper.vanishing import ScoreVanishing
from sgvf_drake.progress import Progress, no_progress

BASE = "scenario"
"""The part of a file that is complete; every other part is a named override of it."""

KINDS: tuple[type, ...] = (
    BaselineComparison,
    Corners,
    Flights,
    Indexing,
    LossAblation,
    Overview,
    RecipeAblation,
    ScoreVanishing,
    SteinIdentity,
)
"""The kinds of experiment; the name of a class is its tag in a scenario."""

SCENARIO_FILE, ROWS_FILE, TRIALS = "scenario.yaml", "rows.json", "trials"
"""What a run leaves besides its summary, exhibits and logs."""


@dataclass
class NoExperiment:
    """Stands where a scenario names no kind."""


_PACKAGED = Path(str(files("sgvf_drake.paper") / "scenarios"))
_Kind: Any = reduce(operator.or_, KINDS, NoExperiment)


@dataclass
class Scenario:
    """An experiment as it is run.

    Attributes:
        title: What it shows, in a few words.
        source: Where the paper has it: "Fig. 4".
        experiment: A kind with its options.
    """

    title: str = ""
    source: str = ""
    experiment: _Kind = field(default_factory=NoExperiment)

    def to_yaml(self) -> str:
        """Returns it as a file that `load_scenario` reads."""
        return yaml_dump_typed(self, child_name=BASE)

    def summary(self) -> dict[str, Any]:
        """Returns it as plain values."""
        return {
            "title": self.title,
            "source": self.source,
            "kind": type(self.experiment).__name__,
            "options": asdict(self.experiment),
        }


def scenario_names() -> list[str]:
    """Returns the names of the scenarios that come with the package, in their order."""
    return sorted(file.stem for file in _PACKAGED.glob("*.yaml"))


def override_names(scenario: str | Path) -> list[str]:
    """Returns the names of the overrides in a scenario's file, in their order.

    Raises:
        ConfigurationError: If there is no such scenario, or its file cannot be read.
    """
    return _overrides_in(_find(scenario))


def load_scenario(
    scenario: str | Path, overrides: Sequence[str] = (), settings: Sequence[str] = ()
) -> Scenario:
    """Reads a scenario.

    The file has a part `scenario`, and other parts that override it in parts; with Drake's
    `yaml_load_typed`, so that an unknown key is an error.

    Args:
        scenario: A name of `scenario_names()`, or a YAML file.
        overrides: Names of overrides in the file, applied in this order.
        settings: Options of the experiment as ``name=value``, the value in YAML; last.

    Raises:
        ConfigurationError: If there is no such scenario or override, or the file or a setting
            cannot be used; the message names it.
    """
    file = _find(scenario)
    known = _overrides_in(file)
    unknown = [name for name in overrides if name not in known]
    if unknown:
        raise ConfigurationError(
            f"there is no override {unknown[0]!r} in {file} (it has "
            f"{', '.join(known) or 'none'})"
        )
    loaded = Scenario()
    for part in (BASE, *overrides):
        with _named(f"{file}, {part}"):
            loaded = yaml_load_typed(
                schema=Scenario, filename=str(file), child_name=part, defaults=loaded
            )
        if isinstance(loaded.experiment, NoExperiment):
            raise ConfigurationError(
                f"{file}, {part}: the experiment needs a kind, as in `experiment: !"
                f"{KINDS[0].__name__}` (they are {', '.join(kind.__name__ for kind in KINDS)})"
            )
    for setting in settings:
        loaded = _with_setting(loaded, setting)
    seeds = loaded.experiment.seeds
    if not seeds or len(set(seeds)) < len(seeds) or min(seeds) < 0:
        raise ConfigurationError(
            f"{file}: seeds must be different numbers from 0 on, at least one, not {seeds}"
        )
    return loaded


def _find(scenario: str | Path) -> Path:
    path = Path(scenario)
    if path.suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise ConfigurationError(f"there is no scenario file {path}")
        return path
    packaged = _PACKAGED / f"{scenario}.yaml"
    if not packaged.is_file():
        raise ConfigurationError(
            f"there is no scenario {str(scenario)!r} (they are {', '.join(scenario_names())}; "
            "or give a .yaml file)"
        )
    return packaged


def _overrides_in(file: Path) -> list[str]:
    with _named(str(file)):
        content = yaml_load_file(str(file))
    if not isinstance(content, dict) or BASE not in content:
        raise ConfigurationError(f"there is no part {BASE!r} in {file}")
    return [name for name in content if name != BASE]


def _with_setting(scenario: Scenario, setting: str) -> Scenario:
    name, equals, value = setting.partition("=")
    options = [option.name for option in fields(scenario.experiment)]
    if not equals or name not in options:
        raise ConfigurationError(
            f"the setting {setting!r} is not name=value with a name of "
            f"{type(scenario.experiment).__name__} ({', '.join(options)})"
        )
    data = f"experiment: !{type(scenario.experiment).__name__}\n  {name}: {value}\n"
    with _named(f"setting {setting!r}"):
        loaded: Scenario = yaml_load_typed(schema=Scenario, data=data, defaults=scenario)
    return loaded


@contextmanager
def _named(place: str) -> Iterator[None]:
    """Turns what reading YAML raises into an error that tells where."""
    try:
        yield
    except (RuntimeError, TypeError, ValueError, OSError, yaml.YAMLError) as error:
        raise ConfigurationError(f"{place}: {' '.join(str(error).split())}") from None


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
