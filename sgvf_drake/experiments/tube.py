"""The tube, or the walls, about a path that a verification or a certificate left, as curves."""

from collections.abc import Sequence
import json
from pathlib import Path
from typing import Any

from contourpy import contour_generator
import numpy as np

from sgvf_drake.arrays import BoolArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.certified import CertifiedField, certificate_file
from sgvf_drake.experiments.results import SUMMARY
from sgvf_drake.fields import FloatArray, GuidingField
from sgvf_drake.lyapunov import LyapunovFunction

# Cells of the raster on which the level curves are followed, along each axis of the box.
CELLS = 600
# A tube takes at least so many of them from the path to its border; those near a thinner one
# are divided, into at most so many along each side.
CELLS_TO_BORDER = 4
FINEST = 8
TINY = np.finfo(np.float64).tiny


def tube_curves(
    field: GuidingField, results: str | Path, scale: float = 1.0, speed: float = 0.45
) -> Sequence[FloatArray]:
    """Returns what borders the set that robots do not leave, polylines in metres, (k, 2) each.

    Of a verification that is the tube {V <= c_in}, of a certificate the outermost walls.

    Args:
        field: The planar field, in the unit of its waypoints.
        results: The folder that `sgvf verify` left, with or without the same scale; or the
            one of `sgvf certify`, or its certificate.
        scale: Metres in one unit of the waypoints.
        speed: Of the flight, m/s: a certificate may be that of the field as it is flown.

    Raises:
        ConfigurationError: If there is neither of this field, or if it found no tube or walls.
    """
    if certificate_file(results) is None:
        return _verified_tube(field, results, scale)
    walls = CertifiedField.open(field, results, speed, scale).certificate.walls
    outermost = [one.polygons(side)[-1] for one in walls if one for side in (1, -1)]
    closed = [np.append(wall, wall[:1], axis=0) for wall in outermost]
    return [scale * field.cloud.denormalize(wall) for wall in closed]


def _verified_tube(
    field: GuidingField, verified: str | Path, scale: float
) -> Sequence[FloatArray]:
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
    V = LyapunovFunction.of(field, sigma)
    x, y, values = _raster(V, lower, upper, CELLS)
    cell = float((upper - lower).max()) / CELLS
    # V is about r^2 / 2 sigma^2 at a distance r from the path.
    root = np.sqrt(max(level, TINY))
    finer = int(np.ceil(CELLS_TO_BORDER * cell / (sigma * np.sqrt(2) * root)))
    if finer > 1:
        finer = min(finer, FINEST)
        # V is at most (sqrt(V') + r / sqrt(2) sigma)^2 at a distance r from where it is V',
        # since its Hessian is at most I / sigma^2: so no cell that the level reaches into is
        # left out.
        near = _has_corner(np.sqrt(np.maximum(values, 0)) <= root + cell / (2 * sigma))
        cells = np.pad(near.repeat(finer, axis=0).repeat(finer, axis=1), 1)
        x, y, values = _raster(V, lower, upper, CELLS * finer, _has_corner(cells))
    return [np.asarray(line) for line in contour_generator(x, y, values).lines(level)]


def _raster(
    V: LyapunovFunction,
    lower: FloatArray,
    upper: FloatArray,
    cells: int,
    wanted: BoolArray | None = None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns the axes of a raster and V on it; infinite where it is not wanted."""
    x, y = (np.linspace(a, b, cells + 1) for a, b in zip(lower, upper, strict=True))
    if wanted is None:
        wanted = np.ones((cells + 1, cells + 1), bool)
    rows, columns = np.nonzero(wanted)
    values = np.full(wanted.shape, np.inf)
    values[rows, columns] = V(np.column_stack([x[columns], y[rows]]))
    return x, y, values


def _has_corner(marked: BoolArray) -> BoolArray:
    """Returns which squares of four neighbours in an array have a marked one."""
    return marked[:-1, :-1] | marked[1:, :-1] | marked[:-1, 1:] | marked[1:, 1:]


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigurationError(f"there is no verification in {path.parent}") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ConfigurationError(f"cannot read {path}: {error}") from None
