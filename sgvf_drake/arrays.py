"""Names for the types of arrays, whose shapes stand in the docstrings; and grids of points."""

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
"""An array of float64, of a shape that the docstring tells."""

IntArray = NDArray[np.intp]
"""An array of indices."""

BoolArray = NDArray[np.bool_]
"""An array of truth values."""

Box = tuple[FloatArray, FloatArray]
"""The lower and the upper corner of a box, (d,) each."""


def box_grid(box: Box, size: int) -> tuple[tuple[FloatArray, ...], FloatArray]:
    """Returns the coordinates of a grid over a box, and its points.

    Args:
        box: The box, whose borders the grid includes.
        size: Points along each axis.

    Returns:
        x, y and so on, (size,) each; the points (size^d, d), those of one y after another.
    """
    axes = tuple(np.linspace(lower, upper, size) for lower, upper in zip(*box, strict=True))
    coordinates = np.meshgrid(*axes[::-1], indexing="ij")[::-1]
    return axes, np.stack(coordinates, axis=-1).reshape(-1, len(axes))


def plane_grid(box: Box, size: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns x and y of a grid over a planar box, and its points (size^2, 2): `box_grid`."""
    (x, y), points = box_grid(box, size)
    return x, y, points
