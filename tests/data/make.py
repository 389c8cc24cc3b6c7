"""Trains the fields that the tests read from files, and writes them to tests/data/fields.

`make test-data` trains all of them; `python -m tests.data.make NAME ...` trains some.  The
files hold what the code of that day had learned.  Tests read them, because training takes
seconds and most tests only need a trained field; the tests of each recipe train one of
`FIELDS` anew and compare how the two behave.  Train them again when a recipe changes on
purpose, and commit the files together with that change.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
import sys

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.paths import make_shape
from tests.networks import SHAPES

FOLDER = Path(__file__).parent / "fields"


def open_circle() -> PointCloud:
    """Six tenths of a circle of radius 3, from (-2.43, -1.76) around to (3, 0), shuffled."""
    angle = np.linspace(0, 1.2 * np.pi, 80)
    points = 3 * np.column_stack([np.cos(angle), np.sin(angle)])
    return PointCloud(np.random.default_rng(0).permutation(points))


def half_circle() -> PointCloud:
    """Half of a circle of 4 m radius, from (-4, 0) over (0, 4) to (4, 0), in this order."""
    angle = np.linspace(np.pi, 0, 80)
    return PointCloud(4.0 * np.column_stack([np.cos(angle), np.sin(angle)]))


def network_cloud(name: str) -> PointCloud:
    """A shape of tests/networks.py, 6 m wide, about the origin."""
    points = SHAPES[name].sample(300, 0.0, random=False, seed=0) * 6.0 / 8.0
    return PointCloud(points - (points.min(axis=0) + points.max(axis=0)) / 2)


@dataclass(frozen=True)
class StoredField:
    """What a stored field was trained on, and how.

    Attributes:
        cloud: Makes the waypoints.
        options: The arguments of `TrainingConfig`.
    """

    cloud: Callable[[], PointCloud]
    options: dict[str, object]


def _shape(name: str) -> Callable[[], PointCloud]:
    return lambda: make_shape(name)[0]


FIELDS = {
    "robust": StoredField(_shape("concentric-circles"), {"recipe": "robust"}),
    "exact": StoredField(_shape("concentric-circles"), {"recipe": "exact"}),
    "paper": StoredField(_shape("concentric-circles"), {"recipe": "paper"}),
    "flight": StoredField(_shape("concentric-flight"), {"recipe": "exact"}),
    "open": StoredField(open_circle, {"recipe": "exact"}),
    "half_circle": StoredField(
        half_circle, {"recipe": "exact", "open": True, "direction": "reverse"}
    ),
    "tee": StoredField(lambda: network_cloud("T"), {"recipe": "exact"}),
    "eight": StoredField(lambda: network_cloud("eight"), {"recipe": "exact"}),
}
"""The stored fields by name; all of seed 0."""


def field_file(name: str) -> Path:
    """Returns the file of a stored field."""
    return FOLDER / f"{name}.safetensors"


def main(names: list[str]) -> None:
    """Trains these fields, or all of them, and replaces their files."""
    from sgvf_drake.learning import TrainingConfig, train

    for name in names or FIELDS:
        stored = FIELDS[name]
        result = train(stored.cloud(), TrainingConfig(seed=0, **stored.options))
        result.field.save(field_file(name), overwrite=True)
        check = result.self_check
        print(f"{name}: {result.wall_s:.1f} s, self-check passed: {check.passed}", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
