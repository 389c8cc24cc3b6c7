"""Squares in the plane, as the cells of a proof."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray

# From the centre of a square to those of its quarters, in halves of its half-side.
QUARTERS = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Boxes:
    """n closed squares {c + d : |d_k| <= half}.

    Centres and half-sides of a dyadic grid are exact in float64, so that neighbours share
    their sides to the last bit, and quarters cover their square.

    Attributes:
        centers: c, (n, 2).
        half: (n,) half-sides.
    """

    centers: FloatArray
    half: FloatArray

    def __len__(self) -> int:
        return len(self.half)

    def __getitem__(self, rows: BoolArray | slice) -> "Boxes":
        return Boxes(self.centers[rows], self.half[rows])

    def quarters(self) -> "Boxes":
        """Returns the four quarters of each square, (4 n)."""
        half = self.half / 2
        centers = self.centers[:, None] + half[:, None, None] * QUARTERS
        return Boxes(centers.reshape(-1, 2), np.repeat(half, len(QUARTERS)))

    @classmethod
    def covering(cls, half_width: float, half: float) -> "Boxes":
        """Returns a grid of squares around the origin that covers |z_k| <= `half_width`.

        Args:
            half_width: Of the square that is covered.
            half: Of the squares; a power of two.
        """
        count = int(np.ceil(half_width / (2 * half)))
        axis = half * (2 * np.arange(-count, count) + 1.0)
        centers = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
        return cls(centers, np.full(len(centers), half))
