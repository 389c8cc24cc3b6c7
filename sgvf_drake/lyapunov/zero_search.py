"""All zeros of a field in a box: by subdivision, each refined by Newton's method.

Every cell of a quadtree, or an octree, ends in one of four ways: the field does not vanish in
it; it holds exactly one zero, which is found; it is divided; or it is left at the smallest size
as undecided, as where zeros are degenerate or form a line.  In the plane, what is left has an
index, as long as the field does not vanish around it.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import Field
from sgvf_drake.lyapunov.cells import (
    CellModel,
    Cells,
    InChunks,
    SmoothMap,
    changes_little,
    chunks,
    is_one_to_one,
)
from sgvf_drake.lyapunov.function import distinct
from sgvf_drake.lyapunov.winding import cut, turning
from sgvf_drake.matrices import adjugate

# Side of the first cells, in scales of the field.
FIRST_CELL = 1.0
# The scale where none is given, and the side of the smallest cells, in sides of the box.
DEFAULT_SCALE = 1 / 64
SMALLEST_CELL = 2.0**-30
# Where the box is small and far from the origin, cells are at least so many times the distance
# between neighbouring numbers.
SPACINGS = 1_000
# In space, where first cells of that side were more than this, they are larger.
FIRST_CELLS = 250_000
# A search that would need more cells than this leaves what remains undecided; in space it is
# four times as many.
MOST_CELLS = 300_000
# Cells that are looked at together, to bound the memory.
BATCH = 50_000
# A zero is looked for in a cell enlarged by this factor, so that one on the border between
# two cells is found from both.
ENLARGED = 1.25
# Newton's method doubles the digits in every step; these are enough for all of them.
NEWTON_STEPS = 8
# The last step is shorter than this part of the cell's half-side; the next would not show.
NEWTON_TOLERANCE = 1e-6
# A zero this far outside of the box, in its sides, is on its border.
ROUNDING = 1e-12
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
class ZeroSearch:
    """What `find_zeros` found.

    Attributes:
        points: (k, d) the zeros.
        indices: (k,) their Poincare indices; 0 for a cluster in space, where none is told.
        degenerate: (k,) whether each stands for a cluster of cells that remained undecided.
        undecided: Number of those clusters, whether or not they hold a zero.
        cells: Number of cells over which the field was evaluated.
    """

    points: FloatArray
    indices: IntArray
    degenerate: BoolArray
    undecided: int
    cells: int


def find_zeros(
    field: Field, box: tuple[FloatArray, FloatArray], scale: float | None = None
) -> ZeroSearch:
    """Finds all zeros of a field in a box, its border included.

    All of them, as far as the rims of cells tell what is in them; see `CellModel`.

    Args:
        field: The field, differentiable where it vanishes.
        box: Lower and upper corner, (d,) each.
        scale: The length over which the field changes, in the unit of the box; None: a 64th
            of the box.

    Raises:
        ConfigurationError: The box is not of the field's dimension, or a planar field vanishes
            along a line that reaches the border of the box, so that its zeros have no index.
    """
    lower, upper = (np.asarray(corner, dtype=np.float64) for corner in box)
    dim, size = field.dim, float((upper - lower).max())
    if lower.shape != (dim,) or upper.shape != (dim,):
        raise ConfigurationError(f"zeros of a field in {dim}-D are found in boxes of {dim}-D")
    side = FIRST_CELL * (DEFAULT_SCALE * size if scale is None else scale)
    fewest = float((upper - lower).prod() / FIRST_CELLS) ** (1 / dim)
    first = Cells.covering((lower, upper), side if dim == 2 else max(side, fewest))
    values = InChunks(field)
    finest = SPACINGS * float(np.spacing(np.abs([lower, upper]).max()))
    points, undecided, count = _search(values, first, max(SMALLEST_CELL * size, finest))
    indices = np.sign(np.linalg.det(values.value_and_jacobian(points)[1])).astype(np.intp)
    found = [_zero_of_cluster(values, cells, points, indices) for cells in undecided]
    held = [zero for zero in found if zero is not None]
    points = np.concatenate([points, *(point[None] for point, _ in held)])
    indices = np.append(indices, [index for _, index in held]).astype(np.intp)
    degenerate = np.arange(len(points)) >= len(points) - len(held)
    # The last bits of a zero on the border may lie beyond it.
    slack = ROUNDING * size
    inside = ((points >= lower - slack) & (points <= upper + slack)).all(axis=1)
    return ZeroSearch(points[inside], indices[inside], degenerate[inside], len(found), count)


def _search(
    field: SmoothMap, cells: Cells, smallest: float
) -> tuple[FloatArray, list[Cells], int]:
    """Returns the simple zeros (k, d), clusters of undecided cells, and the number of cells."""
    count, parts = len(cells), 2**cells.dim
    found = [np.empty((0, cells.dim))]
    cells, smooth = _left_over(field, cells)
    flat = _flat_cells(field, cells)
    # What is beside them counts as part of them: there, the field does not vanish.
    beside = cells[flat].grown().contains(cells.centers)
    lines, cells, smooth = cells[flat], cells[~beside], smooth[~beside]
    while len(cells):
        zeros, decided = _single_zeros(field, cells, smooth)
        found.append(zeros)
        cells = cells[~decided]
        if cells.half < smallest or count + parts * len(cells) > MOST_CELLS * parts**2 // 16:
            break
        cells = cells.quartered()
        count += len(cells)
        cells, smooth = _left_over(field, cells)
    points = distinct(np.concatenate(found), smallest)
    return points, [*lines.clusters(), *cells.clusters()], count


def _left_over(field: SmoothMap, cells: Cells) -> tuple[Cells, BoolArray]:
    """Returns the cells in which a field may vanish, and where it is nearly linear in them."""
    open_cells = [~changes_little(field, cells[rows]) for rows in chunks(len(cells), BATCH)]
    cells = cells[np.concatenate(open_cells)]
    left, smooth = [], []
    for rows in chunks(len(cells), BATCH):
        model = CellModel.over(field, cells[rows])
        left.append(~model.vanishes_nowhere())
        smooth.append(model.is_nearly_linear())
    kept = np.concatenate(left)
    return cells[kept], np.concatenate(smooth)[kept]


def _single_zeros(
    field: SmoothMap, cells: Cells, smooth: BoolArray
) -> tuple[FloatArray, BoolArray]:
    """Returns zeros (k, d) of the smooth cells, and which cells have one and no other, (n,)."""
    half = ENLARGED * cells.half
    decided = np.zeros(len(cells), bool)
    candidates = np.flatnonzero(smooth)
    candidates = candidates[is_one_to_one(field, cells.centers[candidates], half)]
    zeros, converged = _newton(field, cells.centers[candidates], half)
    decided[candidates[converged]] = True
    return zeros[converged], decided


def _newton(field: SmoothMap, centers: FloatArray, half: float) -> tuple[FloatArray, BoolArray]:
    """Returns where Newton's method leads from the centres, and whether to a zero nearby."""
    x = centers.copy()
    inside = np.ones(len(x), bool)
    last = np.full(len(x), np.inf)
    for _ in range(NEWTON_STEPS):
        value, J = field.value_and_jacobian(x[inside])
        determinant = np.linalg.det(J)
        # Where the Jacobian is singular, there is no step to a zero.
        determinant[determinant == 0] = np.inf
        step = (adjugate(J) @ value[:, :, None])[:, :, 0] / determinant[:, None]
        x[inside] -= step
        last[inside] = np.where(np.isinf(determinant), np.inf, np.abs(step).max(axis=1))
        inside = np.abs(x - centers).max(axis=1) <= half
    return x, inside & (last <= NEWTON_TOLERANCE * half)


def _zero_of_cluster(
    field: SmoothMap, cells: Cells, points: FloatArray, indices: IntArray
) -> tuple[FloatArray, int] | None:
    """Returns where |m| is smallest in a cluster of undecided cells, and the index of it all.

    None where nothing tells of a zero beside those that were told apart: the index is zero,
    and |m| cannot be made zero to rounding, or one of those is there.  They are `points` (k, d)
    with `indices` (k,), which are subtracted where they are beside the cells.  In space no
    index is told: it is zero.

    Raises:
        ConfigurationError: The field vanishes on the border around the cells.
    """
    around = cells.grown()
    known = around.contains(points)
    index = 0
    if cells.dim == 2:
        turns = turning(field, *cut(*around.border(), cells.side / BORDER_PARTS)) / (2 * np.pi)
        index = round(turns) - int(indices[known].sum())
    values = np.linalg.norm(field(cells.centers), axis=1)
    start, size = cells.centers[values.argmin()], float(values.max())

    def scaled(u: FloatArray) -> FloatArray:
        return field((start + cells.side * u)[None])[0] / size

    def slope(u: FloatArray) -> FloatArray:
        jacobian = field.value_and_jacobian((start + cells.side * u)[None])[1]
        return jacobian[0] * cells.side / size

    least = least_squares(
        scaled, np.zeros(cells.dim), slope, xtol=1e-15, ftol=1e-15, gtol=1e-15
    )
    near = np.abs(least.x).max() <= 2
    point = start + cells.side * least.x if near else start
    zero = bool(near and np.linalg.norm(least.fun) < VANISHING)
    return (point, index) if index != 0 or (zero and not known.any()) else None


def _flat_cells(field: SmoothMap, cells: Cells) -> BoolArray:
    """Whether each cell is crossed by a valley of |m| whose bottom is flat to `FLATNESS`, (n,).

    In the steepest directions a field passes through zero; along the line where it does so,
    only the component across them is left.  In space it may be left in a surface: a direction
    that is as flat as the bottom is none of the steep ones.
    """
    flat = np.zeros(len(cells), bool)
    U, singular, Vt = np.linalg.svd(field.value_and_jacobian(cells.centers)[1])
    sloped = np.flatnonzero(singular[:, 0] > 0)
    steepest, uphill, along = U[sloped, :, :-1], Vt[sloped, :-1], Vt[sloped, -1]
    slopes, center = singular[sloped, :-1], cells.centers[sloped]
    slopes[slopes <= FLATNESS * slopes[:, :1]] = np.inf
    flat[sloped] = True
    for place in VALLEY_PLACES:
        x = center + place * cells.half * along
        for _ in range(VALLEY_STEPS):
            height = (steepest * field(x)[:, :, None]).sum(axis=1) / slopes
            # Where the slope at the centre says nothing of that here, not out of sight.
            step = np.clip(height, -cells.side, cells.side)[:, :, None] * uphill
            x = x - step.sum(axis=1)
        bottom = np.linalg.norm(field(x), axis=1)
        near = np.linalg.norm(x - center, axis=1) <= cells.side
        flat[sloped] &= near & (bottom <= FLATNESS * slopes[:, 0] * cells.half)
    return flat
