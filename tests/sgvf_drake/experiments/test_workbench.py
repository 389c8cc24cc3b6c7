"""The bench of trials: each runs once, whole or not at all, in one process or in several."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
import importlib
import os
import signal
import stat
import subprocess
import sys
import time
from types import SimpleNamespace

import pytest

from sgvf_drake.exceptions import ConfigurationError, ExperimentError
from sgvf_drake.experiments import measured_code, store, workbench
from sgvf_drake.experiments.workbench import Workbench

# Modules of their own, since processes import them.  Each trial writes a line into a file.
TRIALS = """
from dataclasses import dataclass
import os
import time

from roots_of_{stem} import root


@dataclass(frozen=True)
class Trial:
    number: int
    log: str
    values: tuple = (1.0, 2.0)

    @property
    def doubled(self):
        return 2 * self.number


def measure(trial, folder):
    with open(trial.log, "a") as log:
        print(trial.number, os.getpid(), file=log)
    (folder / "file.txt").write_text(str(trial.number))
    if trial.number >= 1000:
        time.sleep(600)
    return {{"root": root(trial.number), "nan": float("nan"), "values": trial.values}}


def measure_otherwise(trial, folder):
    return {{**measure(trial, folder), "otherwise": True}}


def measure_what_is_no_json(trial, folder):
    return {{"set": {{1, 2}}}}


def interrupt(trial, folder):
    (folder / "half.txt").write_text("half")
    raise KeyboardInterrupt
"""
ROOTS = '''
def root(number):
    """Returns the root."""
    if number < 0:
        raise ValueError(f"{number} has no root")
    return number**0.5
'''


def forget():
    """Has the digest of the code taken anew, as in another process."""
    for cached in (measured_code.code_digest, measured_code._code_of, measured_code._file_of):
        cached.cache_clear()


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module with trials, which imports one of two others, and what was measured."""
    stem = tmp_path.name
    names = {name: f"{name}_of_{stem}" for name in ("trials", "roots", "others")}
    files = {name: tmp_path / "code" / f"{own}.py" for name, own in names.items()}
    files["trials"].parent.mkdir()
    files["trials"].write_text(TRIALS.format(stem=stem))
    files["roots"].write_text(ROOTS)
    files["others"].write_text("others = 1\n")
    monkeypatch.syspath_prepend(files["trials"].parent)
    ours = {own: files[name].with_suffix("") for name, own in names.items()}
    monkeypatch.setattr(measured_code, "_ROOTS", ours)
    forget()
    module = importlib.import_module(names["trials"])
    log = tmp_path / "log.txt"
    log.touch()

    def lines():
        return [tuple(map(int, line.split())) for line in log.read_text().splitlines()]

    yield SimpleNamespace(
        **{"files": files, "name": names["trials"], "store": tmp_path / "store", "log": log},
        **{"measure": module.measure, "module": module},
        trials=lambda *numbers: [module.Trial(number, str(log)) for number in numbers],
        measured=lambda: [number for number, _ in lines()],
        # Of the trials that take longer than any test: each keeps a process to itself.
        processes=lambda: {process for number, process in lines() if number >= 1000},
    )
    for name in names.values():
        sys.modules.pop(name, None)
    forget()


def run(module, *numbers, measure=None, **options):
    """Runs trials on a bench of the module's store."""
    bench = Workbench(module.store, **options)
    return bench.run(measure or module.measure, module.trials(*numbers), "rooting")


def folders(store):
    return sorted(path.name for path in store.iterdir() if path.is_dir())


# What a trial leaves.


def test_trials_are_measured_in_their_order_and_leave_rows_and_files(module):
    calls = []
    mask = os.umask(0o022)
    try:
        records = run(module, 4, 1, 4, 9, progress=lambda *call: calls.append(call))
    finally:
        os.umask(mask)
    assert [record.row["root"] for record in records] == [2, 1, 2, 3]
    # Equal ones are measured once.
    assert module.measured() == [4, 1, 9]
    assert calls == [("rooting", done, 3) for done in range(4)]
    first = records[0]
    assert first.row == {"root": 2, "nan": None, "values": [1.0, 2.0]}
    assert [path.name for path in first.folder.iterdir()] == ["file.txt"]
    assert (first.folder / "file.txt").read_text() == "4"
    assert first.elapsed_s > 0.0
    assert folders(module.store) == sorted({record.folder.name for record in records})
    # Others can read it.
    assert stat.S_IMODE(first.folder.stat().st_mode) == 0o755


def test_finished_trials_are_not_measured_again_and_their_time_counts(module):
    first = Workbench(module.store)
    rows = first.run(module.measure, module.trials(1, 2), "rooting")
    second = Workbench(module.store)
    again = second.run(module.measure, module.trials(2, 3, 1), "rooting")
    assert module.measured() == [1, 2, 3]
    assert [record.row for record in again[::2]] == [record.row for record in rows[::-1]]
    assert second.trial_s == pytest.approx(first.trial_s + again[1].elapsed_s)


def test_another_trial_or_function_has_a_record_of_its_own(module):
    bench = Workbench(module.store)
    (trial,) = module.trials(1)
    trials = [trial, replace(trial, values=(3.0,))]
    for _ in range(2):
        bench.run(module.measure, trials, "rooting")
        (other,) = bench.run(module.module.measure_otherwise, [trial], "rooting")
        assert other.row["otherwise"] is True
    assert module.measured() == [1, 1, 1]


@pytest.mark.parametrize(
    ("name", "old", "new", "counts"),
    [
        ("roots", "number**0.5", "number**0.25", True),
        ("trials", "time.sleep(600)", "time.sleep(60)", True),
        # What the trial computes of itself, where nobody names its class.
        ("trials", "2 * self.number", "3 * self.number", True),
        ("roots", "Returns the root", "Gives the root", False),
        ("trials", "def measure(", "# What takes the time.\ndef measure(", False),
        ("others", "others = 1", "others = 2", False),
    ],
)
def test_a_changed_line_is_measured_again_and_words_are_not(module, name, old, new, counts):
    run(module, 1)
    file = module.files[name]
    source = file.read_text()
    file.write_text(source.replace(old, new))
    forget()
    (kept,) = run(module, 1, any_code=True)
    assert module.measured() == [1]
    (fresh,) = run(module, 1)
    assert module.measured() == [1, 1] if counts else [1]
    assert (fresh.code != kept.code) == (fresh.folder != kept.folder) == counts
    # The older one is there yet, where somebody goes back.
    file.write_text(source)
    forget()
    assert run(module, 1)[0].code == kept.code
    assert len(module.measured()) == 1 + counts


# What goes wrong.


def test_a_failing_trial_does_not_stop_the_others(module):
    message = r"^2 of 4 trials of rooting failed; the first, Trial\(number=-1.*ValueError: -1 "
    with pytest.raises(ExperimentError, match=message):
        run(module, 1, -1, 2, -2)
    assert module.measured() == [1, -1, 2, -2]
    assert len(folders(module.store)) == 2
    # Only those that failed run again.
    with pytest.raises(ExperimentError, match="-1 has no root"):
        run(module, 1, -1, 2)
    assert module.measured() == [1, -1, 2, -2, -1]


def test_an_interruption_leaves_what_has_ended_and_nothing_half_written(module):
    run(module, 1)
    before = folders(module.store)
    with pytest.raises(KeyboardInterrupt):
        run(module, 2, measure=module.module.interrupt)
    with pytest.raises(ExperimentError, match="set is not JSON serializable"):
        run(module, 3, measure=module.module.measure_what_is_no_json)
    assert folders(module.store) == before
    run(module, 1)
    assert module.measured() == [1]


def test_code_that_changes_while_trials_run_is_not_what_measured_them(module):
    with pytest.raises(ExperimentError, match="the code was changed while the trials ran"):
        workbench._measure(
            module.measure, store.TrialStore(module.store), (*module.trials(2), "other code")
        )
    assert module.measured() == []


def test_a_record_without_its_files_is_measured_again(module):
    (record,) = run(module, 1)
    (record.folder / "file.txt").unlink()
    record.folder.rmdir()
    (again,) = run(module, 1)
    assert module.measured() == [1, 1]
    assert (again.folder / "file.txt").exists()


def test_files_without_their_row_are_replaced(module):
    (record,) = run(module, 1)
    (record.folder / "more.txt").write_text("of a killed process")
    (module.store / store.ROWS).unlink()
    (again,) = run(module, 1)
    assert [path.name for path in again.folder.iterdir()] == ["file.txt"]


def test_a_damaged_file_of_rows_is_told(module):
    module.store.mkdir()
    (module.store / store.ROWS).write_text("no database" * 100)
    with pytest.raises(ExperimentError, match=r"stored trials in .*rows\.sqlite: file is not"):
        run(module, 1)
    assert module.measured() == []


def test_there_must_be_a_process_and_no_trials_are_no_work(module):
    with pytest.raises(ConfigurationError, match="jobs must be at least 1, not 0"):
        Workbench(module.store, jobs=0)
    assert run(module, jobs=2) == []
    assert not module.store.exists()


# Several at once.


def test_any_executor_can_do_the_work(module):
    with ThreadPoolExecutor(3) as executor:
        records = run(module, *range(20), executor=executor)
        # It is left open for others.
        assert executor.submit(int).result() == 0
    assert [record.row["root"] for record in records] == [n**0.5 for n in range(20)]
    with ThreadPoolExecutor(3) as executor, pytest.raises(ExperimentError, match="-1 has no"):
        run(module, -1, 20, 21, executor=executor)
    assert sorted(module.measured()) == [-1, *range(22)]


def test_a_store_can_be_begun_by_many_at_once(module, tmp_path):
    # Each on a connection of its own, as processes have them.
    def begin(number):
        files = tmp_path / f"files{number}"
        files.mkdir()
        key = store.Key("a.measure", str(number % 5), "code")
        kept = store.TrialStore(module.store)
        kept.put(key, {"number": number % 5}, files, 1.0)
        return kept.find(key)

    module.store.mkdir()
    with ThreadPoolExecutor(10) as executor:
        records = list(executor.map(begin, range(40)))
    assert [record.row["number"] for record in records] == 8 * [*range(5)]
    assert len(folders(module.store)) == 5


SCRIPT = """
import sys
sys.path.insert(0, {code!r})
import {name} as module
from pathlib import Path
from sgvf_drake.experiments import measured_code
from sgvf_drake.experiments.workbench import Workbench

if __name__ == "__main__":
    numbers = (*range(40), *range(1000, 1000 + {jobs}))
    trials = [module.Trial(number, {log!r}) for number in numbers]
    Workbench(Path({store!r}), jobs={jobs}).run(module.measure, trials, "rooting")
"""


def wait_until(happens, timeout_s=120.0):
    deadline = time.monotonic() + timeout_s
    while not happens():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.full)])
def test_a_killed_run_loses_nothing_that_ended(module, tmp_path, monkeypatch, caplog, jobs):
    # In processes the modules are none of ours: their own files count, which is enough here.
    monkeypatch.setattr(measured_code, "_ROOTS", {})
    forget()
    script = tmp_path / "script.py"
    places = {"code": str(module.files["trials"].parent), "store": str(module.store)}
    script.write_text(SCRIPT.format(name=module.name, log=str(module.log), jobs=jobs, **places))
    process = subprocess.Popen([sys.executable, script])
    try:
        # Another process, which writes into the same store at the same time.
        wait_until(lambda: module.measured())
        records = run(module, *range(60, 0, -1))
        assert [record.row["root"] for record in records] == [n**0.5 for n in range(60, 0, -1)]
        wait_until(lambda: len(module.processes()) == jobs)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    # The processes of the killed one end with it, in the middle of their trials.
    for worker in module.processes():
        wait_until(lambda worker=worker: not alive(worker))
    before = len(module.measured())
    hidden = [path for path in module.store.iterdir() if path.name.startswith(".")]
    assert len(hidden) == jobs
    assert not caplog.records
    assert len(run(module, *range(61))) == 61
    assert module.measured()[before:] == []
    # What it has left is removed, and told.
    assert not [path for path in module.store.iterdir() if path.name.startswith(".")]
    told = [record.getMessage() for record in caplog.records]
    assert sorted(told) == sorted(
        f"removed {path}, which a killed run had left" for path in hidden
    )


def alive(process):
    """Whether a process has a thread that is not over: that keeps its files, and locks, open.

    A zombie is over and waits for whoever has inherited it; but the first thread may be one
    while others have yet to end.
    """
    try:
        threads = os.listdir(f"/proc/{process}/task")
        with open(f"/proc/{process}/stat") as stat:
            state = stat.read().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return len(threads) > 1 or state != "Z"
