"""A traced piece, travelled the other way, closed or opened."""

from dataclasses import replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.paths.polyline import signed_area
from sgvf_drake.paths.spanning_tree import TracedPiece


def reverse(piece: TracedPiece) -> TracedPiece:
    """Returns the piece, travelled the other way."""
    return replace(piece, arc=piece.arc.max() - piece.arc, order=piece.order[::-1])


def with_ends(piece: TracedPiece, points: FloatArray, closed: bool) -> TracedPiece:
    """Returns the piece as a closed or an open one, whatever its tree looks like.

    A piece that is opened breaks where its tree did, at the widest gap of the loop.
    """
    if piece.closed == closed:
        return piece
    ends = points[piece.order[[0, -1]]]
    gap = float(np.linalg.norm(ends[1] - ends[0]))
    if closed:
        closing = replace(piece, closed=True, length=piece.length + gap)
        return (
            closing
            if len(piece.order) > 2 and signed_area(points[closing.order]) >= 0
            else reverse(closing)
        )
    opened = replace(piece, closed=False, length=piece.length - gap)
    return reverse(opened) if tuple(ends[1]) < tuple(ends[0]) else opened
