"""Every notebook runs from a fresh folder, and is stored without what it printed."""

import ast
from pathlib import Path
from types import ModuleType

import nbclient
import nbformat
import pytest

FOLDER = Path(__file__).parents[1] / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
PUBLIC = (
    *("dataclasses", "tempfile"),
    *("sgvf_drake", "systems", "pydrake", "numpy", "pandas", "matplotlib"),
)
# Drake logs where Meshcat serves; anything else on this stream is a warning.
MESHCAT_ADDRESS = "INFO:drake:Meshcat listening for connections at http://localhost:"
TIMEOUT_S = 300


def notebook_cases():
    return pytest.mark.parametrize("file", NOTEBOOKS, ids=[file.stem for file in NOTEBOOKS])


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_there_are_notebooks():
    assert "00_quickstart" in [file.stem for file in NOTEBOOKS]


@notebook_cases()
def test_nothing_is_stored(file):
    notebook = nbformat.read(file, as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in code_cells(notebook):
        assert cell.outputs == []
        assert cell.execution_count is None


@notebook_cases()
def test_only_public_names_are_used_and_they_exist(file):
    source = "\n".join(cell.source for cell in code_cells(nbformat.read(file, as_version=4)))
    tree = ast.parse(source.replace("%matplotlib inline", ""))
    imports = [part for part in tree.body if isinstance(part, ast.Import | ast.ImportFrom)]
    names = {}
    exec(compile(ast.Module(imports, []), file.name, "exec"), names)
    modules = {key: value for key, value in names.items() if isinstance(value, ModuleType)}
    assert "sgvf" in modules
    for part in imports:
        sources = [part.module] if isinstance(part, ast.ImportFrom) else []
        for module in sources or [name.name for name in part.names]:
            first, *others = module.split(".")
            assert first in PUBLIC, module
            assert not any(other.startswith("_") for other in others), module
    for part in ast.walk(tree):
        if isinstance(part, ast.Attribute) and isinstance(part.value, ast.Name):
            module = modules.get(part.value.id)
            assert module is None or hasattr(module, part.attr), ast.unparse(part)


@pytest.mark.full
@notebook_cases()
def test_it_runs_and_shows_pictures(file, tmp_path, monkeypatch):
    # Whatever it writes, and whatever the kernel keeps, goes here.
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    work = tmp_path / "work"
    work.mkdir()
    notebook = nbformat.read(file, as_version=4)
    nbclient.NotebookClient(
        notebook,
        timeout=TIMEOUT_S,
        kernel_name="python3",
        resources={"metadata": {"path": str(work)}},
    ).execute()
    pictures = [
        cell
        for cell in code_cells(notebook)
        if any("image/png" in output.get("data", {}) for output in cell.outputs)
    ]
    assert len(pictures) >= 3
    for cell in code_cells(notebook):
        for output in cell.outputs:
            if output.get("name") == "stderr":
                assert output.text.startswith(MESHCAT_ADDRESS), output.text
                assert len(output.text.splitlines()) == 1, output.text
