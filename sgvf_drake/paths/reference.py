"""Polylines: the pieces of a path, and the path that a run is measured against."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.clouds import Origin, PointCloud
from sgvf_drake.exceptions import PointCloudError

CLOSING_TOLERANCE = 1e-9
"""First and last point of a file are the same when this close, in parts of the extent."""

LONG_POLYLINE = 20
"""A polyline of this many vertices whose ends meet is a loop, not an open polygon."""

MEETING_STEPS = 2.0
"""Ends meet within this many median distances of neighbouring vertices."""

SAMPLES = 16_384
"""Samples of a whole reference that find the nearest segments, besides one a segment."""

PROJECTION_TOLERANCE = 1e-7
"""Error of a projected distance, in parts of the reference's half-extent (4 U)."""

CHUNK = 65_536
"""Points that are projected at once, to bound the memory."""


@dataclass(frozen=True, eq=False)
class Projection:
    """The nearest points of a reference.

    Attributes:
        distance: (n,) distance to it.
        piece: (n,) the piece it lies on.
        arc: (n,) its arc length on that piece.
    """

    distance: FloatArray
    piece: IntArray
    arc: FloatArray


@dataclass(frozen=True, eq=False)
class _Segments:
    """Straight segments, and an index to find the nearest one.

    Attributes:
        start: (S, d) first end of each segment.
        end: (S, d) other end.
        arc: (S, 2) arc length at both ends.
        piece: (S,) the piece that each belongs to.
    """

    start: FloatArray
    end: FloatArray
    arc: FloatArray
    piece: IntArray

    @cached_property
    def _part(self) -> float:
        """Longest part of a segment that one sample stands for."""
        total = float(np.linalg.norm(self.end - self.start, axis=1).sum())
        return max(total / SAMPLES, float(np.finfo(np.float64).tiny))

    @cached_property
    def _index(self) -> tuple[cKDTree, IntArray]:
        """A tree of samples in the middle of equal parts, and the segment of each."""
        length = np.linalg.norm(self.end - self.start, axis=1)
        parts = np.maximum(np.ceil(length / self._part), 1).astype(np.intp)
        segment = np.repeat(np.arange(len(parts)), parts)
        number = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
        t = ((number + 0.5) / parts[segment])[:, None]
        return cKDTree(self.start[segment] * (1 - t) + self.end[segment] * t), segment

    def project(self, x: FloatArray) -> Projection:
        x = np.asarray(x, dtype=np.float64)
        distance, arc = np.empty(len(x)), np.empty(len(x))
        piece = np.empty(len(x), dtype=np.intp)
        for first in range(0, len(x), CHUNK):
            chunk = slice(first, first + CHUNK)
            distance[chunk], piece[chunk], arc[chunk] = self._project_chunk(x[chunk])
        return Projection(distance, piece, arc)

    def _project_chunk(self, x: FloatArray) -> tuple[FloatArray, IntArray, FloatArray]:
        """Looks at the segments of the k nearest samples, with k growing until it is proved.

        A segment of which no sample is among the k nearest is farther away than the
        distance r_k of the k-th one allows: its nearest point lies within half a part of
        a sample, so its distance is at least sqrt(r_k^2 - (part / 2)^2).
        """
        tree, segment = self._index
        distance, arc = np.empty(len(x)), np.empty(len(x))
        piece = np.empty(len(x), dtype=np.intp)
        tolerance = PROJECTION_TOLERANCE * float((tree.maxes - tree.mins).max()) / 2
        todo, k = np.arange(len(x)), 4
        while len(todo):
            k = min(k, tree.n)
            r, sample = tree.query(x[todo], k=np.arange(1, k + 1))
            distance[todo], piece[todo], arc[todo] = self._nearest(x[todo], segment[sample])
            if k == tree.n:
                break
            proved = np.sqrt(np.maximum(r[:, -1] ** 2 - (self._part / 2) ** 2, 0))
            todo, k = todo[distance[todo] > proved + tolerance], 4 * k
        return distance, piece, arc

    def _nearest(
        self, x: FloatArray, candidates: IntArray
    ) -> tuple[FloatArray, IntArray, FloatArray]:
        """Projects (n, d) on segments (n, k) and returns the nearest of each row."""
        best = np.full(len(x), np.inf)
        arc = np.empty(len(x))
        piece = np.empty(len(x), dtype=np.intp)
        for segment in candidates.T:
            start, along = self.start[segment], (self.end - self.start)[segment]
            squared_length = (along**2).sum(axis=1)
            # Between vertices that coincide any t will do.
            squared_length[squared_length == 0] = 1.0
            t = np.clip(((x - start) * along).sum(axis=1) / squared_length, 0, 1)
            distance = np.sqrt(((x - start - t[:, None] * along) ** 2).sum(axis=1))
            closer = distance < best
            best[closer] = distance[closer]
            ends = self.arc[segment[closer]]
            arc[closer] = ends[:, 0] + t[closer] * (ends[:, 1] - ends[:, 0])
            piece[closer] = self.piece[segment[closer]]
        return best, piece, arc


@dataclass(frozen=True, eq=False)
class Piece:
    """A polyline.

    Attributes:
        vertices: (M, d) in order, M >= 2, a read-only copy.
        closed: Whether the last vertex is joined to the first, which is not repeated.

    Raises:
        PointCloudError: if the vertices are not finite, or all the same.
    """

    vertices: FloatArray
    closed: bool

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64)
        if vertices.ndim != 2 or len(vertices) < 2 or not np.isfinite(vertices).all():
            raise PointCloudError(
                f"a piece needs at least 2 finite vertices (M, d), not {vertices.shape}"
            )
        vertices.flags.writeable = False
        object.__setattr__(self, "vertices", vertices)
        if self.length == 0:
            raise PointCloudError("all vertices of a piece coincide")

    @cached_property
    def _knots(self) -> FloatArray:
        """The vertices, with the first one repeated at the end of a closed piece."""
        if self.closed:
            return np.concatenate([self.vertices, self.vertices[:1]])
        return self.vertices

    @cached_property
    def _knot_arc(self) -> FloatArray:
        steps = np.linalg.norm(np.diff(self._knots, axis=0), axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @property
    def length(self) -> float:
        """The length, including the closing segment of a closed piece."""
        return float(self._knot_arc[-1])

    @property
    def arc(self) -> FloatArray:
        """Arc length at each vertex, (M,)."""
        return self._knot_arc[: len(self.vertices)]

    def at(self, arc: FloatArray) -> FloatArray:
        """Returns the points (n, d) at arc lengths (n,) between 0 and the length."""
        return np.column_stack(
            [np.interp(arc, self._knot_arc, coordinate) for coordinate in self._knots.T]
        )

    def sample(self, n: int) -> FloatArray:
        """Returns `n` points (n, d) at equal arc-length steps, beginning at the first vertex.

        On an open piece the last point is the last vertex.
        """
        return self.at(np.linspace(0, self.length, n, endpoint=not self.closed))

    def rescaled(self, factor: float) -> "Piece":
        """Returns the polyline in another unit of length: positions times `factor`."""
        return Piece(self.vertices * factor, self.closed)


@dataclass(frozen=True, eq=False)
class ReferencePath:
    """A path as the metrics see it: one or more polylines.

    Attributes:
        pieces: The polylines, all in the same dimension.
        origin: Where the coordinates are zero, if they were degrees; see `PointCloud.origin`.
        messages: What was read, if they come from a file, a line each.

    Raises:
        PointCloudError: if there is no piece, or their dimensions differ.
    """

    pieces: tuple[Piece, ...]
    origin: Origin | None = None
    messages: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "pieces", tuple(self.pieces))
        dims = sorted({piece.vertices.shape[1] for piece in self.pieces})
        if len(dims) != 1:
            raise PointCloudError(f"need pieces of one dimension, got dimensions {dims}")

    @classmethod
    def read(
        cls,
        path: str | Path,
        columns: str | Sequence[str | int] | None = None,
        closed: bool | None = None,
        origin: Origin | None = None,
    ) -> "ReferencePath":
        """Reads an ordered polyline, one vertex a line, as one piece.

        Args:
            path: the file; see `PointCloud.read`.
            columns: the columns to take.
            closed: whether it is closed; by default, if its last point repeats its first,
                or lies no farther from it than vertices of a long polyline lie apart, as
                in the center lines of race tracks.
            origin: for a file in degrees, that of the cloud that it is compared with.

        Raises:
            PointCloudError: if the file, a line or a value cannot be used.
        """
        cloud = PointCloud.read(path, columns, origin)
        vertices = cloud.points
        gap = float(np.linalg.norm(vertices[-1] - vertices[0]))
        repeats = gap <= CLOSING_TOLERANCE * cloud.half_extent
        if closed is None:
            closed = repeats or _ends_meet(vertices, gap)
        piece = Piece(vertices[:-1] if closed and repeats else vertices, closed)
        return cls((piece,), cloud.origin, cloud.messages)

    @property
    def dim(self) -> int:
        """The dimension d of the space."""
        return int(self.pieces[0].vertices.shape[1])

    @property
    def lengths(self) -> FloatArray:
        """The length of each piece, (P,)."""
        return np.array([piece.length for piece in self.pieces])

    @property
    def closed(self) -> BoolArray:
        """Whether each piece is closed, (P,)."""
        return np.array([piece.closed for piece in self.pieces])

    @property
    def longest(self) -> float:
        """The length of the longest piece."""
        return float(self.lengths.max())

    def first_and_last(self, piece: int) -> FloatArray:
        """Returns the first and the last vertex of a piece, (2, d)."""
        return self.pieces[piece].vertices[[0, -1]]

    def project(self, x: FloatArray) -> Projection:
        """Returns the nearest points of the path to `x` (n, d)."""
        return self._segments.project(x)

    def rescaled(self, factor: float) -> "ReferencePath":
        """Returns the path in another unit of length: positions times `factor`."""
        return ReferencePath(tuple(piece.rescaled(factor) for piece in self.pieces))

    @cached_property
    def _segments(self) -> _Segments:
        knots = [piece._knots for piece in self.pieces]
        arcs = [piece._knot_arc for piece in self.pieces]
        counts = [len(points) - 1 for points in knots]
        return _Segments(
            np.concatenate([points[:-1] for points in knots]),
            np.concatenate([points[1:] for points in knots]),
            np.concatenate([np.column_stack([arc[:-1], arc[1:]]) for arc in arcs]),
            np.repeat(np.arange(len(counts)), counts),
        )


def _ends_meet(vertices: FloatArray, gap: float) -> bool:
    # Few vertices may be the corners of an open polygon, whose sides are as long as its gap.
    steps = np.linalg.norm(np.diff(vertices, axis=0), axis=1)
    return len(vertices) >= LONG_POLYLINE and gap <= MEETING_STEPS * float(np.median(steps))
