"""One case: what is trained, and what names it and tells it from others."""

from dataclasses import asdict, dataclass
import hashlib
import json
from pathlib import Path
import re
from typing import Any

# Starts of a case, unless given.
STARTS = 100

# The columns by which a table is sorted; all but the seed make a group.
LABELS = ("name", "shape", "sampling", "recipe", "seed")


@dataclass(frozen=True)
class Case:
    """One training and what it is measured with.

    Attributes:
        name: The group of cases it belongs to.
        cloud: Path of the cloud, one of `clouds.PATHS`; with a source, a name for it.
        sampling: One of `clouds.SAMPLINGS`.
        recipe: Of the training.
        seed: Of the cloud and of the training.
        starts: Number of starts on a grid over the box.
        overrides: Names and values of a `TrainingConfig`, beside recipe and seed.
        source: A file with the ordered path.
    """

    name: str
    cloud: str
    sampling: str = "uniform"
    recipe: str = "robust"
    seed: int = 0
    starts: int = STARTS
    overrides: tuple[tuple[str, Any], ...] = ()
    source: str | None = None

    @property
    def key(self) -> str:
        """The stem of its files; it leaves out starts, overrides and source."""
        raw = "-".join([self.name, self.cloud, self.sampling, self.recipe, f"seed{self.seed}"])
        safe = re.sub(r"[^A-Za-z0-9_.-]", "_", raw)
        if safe == raw:
            return raw
        return f"{safe}-{hashlib.sha256(raw.encode()).hexdigest()[:8]}"

    @property
    def labels(self) -> dict[str, Any]:
        """Its columns of the table: `LABELS`, starts and key."""
        return {
            "name": self.name,
            "shape": self.cloud,
            "sampling": self.sampling,
            "recipe": self.recipe,
            "seed": self.seed,
            "starts": self.starts,
            "key": self.key,
        }

    def identity(self) -> dict[str, Any]:
        """Returns its fields and a digest of its source, as plain JSON values."""
        source = None
        if self.source is not None and Path(self.source).is_file():
            source = hashlib.sha256(Path(self.source).read_bytes()).hexdigest()
        identity = {"case": asdict(self), "source": source}
        plain: dict[str, Any] = json.loads(json.dumps(identity))
        return plain
