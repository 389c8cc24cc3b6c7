"""What a run is measured against: the true path, or else the tree of its cloud.

The measurements alone use it; nothing that is trained ever sees a true path.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.clouds import Origin, PointCloud
from sgvf_drake.exceptions import PointCloudError
from sgvf_drake.paths.ends import with_ends
from sgvf_drake.paths.spanning_tree import TracedPiece, trace_pieces

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

END_REACH = 1.0
"""An end of a field belongs to a piece whose tree ends within this many U of it."""

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
        end: (S, d) other end; equal to the first for an isolated point.
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
            # An isolated point has no direction: any t will do.
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


class Reference(ABC):
    """A path in pieces, as the metrics see it."""

    pieces: tuple[Piece, ...] | tuple[TracedPiece, ...]
    messages: tuple[str, ...] = ()
    """What was read, if it comes from a file, a line each."""

    @property
    @abstractmethod
    def dim(self) -> int:
        """The dimension d of the space."""

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

    @property
    @abstractmethod
    def waypoints(self) -> tuple[FloatArray, ...] | None:
        """The waypoints (M, d) of each piece, if passing all of them is what makes a lap.

        None where the arc length is known well enough to tell a lap by itself.
        """

    @abstractmethod
    def first_and_last(self, piece: int) -> FloatArray:
        """Returns the first and the last vertex of a piece, (2, d)."""

    def project(self, x: FloatArray) -> Projection:
        """Returns the nearest points of the path to `x` (n, d)."""
        return self._segments.project(x)

    @cached_property
    @abstractmethod
    def _segments(self) -> _Segments: ...


@dataclass(frozen=True, eq=False)
class ReferencePath(Reference):
    """The true path: one or more polylines.

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
        return int(self.pieces[0].vertices.shape[1])

    @property
    def waypoints(self) -> None:
        """None: arc length tells a lap."""

    def first_and_last(self, piece: int) -> FloatArray:
        return self.pieces[piece].vertices[[0, -1]]

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


@dataclass(frozen=True, eq=False)
class TreeReference(Reference):
    """The spanning tree of a cloud, where the true path is not known.

    All edges count, side branches too, and the closing edge of closed pieces: it is the one
    edge of a loop that the tree leaves out.

    Attributes:
        points: (N, d) the cloud.
        pieces: Its pieces; see `trace_pieces`.
    """

    points: FloatArray
    pieces: tuple[TracedPiece, ...]

    @property
    def dim(self) -> int:
        return int(self.points.shape[1])

    @cached_property
    def waypoints(self) -> tuple[FloatArray, ...]:
        """The waypoints (M, d) of each piece: a lap passes all of them."""
        return tuple(self.points[piece.indices] for piece in self.pieces)

    def first_and_last(self, piece: int) -> FloatArray:
        return self.points[self.pieces[piece].order[[0, -1]]]

    @cached_property
    def _segments(self) -> _Segments:
        ends, arcs = zip(*(self._piece_segments(piece) for piece in self.pieces), strict=True)
        pairs = np.concatenate(ends)
        return _Segments(
            self.points[pairs[:, 0]],
            self.points[pairs[:, 1]],
            np.concatenate(arcs),
            np.repeat(np.arange(len(ends)), [len(pair) for pair in ends]),
        )

    def _piece_segments(self, piece: TracedPiece) -> tuple[IntArray, FloatArray]:
        """Pairs of waypoints (S, 2) and their arc lengths (S, 2), isolated points too."""
        if len(piece.edges) == 0:
            return np.repeat(piece.indices[:1], 2)[None, :], np.zeros((1, 2))
        arcs = piece.arc[np.searchsorted(piece.indices, piece.edges)]
        if not piece.closed:
            return piece.edges, arcs
        closing_pair = piece.order[[-1, 0]]
        closing_arc = [piece.arc[np.searchsorted(piece.indices, piece.order[-1])], piece.length]
        return np.vstack([piece.edges, closing_pair]), np.vstack([arcs, closing_arc])

    def opened_at(self, ends: FloatArray, unit_length: float) -> "TreeReference":
        """Returns the same tree with its pieces open where a field has an end.

        The user may have said so of a piece that looks closed.

        Args:
            ends: (E, d) where the field comes to rest.
            unit_length: U; an end belongs to a piece that ends within `END_REACH` of it.
        """
        pieces = list(self.pieces)
        for number, piece in enumerate(pieces):
            between = np.linalg.norm(ends[:, None] - self.first_and_last(number), axis=2)
            if between.min(initial=np.inf) < END_REACH * unit_length:
                pieces[number] = with_ends(piece, self.points, closed=False)
        return TreeReference(self.points, tuple(pieces))


def tree_reference(cloud: PointCloud) -> TreeReference:
    """Makes a reference of the spanning tree of a cloud."""
    return TreeReference(cloud.points, trace_pieces(cloud.points))
