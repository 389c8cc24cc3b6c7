"""Who does the work of experiments: processes of this machine, a Dask cluster, any Executor."""

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    as_completed,
    wait,
)
from contextlib import contextmanager
import logging
import multiprocessing
import os
import threading
from typing import Any

from sgvf_drake.exceptions import ConfigurationError, ExperimentError

# Work has failed when so many processes have died that did nothing else at the time.
MOST_DEATHS = 3
# How long a scheduler may take to answer, and to have its first worker, s.
PATIENCE_S = 10

Work = Callable[[Any], None]
Outcome = tuple[Any, BaseException | None]
"""What was to be done, and why it failed, if it did."""


def in_this_process(work: Work, items: Sequence[Any]) -> Iterator[Outcome]:
    """Works through items in their order."""
    for item in items:
        yield item, _error_of(work, item)


def in_executor(work: Work, items: Sequence[Any], executor: Executor) -> Iterator[Outcome]:
    """Gives each item as it ends; what has not begun is given up where nobody asks for more."""
    futures = {executor.submit(work, item): item for item in items}
    try:
        for future in as_completed(futures):
            # Also that it was cancelled, as work is whose cluster has gone.
            yield futures[future], _error_of(future.result)
    finally:
        for future in futures:
            future.cancel()


def in_processes(work: Work, items: Sequence[Any], jobs: int) -> Iterator[Outcome]:
    """Gives each item as it ends, in processes of which any may die.

    A pool is broken when one of its processes dies, and does not tell what that one did.  So
    all that was under way is done again, one after the other, each in a process of its own;
    one that ends such processes again and again has failed.  A new pool does the rest.

    Args:
        work: What is done with each; a function of a module, or a partial one.
        items: The items.
        jobs: Processes at the same time.
    """
    waiting = deque(items)
    while waiting:
        suspects = yield from _in_pool(work, waiting, jobs)
        if suspects:
            logging.getLogger(__name__).warning(
                "a process has died; what was under way (%d) is done again", len(suspects)
            )
        for item in suspects:
            for _ in range(MOST_DEATHS):
                if not (yield from _in_pool(work, deque([item]), 1)):
                    break
            else:
                error = f"{MOST_DEATHS} processes died of it, one after the other"
                yield item, ExperimentError(error)


def _in_pool(work: Work, waiting: deque[Any], jobs: int) -> Generator[Outcome, None, list[Any]]:
    """Takes items and gives each as it ends, until there are none or a process dies.

    Returns:
        Those that were under way then.
    """
    running: dict[Future[None], Any] = {}
    died: list[Any] = []
    executor, broken = _pool(jobs), False
    try:
        while running or (waiting and not broken):
            # One more than are at work, so that none waits for this process.
            while waiting and not broken and len(running) <= jobs:
                try:
                    running[executor.submit(work, waiting[0])] = waiting[0]
                    waiting.popleft()
                except BrokenExecutor:
                    broken = True
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                item, error = running.pop(future), future.exception()
                if isinstance(error, BrokenExecutor):
                    broken = True
                    died.append(item)
                else:
                    yield item, error
    finally:
        executor.shutdown(cancel_futures=True)
    return died


def _error_of(work: Callable[..., None], *arguments: Any) -> Exception | None:
    try:
        work(*arguments)
    # Whatever one does wrong, the others are to be done.
    except Exception as error:
        return error
    return None


def _pool(jobs: int) -> Executor:
    # Spawned: a fork would copy the threads and locks of torch and Drake.
    spawn = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(jobs, mp_context=spawn, initializer=_end_with_parent)


def _end_with_parent() -> None:
    """Has this process end with the one that started it, also where that one is killed."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait_for_its_end() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait_for_its_end, daemon=True).start()


@contextmanager
def workers_of(scheduler: str | None, jobs: int = 1) -> Iterator[Executor | None]:
    """Gives the workers of a Dask cluster as an Executor; None without a scheduler.

    Dask does again what was under way on a worker that died.

    Args:
        scheduler: Its address, as tcp://host:8786; None: the work is that of processes here.
        jobs: Number of those processes; of a cluster it says nothing, and so must be 1.

    Raises:
        ConfigurationError: If Dask is not installed, if there is no such scheduler, if it has
            no workers, or some that do several things in one process.
    """
    if scheduler is None:
        yield None
        return
    if jobs != 1:
        raise ConfigurationError(
            f"give either the jobs or the scheduler: {scheduler} has its own workers"
        )
    try:
        import distributed
    except ImportError:
        raise ConfigurationError(
            "a scheduler needs Dask: pip install 'sgvf-drake[dask]'"
        ) from None
    # Its functions carry no types.
    connect: Any = distributed.Client
    try:
        client = connect(scheduler, timeout=PATIENCE_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ConfigurationError(
            f"there is no Dask scheduler at {scheduler}: {error}"
        ) from None
    with client:
        _check_workers(client, scheduler)
        # Not pure: each result is a stored row, and not to be shared.
        yield client.get_executor(pure=False)


def _check_workers(client: Any, scheduler: str) -> None:
    """Raises ConfigurationError unless there are workers of one thread each."""
    try:
        client.wait_for_workers(1, timeout=PATIENCE_S)
    except TimeoutError:
        raise ConfigurationError(
            f"the scheduler at {scheduler} has no workers: dask worker {scheduler} "
            "--nthreads 1 starts one"
        ) from None
    # The random numbers of torch, for one, belong to the process and not to the thread.
    found = client.scheduler_info(n_workers=-1)["workers"]
    several = [address for address, worker in found.items() if worker["nthreads"] != 1]
    if several:
        raise ConfigurationError(
            f"the worker {several[0]} has several threads, whose trials would disturb each "
            "other; start it with --nthreads 1"
        )
