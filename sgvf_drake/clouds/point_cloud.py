"""A point cloud: the waypoints of a path, in no particular order, checked once."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import hashlib
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from sgvf_drake.arrays import FloatArray
from sgvf_drake.clouds.geodesy import Origin
from sgvf_drake.clouds.reading import read_recording
from sgvf_drake.clouds.tables import looks_transposed
from sgvf_drake.exceptions import PointCloudError

HALF_EXTENT_UNITS = 4.0
"""Half-extent of every cloud in normalised units: the scale of the paper's own shapes, for
which noise levels, step sizes and network inputs are chosen."""

BOX_FACTOR = 1.25
"""Half-size of the box in half-extents: +-5 normalised units, the paper's workspace."""

SMALLEST_RELATIVE_EXTENT = 1e-9
"""Half-extent over largest coordinate: below it, float64 leaves fewer than seven digits."""

EXTENT_RANGE = (1e-100, 1e100)
"""Half-extents whose squares, and the squares of whose inverses, are normal float64."""


@dataclass(frozen=True, eq=False, repr=False)
class PointCloud:
    """Waypoints of a path, of which neither order nor pieces are known.

    Attributes:
        points: (N, d) float64, a read-only copy, in the user's unit of length; N >= 2,
            d >= 2.  Waypoints may coincide, but not all of them.
        shape: Name of the shape that they were sampled from, if any.
        velocities: (N, d) float64, a read-only copy: how a robot moved that recorded the
            waypoints, zero where that is not known, or None.  They settle the direction of
            travel and nothing else, so their unit does not matter.
        breaks: Waypoints in front of which their recording was interrupted, rising numbers
            between 0 and N; none where that is not known.
        origin: Latitude, longitude (degrees) and height (m) where the coordinates are zero,
            if they are metres along east, north and up that were degrees; or None.
        messages: What was read and what was made of it, a line each.

    Raises:
        PointCloudError: if the points are not such an array, not finite, or so close
            together that float64 cannot resolve them; if the velocities are not as many,
            or not finite; if the breaks are not such numbers.
    """

    points: FloatArray
    shape: str | None = None
    velocities: FloatArray | None = None
    breaks: tuple[int, ...] = ()
    origin: Origin | None = None
    messages: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        points = _as_points(self.points)
        points.flags.writeable = False
        object.__setattr__(self, "points", points)
        if self.velocities is not None:
            velocities = _as_velocities(self.velocities, points.shape)
            velocities.flags.writeable = False
            object.__setattr__(self, "velocities", velocities)
        object.__setattr__(self, "breaks", _as_breaks(self.breaks, len(points)))
        _check_extent(points, self.half_extent)

    @classmethod
    def read(
        cls,
        path: str | Path,
        columns: str | Sequence[str | int] | None = None,
        origin: Origin | None = None,
    ) -> "PointCloud":
        """Reads a file: CSV or other text, .npy, .npz, GPX, or a mission of QGroundControl.

        Latitudes and longitudes become metres along east and north.  `messages` tells what was
        read.  What is recognised, and how, is told on the page "Files of waypoints".

        Args:
            path: The file; it may be compressed by gzip.
            columns: The columns of the coordinates, by name or by number from 0: "x_m,y_m",
                "0,1" or a list.  By default those whose names say so, or both of two columns
                without names.
            origin: Where east, north and up are zero, for a file in degrees; by default amid
                its places.  Files that are to be compared need the same one.

        Raises:
            PointCloudError: if the file, a line or a value cannot be used, or if it leaves a
                choice of the columns.
        """
        recording = read_recording(path, columns, origin)
        try:
            return cls(
                recording.points,
                velocities=recording.velocities,
                breaks=recording.breaks,
                origin=recording.origin,
                messages=recording.messages,
            )
        except PointCloudError as error:
            raise PointCloudError(f"{path}: {error}") from error

    @property
    def num_points(self) -> int:
        """The number of waypoints N."""
        return len(self.points)

    @property
    def dim(self) -> int:
        """The dimension d of the space."""
        return int(self.points.shape[1])

    @cached_property
    def center(self) -> FloatArray:
        """The middle of the range of each coordinate, (d,)."""
        center: FloatArray = self.points.min(axis=0) / 2 + self.points.max(axis=0) / 2
        center.flags.writeable = False
        return center

    @cached_property
    def half_extent(self) -> float:
        """Half the range of the coordinate with the largest range."""
        return float((self.points.max(axis=0) / 2 - self.points.min(axis=0) / 2).max())

    @property
    def unit_length(self) -> float:
        """The unit of length U of this cloud: its half-extent is `HALF_EXTENT_UNITS` U."""
        return self.half_extent / HALF_EXTENT_UNITS

    @property
    def box(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper corner, (d,) each, of the square (cube) around the cloud."""
        half_size = BOX_FACTOR * self.half_extent
        return self.center - half_size, self.center + half_size

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the shape, type and bytes of the points, in hexadecimal."""
        header = f"{self.points.shape} {self.points.dtype.str} "
        return hashlib.sha256(header.encode() + self.points.tobytes()).hexdigest()

    def normalize(self, x: ArrayLike) -> FloatArray:
        """Maps points (..., d) to normalised units, in which the cloud spans +-4."""
        return (np.asarray(x, dtype=np.float64) - self.center) / self.unit_length

    def denormalize(self, x: ArrayLike) -> FloatArray:
        """Maps points (..., d) from normalised units back to the user's unit of length."""
        return np.asarray(x, dtype=np.float64) * self.unit_length + self.center

    def __repr__(self) -> str:
        shape = f", shape={self.shape!r}" if self.shape else ""
        return f"PointCloud({self.num_points} points in {self.dim}-D{shape})"


def _as_points(values: ArrayLike) -> FloatArray:
    """Returns a finite copy (N, d) with N >= 2 and d >= 2."""
    try:
        array = np.asarray(values)
    except ValueError as error:
        raise PointCloudError("the waypoints do not all have the same length") from error
    if array.dtype.kind not in "fiu":
        raise PointCloudError(f"waypoints must be real numbers, not {array.dtype}")
    if array.ndim != 2:
        raise PointCloudError(f"waypoints must be an array (N, d), not {array.shape}")
    if array.shape[0] < 2:
        raise PointCloudError(f"a path needs at least 2 waypoints, not {array.shape[0]}")
    if looks_transposed(array.shape):
        raise PointCloudError(f"{array.shape[0]} points in {array.shape[1]}-D: transposed?")
    if array.shape[1] < 2:
        raise PointCloudError(
            f"waypoints must have at least 2 coordinates, not {array.shape[1]}"
        )
    # order="C": the digest must not depend on the layout of the array that was passed.
    with np.errstate(over="ignore"):
        points = np.array(array, dtype=np.float64, order="C")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise PointCloudError(f"waypoint {bad[0]} is not finite: {points[bad[0]].tolist()}")
    return points


def _as_velocities(values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Returns a finite copy of the shape of the points."""
    try:
        velocities = np.array(values, dtype=np.float64, order="C")
    except (TypeError, ValueError) as error:
        raise PointCloudError(f"velocities must be real numbers: {error}") from error
    if velocities.shape != shape:
        raise PointCloudError(
            f"velocities are an array {velocities.shape}, but the waypoints are {shape}"
        )
    bad = np.flatnonzero(~np.isfinite(velocities).all(axis=1))
    if len(bad):
        raise PointCloudError(f"velocity {bad[0]} is not finite: {velocities[bad[0]].tolist()}")
    return velocities


def _as_breaks(values: Sequence[int], num_points: int) -> tuple[int, ...]:
    """Returns rising numbers between 0 and N."""
    breaks = tuple(int(value) for value in values)
    between = (0, *breaks, num_points)
    if any(after <= before for before, after in pairwise(between)):
        raise PointCloudError(
            f"breaks must rise between 0 and {num_points}, not be {list(values)[:8]}"
        )
    return breaks


def _check_extent(points: FloatArray, half_extent: float) -> None:
    smallest, largest = EXTENT_RANGE
    if half_extent == 0:
        raise PointCloudError(
            f"all {len(points)} waypoints coincide at {points[0].tolist()}; "
            "a path needs at least 2 distinct ones"
        )
    if not smallest < half_extent < largest:
        raise PointCloudError(
            f"the waypoints span {2 * half_extent:.3g}, beyond what float64 can square; "
            "choose another unit of length"
        )
    magnitude = float(np.abs(points).max())
    if half_extent < SMALLEST_RELATIVE_EXTENT * magnitude:
        raise PointCloudError(
            f"the waypoints span only {2 * half_extent:.3g} at coordinates of "
            f"{magnitude:.3g}, which float64 cannot resolve; subtract an offset first"
        )
