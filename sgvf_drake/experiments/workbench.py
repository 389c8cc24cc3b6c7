"""Where the trials of experiments run: in parallel, each stored as it ends, none twice."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
import socket
import time
from typing import Any

from sgvf_drake.exceptions import ConfigurationError, ExperimentError
from sgvf_drake.experiments.measured_code import code_digest
from sgvf_drake.experiments.results import hidden_folder, remove_abandoned
from sgvf_drake.experiments.store import Key, Record, Row, TrialStore, make_key
from sgvf_drake.experiments.workers import (
    Outcome,
    in_executor,
    in_processes,
    in_this_process,
)
from sgvf_drake.progress import Progress, no_progress

# What the hidden folders are called in which trials run.
HIDDEN = "trial"
SAME_FOLDER = "all workers need the folder of the results under the same name"

Measure = Callable[[Any, Path], Row]

__all__ = ["Ended", "Measure", "Record", "Row", "Workbench"]


@dataclass(frozen=True, eq=False)
class Ended:
    """A trial that has ended, now or in an earlier run.

    Attributes:
        trial: What it was.
        record: What came of it; None if it failed.
        error: Why it failed; None if it did not.
    """

    trial: Any
    record: Record | None
    error: BaseException | None


class Workbench:
    """Runs trials and keeps what they found, so that a run can be resumed.

    A trial is a frozen dataclass of plain values; it is measured by a function of a module,
    ``measure(trial, folder) -> row``, which may leave files in the folder.  A stored record
    counts as long as the trial and the code under it are the same; comments and docstrings
    are no part of the code.

    Args:
        store: The folder of the records; made when the first trial ends.
        jobs: Processes that measure at the same time; 1: this one.  What dies with one of
            them is measured again in another.
        progress: Told how many trials of a stage have ended.
        executor: Measures in place of processes of this machine, as `workers_of` does; wherever
            that is, the folder `store` is the same.
        any_code: Whether records of other code count as well.

    Raises:
        ConfigurationError: If there is no process to run them.
    """

    def __init__(
        self,
        store: Path,
        jobs: int = 1,
        progress: Progress = no_progress,
        *,
        executor: Executor | None = None,
        any_code: bool = False,
    ) -> None:
        if jobs < 1:
            raise ConfigurationError(f"the number of jobs must be at least 1, not {jobs}")
        # Workers may be at home in another folder.
        self.store = TrialStore(store.absolute(), any_code)
        self.jobs = jobs
        self.progress = progress
        self.executor = executor
        self.trial_s = 0.0
        """Time of all trials asked for so far, those that were stored included."""
        self.measured = 0
        """How many have ended so far, those that were stored before excluded."""

    def run(self, measure: Measure, trials: Sequence[Any], stage: str) -> list[Record]:
        """Returns the records of trials, in their order; runs those that are not stored.

        Args:
            measure: What measures one; a function of a module, since it may run in another
                process.
            trials: The trials.
            stage: What they are called where progress is shown.

        Raises:
            ExperimentError: If a trial failed; the others ran, and are stored.
        """
        keys = [_key(measure, trial) for trial in trials]
        total = len(set(keys))
        records, failures = {}, []
        self.progress(stage, 0, total)
        for done, ended in enumerate(self.each(measure, trials), start=1):
            self.progress(stage, done, total)
            if ended.record is None:
                failures.append(ended)
            else:
                records[_key(measure, ended.trial)] = ended.record
        if failures:
            trial, error = failures[0].trial, failures[0].error
            raise ExperimentError(
                f"{len(failures)} of {total} trials of {stage} failed; the first, "
                f"{trial}: {type(error).__name__}: {error}"
            ) from error
        found = [records[key] for key in keys]
        self.trial_s += sum(record.elapsed_s for record in found)
        return found

    def each(self, measure: Measure, trials: Sequence[Any]) -> Iterator[Ended]:
        """Gives each different trial when it has ended, those that are stored first."""
        remove_abandoned(self.store.folder, HIDDEN)
        todo = {}
        for key, trial in {_key(measure, trial): trial for trial in trials}.items():
            record = self.store.find(key)
            if record is None:
                todo[key] = trial
            else:
                yield Ended(trial, record, None)
        for (trial, _), error in self._work(measure, list(todo.values())):
            record = None if error else self.store.find(_key(measure, trial))
            if record is None and error is None:
                error = ExperimentError(
                    f"it left nothing in {self.store.folder}: {SAME_FOLDER}"
                )
            self.measured += 1
            yield Ended(trial, record, error)

    def _work(self, measure: Measure, trials: Sequence[Any]) -> Iterator[Outcome]:
        """Measures trials and gives each when it ends, in their order with one job.

        Each of them is given with the digest of its code, as it is now.
        """
        if not trials:
            return iter(())
        self.store.make_folder()
        work = partial(_measure, measure, self.store)
        items = [(trial, _code(measure, trial)) for trial in trials]
        if self.executor is not None:
            return in_executor(work, items, self.executor)
        if self.jobs == 1 or len(items) == 1:
            return in_this_process(work, items)
        return in_processes(work, items, self.jobs)


def _measure(measure: Measure, store: TrialStore, item: tuple[Any, str]) -> None:
    """Stores the row and the files of a trial, whole or not at all.

    Args:
        measure: What measures it.
        store: Where it is stored.
        item: The trial, and the digest of the code of the run.

    Raises:
        ExperimentError: If the code in this process is not that of the run, or if it sees
            another folder.
    """
    trial, code = item
    # Before the work: code that is edited meanwhile has no part in it.
    if _code(measure, trial) != code:
        raise ExperimentError("the code was changed while the trials ran; run them again")
    if not store.folder.is_dir():
        raise ExperimentError(
            f"the worker on {socket.gethostname()} sees no {store.folder}: {SAME_FOLDER}"
        )
    with hidden_folder(store.folder, HIDDEN) as folder:
        begin = time.perf_counter()
        row = measure(trial, folder)
        elapsed_s = time.perf_counter() - begin
        store.put(make_key(measure, trial, code), row, folder, elapsed_s)


def _key(measure: Measure, trial: Any) -> Key:
    return make_key(measure, trial, _code(measure, trial))


def _code(measure: Measure, trial: Any) -> str:
    # The class of the trial may compute what is not among its values.
    kind: Any = type(trial)
    return code_digest(measure, kind)
