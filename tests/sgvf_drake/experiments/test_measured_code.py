"""The digest of the code: it changes with whatever decides a number, and with no more."""

from functools import cache
from pathlib import Path

import grimp
import pytest

import sgvf_drake
from sgvf_drake.experiments import measured_code, paper
from sgvf_drake.experiments.measured_code import (
    DRAWING_CODE,
    MEASURED_CODE,
    code_digest,
    measured_files,
)

PACKAGE = Path(sgvf_drake.__file__).parent
PAPER = sorted(Path(paper.__file__).parent.rglob("*.py"))
TRIALS = [path for path in PAPER if path.stem == "trials"]


def forget():
    """Has files read again, as in another process."""
    for cached in (measured_code.code_digest, measured_code._imported):
        cached.cache_clear()


@pytest.fixture
def change(tmp_path, monkeypatch):
    """A package in place of ours, and whether changing a file of it changes the digest."""
    sources = {
        "paths/shapes.py": "",
        "metrics.py": "",
        "plotting.py": "import json\n",
        "experiments/__init__.py": "from ours.experiments.unused import nothing\n",
        "experiments/unused.py": "nothing = 0\n",
        "experiments/trials.py": (
            "import numpy as np\n"
            "from ours.experiments import measures\n"
            "from ours import plotting\n"
            "def measure():\n"
            "    from ours.experiments.late import late\n"
            "    import ours.experiments.whole\n"
        ),
        "experiments/measures.py": "from ours.experiments.deep import deep\n",
        "experiments/deep.py": "from ours.experiments.trials import measure\n",
        "experiments/late.py": "",
        "experiments/whole/__init__.py": "from ours.experiments.whole.part import part\n",
        "experiments/whole/part.py": "",
        "experiments/whole/other.py": "",
    }
    root = tmp_path / "ours"
    for name, text in sources.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    systems = tmp_path / "systems"
    systems.mkdir()
    roots = {"ours": root, "sgvf_drake": root, "systems": systems}
    monkeypatch.setattr(measured_code, "_ROOTS", roots)
    forget()
    monkeypatch.setattr(measured_code, "MEASURED_CODE", ("paths", "metrics.py"))
    trials = root / "experiments/trials.py"

    def change(name, **options):
        before = code_digest(trials, **options)
        assert code_digest(trials, **options) == before
        (root / name).write_text((root / name).read_text() + "# Changed.\n")
        forget()
        return code_digest(trials, **options) != before

    yield change
    forget()


@pytest.mark.parametrize(
    "name",
    [
        *("paths/shapes.py", "metrics.py", "experiments/trials.py", "experiments/measures.py"),
        *("experiments/deep.py", "experiments/late.py"),
        *("experiments/whole/__init__.py", "experiments/whole/part.py"),
    ],
)
def test_the_digest_changes_with_what_is_imported(change, name):
    assert change(name)


@pytest.mark.parametrize(
    "name",
    ["experiments/__init__.py", "experiments/unused.py", "experiments/whole/other.py"],
)
def test_the_digest_stays_with_what_is_not_imported(change, name):
    assert not change(name)


def test_what_draws_counts_where_it_is_asked_for(change):
    assert not change("plotting.py")
    assert change("plotting.py", drawing=True)


def test_a_new_file_changes_the_digest(change, tmp_path):
    trials = tmp_path / "ours/experiments/trials.py"
    before = code_digest(trials)
    (tmp_path / "ours/paths/more.py").touch()
    forget()
    assert code_digest(trials) != before


def test_the_digest_is_the_same_wherever_the_package_is(change, tmp_path, monkeypatch):
    before = code_digest(tmp_path / "ours/experiments/trials.py")
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    for name in ("ours", "systems"):
        (tmp_path / name).rename(moved / name)
    roots = {"ours": moved / "ours", "sgvf_drake": moved / "ours"}
    monkeypatch.setattr(measured_code, "_ROOTS", {**roots, "systems": moved / "systems"})
    forget()
    assert code_digest(moved / "ours/experiments/trials.py") == before


# Of the package itself, beside import-linter's graph of imports.


@pytest.fixture(scope="module")
def upstream():
    """What a module imports, directly or not: (name) -> names."""
    return cache(grimp.build_graph("sgvf_drake", "systems").find_upstream_modules)


def module_of(path):
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


@pytest.mark.parametrize("path", PAPER, ids=lambda path: path.stem)
def test_the_imports_are_those_of_the_graph(upstream, path):
    files = measured_files(path, drawing=True)
    # Those on which all rest, and what they import, are in it anyway.
    start = {*measured_files(drawing=True), path}
    names = {module_of(file) for file in start}
    assert {module_of(file) for file in files} == names.union(*map(upstream, names))


def test_trials_do_not_depend_on_what_draws():
    assert TRIALS
    drawing = {file for name in DRAWING_CODE for file in measured_code._files(PACKAGE / name)}
    for path in TRIALS:
        files = measured_files(path)
        assert path in files
        assert not files & drawing


def test_the_places_are_there():
    for name in (*MEASURED_CODE, *DRAWING_CODE):
        assert (PACKAGE / name).exists(), name
