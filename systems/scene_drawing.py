"""What stands still in a picture of a flight: waypoints, the field, and level curves of V.

Each is one object in Meshcat's scene, because hundreds of objects stall a browser.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat, Rgba
from pydrake.perception import PointCloud

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.fields.base import Field

WAYPOINTS_PATH = "/waypoints"
FIELD_PATH = "/field"
TUBE_PATH = "/tube"

WAYPOINT_COLOR = Rgba(0.1, 0.1, 0.1)
FIELD_COLOR = Rgba(0.62, 0.69, 0.73)
TUBE_COLOR = Rgba(0.0, 0.62, 0.45)

WAYPOINT_SIZE = 0.01
"""Of a point, in lengths of the cloud's largest extent."""

FIELD_ARROWS = 31
"""Along the longer side of the box; the picture then has about a thousand."""

ARROW_LENGTH = 0.8
"""Of an arrow where |m| is at least 1, in spacings of the grid: neighbours do not touch."""

ARROW_HEAD = 0.35
"""Of a head stroke, in lengths of its shaft."""

ARROW_HEAD_ANGLE = 0.45
"""rad; between shaft and head stroke."""


def DrawWaypoints(
    meshcat: Meshcat, points: ArrayLike, altitude: float, path: str = WAYPOINTS_PATH
) -> None:
    """Draws waypoints as one cloud of points.

    Args:
        meshcat: Is drawn to.
        points: (n, 2) or (n, 3) in m.
        altitude: In m, of points in the plane.
        path: In Meshcat's scene.

    Raises:
        ConfigurationError: if the shape is wrong.
        NonFiniteValueError: if a value is not finite.
    """
    p_W = _Lift("points", points, altitude)
    cloud = PointCloud(len(p_W))
    cloud.mutable_xyzs()[:] = p_W.T
    extent = float(np.ptp(p_W, axis=0).max())
    # A single point has no extent; then its size is in metres.
    meshcat.SetObject(path, cloud, WAYPOINT_SIZE * (extent or 1.0), WAYPOINT_COLOR)


def DrawField(
    meshcat: Meshcat,
    field: Field,
    box: tuple[ArrayLike, ArrayLike],
    altitude: float,
    path: str = FIELD_PATH,
) -> None:
    """Draws a guiding field at an altitude as arrows on a grid, all in one set of lines.

    Of a field of dimension 3 the slice at the altitude is drawn.

    Args:
        meshcat: Is drawn to.
        field: Of dimension 2 or 3, in metres.
        box: Lower and upper corner, (d,) each in m; only x and y count.
        altitude: In m.
        path: In Meshcat's scene.

    Raises:
        ConfigurationError: if the dimension is another, or the box is empty.
        NonFiniteValueError: if the box, the altitude or the field's value is not finite.
    """
    if field.dim not in (2, 3):
        raise ConfigurationError(f"a field of dimension 2 or 3 is drawn, got {field.dim}")
    points, spacing = _Grid(*PlaneBox(box))
    p_W = _Lift("the grid", points, altitude)
    m = np.zeros_like(p_W)
    m[:, : field.dim] = field(p_W[:, : field.dim])
    if not np.isfinite(m).all():
        worst = p_W[np.argmin(np.isfinite(m).all(axis=1))]
        raise NonFiniteValueError(f"the field is not finite at {worst[: field.dim].tolist()}")
    start, end = _Arrows(p_W, m, ARROW_LENGTH * spacing)
    _DrawSegments(meshcat, path, start, end, FIELD_COLOR)


def DrawTube(
    meshcat: Meshcat, curves: Sequence[ArrayLike], altitude: float, path: str = TUBE_PATH
) -> None:
    """Draws level curves of a Lyapunov function around the path, all in one set of lines.

    Args:
        meshcat: Is drawn to.
        curves: Polylines, (k, 2) or (k, 3) each in m; a closed one ends where it starts.
        altitude: In m, of curves in the plane.
        path: In Meshcat's scene.

    Raises:
        ConfigurationError: if there is no curve, or the shape of one is wrong.
        NonFiniteValueError: if a value is not finite.
    """
    if len(curves) == 0:
        raise ConfigurationError("there is no curve to draw")
    lifted = [_Lift("a curve", curve, altitude) for curve in curves]
    start = np.vstack([curve[:-1] for curve in lifted])
    end = np.vstack([curve[1:] for curve in lifted])
    _DrawSegments(meshcat, path, start, end, TUBE_COLOR)


def PlaneBox(box: tuple[ArrayLike, ArrayLike]) -> tuple[FloatArray, FloatArray]:
    """Returns lower and upper corner of a box in the plane, (2,) each.

    Args:
        box: Lower and upper corner, (2,) or (3,) each in m.

    Raises:
        ConfigurationError: if the shape is wrong or the box is empty.
        NonFiniteValueError: if a value is not finite.
    """
    corners = np.array(box, dtype=np.float64)
    if corners.shape not in ((2, 2), (2, 3)):
        raise ConfigurationError(
            f"the box must be two corners of 2 or 3 values, got shape {corners.shape}"
        )
    lower, upper = corners[:, :2]
    if not np.isfinite(corners).all():
        raise NonFiniteValueError(f"the box must be finite, got {corners.tolist()}")
    if (upper <= lower).any():
        raise ConfigurationError(f"the box is empty: {lower.tolist()} to {upper.tolist()}")
    return lower, upper


def _Lift(name: str, points: ArrayLike, altitude: float) -> FloatArray:
    """Returns the points in space, (n, 3); those in the plane get the altitude."""
    p_W = np.asarray(points, dtype=np.float64)
    if p_W.ndim != 2 or p_W.shape[1] not in (2, 3) or len(p_W) == 0:
        raise ConfigurationError(f"{name} must be (n, 2) or (n, 3), got shape {p_W.shape}")
    if p_W.shape[1] == 2:
        p_W = np.column_stack((p_W, np.full(len(p_W), altitude)))
    if not np.isfinite(p_W).all():
        raise NonFiniteValueError(f"{name} and the altitude must be finite")
    return p_W


def _DrawSegments(
    meshcat: Any, path: str, start: FloatArray, end: FloatArray, color: Rgba
) -> None:
    """Draws n segments, (n, 3) each in m, as one object; browsers make all one pixel wide."""
    # Drake's stubs misname the type of every array, so meshcat is untyped.
    meshcat.SetLineSegments(path, start.T, end.T, 1.0, color)


def _Grid(lower: FloatArray, upper: FloatArray) -> tuple[FloatArray, float]:
    """Returns the centres of square cells that cover the box, (n, 2), and their spacing."""
    spacing = float((upper - lower).max()) / FIELD_ARROWS
    counts = np.maximum(np.rint((upper - lower) / spacing), 1.0).astype(int)
    middle = (lower + upper) / 2.0
    x, y = (
        c + spacing * (np.arange(n) - (n - 1) / 2.0)
        for c, n in zip(middle, counts, strict=True)
    )
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2), spacing


def _Arrows(p_W: FloatArray, m: FloatArray, length: float) -> tuple[FloatArray, FloatArray]:
    """Returns start and end (3 n, 3) of the strokes of arrows along m in the middle of points.

    First come n shafts, then two strokes of every head.  `length` is that of an arrow where
    |m| is 1, or more.
    """
    size = np.linalg.norm(m, axis=1, keepdims=True)
    shaft = length * m / np.maximum(size, 1.0)
    tip = p_W + shaft / 2.0
    # Heads lie flat, as the slice does, but where an arrow points straight up or down.
    side = np.column_stack((-shaft[:, 1], shaft[:, 0], np.zeros(len(m))))
    width = np.linalg.norm(side, axis=1, keepdims=True)
    vertical = width == 0.0
    side = np.where(vertical, [1.0, 0.0, 0.0], side / np.where(vertical, 1.0, width))
    side *= np.linalg.norm(shaft, axis=1, keepdims=True)
    along, across = np.cos(ARROW_HEAD_ANGLE) * shaft, np.sin(ARROW_HEAD_ANGLE) * side
    left = tip - ARROW_HEAD * (along - across)
    right = tip - ARROW_HEAD * (along + across)
    return np.vstack((tip - shaft, tip, tip)), np.vstack((tip, left, right))
