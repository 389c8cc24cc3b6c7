"""What is known of a planar field over a cell: a linear model and its remainder.

Here the remainder is estimated, from the field on the rim of the cell.  With a bound in its
place, the tests below would be proofs.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.lyapunov.cells import RIM, Cells

# The remainder, and the change of the Jacobian, over a cell are taken to be so many times
# the largest on its rim.  A straight front, however steep, cuts a corner off any cell that it
# crosses; so what is not seen on the rim is small and round.
SAFETY = 2.0
# Points at which a field is evaluated at once, to bound the memory.
CHUNK = 8_192


class PlanarMap(Protocol):
    """What is asked of a field here; every planar `Field` is one."""

    def __call__(self, x: FloatArray) -> FloatArray:
        """Returns the value: (n, 2) -> (n, 2)."""

    def value_and_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the value (n, 2), and the Jacobian (n, 2, 2)."""


@dataclass(frozen=True, eq=False)
class InChunks:
    """A field that is evaluated at `CHUNK` points at a time.

    Attributes:
        field: The field.
    """

    field: PlanarMap

    def __call__(self, x: FloatArray) -> FloatArray:
        """Returns the value: (n, 2) -> (n, 2)."""
        return np.concatenate([self.field(x[rows]) for rows in _chunks(len(x))])

    def value_and_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the value (n, 2), and the Jacobian (n, 2, 2)."""
        parts = [self.field.value_and_jacobian(x[rows]) for rows in _chunks(len(x))]
        values, jacobians = zip(*parts, strict=True)
        return np.concatenate(values), np.concatenate(jacobians)


@dataclass(frozen=True, eq=False)
class CellModel:
    """A field over n cells: m(c + d) = value + jacobian d + remainder.

    Attributes:
        half: Half-side of the cells.
        value: (n, 2) at their centres c.
        jacobian: (n, 2, 2) there.
        remainders: (n, 8, 2) on their rims.
    """

    half: float
    value: FloatArray
    jacobian: FloatArray
    remainders: FloatArray

    @classmethod
    def over(cls, field: PlanarMap, cells: Cells) -> "CellModel":
        """Returns the model of a field over cells."""
        value, jacobian = field.value_and_jacobian(cells.centers)
        points, which = cells.rim()
        linear = cells.half * (jacobian @ RIM.T).swapaxes(1, 2)
        remainders = field(points)[which] - value[:, None] - linear
        return cls(cells.half, value, jacobian, remainders)

    def vanishes_nowhere(self) -> BoolArray:
        """Whether each cell holds no zero, (n,).

        In some direction, the value is more than the linear part and the remainder undo.
        The singular vectors of the Jacobian serve along a valley of |m|, which one of them
        crosses; the rows of its inverse, here without their lengths, are those of Newton's
        method.
        """
        J = self.jacobian
        directions = np.concatenate([self._svd[0], adjugate(J)], axis=1)
        value = np.abs(directions @ self.value[:, :, None])[:, :, 0]
        linear = self.half * np.abs(directions @ J).sum(axis=2)
        rest = np.abs(directions @ self.remainders.swapaxes(1, 2)).max(axis=2)
        return np.asarray((value > linear + SAFETY * rest).any(axis=1))

    def is_nearly_linear(self) -> BoolArray:
        """Whether the remainder is not far above the linear part in either direction, (n,).

        Where it is, `is_one_to_one` need not be asked, which costs more.
        """
        directions, singular = self._svd
        rest = np.abs(directions @ self.remainders.swapaxes(1, 2)).max(axis=2)
        return np.asarray((rest < SAFETY * self.half * singular).all(axis=1))

    @cached_property
    def _svd(self) -> tuple[FloatArray, FloatArray]:
        """The left singular vectors of the Jacobians, in rows (n, 2, 2); the values (n, 2)."""
        U, singular, _ = np.linalg.svd(self.jacobian)
        return U.swapaxes(1, 2), singular


def is_one_to_one(field: PlanarMap, centers: FloatArray, half: float) -> BoolArray:
    """Whether a field takes no value twice in squares of half-side `half`, (n,).

    Two points of one value would make the mean of the Jacobian between them singular.  It
    differs from that at the centre by a matrix whose entries, in the frame of the singular
    vectors, are at most `change`.
    """
    points = centers[:, None, :] + half * np.concatenate([[[0, 0]], RIM])
    J = field.value_and_jacobian(points.reshape(-1, 2))[1].reshape(*points.shape, 2)
    U, singular, Vt = np.linalg.svd(J[:, 0])
    left, right = U.swapaxes(1, 2)[:, None], Vt.swapaxes(1, 2)[:, None]
    change = SAFETY * np.abs(left @ (J[:, 1:] - J[:, :1]) @ right).max(axis=1)
    first, second = singular[:, 0] - change[:, 0, 0], singular[:, 1] - change[:, 1, 1]
    return (second > 0) & (first > 0) & (first * second > change[:, 0, 1] * change[:, 1, 0])


def adjugate(J: FloatArray) -> FloatArray:
    """Returns the inverses of matrices times their determinants, (n, 2, 2)."""
    (a, b), (c, d) = J[:, 0].T, J[:, 1].T
    return np.stack([np.stack([d, -b], axis=1), np.stack([-c, a], axis=1)], axis=1)


def _chunks(count: int) -> list[slice]:
    # One chunk at least, if an empty one.
    return [slice(start, start + CHUNK) for start in range(0, max(count, 1), CHUNK)]
