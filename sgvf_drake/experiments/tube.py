"""The tube about a path that a verification left behind, as curves to draw."""

from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any

from contourpy import contour_generator
import numpy as np

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.results import SUMMARY
from sgvf_drake.fields import FloatArray, GuidingField
from sgvf_drake.lyapunov import LyapunovFunction

# Cells of the raster on which the level curves are followed, along each axis of the box.
CELLS = 600


def tube_curves(
    field: GuidingField, verified: str | Path, scale: float = 1.0
) -> Sequence[FloatArray]:
    """Returns the border of the tube {V <= c_in} as polylines in metres, (k, 2) each.

    Args:
        field: The planar field, in the unit of its waypoints.
        verified: The folder that `sgvf verify` left, with or without the same scale.
        scale: Metres in one unit of the waypoints.

    Raises:
        ConfigurationError: There is no verification of this field, or it found no tube.
    """
    summary = _read(Path(verified) / SUMMARY)
    try:
        known = (summary["digest"], summary["recipe"], summary["seed"])
        c_in = None if summary["c_in"] is None else float(summary["c_in"])
        sigma_in_U = summary["sigma"] / summary["unit_length"]
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        raise ConfigurationError(f"{verified} holds no results of a verification") from None
    metric = field.rescaled(scale)
    if known not in [(f.cloud.digest, f.recipe, f.seed) for f in (field, metric)]:
        raise ConfigurationError(f"{verified} is the verification of another field")
    if c_in is None:
        raise ConfigurationError(f"the verification in {verified} found no tube")
    return level_curves(metric, sigma_in_U * metric.cloud.unit_length, c_in)


def level_curves(field: GuidingField, sigma: float, level: float) -> Sequence[FloatArray]:
    """Returns where V of noise level sigma has a level, as polylines (k, 2) in the box."""
    if field.dim != 2:
        raise ConfigurationError(f"a tube is drawn of planar fields, not in {field.dim}-D")
    lower, upper = field.cloud.box
    x, y = (np.linspace(a, b, CELLS + 1) for a, b in zip(lower, upper, strict=True))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    V = LyapunovFunction.of(field, sigma)(grid).reshape(len(y), len(x))
    return [np.asarray(line) for line in contour_generator(x, y, V).lines(level)]


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigurationError(f"there is no verification in {path.parent}") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ConfigurationError(f"cannot read {path}: {error}") from None
