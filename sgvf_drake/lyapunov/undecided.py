"""Where a search for zeros cannot decide: degenerate zeros, and lines of them.

Whatever is there has an index, as long as the field does not vanish around it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.lyapunov.cell_model import PlanarMap
from sgvf_drake.lyapunov.cells import Cells
from sgvf_drake.lyapunov.winding import cut, turning

# Along the bottom of a valley |m| is less than this part of what it rises to across half a
# cell: no zeros there can be told apart, neither by a search nor by a robot.
FLATNESS = 1e-5
# Steps across a valley to its bottom, with the slope at the centre of the cell throughout.
VALLEY_STEPS = 12
# Places along the bottom that are looked at, in half-sides from the middle; not a whole side
# apart, which might be the distance between the zeros.
VALLEY_PLACES = (-0.7, 0.0, 0.7)
# Parts of a cell's side in which the field is followed around a cluster.
BORDER_PARTS = 4
# |m| is zero where it can be made less than this part of what it is nearby.
VANISHING = 1e-6


@dataclass(frozen=True, eq=False)
class Cluster:
    """Neighbouring cells that remained undecided.

    Attributes:
        point: (2,) where |m| is smallest.
        index: The sum of the Poincare indices of all its zeros.
        vanishes: Whether there is a zero beside those that were told apart: the index is not
            zero, or |m| can be made zero to rounding where none of them is.
    """

    point: FloatArray
    index: int
    vanishes: bool


def cluster_of(
    field: PlanarMap, cells: Cells, points: FloatArray, indices: IntArray
) -> Cluster:
    """Examines a cluster of undecided cells.

    Args:
        field: The field.
        cells: The cells.
        points: (k, 2) the zeros that were told apart,
        indices: (k,) and their indices; those of zeros beside the cells are subtracted.

    Raises:
        ConfigurationError: The field vanishes on the border around the cells.
    """
    around = cells.grown()
    known = around.contains(points)
    turns = turning(field, *cut(*around.border(), cells.side / BORDER_PARTS)) / (2 * np.pi)
    index = round(turns) - int(indices[known].sum())
    values = np.linalg.norm(field(cells.centers), axis=1)
    start, size = cells.centers[values.argmin()], float(values.max())

    def scaled(u: FloatArray) -> FloatArray:
        return field((start + cells.side * u)[None])[0] / size

    def slope(u: FloatArray) -> FloatArray:
        jacobian = field.value_and_jacobian((start + cells.side * u)[None])[1]
        return jacobian[0] * cells.side / size

    least = least_squares(scaled, np.zeros(2), slope, xtol=1e-15, ftol=1e-15, gtol=1e-15)
    near = np.abs(least.x).max() <= 2
    point = start + cells.side * least.x if near else start
    zero = bool(near and np.linalg.norm(least.fun) < VANISHING)
    return Cluster(point, index, index != 0 or (zero and not known.any()))


def flat_cells(field: PlanarMap, cells: Cells) -> BoolArray:
    """Whether each cell is crossed by a valley of |m| whose bottom is flat to `FLATNESS`, (n,).

    In the steepest direction a field passes through zero; along the line where it does so,
    only the component across that direction is left.
    """
    flat = np.zeros(len(cells), bool)
    U, singular, Vt = np.linalg.svd(field.value_and_jacobian(cells.centers)[1])
    sloped = np.flatnonzero(singular[:, 0] > 0)
    steepest, uphill, along = U[sloped, :, 0], Vt[sloped, 0], Vt[sloped, 1]
    slope, center = singular[sloped, 0], cells.centers[sloped]
    flat[sloped] = True
    for place in VALLEY_PLACES:
        x = center + place * cells.half * along
        for _ in range(VALLEY_STEPS):
            height = (steepest * field(x)).sum(axis=1) / slope
            # Where the slope at the centre says nothing of that here, not out of sight.
            x = x - np.clip(height, -cells.side, cells.side)[:, None] * uphill
        bottom = np.linalg.norm(field(x), axis=1)
        near = np.linalg.norm(x - center, axis=1) <= cells.side
        flat[sloped] &= near & (bottom <= FLATNESS * slope * cells.half)
    return flat
