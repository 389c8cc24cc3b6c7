"""Every notebook runs from a fresh folder, and is stored without what it printed."""

from pathlib import Path

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
def test_only_public_names_are_used(file):
    lines = [
        line.split()
        for cell in code_cells(nbformat.read(file, as_version=4))
        for line in cell.source.splitlines()
    ]
    imported = [words[1] for words in lines if words and words[0] in ("import", "from")]
    assert imported
    for module in imported:
        parts = module.split(".")
        assert parts[0] in PUBLIC, module
        assert not any(part.startswith("_") for part in parts), module


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
