"""The package as a whole: its public names, and what importing it costs."""

import ast
from pathlib import Path
import subprocess
import sys

import pytest

import sgvf_drake
import systems

PACKAGE = Path(sgvf_drake.__file__).parent
EXPERIMENTERS = {"cli", "experiments", "paper", "__main__.py"}


def modules_after(code, folder):
    """The modules that a fresh process has after running `code`."""
    run = subprocess.run(
        [sys.executable, "-c", f"import sys\n{code}\nprint(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
        cwd=folder,
    )
    return set(run.stdout.split())


def imported_modules(file):
    """The modules that a file imports, at its top or inside of functions."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: a relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_systems_comes_with_this_distribution():
    # Another distribution on the index has the same import name.
    assert Path(systems.__file__).parents[1] == PACKAGE.parent


def test_every_public_name_resolves():
    assert len(sgvf_drake.__all__) == len(set(sgvf_drake.__all__))
    for name in sgvf_drake.__all__:
        assert getattr(sgvf_drake, name) is not None, name
    assert set(sgvf_drake.__all__) <= set(dir(sgvf_drake))


def test_other_names_do_not_resolve():
    with pytest.raises(AttributeError, match=r"'sgvf_drake' has no attribute 'trian'"):
        _ = sgvf_drake.trian


def test_importing_is_light(tmp_path):
    modules = modules_after("import sgvf_drake", tmp_path)
    assert "sgvf_drake.fields" in modules
    assert not modules & {"torch", "pydrake", "matplotlib", "systems"}
    assert not any(name.startswith("sgvf_drake.experiments") for name in modules)


def test_torch_comes_with_the_first_use_of_train(tmp_path):
    code = "import sgvf_drake\nassert 'torch' not in sys.modules\nsgvf_drake.TrainingConfig"
    modules = modules_after(code, tmp_path)
    assert "torch" in modules
    assert "pydrake" not in modules


def test_a_field_is_evaluated_without_torch(tmp_path, make_field):
    make_field("robust").save(tmp_path / "field.safetensors")
    code = (
        "import numpy as np, sgvf_drake, systems\n"
        "field = sgvf_drake.load_field('field.safetensors')\n"
        "field.value_and_jacobian(np.zeros(2))\n"
        "systems.MakeFlightDiagram(field)"
    )
    modules = modules_after(code, tmp_path)
    assert "pydrake" in modules
    assert "torch" not in modules


def test_the_library_never_imports_its_experiments():
    files = [
        file
        for file in (*PACKAGE.rglob("*.py"), *Path(systems.__file__).parent.rglob("*.py"))
        if not EXPERIMENTERS & set(file.parts)
    ]
    assert len(files) > 30
    for file in files:
        for module in imported_modules(file):
            assert not module.startswith("sgvf_drake.experiments"), file


def test_packages_are_typed():
    for package in (PACKAGE, Path(systems.__file__).parent):
        assert (package / "py.typed").is_file()
