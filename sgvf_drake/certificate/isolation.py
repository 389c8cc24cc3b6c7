"""Zeros of d functions over cubes of R^d, shown to be none or one (Krawczyk's method).

With a matrix A near the inverse of the Jacobian J, and lengths by the largest entry, z - A m(z)
shrinks distances where |I - A J| <= k < 1 all over a cube.  Then m is one to one on it, det J
has one sign, and a part of it that reaches |A m(x)| / (1 - k) from x to all sides holds a zero.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.kernels import SLACK, TINY
from sgvf_drake.certificate.patches import Patches
from sgvf_drake.certificate.taylor_model import DualModel, TaylorModel
from sgvf_drake.matrices import adjugate, determinant, size_of_determinant

# Newton's method doubles the digits in every step: enough for all of them.
NEWTON_STEPS = 6
# A zero is looked for in a square larger by this factor, so that one on a side between two
# squares is well inside of both.
ENLARGED = 1.25
# The half-side of an enclosure, in those that it has to have, for the rounding of that.
WIDER = 2.0


class BoundedMap(Protocol):
    """As many functions as the space has dimensions, that can be bounded."""

    def model(self, patches: Patches) -> TaylorModel:
        """Returns their models, (n, d)."""

    def dual(self, patches: Patches) -> DualModel:
        """Returns their models and those of their derivatives."""


@dataclass(frozen=True, eq=False)
class Isolated:
    """What is known of zeros near n squares.

    Attributes:
        is_one: (n,) whether the enlarged square holds one zero and no other; all that follows
            is said of those.
        points: (n, d) the centre of a small square that holds it.
        radius: (n,) the half-side of that.
        index: (n,) the index of the zero: the sign of det J.
    """

    is_one: BoolArray
    points: FloatArray
    radius: FloatArray
    index: IntArray


def directions_of(m: TaylorModel) -> FloatArray:
    """Returns directions u (n, d) with m . u > 0 all over each square; NaN: none is found.

    That of m at the centre is tried, then the rows of the inverse Jacobian: where m is steep
    across a line and flat along it, they point along the flat part.
    """
    # By the parameters, so in the half-side of the square.
    found = np.full_like(m.value, np.nan)
    for u in (m.value, *_rows(_inverse(m.slopes))):
        along = m.weighted(u)
        side = np.where(along.lower > 0, 1.0, np.where(along.upper < 0, -1.0, np.nan))
        found = np.where(np.isnan(found), side * u, found)
    return found


def may_be_isolated(m: TaylorModel) -> BoolArray:
    """Tells, by models over squares, on which (n,) it is worth while to `isolate`."""
    A = _inverse(m.slopes)
    step = np.abs(A @ m.value[:, :, None]).max(axis=(1, 2))
    change = 2 * np.abs(m.quadratic).sum(axis=1)
    bend = (np.abs(A) @ change[:, :, None]).max(axis=(1, 2))
    # In half-sides of the square, as the parameters are.
    return (step < 2) & (bend < 1)


def isolate(function: BoundedMap, boxes: Boxes, margin: float) -> Isolated:
    """Looks for a zero that is the only one in each square, enlarged by `ENLARGED`.

    The square itself then holds that zero or none.

    Args:
        function: The functions.
        boxes: The squares.
        margin: An enclosure reaches farther by this than it has to.
    """
    half = ENLARGED * boxes.half
    points = _newton(function, boxes.centers)
    here = function.dual(Patches.points(points))
    A = _inverse(_jacobian(here))
    step = np.max([_largest(here.value.weighted(row)) for row in _rows(A)], axis=0)
    k = _contraction(function.dual(Boxes(boxes.centers, half).patches), A)
    radius = WIDER * step / (1 - k) + margin
    reach = np.abs(points - boxes.centers).max(axis=1) + radius
    index = _sign_of_determinant(A)
    is_one = (k < 1) & ((1 + SLACK) * reach < half) & (index != 0)
    return Isolated(is_one, points, radius, index)


def _newton(function: BoundedMap, points: FloatArray) -> FloatArray:
    """Returns where Newton's method leads from points (n, d); not finite: nowhere."""
    for _ in range(NEWTON_STEPS):
        m = function.dual(Patches.points(points))
        points = points - (_inverse(_jacobian(m)) @ m.value.value[:, :, None])[:, :, 0]
    return points


def _contraction(m: DualModel, A: FloatArray) -> FloatArray:
    """Returns a bound (n,) of |I - A J| over squares: the largest row sum."""
    sums = []
    for i, row in enumerate(_rows(A)):
        entries = [slope.weighted(row) for slope in m.slopes]
        entries[i] = entries[i].shifted(-1.0)
        sums.append(np.sum([_largest(entry) for entry in entries], axis=0))
    return np.asarray((1 + SLACK) * np.max(sums, axis=0))


def _largest(m: TaylorModel) -> FloatArray:
    """Returns bounds (n,) of the absolute value of one function."""
    return np.maximum(np.abs(m.lower), np.abs(m.upper))[:, 0]


def _rows(A: FloatArray) -> FloatArray:
    """Returns the rows of matrices (n, d, d), (d, n, d)."""
    return np.moveaxis(A, 1, 0)


def _jacobian(m: DualModel) -> FloatArray:
    """Returns the derivatives (n, d, d) at the centres, a row for each coordinate."""
    return np.stack([slope.value for slope in m.slopes], axis=1)


def _inverse(jacobian: FloatArray) -> FloatArray:
    """Returns the inverses (n, d, d), but for rounding, of derivatives.

    Their rows are those of the coordinates; entries that are not finite: there is none.
    """
    J = jacobian.swapaxes(1, 2)
    return np.asarray(adjugate(J) / determinant(J)[:, None, None])


def _sign_of_determinant(A: FloatArray) -> IntArray:
    """Returns the signs (n,) of the determinants; 0: rounding leaves it open."""
    found, error = determinant(A), SLACK * size_of_determinant(A) + TINY
    return np.where(np.abs(found) > error, np.sign(found), 0).astype(np.intp)
