"""Square cells of the plane, or cubes of space, and what is known of a field over each of them.

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
from sgvf_drake.matrices import adjugate, determinant


def corners(dim: int) -> IntArray:
    """Returns the offsets of a cell's corners from its lowest one, in sides, (2^d, d).

    From each to the next there is one side: of squares they run counter-clockwise.
    """
    number = np.arange(2**dim)
    return ((number ^ number >> 1)[:, None] >> np.arange(dim)) & 1


def around(dim: int) -> IntArray:
    """Returns the offsets to the places around a cell's centre and to itself, (3^d, d).

    In half-sides, these are its corners, and the middles of its edges and sides; in sides,
    its neighbours.  The middle row is the cell itself.
    """
    return np.indices((3,) * dim).reshape(dim, -1).T - 1


def rim(dim: int) -> IntArray:
    """Returns the same without the centre, (3^d - 1, d)."""
    return np.delete(around(dim), 3**dim // 2, axis=0)


@dataclass(frozen=True, eq=False)
class Cells:
    """Equal squares, or cubes, of a regular grid.

    Attributes:
        origin: (d,) lowest corner of the grid.
        side: Length of a cell's side.
        numbers: (n, d) column, row and so on of each cell.
    """

    origin: FloatArray
    side: float
    numbers: IntArray

    @classmethod
    def covering(cls, box: tuple[FloatArray, FloatArray], side: float) -> "Cells":
        """Returns the cells that cover a box, (d,) and (d,), with at most the given side."""
        lower, upper = box
        longest = float((upper - lower).max())
        side = longest / np.ceil(longest / side)
        # A box whose sides are whole multiples up to rounding needs no cells beyond it.
        counts = np.ceil((upper - lower) / side - 1e-9).astype(np.intp)
        numbers = np.indices(tuple(counts)).reshape(len(counts), -1).T
        return cls(lower, side, numbers)

    def __len__(self) -> int:
        return len(self.numbers)

    def __getitem__(self, which: BoolArray | IntArray | slice) -> "Cells":
        return replace(self, numbers=self.numbers[which])

    @property
    def dim(self) -> int:
        """The dimension d of the space."""
        return self.numbers.shape[1]

    @property
    def centers(self) -> FloatArray:
        """The centres, (n, d)."""
        return self.origin + (self.numbers + 0.5) * self.side

    @property
    def half(self) -> float:
        """Half the length of a side."""
        return self.side / 2

    def rim(self) -> tuple[FloatArray, IntArray]:
        """Returns the points on the rims of all cells and which of them are a cell's `rim`.

        Neighbours share theirs: (k, d) and (n, 3^d - 1).
        """
        numbers = 2 * self.numbers[:, None, :] + 1 + rim(self.dim)
        shared, which = _distinct_rows(numbers.reshape(-1, self.dim))
        return self.origin + shared * self.half, which.reshape(numbers.shape[:2])

    def corners(self) -> tuple[FloatArray, IntArray]:
        """Returns the corners of all cells and which are a cell's, (k, d) and (n, 2^d)."""
        numbers = self.numbers[:, None, :] + corners(self.dim)
        shared, which = _distinct_rows(numbers.reshape(-1, self.dim))
        return self.origin + shared * self.side, which.reshape(numbers.shape[:2])

    def quartered(self) -> "Cells":
        """Returns the four quarters of every cell; of cubes the 2^d parts."""
        numbers = 2 * self.numbers[:, None, :] + corners(self.dim)
        return Cells(self.origin, self.side / 2, numbers.reshape(-1, self.dim))

    def grown(self) -> "Cells":
        """Returns these cells and all that touch them."""
        numbers = (self.numbers[:, None, :] + around(self.dim)).reshape(-1, self.dim)
        return replace(self, numbers=_distinct_rows(numbers)[0])

    def contains(self, points: FloatArray) -> BoolArray:
        """Returns whether each point (k, d) lies in any of the cells, (k,)."""
        if not len(self):
            return np.zeros(len(points), bool)
        numbers = np.floor((points - self.origin) / self.side)
        distance, _ = cKDTree(self.numbers).query(numbers)
        return np.asarray(distance == 0)

    def clusters(self) -> Sequence["Cells"]:
        """Splits into sets of cells that stay apart when they are `grown`."""
        if not len(self):
            return []
        # Fewer than two cells between them, along every axis.
        pairs = cKDTree(self.numbers).query_pairs(2.5, p=np.inf, output_type="ndarray")
        graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(self), len(self)))
        count, label = connected_components(graph, directed=False)
        return [self[label == number] for number in range(count)]

    def border(self) -> tuple[FloatArray, FloatArray]:
        """Returns the segments around the union of squares, (e, 2) and (e, 2).

        The union is on the left of each: outer borders run counter-clockwise, those of holes
        clockwise.
        """
        start = self.numbers[:, None, :] + corners(2)
        edges = np.concatenate([start, np.roll(start, -1, axis=1)], axis=2).reshape(-1, 4)
        # An edge between two cells is there once in either direction.
        both = np.concatenate([edges, edges[:, [2, 3, 0, 1]]])
        _, where, count = np.unique(both, axis=0, return_index=True, return_counts=True)
        outer = edges[where[(count == 1) & (where < len(edges))]]
        return self.origin + outer[:, :2] * self.side, self.origin + outer[:, 2:] * self.side


# The remainder, and the change of the Jacobian, over a cell are taken to be so many times
# the largest on its rim.  A straight front, however steep, cuts a corner off any cell that it
# crosses; so what is not seen on the rim is small and round.
SAFETY = 2.0
# Points at which a field is evaluated at once, to bound the memory.
CHUNK = 8_192


class SmoothMap(Protocol):
    """What is asked of a field here; every `Field` is one."""

    def __call__(self, x: FloatArray) -> FloatArray:
        """Returns the value: (n, d) -> (n, d)."""

    def value_and_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the value (n, d), and the Jacobian (n, d, d)."""


@dataclass(frozen=True, eq=False)
class InChunks:
    """A field that is evaluated at `CHUNK` points at a time."""

    field: SmoothMap

    def __call__(self, x: FloatArray) -> FloatArray:
        """Returns the value: (n, d) -> (n, d)."""
        return np.concatenate([self.field(x[rows]) for rows in chunks(len(x), CHUNK)])

    def value_and_jacobian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns the value (n, d), and the Jacobian (n, d, d)."""
        parts = [self.field.value_and_jacobian(x[rows]) for rows in chunks(len(x), CHUNK)]
        values, jacobians = zip(*parts, strict=True)
        return np.concatenate(values), np.concatenate(jacobians)


@dataclass(frozen=True, eq=False)
class CellModel:
    """A field over n cells: m(c + d) = value + jacobian d + remainder.

    Attributes:
        half: Half-side of the cells.
        value: (n, d) at their centres c.
        jacobian: (n, d, d) there.
        remainders: (n, 3^d - 1, d) on their rims.
    """

    half: float
    value: FloatArray
    jacobian: FloatArray
    remainders: FloatArray

    @classmethod
    def over(cls, field: SmoothMap, cells: Cells) -> "CellModel":
        """Returns the model of a field over cells."""
        value, jacobian = field.value_and_jacobian(cells.centers)
        points, which = cells.rim()
        linear = cells.half * (jacobian @ rim(cells.dim).T).swapaxes(1, 2)
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
        """The left singular vectors of the Jacobians, in rows (n, d, d); the values (n, d)."""
        U, singular, _ = np.linalg.svd(self.jacobian)
        return U.swapaxes(1, 2), singular


def changes_little(field: SmoothMap, cells: Cells) -> BoolArray:
    """Whether a field clearly has one direction in each cell, by its corners, (n,).

    As `CellModel.vanishes_nowhere`, but with a constant for a model: it leaves more cells open,
    and asks for a few values only.
    """
    value = field(cells.centers)
    points, which = cells.corners()
    along = (field(points)[which] @ value[:, :, None])[:, :, 0]
    squared = (value**2).sum(axis=1)
    return np.asarray(squared > SAFETY * np.abs(along - squared[:, None]).max(axis=1))


def is_one_to_one(field: SmoothMap, centers: FloatArray, half: float) -> BoolArray:
    """Whether a field takes no value twice in cells of half-side `half`, (n,).

    Two points of one value would make the mean of the Jacobian between them singular.  It
    differs from that at the centre by a matrix whose entries, in the frame of the singular
    vectors, are at most `change`.  No such matrix is singular where the singular values less
    the changes on the diagonal, with the others below zero beside it, are an M-matrix.
    """
    dim = centers.shape[1]
    points = centers[:, None, :] + half * around(dim)
    J = field.value_and_jacobian(points.reshape(-1, dim))[1].reshape(*points.shape, dim)
    middle = J[:, [3**dim // 2]]
    U, singular, Vt = np.linalg.svd(middle[:, 0])
    left, right = U.swapaxes(1, 2)[:, None], Vt.swapaxes(1, 2)[:, None]
    change = SAFETY * np.abs(left @ (J - middle) @ right).max(axis=1)
    least = singular[:, :, None] * np.eye(dim) - change
    minors = [determinant(least[:, :size, :size]) for size in range(1, dim + 1)]
    return np.asarray((np.array(minors) > 0).all(axis=0))


def _distinct_rows(numbers: IntArray) -> tuple[IntArray, IntArray]:
    """Returns different rows of whole numbers, in order, and which of them each row is.

    As `np.unique` along an axis does, ten times as fast: by the ranks in each column.
    """
    ranks = [np.unique(column, return_inverse=True)[1] for column in numbers.T]
    key = np.ravel_multi_index(ranks, [rank.max(initial=0) + 1 for rank in ranks])
    _, first, which = np.unique(key, return_index=True, return_inverse=True)
    return numbers[first], which


def chunks(count: int, size: int) -> list[slice]:
    """Returns the slices of so many rows by chunks of a size: one at least, if an empty one."""
    return [slice(start, start + size) for start in range(0, max(count, 1), size)]
