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


def plane_grid(box: Box, size: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns the coordinates of a grid over a planar box, and its points.

    Args:
        box: The planar box, whose borders the grid includes.
        size: Points along each axis.

    Returns:
        x and y, (size,) each; the points (size^2, 2), y by y.
    """
    x, y = (np.linspace(lower, upper, size) for lower, upper in zip(*box, strict=True))
    return x, y, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
