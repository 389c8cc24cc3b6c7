"""Components and holes of {V <= c}, counted on squares that cover it.

A cover of a sublevel set may have parts and holes that the set has not, and close holes that
it has.  But where V has no critical value between c and c_out, as under C1, all sublevel sets
in between are of one shape, and each is a deformation retract of the next.  Two covers one
inside of the other, with such sets before, between and after them,

    {V <= c}  in  inner cover  in  {V <= c_1}  in  outer cover  in  {V <= c_2},

then tell what is there: the components and the holes of the set are those of the inner cover
that are still different ones in the outer cover (and, of holes, in the order reversed).
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.certificate.squares import HALF_WIDTH

# Closed squares that share a corner hang together; open ones between them do not.
TOUCHING = np.ones((3, 3), bool)


@dataclass(frozen=True, eq=False)
class Cover:
    """Squares of one size that cover {V <= c}, on a raster.

    Attributes:
        inside: (k, k) whether each square belongs to it.
        lower: (2,) the corner of the raster.
        side: Of its squares.
        highest: What V is at most on them.
    """

    inside: BoolArray
    lower: FloatArray
    side: float
    highest: float

    def cells_of(self, points: FloatArray) -> IntArray:
        """Returns the indices of the squares that points (n, 2) are in, (n, 2)."""
        return np.floor((points - self.lower) / self.side).astype(np.intp)


@dataclass(frozen=True)
class Shape:
    """What is known of the sublevel sets of a band.

    Attributes:
        holes: Of each component, in the order of `labels`.
        labels: (k, k) the components by their numbers, from 1, on the outer cover's raster;
            0 outside.
        cover: The outer cover.
    """

    holes: tuple[int, ...]
    labels: IntArray
    cover: Cover

    @property
    def components(self) -> int:
        """The number of components."""
        return len(self.holes)

    def squares_of(self, component: int, half: float) -> Boxes:
        """Returns the squares of a size, that of the raster's or a multiple, over a component.

        Args:
            component: Its number, from 1.
            half: Half-side of the squares; a power of two.
        """
        cells = np.argwhere(self.labels == component)
        cells = np.unique(cells // round(2 * half / self.cover.side), axis=0)
        centers = self.cover.lower + 2 * half * (cells + 0.5)
        return Boxes(centers, np.full(len(centers), half))

    def component_of(self, points: FloatArray) -> IntArray:
        """Returns the numbers, from 1, of the components that points (n, 2) are in; or 0."""
        rows, columns = self.cover.cells_of(points).T
        return np.asarray(self.labels[rows, columns])


def cover(levels: MixtureModel, level: float, half: float) -> Cover:
    """Returns the squares of a grid around the origin on which V may be at most `level`.

    Args:
        levels: V.
        level: c.
        half: Of the squares; a power of two.
    """
    boxes = levels.squares_below(level, Boxes.square(HALF_WIDTH), half)
    count = round(HALF_WIDTH / half)
    lower = np.full(2, -HALF_WIDTH)
    inside = np.zeros((count, count), bool)
    found = Cover(inside, lower, 2 * half, float(levels.level_range(boxes)[1].max()))
    rows, columns = found.cells_of(boxes.centers).T
    inside[rows, columns] = True
    return found


def shape_of_band(levels: MixtureModel, c_in: float, c_out: float, half: float) -> Shape | None:
    """Returns the shape of {V <= c} for c in a band without critical values.

    Args:
        levels: V.
        c_in: The lowest level.
        c_out: The highest; V has no critical value from one to the other.
        half: Of the squares of the covers; a power of two.

    Returns:
        None where the squares are too large for the band.
    """
    inner = cover(levels, c_in, half)
    outer = cover(levels, inner.highest, half)
    if outer.highest > c_out:
        return None
    labels, count = ndimage.label(outer.inside, TOUCHING)
    reached = np.unique(labels[inner.inside])
    holes = tuple(
        _lasting_holes(inner.inside & (labels == label), labels == label) for label in reached
    )
    renumbered = np.zeros(count + 1, np.intp)
    renumbered[reached] = np.arange(1, len(reached) + 1)
    return Shape(holes, renumbered[labels], outer)


def _lasting_holes(inner: BoolArray, outer: BoolArray) -> int:
    """The holes of the inner cover that the outer one does not close, by what is around."""
    around, _ = ndimage.label(np.pad(~inner, 1, constant_values=True))
    still_around = np.pad(~outer, 1, constant_values=True)
    # One of them is the outside.
    return len(np.unique(around[still_around])) - 1
