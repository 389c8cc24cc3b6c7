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
    def square(cls, half: float) -> "Boxes":
        """Returns the one square around the origin of a half-side."""
        return cls(np.zeros((1, 2)), np.array([half]))
