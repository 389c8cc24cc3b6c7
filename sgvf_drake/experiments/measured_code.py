"""Which code decides the numbers of an experiment, as a digest."""

from functools import cache
import hashlib
from pathlib import Path

import sgvf_drake
import systems

# Folders and files, relative to `sgvf_drake`.  What draws, tells or reports is not in it.
MEASURED_CODE = (
    *("paths", "fields", "learning", "lyapunov", "metrics.py"),
    *("experiments/clouds.py", "experiments/follow.py", "experiments/simulation.py"),
)


@cache
def code_digest(*modules: Path) -> str:
    """Returns a digest of the code that decides the numbers, as it is when first asked.

    Args:
        modules: Files of the experiment itself, besides what all experiments rest on.
    """
    package = Path(sgvf_drake.__file__).parent
    places = [*(package / name for name in MEASURED_CODE), Path(systems.__file__).parent]
    digest = hashlib.sha256()
    for place in (*places, *modules):
        for file in sorted(place.rglob("*.py")) if place.is_dir() else [place]:
            digest.update(f"{file.relative_to(place.parent)}\n".encode() + file.read_bytes())
    return digest.hexdigest()
