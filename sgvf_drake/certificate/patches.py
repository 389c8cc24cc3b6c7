"""Patches of space, over which fields are bounded: segments, faces, cubes, and twisted ones."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class Patches:
    """n closed patches {c + A u + sum_j b_j u_0 u_j : |u_j| <= 1} of k parameters in R^d.

    With k = 0 they are points, with k = 1 segments, with k = 2 parallelograms, and so on; or,
    with twists, what is between two segments, or two parallelograms.  The numbers here define
    them, so that nothing about them is rounded.

    Attributes:
        centers: c, (n, d).
        axes: A, (n, d, k); columns are half the sides.
        twists: b_1, b_2, ..., (n, d, k - 1); None: they are zero.
    """

    centers: FloatArray
    axes: FloatArray
    twists: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.centers)

    def __getitem__(self, rows: BoolArray | slice) -> "Patches":
        twists = None if self.twists is None else self.twists[rows]
        return Patches(self.centers[rows], self.axes[rows], twists)

    @property
    def untwisted(self) -> "Patches":
        """Patches that hold these, of further parameters in the place of the u_0 u_j."""
        if self.twists is None:
            return self
        return Patches(self.centers, np.concatenate([self.axes, self.twists], axis=2))

    @classmethod
    def points(cls, points: FloatArray) -> "Patches":
        """Returns the patches without a parameter that points (n, d) are."""
        return cls(points, np.empty((*points.shape, 0)))
