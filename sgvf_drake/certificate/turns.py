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
        boxes: Squares of a dyadic grid in the square, without overlap.
        directions: (n, 2) u of each, NaN where none is known.
        half: Half-side of the square.

    Returns:
        The number, counter-clockwise; None: it is not proved, or they do not cover the border.
    """
    sides = _sides(boxes, half)
    if any(boxes.half[side].sum() != half for side in sides):
        return None
    u = directions[np.concatenate(sides)]
    w = np.roll(u, -1, axis=0)
    turns = np.arctan2(u[:, 0] * w[:, 1] - u[:, 1] * w[:, 0], (u * w).sum(axis=1))
    # NaN is not either.
    if not (np.abs(turns) <= LARGEST_TURN).all():
        return None
    return round(float(turns.sum()) / (2 * np.pi))


def at_border(boxes: Boxes, half: float) -> BoolArray:
    """Tells which squares (n,) of a dyadic grid have a side on the border of a square."""
    return np.asarray(np.abs(boxes.centers).max(axis=1) + boxes.half == half)


def _sides(boxes: Boxes, half: float) -> list[IntArray]:
    """Returns the squares along each side, counter-clockwise; those in corners are on two."""
    x, y = boxes.centers.T
    sides = []
    for outward, forward in ((-y, x), (x, y), (y, -x), (-x, -y)):
        side = np.flatnonzero(outward + boxes.half == half)
        sides.append(side[np.argsort(forward[side])])
    return sides
