"""Work in processes: what fails is told, and the rest is done."""

from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import pytest

from sgvf_drake.experiments import processes
from sgvf_drake.experiments.processes import each_finished


def invert(number):
    return 1 / number


class Pool:
    """Stands in for processes: works at once, and dies of an odd number."""

    def __init__(self, jobs, mp_context):
        self.jobs = jobs
        # Neither the threads nor the locks of this process are copied.
        assert mp_context.get_start_method() == "spawn"
        self.open = True
        Pool.last = self

    def submit(self, work, item):
        future = Future()
        if item % 2:
            future.set_exception(BrokenProcessPool("killed"))
        else:
            future.set_result(work(item))
        return future

    def shutdown(self, cancel_futures):
        assert cancel_futures
        self.open = False


@pytest.fixture
def pool(monkeypatch):
    monkeypatch.setattr(processes, "ProcessPoolExecutor", Pool)
    return Pool


def test_one_process_works_in_order():
    finished = list(each_finished(invert, [4, 0, 2], 1))
    assert [one.item for one in finished] == [4, 0, 2]
    assert [one.result for one in finished] == [0.25, None, 0.5]
    assert isinstance(finished[1].error, ZeroDivisionError)
    assert finished[0].error is finished[2].error is None


def test_work_is_given_when_it_ends():
    done = []
    work = each_finished(lambda item: done.append(item), [1, 2, 3], 1)
    assert next(work).item == 1
    assert done == [1]


def test_an_interruption_ends_the_work():
    def interrupt(item):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        next(each_finished(interrupt, [1, 2], 1))


def test_a_process_that_dies_is_an_error_of_its_item(pool):
    finished = {one.item: one for one in each_finished(invert, [4, 3, 2], 2)}
    assert (finished[4].result, finished[2].result) == (0.25, 0.5)
    assert finished[3].result is None
    assert str(finished[3].error) == "killed"
    assert pool.last.jobs == 2
    assert not pool.last.open


def test_the_pool_is_closed_when_nobody_asks_for_more(pool):
    work = each_finished(invert, [4, 2], 2)
    next(work)
    work.close()
    assert not pool.last.open


def test_one_item_needs_no_pool(monkeypatch):
    monkeypatch.setattr(processes, "ProcessPoolExecutor", None)
    assert [one.result for one in each_finished(invert, [2], 8)] == [0.5]
    assert list(each_finished(invert, [], 8)) == []
