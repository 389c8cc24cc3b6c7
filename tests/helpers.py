"""What many tests look at: results in a folder, how much is drawn, points on a circle."""

import json
import os
from pathlib import Path

from matplotlib.image import imread
import numpy as np


def names_in(folder):
    """The names of what is in a folder."""
    return {path.name for path in Path(folder).iterdir()}


def summary_of(folder):
    """The summary among the results in a folder."""
    return json.loads((Path(folder) / "summary.json").read_text())


def content_of(folder):
    """The bytes of every file below a folder."""
    return {path: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}


def ink(picture):
    """The part of a picture that is not about white."""
    return np.any(imread(picture)[..., :3] < 0.9, axis=2).mean()


def circle(radius, count, center=(0.0, 0.0)):
    """Equally spaced points on a circle, counter-clockwise from its right."""
    angle = 2 * np.pi * np.arange(count) / count
    return center + radius * np.column_stack([np.cos(angle), np.sin(angle)])


class Trap:
    """Unpickling it leaves a trace."""

    def __reduce__(self):
        return os.mkdir, ("sprung",)
