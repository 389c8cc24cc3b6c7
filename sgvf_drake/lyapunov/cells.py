"""Square cells over a part of the plane: what a search by subdivision works on."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
