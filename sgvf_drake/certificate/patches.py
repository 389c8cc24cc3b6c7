"""Affine patches of space, over which fields are bounded: segments, faces, squares, cubes."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Patches:
    """n closed patches {c + A u : |u_j| <= 1} of k parameters in R^d.

    With k = 0 they are points, with k = 1 segments, with k = 2 parallelograms, and so on.  The
    numbers here define them, so that nothing about them is rounded.

    Attributes:
        centers: c, (n, d).
        axes: A, (n, d, k); columns are half the sides.
    """

    centers: FloatArray
    axes: FloatArray

    def __len__(self) -> int:
        return len(self.centers)

    def __getitem__(self, rows: BoolArray | slice) -> "Patches":
        return Patches(self.centers[rows], self.axes[rows])

    @classmethod
    def points(cls, points: FloatArray) -> "Patches":
        """Returns the patches without a parameter that points (n, d) are."""
        return cls(points, np.empty((*points.shape, 0)))
