"""The shape of a path as its score sees it: tangents and curvature after a blur, branches."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from sgvf_drake.arrays import FloatArray
from sgvf_drake.paths import (
    Piece,
    PointCloud,
    Reference,
    ReferencePath,
    TreeReference,
    trace_pieces,
)

# Distance of neighbouring samples, and standard deviation of the blur along the path, in noise
# levels: a corner is as sharp as its density, and the jags of a tree are smoothed out.
SAMPLE_SPACING = 0.5
BLUR = 2.0
# Where the blur is cut off, in its standard deviations; nearer, its derivatives are biased.
REACH = 8.0
# A piece has at least this many samples, however short it is.
FEWEST_SAMPLES = 8
# A path whose radius is more than a thousand noise levels is straight.
STRAIGHT = 1e-3
# A branch of the tree is longer than this many noise levels; shorter ones are noise.
BRANCH_LENGTH = 6.0


@dataclass(frozen=True, eq=False)
class PathShape:
    """A planar path at n places, evenly spaced along each piece.

    Attributes:
        points: (n, 2) the places.
        tangents: (n, 2) unit vectors along the blurred path.
        curvature: (n,) of the blurred path, not negative, per unit of length; zero where it
            is straight.
        branches: (B, 2) the waypoints at which the path branches.
    """

    points: FloatArray
    tangents: FloatArray
    curvature: FloatArray
    branches: FloatArray


def path_shape(reference: Reference, cloud: PointCloud, sigma: float) -> PathShape:
    """Measures a path.

    Args:
        reference: The path; of a tree, its longest path without the branches.
        cloud: The waypoints, of whose tree the branches are taken.
        sigma: The noise level, in the same unit.
    """
    samples = [_sample(piece, sigma) for piece in _polylines(reference)]
    points, tangents, curvature = (np.concatenate(part) for part in zip(*samples, strict=True))
    return PathShape(points, tangents, curvature, _branches(cloud.points, sigma))


def _polylines(reference: Reference) -> Sequence[Piece]:
    if isinstance(reference, ReferencePath):
        return reference.pieces
    assert isinstance(reference, TreeReference), type(reference)
    # An isolated waypoint is no line.
    return [
        Piece(reference.points[piece.order], piece.closed)
        for piece in reference.pieces
        if len(piece.order) > 1
    ]


def _sample(piece: Piece, sigma: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns places (n, 2), tangents (n, 2) and curvature (n,) of one piece."""
    points = piece.sample(max(FEWEST_SAMPLES, round(piece.length / (SAMPLE_SPACING * sigma))))
    blur, mode = BLUR / SAMPLE_SPACING, "wrap" if piece.closed else "nearest"
    # The derivatives of the blurred path, in noise levels for each sample.
    along, bend = (
        gaussian_filter1d(points / sigma, blur, axis=0, order=order, mode=mode, truncate=REACH)
        for order in (1, 2)
    )
    # A path that turns back on itself has no direction there.
    speed = np.maximum(np.linalg.norm(along, axis=1), np.finfo(np.float64).eps)
    cross = along[:, 0] * bend[:, 1] - along[:, 1] * bend[:, 0]
    bending = np.abs(cross) / speed**3
    bending[bending < STRAIGHT] = 0.0
    return points, along / speed[:, None], bending / sigma


def _branches(points: FloatArray, sigma: float) -> FloatArray:
    """Returns the waypoints at which long side branches leave the longest paths, (B, 2)."""
    found = [np.empty(0, np.intp)]
    for piece in trace_pieces(points):
        first, second = piece.edges.T
        lengths = np.linalg.norm(points[first] - points[second], axis=1)
        # A sparse graph holds no edges of length zero, as between copies of a waypoint.
        some = lengths > 0
        graph = coo_array(
            (lengths[some], (first[some], second[some])), shape=(len(points), len(points))
        )
        aside, _, source = dijkstra(
            graph.tocsr(),
            directed=False,
            indices=piece.order,
            min_only=True,
            return_predecessors=True,
        )
        far = np.isfinite(aside) & (aside > BRANCH_LENGTH * sigma)
        found.append(np.unique(source[far]))
    return points[np.concatenate(found)]
