"""Work in several processes, of which one failure does not stop the rest."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context
from typing import Generic, TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Finished(Generic[Item, Result]):
    """A piece of work that has ended.

    Attributes:
        item: What it was.
        result: What came of it; None if it failed.
        error: Why it failed, or its process died; None if it did not.
    """

    item: Item
    result: Result | None
    error: BaseException | None


def each_finished(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int
) -> Iterator[Finished[Item, Result]]:
    """Does the work for every item and gives each when it ends, in this order with one job.

    Args:
        work: A function of a module, since it may run in another process.
        items: What it is called with.
        jobs: Processes that work at the same time; 1: this one.
    """
    if jobs == 1 or len(items) < 2:
        yield from (_attempt(work, item) for item in items)
        return
    # Spawned: a fork would copy the threads and locks of torch and Drake.
    pool = ProcessPoolExecutor(jobs, mp_context=get_context("spawn"))
    try:
        futures = {pool.submit(work, item): item for item in items}
        for future in as_completed(futures):
            error = future.exception()
            result = future.result() if error is None else None
            yield Finished(futures[future], result, error)
    finally:
        pool.shutdown(cancel_futures=True)


def _attempt(work: Callable[[Item], Result], item: Item) -> Finished[Item, Result]:
    try:
        return Finished(item, work(item), None)
    # Whatever one does wrong, the others are to run.
    except Exception as error:
        return Finished(item, None, error)
