"""Processes that die, Dask workers that are killed, and schedulers that are not there."""

from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
import os
from pathlib import Path
import signal
import sys
import time

import pytest

from sgvf_drake.exceptions import ConfigurationError, ExperimentError
from sgvf_drake.experiments.workers import in_executor, in_processes, workers_of

# A module of its own, since processes import it.
WORK = """
import os
from pathlib import Path
import signal


def log(folder, item):
    with open(Path(folder) / "log.txt", "a") as file:
        print(item, file=file)
    if item < 0:
        raise ValueError(f"{item} is negative")


def die_once(folder, item):
    if item == 3:
        try:
            (Path(folder) / "died").touch(exist_ok=False)
        except FileExistsError:
            pass
        else:
            os.kill(os.getpid(), signal.SIGKILL)
    log(folder, item)


def die_always(folder, item):
    if item == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    log(folder, item)
"""


@pytest.fixture
def work(tmp_path, monkeypatch):
    """The functions above, by their names; each item that was done is a line of a log."""
    import importlib

    name = f"work_of_{tmp_path.name}"
    (tmp_path / f"{name}.py").write_text(WORK)
    monkeypatch.syspath_prepend(tmp_path)
    # Also where processes and Dask's workers look.
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *sys.path]))
    module = importlib.import_module(name)
    yield lambda function: partial(getattr(module, function), str(tmp_path))
    sys.modules.pop(name)


def done(tmp_path):
    return sorted(map(int, (tmp_path / "log.txt").read_text().split()))


def test_what_was_under_way_when_a_process_died_is_done_again(work, tmp_path, caplog):
    outcomes = dict(in_processes(work("die_once"), [3, 4], 1))
    assert outcomes == {3: None, 4: None}
    assert set(done(tmp_path)) == {3, 4}
    (message,) = [record.getMessage() for record in caplog.records]
    assert message == "a process has died; what was under way (2) is done again"


@pytest.mark.full
def test_what_kills_its_processes_has_failed_and_the_rest_is_done(work, tmp_path, monkeypatch):
    monkeypatch.setattr("sgvf_drake.experiments.workers.MOST_DEATHS", 1)
    outcomes = dict(in_processes(work("die_always"), [-1, 3, 1], 1))
    error = outcomes.pop(3)
    assert isinstance(error, ExperimentError)
    assert str(error) == "1 processes died of it, one after the other"
    assert str(outcomes.pop(-1)) == "-1 is negative"
    assert outcomes == {1: None}
    assert set(done(tmp_path)) == {-1, 1}


def test_an_executor_that_gives_up_gives_errors(work):
    class GivesUp(ThreadPoolExecutor):
        def submit(self, *arguments):
            future = Future()
            future.cancel()
            future.set_running_or_notify_cancel()
            return future

    (outcome,) = in_executor(work("log"), [1], GivesUp(1))
    assert type(outcome[1]).__name__ == "CancelledError"


@pytest.fixture(scope="module")
def cluster():
    """A Dask cluster of two worker processes on this machine."""
    from distributed import LocalCluster

    options = {"n_workers": 2, "threads_per_worker": 1, "host": "127.0.0.1"}
    with LocalCluster(**options, dashboard_address=":0") as cluster:
        yield cluster


@pytest.mark.full
def test_dask_does_again_what_was_on_a_worker_that_was_killed(work, tmp_path, cluster):
    with workers_of(cluster.scheduler_address) as executor:
        ends = in_executor(partial(slowly, str(tmp_path)), range(20), executor)
        first = next(ends)
        victim = next(iter(cluster.workers.values())).pid
        os.kill(victim, signal.SIGKILL)
        outcomes = dict([first, *ends])
    assert outcomes == dict.fromkeys(range(20))
    assert set(done(tmp_path)) == set(range(20))


def slowly(folder, item):
    time.sleep(0.2)
    with open(Path(folder) / "log.txt", "a") as file:
        print(item, file=file)


def test_without_a_scheduler_there_is_no_executor():
    with workers_of(None, jobs=4) as executor:
        assert executor is None


def test_a_scheduler_and_jobs_exclude_each_other():
    with (
        pytest.raises(ConfigurationError, match="either the jobs or the scheduler: tcp://a:1"),
        workers_of("tcp://a:1", jobs=2),
    ):
        pass


def test_without_dask_it_is_told_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(ConfigurationError, match=r"pip install 'sgvf-drake\[dask\]'"),
        workers_of("tcp://127.0.0.1:1"),
    ):
        pass


def test_a_scheduler_that_is_not_there_is_named(monkeypatch):
    monkeypatch.setattr("sgvf_drake.experiments.workers.PATIENCE_S", 0.5)
    with (
        pytest.raises(ConfigurationError, match=r"no Dask scheduler at tcp://127\.0\.0\.1:1: "),
        workers_of("tcp://127.0.0.1:1"),
    ):
        pass


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_workers": 0}, "has no workers: dask worker .* --nthreads 1 starts one"),
        ({"n_workers": 1, "threads_per_worker": 2}, "several threads, .* --nthreads 1"),
    ],
)
def test_a_cluster_that_cannot_do_the_work_is_refused(monkeypatch, options, message):
    from distributed import LocalCluster

    monkeypatch.setattr("sgvf_drake.experiments.workers.PATIENCE_S", 2.0)
    options |= {"processes": False, "protocol": "tcp://", "host": "127.0.0.1"}
    with (
        LocalCluster(**options, dashboard_address=":0") as cluster,
        pytest.raises(ConfigurationError, match=message),
        workers_of(cluster.scheduler_address),
    ):
        pass
