"""The digest of the code: it changes with whatever decides a number, and with no more."""

import importlib.util
from pathlib import Path

import grimp
import pytest

import sgvf_drake
from sgvf_drake.experiments import follow, measured_code
from sgvf_drake.experiments.measured_code import code_digest
from sgvf_drake.experiments.quality.running import measure_case
from sgvf_drake.experiments.workbench import Workbench
from sgvf_drake.learning import train
from systems import MakeKinematicDiagram

PACKAGE = Path(sgvf_drake.__file__).parent

# A package in place of ours.  Only `measure` is asked for.
SOURCES = {
    "__init__.py": "from ours.unused import nothing\n",
    "unused.py": "nothing = 0\n",
    "trials.py": '''"""Trials."""
import numpy as np
from ours import figures, measures
from ours.records import Row
from ours.constants import LIMIT, UNIT

STEPS = 10
COLOUR = "blue"


def measure(trial, folder) -> Row:
    """Measures."""
    from ours.late import late

    rows: list[Row] = []
    return helper(trial) + late(measures)


def helper(trial: Row):
    return STEPS * LIMIT * np.pi


def figure(rows):
    return figures.draw(rows, COLOUR, UNIT)


print("at import")
''',
    "measures.py": '"""Measures."""\nfrom ours.deep import deep\nx = deep()  # Deep.\n',
    "deep.py": "import ours.measures\nfrom ours import whole\ndef deep():\n    return whole\n",
    "late.py": "late = 1\n",
    "whole/__init__.py": "from ours.whole.part import part\n",
    "whole/part.py": "part = 1\n",
    "whole/other.py": "other = 1\n",
    "constants.py": "LIMIT, UNIT = 1, 2\n",
    "records.py": "Row = dict\n",
    "figures.py": "def draw(*arguments):\n    pass\n",
}

CHANGES = [
    # What is computed.
    ("trials.py", "LIMIT * np.pi", "LIMIT * np.e", True),
    ("trials.py", "STEPS = 10", "STEPS = 11", True),
    ("trials.py", "LIMIT, UNIT", "UNIT as LIMIT", True),
    ("trials.py", '"at import"', '"otherwise"', True),
    ("measures.py", "x = deep()", "x = deep", True),
    ("deep.py", "return whole", "return 0", True),
    ("late.py", "late = 1", "late = 2", True),
    ("whole/__init__.py", "import part", "import part as other", True),
    ("whole/part.py", "part = 1", "part = 2", True),
    ("constants.py", "1, 2", "1, 3", True),
    # Comments, docstrings and annotations.
    ("trials.py", '"""Measures."""', '"""Measures it."""', False),
    ("trials.py", "-> Row", "-> object", False),
    ("trials.py", "list[Row]", "list", False),
    ("trials.py", "def helper", "# It helps.\n\n\ndef helper", False),
    ("measures.py", '"""Measures."""', '"""Measures of it."""', False),
    ("measures.py", "# Deep.", "# Deeper.", False),
    # What only stands beside it.
    ("trials.py", 'COLOUR = "blue"', 'COLOUR = "red"', False),
    ("trials.py", "return figures.draw(rows", "return figures.draw(0", False),
    ("figures.py", "pass", "return 1", False),
    ("records.py", "dict", "list", False),
    ("__init__.py", "import nothing", "import nothing as other", False),
    ("unused.py", "nothing = 0", "nothing = 1", False),
    ("whole/other.py", "other = 1", "other = 2", False),
]


def forget():
    """Has files read again, as in another process."""
    for cached in (measured_code.code_digest, measured_code._code_of, measured_code._file_of):
        cached.cache_clear()


def write(root):
    for name, text in SOURCES.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


@pytest.fixture
def digest_in(monkeypatch):
    """The digest of `measure` of a package in place of ours: (folder) -> digest."""

    def digest_in(root):
        monkeypatch.setattr(measured_code, "_ROOTS", {"ours": root})
        forget()

        def measure():
            """Stands in for the function of the file, which need not run."""

        measure.__qualname__ = "measure"
        with pytest.MonkeyPatch.context() as patch:
            place = str(root / "trials.py")
            patch.setattr(measured_code.inspect, "getfile", lambda function: place)
            return code_digest(measure)

    yield digest_in
    forget()


@pytest.mark.parametrize(("name", "old", "new", "counts"), CHANGES)
def test_the_digest_changes_with_what_decides_a_number(
    digest_in, tmp_path, name, old, new, counts
):
    root = tmp_path / "ours"
    write(root)
    before = digest_in(root)
    assert digest_in(root) == before
    text = (root / name).read_text()
    assert text.count(old) == 1
    (root / name).write_text(text.replace(old, new))
    assert (digest_in(root) != before) == counts


def test_the_digest_is_the_same_wherever_the_package_is(digest_in, tmp_path):
    places = [tmp_path / "here" / "ours", tmp_path / "there" / "ours"]
    for place in places:
        write(place)
    assert digest_in(places[0]) == digest_in(places[1])


# Of the package itself, beside import-linter's graph of imports.


def name_of(file):
    parts = file.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(part for part in parts if part != "__init__")


def test_what_counts_is_in_the_graph_of_imports():
    upstream = grimp.build_graph("sgvf_drake", "systems").find_upstream_modules
    names = {}
    for root in (measure_case, follow):
        module = root.__module__
        file = Path(importlib.util.find_spec(module).origin)
        found, new = set(), {file}
        while new:
            found |= new
            new = {one for file in new for one in measured_code._code_of(file).imports} - found
        names[module] = {name_of(file) for file in found} - {module}
        # But for what is imported for annotations alone.
        assert names[module] <= upstream(module)
    case, following = names.values()
    assert train.__module__ in case
    for module in ("sgvf_drake.metrics", MakeKinematicDiagram.__module__):
        assert module in following
    for module in ("sgvf_drake.plotting", Workbench.__module__, train.__module__):
        assert module not in following
