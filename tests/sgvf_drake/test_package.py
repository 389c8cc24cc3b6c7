"""The package as a whole: its public names, and what importing it costs.

That imports point one way, import-linter checks in `make check`.
"""

from pathlib import Path
import subprocess
import sys

import pytest

import sgvf_drake
import systems

PACKAGE = Path(sgvf_drake.__file__).parent


def modules_after(code, folder):
    """The modules that a fresh process has after running each of some pieces of code."""
    program = "\n".join(["import sys", *(f"{piece}\nprint(*sys.modules)" for piece in code)])
    run = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, cwd=folder
    )
    return [set(line.split()) for line in run.stdout.splitlines()]


def test_every_public_name_resolves_and_no_other():
    assert len(sgvf_drake.__all__) == len(set(sgvf_drake.__all__))
    for name in sgvf_drake.__all__:
        assert getattr(sgvf_drake, name) is not None, name
    assert set(sgvf_drake.__all__) <= set(dir(sgvf_drake))
    with pytest.raises(AttributeError, match=r"'sgvf_drake' has no attribute 'trian'"):
        _ = sgvf_drake.trian


def test_importing_is_light_and_torch_comes_with_the_first_use_of_train(tmp_path):
    pieces = ("import sgvf_drake", "sgvf_drake.TrainingConfig()", "sgvf_drake.train")
    modules, configured, later = modules_after(pieces, tmp_path)
    assert "sgvf_drake.fields" in modules
    assert not modules & {"torch", "pydrake", "matplotlib", "systems"}
    assert not any(name.startswith("sgvf_drake.experiments") for name in modules)
    assert "torch" not in configured
    assert "torch" in later
    assert "pydrake" not in later


def test_a_field_is_evaluated_without_torch(tmp_path, make_field):
    make_field("robust").save(tmp_path / "field.safetensors")
    code = (
        "import numpy as np, sgvf_drake, systems\n"
        "field = sgvf_drake.load_field('field.safetensors')\n"
        "field.value_and_jacobian(np.zeros(2))\n"
        "systems.MakeFlightDiagram(field)"
    )
    (modules,) = modules_after([code], tmp_path)
    assert "pydrake" in modules
    assert not modules & {"torch", "pydrake.all"}


def test_packages_are_typed():
    for package in (PACKAGE, Path(systems.__file__).parent):
        assert (package / "py.typed").is_file()
