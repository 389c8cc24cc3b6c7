"""How often a function turns along the border of a square, from where it points on squares."""

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.boxes import Boxes

# Of neighbouring directions that are farther apart, in radians, rounding might tell wrongly on
# which side of each other they are.
LARGEST_TURN = 3.0


def proved_winding_number(boxes: Boxes, directions: FloatArray, half: float) -> int | None:
    """Returns how often m turns along the border of a square around the origin.

    Where m . u > 0 on a square and m . w > 0 on the next one, m at their common point is less
    than a quarter turn away from both.  So from one such point to the next m turns by what u,
    w, ... turn by, each the short way around, but for its angles to the first and the last;
    and around the border these are the same.

    Args:
        boxes: Squares without overlap that cover the square.
        directions: (n, 2) u of each, NaN where none is known.
        half: Half-side of the square.

    Returns:
        The number, counter-clockwise; None: it is not proved.
    """
    u = directions[_along_border(boxes, half)]
    w = np.roll(u, -1, axis=0)
    turns = np.arctan2(u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0], (u * w).sum(axis=1))
    # NaN is not either.
    if not (np.abs(turns) <= LARGEST_TURN).all():
        return None
    return round(float(turns.sum()) / (2 * np.pi))


def at_border(boxes: Boxes, half: float) -> BoolArray:
    """Tells which squares (n,) of a dyadic grid have a side on the border of a square."""
    return np.asarray(np.abs(boxes.centers).max(axis=1) + boxes.half == half)


def _along_border(boxes: Boxes, half: float) -> IntArray:
    """Returns the squares there, counter-clockwise; those in the corners come twice."""
    x, y = boxes.centers.T
    order = []
    for outward, forward in ((-y, x), (x, y), (y, -x), (-x, -y)):
        side = np.flatnonzero(outward + boxes.half == half)
        order.append(side[np.argsort(forward[side])])
    return np.concatenate(order)
