"""The bench of trials: each runs once, whole or not at all, in one process or in several."""

from dataclasses import dataclass, replace
import importlib
import json
import os
import stat
import sys
from types import SimpleNamespace

import pytest

import sgvf_drake
from sgvf_drake.exceptions import ConfigurationError, ExperimentError
from sgvf_drake.experiments import measured_code, workbench
from sgvf_drake.experiments.workbench import ROW, Workbench

# A module of its own, since processes import it.  Each trial writes a line into a file.
SOURCE = """
from dataclasses import dataclass
import os
from pathlib import Path


@dataclass(frozen=True)
class Trial:
    number: int
    log: str
    values: tuple = (1.0, 2.0)


def measure(trial, folder):
    with open(trial.log, "a") as log:
        print(trial.number, os.getpid(), file=log)
    (folder / "file.txt").write_text(str(trial.number))
    if trial.number < 0:
        raise ValueError(f"{trial.number} has no root")
    return {"square": trial.number**2, "nan": float("nan"), "values": trial.values}


def measure_otherwise(trial, folder):
    return {**measure(trial, folder), "otherwise": True}


def measure_what_is_no_json(trial, folder):
    return {"set": {1, 2}}
"""


@pytest.fixture
def module(tmp_path, monkeypatch):
    """A module with trials, and the numbers of those that were measured."""
    name = f"trials_of_{tmp_path.name}"
    path = tmp_path / f"{name}.py"
    path.write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module(name)
    log = tmp_path / "log.txt"
    log.touch()

    def lines():
        return [tuple(map(int, line.split())) for line in log.read_text().splitlines()]

    yield SimpleNamespace(
        path=path,
        store=tmp_path / "store",
        measure=module.measure,
        module=module,
        trials=lambda *numbers: [module.Trial(number, str(log)) for number in numbers],
        measured=lambda: [number for number, _ in lines()],
        processes=lambda: {process for _, process in lines()},
    )
    del sys.modules[name]


def rows(records):
    return [record.row for record in records]


def folders(store):
    return sorted(path.name for path in store.iterdir())


# What a trial leaves.


def test_trials_are_measured_in_their_order(module):
    calls = []
    bench = Workbench(module.store, progress=lambda *call: calls.append(call))
    records = bench.run(module.measure, module.trials(3, 1, 2), "squaring")
    assert [record.row["square"] for record in records] == [9, 1, 4]
    assert module.measured() == [3, 1, 2]
    assert calls == [("squaring", done, 3) for done in range(4)]


def test_a_record_is_plain_and_has_its_files(module):
    bench = Workbench(module.store)
    (record,) = bench.run(module.measure, module.trials(4), "squaring")
    assert record.row == {"square": 16, "nan": None, "values": [1.0, 2.0]}
    assert (record.folder / "file.txt").read_text() == "4"
    assert {path.name for path in record.folder.iterdir()} == {ROW, "file.txt"}
    assert record.folder.parent == module.store
    assert record.elapsed_s > 0.0
    assert folders(module.store) == [record.folder.name]


def test_records_are_readable_by_others(module):
    mask = os.umask(0o022)
    try:
        (record,) = Workbench(module.store).run(module.measure, module.trials(1), "squaring")
    finally:
        os.umask(mask)
    assert stat.S_IMODE(record.folder.stat().st_mode) == 0o755


def test_the_time_of_stored_trials_counts(module):
    first, second = Workbench(module.store), Workbench(module.store)
    for bench in (first, second):
        bench.run(module.measure, module.trials(1, 2), "squaring")
    assert first.trial_s > 0.0
    assert second.trial_s == first.trial_s


# What is stored is not measured again, as long as it is the same.


def test_a_finished_trial_is_not_measured_again(module):
    first = Workbench(module.store).run(module.measure, module.trials(1, 2), "squaring")
    calls = []
    bench = Workbench(module.store, progress=lambda *call: calls.append(call))
    second = bench.run(module.measure, module.trials(2, 3, 1), "squaring")
    assert module.measured() == [1, 2, 3]
    assert rows(second)[::2] == rows(first)[::-1]
    assert second[2].elapsed_s == first[0].elapsed_s
    assert calls == [("squaring", 2, 3), ("squaring", 3, 3)]


def test_an_equal_trial_is_measured_once(module):
    records = Workbench(module.store).run(module.measure, module.trials(1, 2, 1), "squaring")
    assert module.measured() == [1, 2]
    assert records[0].folder == records[2].folder


def test_another_trial_or_function_has_a_record_of_its_own(module):
    bench = Workbench(module.store)
    (trial,) = module.trials(1)
    bench.run(module.measure, [trial], "squaring")
    bench.run(module.measure, [replace(trial, values=(3.0,))], "squaring")
    (other,) = bench.run(module.module.measure_otherwise, [trial], "squaring")
    assert other.row["otherwise"] is True
    assert module.measured() == [1, 1, 1]
    # All three stay.
    bench.run(module.measure, [trial, replace(trial, values=(3.0,))], "squaring")
    assert module.measured() == [1, 1, 1]


@pytest.fixture
def fresh_digest():
    """Has the digest of the code taken anew, as in another process."""
    yield measured_code.code_digest.cache_clear
    measured_code.code_digest.cache_clear()


def test_a_changed_module_is_measured_again(module, fresh_digest):
    trials = module.trials(1)
    Workbench(module.store).run(module.measure, trials, "squaring")
    module.path.write_text(SOURCE + "\n# Changed.\n")
    fresh_digest()
    Workbench(module.store).run(module.measure, trials, "squaring")
    assert module.measured() == [1, 1]
    # In the place of the older one.
    assert len(folders(module.store)) == 1


@pytest.mark.parametrize(
    ("target", "name", "value"),
    [
        (workbench, "code_digest", lambda *modules: "other"),
        (sgvf_drake, "__version__", "999"),
    ],
)
def test_records_of_other_code_are_not_used(module, monkeypatch, target, name, value):
    trials = module.trials(1)
    Workbench(module.store).run(module.measure, trials, "squaring")
    monkeypatch.setattr(target, name, value)
    for _ in range(2):
        Workbench(module.store).run(module.measure, trials, "squaring")
    assert module.measured() == [1, 1]


def test_code_that_changes_while_trials_run_is_not_what_measured_them(module):
    with pytest.raises(ExperimentError, match="the code was changed while the trials ran"):
        workbench._measure(module.measure, module.store, "other code", *module.trials(2))
    assert not module.store.exists()


@pytest.mark.parametrize("text", ["", "{", "[1]", "{}", '{"identity": 1, "row": {}}'])
def test_a_damaged_record_is_measured_again(module, text):
    bench = Workbench(module.store)
    (record,) = bench.run(module.measure, module.trials(1), "squaring")
    (record.folder / ROW).write_text(text)
    (again,) = bench.run(module.measure, module.trials(1), "squaring")
    assert module.measured() == [1, 1]
    assert json.loads((again.folder / ROW).read_text())["row"] == again.row


# What goes wrong.


def test_a_failure_does_not_stop_the_others(module):
    bench = Workbench(module.store)
    message = r"^2 of 4 trials of squaring failed; the first, Trial\(number=-\d.*ValueError: "
    with pytest.raises(ExperimentError, match=message):
        bench.run(module.measure, module.trials(1, -1, 2, -2), "squaring")
    assert sorted(module.measured()) == [-2, -1, 1, 2]
    assert len(folders(module.store)) == 2
    # Only those that failed run again.
    with pytest.raises(ExperimentError, match="-1 has no root"):
        bench.run(module.measure, module.trials(1, -1, 2), "squaring")
    assert sorted(module.measured()) == [-2, -1, -1, 1, 2]


def test_a_failure_leaves_an_older_record_alone(module, monkeypatch):
    bench = Workbench(module.store)
    (record,) = bench.run(module.measure, module.trials(2), "squaring")
    monkeypatch.setattr(workbench, "code_digest", lambda *modules: "other")

    def fail(*arguments, **options):
        raise OSError("no space left")

    # It fails where the files of the new record are already written.
    code = workbench._code(module.measure)
    monkeypatch.setattr(workbench.json, "dumps", fail)
    with pytest.raises(OSError, match="no space left"):
        workbench._measure(module.measure, module.store, code, *module.trials(2))
    assert module.measured() == [2, 2]
    assert folders(module.store) == [record.folder.name]
    assert json.loads((record.folder / ROW).read_text())["row"]["square"] == 4


def test_an_interruption_leaves_nothing_half_written(module):
    @dataclass(frozen=True)
    class Interrupted:
        number: int = 1

    def measure(trial, folder):
        (folder / "half.txt").write_text("half")
        raise KeyboardInterrupt

    bench = Workbench(module.store)
    bench.run(module.measure, module.trials(1), "squaring")
    before = folders(module.store)
    with pytest.raises(KeyboardInterrupt):
        bench.run(measure, [Interrupted()], "squaring")
    assert folders(module.store) == before


def test_a_row_must_be_json(module):
    bench = Workbench(module.store)
    with pytest.raises(ExperimentError, match="set is not JSON serializable"):
        bench.run(module.module.measure_what_is_no_json, module.trials(1), "squaring")
    assert folders(module.store) == []


def test_there_must_be_a_process(tmp_path):
    with pytest.raises(ConfigurationError, match="jobs must be at least 1, not 0"):
        Workbench(tmp_path / "store", jobs=0)
    assert not (tmp_path / "store").exists()


def test_no_trials_are_no_work(module):
    assert Workbench(module.store, jobs=2).run(module.measure, [], "squaring") == []
    assert not module.store.exists()


# Several processes, once in earnest.


def test_processes_measure_what_one_does_and_survive_a_failure(module, tmp_path):
    calls = []
    bench = Workbench(module.store, 2, lambda *call: calls.append(call))
    with pytest.raises(ExperimentError, match=r"1 of 4 trials .*ValueError: -1 has no root"):
        bench.run(module.measure, module.trials(5, -1, 4, 1), "squaring")
    assert os.getpid() not in module.processes()
    assert calls == [("squaring", done, 4) for done in range(5)]
    assert sorted(module.measured()) == [-1, 1, 4, 5]
    # What they stored is found, in the order of the trials.
    found = bench.run(module.measure, module.trials(4, 5, 1), "squaring")
    assert len(module.measured()) == 4
    alone = Workbench(tmp_path / "alone").run(module.measure, module.trials(4, 5, 1), "alone")
    assert rows(found) == rows(alone)
    names = [record.folder.name for record in found]
    assert names == [record.folder.name for record in alone]
