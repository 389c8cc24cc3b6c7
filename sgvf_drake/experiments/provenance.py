"""Where results come from: versions of what ran, and the commit of the sources."""

from functools import cache
from importlib.metadata import version
from pathlib import Path
import platform
import subprocess
from typing import Any

import sgvf_drake

PACKAGES = ("drake", "torch", "numpy", "scipy", "numba", "pandas", "matplotlib")


@cache
def provenance() -> dict[str, Any]:
    """Returns the versions, and the git commit where the sources are a checkout.

    The commit ends in "-dirty" where files of it were changed; it is None without git, or
    where the package is installed elsewhere.
    """
    versions = {
        "sgvf_drake": sgvf_drake.__version__,
        "python": platform.python_version(),
        **{name: version(name) for name in PACKAGES},
    }
    return {"versions": versions, "commit": _commit()}


def _commit() -> str | None:
    package = Path(sgvf_drake.__file__).parent
    try:
        # An environment inside of some other project is not its checkout.
        if Path(_git(package, "rev-parse", "--show-toplevel")) != package.parent.resolve():
            return None
        return _git(package, "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(folder: Path, *arguments: str) -> str:
    command = ["git", "-C", str(folder), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
