"""Folders of results: whole or not at all."""

import json
import math
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from sgvf_drake.exceptions import ConfigurationError, OutputExistsError
from sgvf_drake.experiments import results
from sgvf_drake.experiments.results import check_results, result_folder, write_summary

NAMES = ("summary.json", "data.csv", "part")


class WorkError(Exception):
    """The work fails."""


def write(folder, text):
    (folder / "data.csv").write_text(text)
    (folder / "part").mkdir()
    (folder / "part" / "inner.txt").write_text(text)


def tree(folder):
    """Every file and folder below, hidden ones too, with the text of files."""
    return {
        str(path.relative_to(folder)): path.read_text() if path.is_file() else None
        for path in folder.rglob("*")
    }


def test_results_appear_when_they_are_whole(tmp_path):
    out = tmp_path / "out"
    with result_folder(out, NAMES) as folder:
        write(folder, "new")
        assert not out.exists()
        # On the same file system, where a move is a rename.
        assert tmp_path in folder.parents
    expected = {"out": None, "out/data.csv": "new"}
    assert tree(tmp_path) == {**expected, "out/part": None, "out/part/inner.txt": "new"}


@pytest.mark.parametrize("error", [WorkError, KeyboardInterrupt])
@pytest.mark.parametrize("out", ["out", "a/b/out"])
def test_a_failure_leaves_nothing_and_older_results_alone(tmp_path, error, out):
    def work(**options):
        with result_folder(tmp_path / out, NAMES, **options) as folder:
            write(folder, "half")
            raise error

    with pytest.raises(error):
        work()
    assert tree(tmp_path) == {}
    with result_folder(tmp_path / out, NAMES) as folder:
        write(folder, "old")
    before = tree(tmp_path)
    with pytest.raises(error):
        work(overwrite=True)
    assert tree(tmp_path) == before


@pytest.mark.parametrize("out", ["file", "file/inner", "file/inner/most", "."])
def test_what_is_in_the_way_is_found_before_the_work(tmp_path, out):
    mine = {"file": "mine", "data.csv": "precious"}
    for name, text in mine.items():
        (tmp_path / name).write_text(text)
    error, match = ConfigurationError, "file is not a folder"
    if out == ".":
        error, match = OutputExistsError, r"already holds data\.csv; .*--overwrite"
    with pytest.raises(error, match=match), result_folder(tmp_path / out, NAMES):
        pytest.fail("the work began")
    assert tree(tmp_path) == mine


def test_what_is_in_the_way_is_found_without_a_trace(tmp_path):
    out = tmp_path / "a" / "out"
    check_results(out, NAMES)
    assert tree(tmp_path) == {}
    out.mkdir(parents=True)
    (out / "notes.txt").write_text("mine")
    check_results(out, NAMES)
    (out / "part").mkdir()
    (out / "data.csv").write_text("precious")
    with pytest.raises(
        OutputExistsError, match=r"already holds data\.csv, part; .*--overwrite"
    ):
        check_results(out, NAMES)
    check_results(out, NAMES, overwrite=True)
    check_results(out, [])
    with pytest.raises(ConfigurationError, match=r"notes\.txt is not a folder"):
        check_results(out / "notes.txt" / "deeper", [], overwrite=True)
    assert tree(out) == {"data.csv": "precious", "notes.txt": "mine", "part": None}


def test_the_summary_comes_last(tmp_path, monkeypatch):
    # Where it is, everything is, even if the machine stops in between.
    moved = []

    def replace(source, target):
        moved.append(target.name)

    monkeypatch.setattr(results.os, "replace", replace)
    with result_folder(tmp_path / "out", ("summary.json", "zeta.png", "part")) as folder:
        (folder / "zeta.png").write_text("a figure")
        (folder / "part").mkdir()
        (folder / "part" / "inner.txt").write_text("a part")
        write_summary(folder, {})
    assert moved == ["inner.txt", "zeta.png", "summary.json"]


def test_overwriting_replaces_the_results_and_nothing_else(tmp_path):
    out = tmp_path / "out"
    with result_folder(out, NAMES) as folder:
        write(folder, "old")
        # Of an earlier run nothing is left.
        write_summary(folder, {})
    (out / "notes.txt").write_text("mine")
    (out / "part" / "more.txt").write_text("mine too")
    with result_folder(out, NAMES, overwrite=True) as folder:
        write(folder, "new")
    assert tree(out) == {
        "data.csv": "new",
        "part": None,
        "part/inner.txt": "new",
        "part/more.txt": "mine too",
        "notes.txt": "mine",
    }


def test_files_of_other_names_stay_in_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "notes.txt").write_text("mine")
    monkeypatch.chdir(tmp_path)
    with result_folder(".", NAMES) as folder:
        (folder / "data.csv").write_text("new")
    assert tree(tmp_path) == {"data.csv": "new", "notes.txt": "mine"}


def test_a_name_that_was_not_declared_is_a_mistake(tmp_path):
    # It could have been overwritten without having been looked for.
    with pytest.raises(AssertionError, match="undeclared"):  # noqa: SIM117
        with result_folder(tmp_path / "out", NAMES) as folder:
            (folder / "other.txt").write_text("new")
    assert tree(tmp_path) == {}


def test_results_are_readable_by_others(tmp_path):
    mask = os.umask(0o022)
    try:
        with result_folder(tmp_path / "out", NAMES) as folder:
            write(folder, "new")
    finally:
        os.umask(mask)
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o755
    assert (tmp_path / "out" / "part").stat().st_mode & 0o777 == 0o755


# Killed runs.

SCRIPT = """
import sys, time
from pathlib import Path
from sgvf_drake.experiments.results import result_folder

with result_folder(sys.argv[1], ["data.csv"]) as folder:
    (folder / "data.csv").write_text("half")
    print("at work", flush=True)
    time.sleep(600)
"""


def test_what_a_killed_run_leaves_is_removed_by_the_next(tmp_path, caplog):
    out = tmp_path / "out"
    (tmp_path / ".out.mine").mkdir()
    command = [sys.executable, "-c", SCRIPT, out]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline() == "at work\n"
            (hidden,) = set(tmp_path.iterdir()) - {tmp_path / ".out.mine"}
            # One that is at work is left alone.
            with result_folder(out, NAMES) as folder:
                write(folder, "new")
            assert list(hidden.rglob("data.csv"))
        finally:
            process.send_signal(signal.SIGKILL)
    assert hidden.exists()
    # That of another place is not looked at, nor is what only looks like one of ours.
    with result_folder(tmp_path / "other", NAMES) as folder:
        write(folder, "new")
    assert hidden.exists()
    assert not caplog.records
    with result_folder(out, NAMES, overwrite=True) as folder:
        write(folder, "newer")
    assert {path.name for path in tmp_path.iterdir()} == {"out", "other", ".out.mine"}
    (record,) = caplog.records
    assert record.getMessage() == f"removed {hidden}, which a killed run had left"


def test_summaries_are_plain_json(tmp_path):
    summary = {
        "nan": math.nan,
        "numpy_inf": np.float64(-np.inf),
        "float32": np.float32(0.5),
        "int": np.int64(7),
        "bool": np.bool_(True),
        "text": "a",
        "none": None,
        "array": np.array([[1.0, np.nan], [np.inf, 2.0]]),
        "tuple": (1, np.float64(2.0), {"deep": [np.nan]}),
        1: "key",
    }
    write_summary(tmp_path, summary)

    def refuse(constant):
        pytest.fail(f"{constant} is not JSON")

    text = (tmp_path / "summary.json").read_text()
    assert text.endswith("}\n")
    assert json.loads(text, parse_constant=refuse) == {
        "nan": None,
        "numpy_inf": None,
        "float32": 0.5,
        "int": 7,
        "bool": True,
        "text": "a",
        "none": None,
        "array": [[1.0, None], [None, 2.0]],
        "tuple": [1, 2.0, {"deep": [None]}],
        "1": "key",
    }
