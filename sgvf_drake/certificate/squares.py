"""Which squares a field is bounded over, in proportion to the scale on which it turns."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.fields import GuidingField

HALF_WIDTH = 8.0
"""Everything is proved inside of a square of this half-side, normalised units; the waypoints
are within 4."""


@dataclass(frozen=True)
class Squares:
    """Half-sides of squares, powers of two.

    Attributes:
        unit: The largest one that is no larger than the noise level of the field.
    """

    unit: float

    @classmethod
    def of(cls, field: GuidingField) -> "Squares":
        """Returns the sizes for a field."""
        return cls(float(2.0 ** np.floor(np.log2(min(field.sigma, 1.0)))))

    @property
    def everything(self) -> Boxes:
        """The square that holds everything."""
        return Boxes.square(HALF_WIDTH)

    @property
    def first(self) -> float:
        """Of those over which a field is bounded first."""
        return self.unit / 2

    @property
    def ring(self) -> float:
        """Of those in the tube."""
        return self.unit / 4

    @property
    def cover(self) -> float:
        """Of the covers whose components and holes are counted."""
        return self.unit / 8

    @property
    def last(self) -> float:
        """Of those that are divided no more."""
        return self.unit / 1024
