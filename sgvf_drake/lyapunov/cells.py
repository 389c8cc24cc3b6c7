"""Square cells of the plane, and what is known of a planar field over each of them.

That is a linear model and its remainder, which is estimated from the field on the rim of the
cell.  With a bound in its place, the tests below would be proofs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray

CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
"""Offsets of a cell's corners from its lower left one, in sides, counter-clockwise."""

RIM = np.array([[-1, -1], [0, -1], [1, -1], [1, 0], [1, 1], [0, 1], [-1, 1], [-1, 0]])
"""Offsets from a cell's centre to its corners and the middles of its sides, in half-sides."""


@dataclass(frozen=True, eq=False)
class Cells:
    """Equal squares of a regular grid.

    Attributes:
        origin: (2,) lower left corner of the grid.
        side: Length of a cell's side.
        numbers: (n, 2) column and row of each cell.
    """

    origin: FloatArray
    side: float
    numbers: IntArray

    @classmethod
    def covering(cls, box: tuple[FloatArray, FloatArray], side: float) -> "Cells":
        """Returns the cells that cover a box, (2,) and (2,), with at most the given side."""
        lower, upper = box
        longest = float((upper - lower).max())
        side = longest / np.ceil(longest / side)
        # A box whose sides are whole multiples up to rounding needs no cells beyond it.
        columns, rows = np.ceil((upper - lower) / side - 1e-9).astype(np.intp)
        numbers = np.indices((columns, rows)).reshape(2, -1).T
        return cls(lower, side, numbers)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, which: BoolArray | IntArray) -> "Cells":
        return replace(self, numbers=self.numbers[which])

    @property
    def centers(self) -> FloatArray:
        """The centres, (n, 2)."""
        return self.origin + (self.numbers + 0.5) * self.side

    @property
    def half(self) -> float:
        """Half the length of a side."""
        return self.side / 2

    def rim(self) -> tuple[FloatArray, IntArray]:
        """Returns the points on the rims of all cells and which of them are a cell's `RIM`.

        Neighbours share theirs: (k, 2) and (n, 8).
        """
        numbers = (2 * self.numbers[:, None, :] + 1 + RIM).reshape(-1, 2)
        shared, which = np.unique(numbers, axis=0, return_inverse=True)
        return self.origin + shared * self.half, which.reshape(-1, len(RIM))

    def quartered(self) -> "Cells":
        """Returns the four quarters of every cell."""
        numbers = (2 * self.numbers[:, None, :] + CORNERS).reshape(-1, 2)
        return Cells(self.origin, self.side / 2, numbers)

    def grown(self) -> "Cells":
        """Returns these cells and all that touch them."""
        around = np.indices((3, 3)).reshape(2, -1).T - 1
        numbers = (self.numbers[:, None, :] + around).reshape(-1, 2)
        return replace(self, numbers=np.unique(numbers, axis=0))

    def contains(self, points: FloatArray) -> BoolArray:
        """Returns whether each point (k, 2) lies in any of the cells, (k,)."""
        if not len(self):
            return np.zeros(len(points), bool)
        numbers = np.floor((points - self.origin) / self.side)
        distance, _ = cKDTree(self.numbers).query(numbers)
        return np.asarray(distance == 0)

    def clusters(self) -> Sequence["Cells"]:
        """Splits into sets of cells that stay apart when they are `grown`."""
        if not len(self):
            return []
        # Fewer than two cells between them: 2 sqrt(2) at most, from corner to corner.
        pairs = cKDTree(self.numbers).query_pairs(2.9, output_type="ndarray")
        graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(self), len(self)))
        count, label = connected_components(graph, directed=False)
        return [self[label == number] for number in range(count)]

    def border(self) -> tuple[FloatArray, FloatArray]:
        """Returns the segments around the union of the cells, (e, 2) and (e, 2).

        The union is on the left of each: outer borders run counter-clockwise, those of holes
        clockwise.
        """
        corners = self.numbers[:, None, :] + CORNERS
        edges = np.concatenate([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 4)
        # An edge between two cells is there once in either direction.
        both = np.concatenate([edges, edges[:, [2, 3, 0, 1]]])
        _, first, count = np.unique(both, axis=0, return_index=True, return_counts=True)
        outer = edges[first[(count == 1) & (first < len(edges))]]
        return self.origin + outer[:, :2] * self.side, self.origin + outer[:, 2:] * self.side


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
    """A field that is evaluated at `CHUNK` points at a time."""

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
