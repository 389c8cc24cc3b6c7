"""Where the trials of experiments run: in parallel, each stored as it ends, none twice."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
import hashlib
import inspect
import json
import os
from pathlib import Path
import shutil
import tempfile
import time
from typing import Any

import sgvf_drake
from sgvf_drake.exceptions import ConfigurationError, ExperimentError
from sgvf_drake.experiments.measured_code import code_digest
from sgvf_drake.experiments.processes import each_finished
from sgvf_drake.experiments.results import plain
from sgvf_drake.progress import Progress, no_progress

ROW = "row.json"
# Digits of the digest in the name of a trial's folder.
KEY_DIGITS = 12

Row = dict[str, Any]
Measure = Callable[[Any, Path], Row]


@dataclass(frozen=True, eq=False)
class Record:
    """A trial that has run.

    Attributes:
        row: What it measured, as plain JSON values.
        folder: The files that it left.
        elapsed_s: How long it took, when it ran.
    """

    row: Row
    folder: Path
    elapsed_s: float


class Workbench:
    """Runs trials and keeps what they found, so that a run can be resumed.

    A trial is a frozen dataclass of plain values; it is measured by a function of a module,
    ``measure(trial, folder) -> row``, which may leave files in the folder.  A stored record
    counts as long as the trial, the function's module and the code under it are the same.

    Args:
        store: The folder of the records; made when the first trial ends.
        jobs: Processes that measure at the same time; 1: this one.
        progress: Told how many trials of a stage have ended.

    Raises:
        ConfigurationError: There is no process to run them.
    """

    def __init__(self, store: Path, jobs: int = 1, progress: Progress = no_progress) -> None:
        if jobs < 1:
            raise ConfigurationError(f"the number of jobs must be at least 1, not {jobs}")
        self.store = store
        self.jobs = jobs
        self.progress = progress
        self.trial_s = 0.0
        """Time of all trials asked for so far, those that were stored included."""

    def run(self, measure: Measure, trials: Sequence[Any], stage: str) -> list[Record]:
        """Returns the records of trials, in their order; runs those that are not stored.

        Args:
            measure: What measures one; a function of a module, since it may run in another
                process.
            trials: The trials.
            stage: What they are called where progress is shown.

        Raises:
            ExperimentError: A trial failed; the others ran, and are stored.
        """
        todo = {
            _key(measure, trial): trial
            for trial in trials
            if self._stored(measure, trial) is None
        }
        total = len({_key(measure, trial) for trial in trials})
        done, failures = total - len(todo), []
        self.progress(stage, done, total)
        work = partial(_measure, measure, self.store, _code(measure))
        for finished in each_finished(work, list(todo.values()), self.jobs):
            done += 1
            self.progress(stage, done, total)
            if finished.error is not None:
                failures.append(finished)
        if failures:
            trial, error = failures[0].item, failures[0].error
            raise ExperimentError(
                f"{len(failures)} of {total} trials of {stage} failed; the first, "
                f"{trial}: {type(error).__name__}: {error}"
            ) from error
        records = [self._stored(measure, trial) for trial in trials]
        found = [record for record in records if record is not None]
        assert len(found) == len(trials)
        self.trial_s += sum(record.elapsed_s for record in found)
        return found

    def _stored(self, measure: Measure, trial: Any) -> Record | None:
        folder = self.store / _key(measure, trial)
        try:
            stored = json.loads((folder / ROW).read_text(encoding="utf-8"))
            if stored["identity"] != _identity(measure, trial):
                return None
            return Record(stored["row"], folder, stored["elapsed_s"])
        except (OSError, ValueError, TypeError, KeyError):
            return None


def _measure(measure: Measure, store: Path, code: str, trial: Any) -> None:
    """Leaves a folder with the row and the files of a trial, whole or not at all.

    Raises:
        ExperimentError: The code in this process is not that of the run.
    """
    # Before the work: code that is edited meanwhile has no part in it.
    identity = _identity(measure, trial)
    if identity["code"] != code:
        raise ExperimentError("the code was changed while the trials ran; run them again")
    store.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(dir=store, prefix="."))
    # Inside of that one, which nobody else may read.
    folder = temporary / "record"
    folder.mkdir()
    try:
        begin = time.perf_counter()
        row = measure(trial, folder)
        content = {
            "identity": identity,
            "row": plain(row),
            "elapsed_s": time.perf_counter() - begin,
        }
        text = json.dumps(content, indent=2, allow_nan=False)
        (folder / ROW).write_text(text + "\n", encoding="utf-8")
        target = store / _key(measure, trial)
        shutil.rmtree(target, ignore_errors=True)
        os.replace(folder, target)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _name(measure: Measure) -> str:
    return f"{measure.__module__}.{measure.__qualname__}"


def _key(measure: Measure, trial: Any) -> str:
    content = json.dumps([_name(measure), plain(asdict(trial))], sort_keys=True)
    digest = hashlib.sha256(content.encode()).hexdigest()[:KEY_DIGITS]
    return f"{measure.__qualname__}-{digest}"


def _identity(measure: Measure, trial: Any) -> Row:
    """What a stored record has to agree with, as plain JSON values."""
    return {
        "measure": _name(measure),
        "trial": plain(asdict(trial)),
        "version": sgvf_drake.__version__,
        "code": _code(measure),
    }


def _code(measure: Measure) -> str:
    return code_digest(Path(inspect.getfile(measure)))
