"""Which way along the path: an orientation hint at every waypoint.

The three losses of the paper leave the sign of the tangent free, point by point; a network
then often learns a branch of which one half runs one way and one half the other, with a
source and a sink between.  The hint settles the sign from the spanning tree of the cloud.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.fields import FloatArray
from sgvf_drake.paths import TracedPiece

# Neighbours count within this many kernel widths, in space and along the tree.  Along the
# tree, so that a neighbouring strand that runs the other way has no say; more than in
# space, since the tree zigzags through noise and runs around a corner.
SPACE_REACH = 3.0
TREE_REACH = 6.0
# Waypoints of the chain whose directions are averaged at each waypoint.
AVERAGED = 16


def orientation_hint(
    points: FloatArray, pieces: Sequence[TracedPiece], width: float
) -> FloatArray:
    """Returns a unit tangent T_i at every waypoint, in the direction of the traced pieces.

    T_i is the kernel average of the chords to its neighbours, each chord turned to point
    forward along the tree.

    Args:
        points: The waypoints, (N, d).
        pieces: Their spanning tree, traced.
        width: Standard deviation of the Gaussian kernel, in the unit of the points.

    Returns:
        (N, d); zero where a waypoint has no neighbour to take a direction from.
    """
    hint = np.zeros_like(points)
    for piece in pieces:
        hint[piece.indices] = _piece_hint(points, piece, width)
    return _unit(hint)


def _piece_hint(points: FloatArray, piece: TracedPiece, width: float) -> FloatArray:
    """Returns the hint at every waypoint of a piece, (M, d), not normalised."""
    row = np.full(len(points), -1)
    row[piece.indices] = np.arange(len(piece.indices))
    main = row[piece.order]
    width = max(width, piece.length / len(main))
    chain = points[piece.order]
    hint = _chain_hint(chain, piece.arc[main], piece, width)
    # Waypoints beside the chain, on short branches of the tree, take the mean direction of
    # the chain around them: at an acute tip, where the tree cuts across and leaves the very
    # tip as such a branch, that is the direction in which the path turns.
    distances, nearest = cKDTree(chain).query(
        points[piece.indices], k=list(range(1, min(AVERAGED, len(chain)) + 1))
    )
    exponents = -0.5 * (distances**2 - distances[:, :1] ** 2) / width**2
    return np.einsum("mk,mkd->md", np.exp(exponents), _unit(hint)[nearest])


def _chain_hint(
    chain: FloatArray, arc: FloatArray, piece: TracedPiece, width: float
) -> FloatArray:
    tail, head = cKDTree(chain).query_pairs(SPACE_REACH * width, output_type="ndarray").T
    forward = arc[head] - arc[tail]
    if piece.closed:
        forward -= piece.length * np.round(forward / piece.length)
    near = np.abs(forward) <= TREE_REACH * width
    tail, head, forward = tail[near], head[near], forward[near]
    chords = chain[head] - chain[tail]
    weights = np.exp(-0.5 * (chords**2).sum(axis=1) / width**2) * np.sign(forward)
    hint = np.zeros_like(chain)
    # A chord looks forward from either of its ends: seen from the head both its sign and
    # its direction turn around.
    np.add.at(hint, tail, weights[:, None] * chords)
    np.add.at(hint, head, weights[:, None] * chords)
    return hint


def _unit(vectors: FloatArray) -> FloatArray:
    norm = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, norm, out=np.zeros_like(vectors), where=norm > 0)
