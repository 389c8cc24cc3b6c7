"""Where the trials of experiments run: in parallel, each stored as it ends, none twice."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import partial
import multiprocessing
import os
from pathlib import Path
import threading
import time
from typing import Any

from sgvf_drake.exceptions import ConfigurationError, ExperimentError
from sgvf_drake.experiments.measured_code import code_digest
from sgvf_drake.experiments.results import hidden_folder, remove_abandoned
from sgvf_drake.experiments.store import Key, Record, Row, TrialStore, make_key
from sgvf_drake.progress import Progress, no_progress

# What the hidden folders are called in which trials run.
HIDDEN = "trial"

Measure = Callable[[Any, Path], Row]

__all__ = ["Ended", "Measure", "Record", "Row", "Workbench"]


@dataclass(frozen=True, eq=False)
class Ended:
    """A trial that has ended, now or in an earlier run.

    Attributes:
        trial: What it was.
        record: What came of it; None if it failed.
        error: Why it failed, or its process died; None if it did not.
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
        jobs: Processes that measure at the same time; 1: this one.
        progress: Told how many trials of a stage have ended.
        executor: Measures in place of processes of this machine; where it does so in others,
            they see the same `store`.
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
        self.store = TrialStore(store, any_code)
        self.jobs = jobs
        self.progress = progress
        self.executor = executor
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
        for trial, error in self._work(measure, list(todo.values())):
            record = None if error else self.store.find(_key(measure, trial))
            yield Ended(trial, record, error)

    def _work(
        self, measure: Measure, trials: Sequence[Any]
    ) -> Iterator[tuple[Any, BaseException | None]]:
        """Measures trials and gives each when it ends, in their order with one job."""
        work = partial(_measure, measure, self.store)
        if self.executor is None and (self.jobs == 1 or len(trials) < 2):
            for trial in trials:
                yield trial, _error_of(work, trial, _code(measure, trial))
            return
        executor = self.executor or _processes(self.jobs)
        try:
            futures = {
                executor.submit(work, trial, _code(measure, trial)): trial for trial in trials
            }
            for future in as_completed(futures):
                yield futures[future], future.exception()
        finally:
            # One that was given is for others to end.
            if self.executor is None:
                executor.shutdown(cancel_futures=True)


def _measure(measure: Measure, store: TrialStore, trial: Any, code: str) -> None:
    """Stores the row and the files of a trial, whole or not at all.

    Raises:
        ExperimentError: If the code in this process is not that of the run.
    """
    # Before the work: code that is edited meanwhile has no part in it.
    if _code(measure, trial) != code:
        raise ExperimentError("the code was changed while the trials ran; run them again")
    with hidden_folder(store.folder, HIDDEN) as folder:
        begin = time.perf_counter()
        row = measure(trial, folder)
        elapsed_s = time.perf_counter() - begin
        store.put(make_key(measure, trial, code), row, folder, elapsed_s)


def _error_of(work: Callable[..., None], *arguments: Any) -> Exception | None:
    try:
        work(*arguments)
    # Whatever one does wrong, the others are to run.
    except Exception as error:
        return error
    return None


def _processes(jobs: int) -> Executor:
    # Spawned: a fork would copy the threads and locks of torch and Drake.
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(jobs, mp_context=spawn, initializer=_end_with_parent)


def _end_with_parent() -> None:
    """Has this process end with the one that started it, also where that one is killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


def _key(measure: Measure, trial: Any) -> Key:
    return make_key(measure, trial, _code(measure, trial))


def _code(measure: Measure, trial: Any) -> str:
    # The class of the trial may compute what is not among its values.
    kind: Any = type(trial)
    return code_digest(measure, kind)
