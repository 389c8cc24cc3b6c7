"""Which code decides the numbers of an experiment, as a digest."""

import ast
from collections.abc import Iterator
from functools import cache
import hashlib
from pathlib import Path

import sgvf_drake
import systems

# Folders and files, relative to `sgvf_drake`, on which all numbers rest.
MEASURED_CODE = (
    *("paths", "fields", "learning", "lyapunov", "metrics.py"),
    *("experiments/clouds.py", "experiments/follow.py", "experiments/simulation.py"),
)
# And those with which no number changes: they draw, tell, store and run.
DRAWING_CODE = (
    *("plotting.py", "progress.py", "experiments/figures", "experiments/results.py"),
    *("experiments/workbench.py", "experiments/processes.py", "experiments/measured_code.py"),
)
_ROOTS = {root.__name__: Path(root.__file__ or "").parent for root in (sgvf_drake, systems)}


@cache
def code_digest(*modules: Path, drawing: bool = False) -> str:
    """Returns a digest of the code that decides the numbers, as it is when first asked.

    Args:
        modules: Files of the experiment itself.  They count with everything of ours that
            they import, besides what all experiments rest on.
        drawing: Whether what draws and tells counts as well.
    """
    digest = hashlib.sha256()
    files = measured_files(*modules, drawing=drawing)
    # By the name, which is the same wherever the package is installed.
    for name, file in sorted((_name(file), file) for file in files):
        digest.update(f"{name}\n".encode() + file.read_bytes())
    return digest.hexdigest()


def measured_files(*modules: Path, drawing: bool = False) -> set[Path]:
    """Returns the files that `code_digest` is taken of."""
    package, others = _ROOTS["sgvf_drake"], _ROOTS["systems"]
    places = [*(package / name for name in MEASURED_CODE), others]
    left_out = () if drawing else DRAWING_CODE
    stop = {file for name in left_out for file in _files(package / name)}
    files: set[Path] = set()
    new = {*modules, *(file for place in places for file in _files(place))}
    while new:
        files |= new
        new = {found for file in new for found in _imported(file)} - files - stop
    return files


def _files(place: Path) -> Iterator[Path]:
    yield from place.rglob("*.py") if place.is_dir() else [place]


def _name(file: Path) -> str:
    for root in _ROOTS.values():
        if file.is_relative_to(root):
            return file.relative_to(root.parent).as_posix()
    return file.name


@cache
def _imported(file: Path) -> frozenset[Path]:
    """The files of ours that a file imports itself, anywhere in it."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(file.read_bytes())):
        match node:
            case ast.Import():
                names |= {alias.name for alias in node.names}
            case ast.ImportFrom(module=str(module), level=0):
                # What a package gives is a module of it, or stands in its own file.
                names |= {
                    one if _file_of(one := f"{module}.{alias.name}") else module
                    for alias in node.names
                }
    return frozenset(found for name in names if (found := _file_of(name)) is not None)


def _file_of(name: str) -> Path | None:
    """The file of a module of ours."""
    first, *rest = name.split(".")
    if first not in _ROOTS:
        return None
    place = _ROOTS[first].joinpath(*rest)
    candidates = (place.with_suffix(".py"), place / "__init__.py")
    return next((file for file in candidates if file.is_file()), None)
