"""Where results go: a folder that is written whole or not at all."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
import fcntl
import glob
import json
import logging
import math
import os
from pathlib import Path
import shutil
import tempfile
from typing import Any

from matplotlib.figure import Figure
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.exceptions import ConfigurationError, OutputExistsError
from sgvf_drake.fields import ScoreInducedField

SUMMARY = "summary.json"
# Inside of a hidden folder: held by the process that works in it, for as long as it lives.
LOCK = "lock"


@contextmanager
def result_folder(
    out: str | os.PathLike[str], names: Sequence[str], *, overwrite: bool = False
) -> Iterator[Path]:
    """Gives a folder to write to, whose files move to `out` when all of them are there.

    Args:
        out: The folder of the results; made, with its parents, if it is not there.
        names: The files and folders that will be written, so that a clash is found before
            the work and not after it.
        overwrite: Whether files of these names may be replaced; those that are not written
            anew are removed.

    Raises:
        OutputExistsError: If `out` holds one of them already and `overwrite` is false.
        ConfigurationError: If `out` cannot be a folder.
    """
    out = Path(out)
    check_results(out, names, overwrite=overwrite)
    made = [folder for folder in out.parents if not folder.exists()]
    remove_abandoned(out.parent, out.name)
    try:
        with hidden_folder(out.parent, out.name) as temporary:
            yield temporary
            written = sorted(path.name for path in temporary.iterdir())
            assert set(written) <= set(names), f"undeclared results {written}"
            out.mkdir(exist_ok=True)
            _move(temporary, out)
            for stale in (out / name for name in set(names) - set(written)):
                # Of an earlier run: it would stand beside results that it does not belong to.
                if stale.is_file():
                    stale.unlink()
    finally:
        # Innermost first; where there are results, the folders are not empty and stay.
        with suppress(OSError):
            for folder in made:
                folder.rmdir()


@contextmanager
def hidden_folder(parent: Path, name: str) -> Iterator[Path]:
    """Gives a folder to write to, hidden beside its target; it goes when the work ends.

    Where the process is killed it stays, without a lock on it: see `remove_abandoned`.

    Args:
        parent: The folder that it is made in, so that a move to the target is a rename.
        name: What the target is called.

    Raises:
        ConfigurationError: If it cannot be made there.
    """
    try:
        parent.mkdir(parents=True, exist_ok=True)
        outer = Path(tempfile.mkdtemp(dir=parent, prefix=f".{name}."))
    except OSError as error:
        raise ConfigurationError(f"cannot write to {parent / name}: {error.strerror}") from None
    with (outer / "unlocked").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            # Under its name only now: nobody sees it without its lock.
            (outer / "unlocked").rename(outer / LOCK)
            # Inside of the outer one, which nobody else may read.
            inner = outer / "files"
            inner.mkdir()
            yield inner
        finally:
            # Before the lock is given back, so that nobody takes it for abandoned.
            shutil.rmtree(outer, ignore_errors=True)


def remove_abandoned(parent: Path, name: str) -> None:
    """Removes what processes that were killed have left of `hidden_folder`, and says so."""
    for folder in sorted(parent.glob(f".{glob.escape(name)}.*")):
        try:
            with (folder / LOCK).open("r+") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            # Its process is at work, or it is not one of ours.
            continue
        logging.getLogger(__name__).warning("removed %s, which a killed run had left", folder)


def check_results(
    out: str | os.PathLike[str], names: Sequence[str], *, overwrite: bool = False
) -> None:
    """Raises what `result_folder` would raise, where names are only known after the work."""
    out = Path(out)
    for folder in (out, *out.parents):
        if folder.exists() and not folder.is_dir():
            raise ConfigurationError(f"cannot write to {out}: {folder} is not a folder")
    clashes = [name for name in names if (out / name).exists()]
    if clashes and not overwrite:
        raise OutputExistsError(
            f"{out} already holds {', '.join(clashes)}; "
            "choose another --out, or pass --overwrite to replace them"
        )


def _move(source: Path, target: Path) -> None:
    """Moves every file, each in one step; what else lies in the target stays.

    The summary is last: where it is, everything is.
    """
    for path in sorted(source.rglob("*"), key=lambda path: (path.name == SUMMARY, path)):
        destination = target / path.relative_to(source)
        if path.is_dir():
            destination.mkdir(exist_ok=True)
        else:
            os.replace(path, destination)


def save_figure(figure: Figure, path: Path) -> None:
    """Writes a figure as a picture."""
    figure.savefig(path, dpi=plotting.DPI)


def origin(field: ScoreInducedField) -> dict[str, Any]:
    """Returns what a field comes from, by the names of `summary.json`."""
    return {"recipe": field.recipe, "seed": field.seed, "digest": field.cloud.digest}


def write_summary(folder: Path, summary: Mapping[str, Any]) -> None:
    """Writes `summary.json`; NumPy values become plain ones, non-finite numbers null."""
    text = json.dumps(plain(summary), indent=2, allow_nan=False)
    (folder / SUMMARY).write_text(text + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """Returns a value as JSON has it: NumPy values plain, non-finite numbers None."""
    match value:
        case Mapping():
            return {str(key): plain(item) for key, item in value.items()}
        case list() | tuple() | np.ndarray():
            return [plain(item) for item in value]
        case np.generic():
            return plain(value.item())
        case float() if not math.isfinite(value):
            return None
        case _:
            return value
