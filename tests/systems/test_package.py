from pathlib import Path
import subprocess
import sys

import sgvf_drake
import systems


def test_systems_is_this_projects_package():
    # Another distribution on the index has the same import name.
    ours, theirs = Path(systems.__file__), Path(sgvf_drake.__file__)
    assert ours.parents[1] == theirs.parents[1]


def test_import_needs_neither_torch_nor_all_of_drake():
    code = (
        "import sys, systems; print([m for m in ('torch', 'pydrake.all') if m in sys.modules])"
    )
    root = Path(systems.__file__).parents[1]
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root
    )
    assert run.stdout.strip() == "[]"


def test_every_public_name_is_there():
    assert sorted(systems.__all__) == sorted(set(systems.__all__))
    for name in systems.__all__:
        assert getattr(systems, name) is not None
