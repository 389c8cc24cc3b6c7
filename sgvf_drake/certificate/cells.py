"""Squares of a quadtree over the box of a field, and their neighbours."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.boxes import Boxes

HALF = 5.125
"""Half-side of the square that is divided, normalised units: the field's box, and more than
rounding can change of it."""

# The square is divided into so many along each axis first, and these into quarters at most so
# often.  The unit of the whole numbers below is the side of the smallest; all powers of two but
# the count.
COUNT, DEPTH = 41, 6
ROOT = 2**DEPTH
UNIT = 2 * HALF / (COUNT * ROOT)
SIDES = ((0, 1), (0, -1), (1, 1), (1, -1))
"""The axis and the sign of the sides of a square."""


@dataclass(frozen=True, eq=False)
class Cells:
    """n squares that cover the square, without overlap.

    Attributes:
        corner: (n, 2) the lower corners, in units from that of the square.
        size: (n,) sides, in units.
    """

    corner: IntArray
    size: IntArray

    def __len__(self) -> int:
        return len(self.size)

    def __getitem__(self, rows: BoolArray) -> "Cells":
        return Cells(self.corner[rows], self.size[rows])

    @classmethod
    def first(cls) -> "Cells":
        """Returns the squares of which none is divided."""
        steps = ROOT * np.arange(COUNT)
        corner = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
        return cls(corner, np.full(len(corner), ROOT))

    @classmethod
    def of(cls, code: str) -> "Cells":
        """Returns the squares of a code, in its order.

        Raises:
            ValueError: If it is none.
        """
        bits = np.unpackbits(np.frombuffer(bytes.fromhex(code), np.uint8)).astype(bool)
        nodes, done, used = cls.first(), [], 0
        while len(nodes):
            divided = bits[used : used + len(nodes)]
            used += len(nodes)
            if len(divided) < len(nodes) or (divided & (nodes.size == 1)).any():
                raise ValueError("not the code of a quadtree")
            done.append(nodes[~divided])
            nodes = nodes[divided].quarters()
        if len(bits) - used >= 8 or bits[used:].any():
            raise ValueError("not the code of a quadtree")
        first, *others = done
        return first.joined(*others)

    def joined(self, *others: "Cells") -> "Cells":
        """Returns these and others."""
        return Cells(
            np.concatenate([self.corner, *(other.corner for other in others)]),
            np.concatenate([self.size, *(other.size for other in others)]),
        )

    @property
    def code(self) -> str:
        """Which squares are divided, from the largest on, as bits in hexadecimal."""
        bits, nodes = [], Cells.first()
        while len(nodes):
            size = nodes.size[0]
            smaller = np.unique(_keys(self.corner[self.size < size] // size))
            divided = np.isin(_keys(nodes.corner // size), smaller)
            bits.append(divided)
            nodes = nodes[divided].quarters()
        return np.packbits(np.concatenate(bits)).tobytes().hex()

    def quarters(self) -> "Cells":
        """Returns the quarters of each, (4 n)."""
        size = self.size // 2
        steps = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
        corner = self.corner[:, None] + size[:, None, None] * steps
        return Cells(corner.reshape(-1, 2), np.repeat(size, 4))

    @property
    def boxes(self) -> Boxes:
        """The same squares, exactly."""
        half = self.size / 2
        return Boxes(UNIT * (self.corner + half[:, None]) - HALF, UNIT * half)

    def areas_in(self, lower: FloatArray, upper: FloatArray) -> FloatArray:
        """Returns the area (n,) of each that is in a box."""
        low = UNIT * self.corner - HALF
        high = low + UNIT * self.size[:, None]
        return np.prod(
            np.clip(np.minimum(high, upper) - np.maximum(low, lower), 0, None), axis=1
        )

    def neighbours(self, axis: int, sign: int) -> IntArray:
        """Returns the square (n,) beyond a side of each that is as large or larger.

        It is -1 at the border, and -2 where the neighbours are smaller: these have the square
        for a neighbour.
        """
        beyond = self.corner.copy()
        beyond[:, axis] += np.where(sign > 0, self.size, -1)
        found = np.full(len(self), -2)
        found[(beyond[:, axis] < 0) | (beyond[:, axis] >= COUNT * ROOT)] = -1
        for size in np.unique(self.size):
            own = np.flatnonzero(self.size == size)
            keys = _keys(self.corner[own])
            order = np.argsort(keys)
            ask = np.flatnonzero((self.size <= size) & (found == -2))
            wanted = _keys(beyond[ask] // size * size)
            place = np.minimum(np.searchsorted(keys[order], wanted), len(own) - 1)
            hit = keys[order][place] == wanted
            found[ask[hit]] = own[order[place[hit]]]
        return found


def _keys(places: IntArray) -> IntArray:
    """Returns a number for each pair of whole numbers (n, 2)."""
    return np.asarray(places[:, 0] * (COUNT * ROOT) + places[:, 1])
