"""Sublevel sets of V: their components and holes in the band, and what leads down from above.

A cover of a sublevel set may have parts and holes that the set has not, and close holes that
it has.  But where V has no critical value between c and c_out, as under C1, all sublevel sets
in between are of one shape, and each is a deformation retract of the next.  Two covers one
inside of the other, with such sets before, between and after them,

    {V <= c}  in  inner cover  in  {V <= c_1}  in  outer cover  in  {V <= c_2},

then tell what is there: the components and the holes of the set are those of the inner cover
that are still different ones in the outer cover (and, of holes, in the order reversed).

Past a critical level of V nothing follows for {V <= c} as a whole, and the critical levels on
the medial axis of a path may be low.  But a component of {c_out <= V <= c} on all of which V
falls leads down to c_out by itself: what starts there cannot leave it but through that level,
and it cannot stay, since it is compact and V_dot has a bound below zero on it.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.boxes import HALF_WIDTH, Boxes, BoxSizes, Division
from sgvf_drake.certificate.certificate import Part
from sgvf_drake.certificate.conditions import LOW, RATE, Conditions, Decrease
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.fields import GuidingField

# Closed squares that share a corner hang together; open ones between them do not.
TOUCHING = np.ones((3, 3), bool)


@dataclass(frozen=True, eq=False)
class Cover:
    """Squares of one size that cover {V <= c}, on a raster.

    Attributes:
        inside: (k, k) whether each square belongs to it.
        lower: (2,) the corner of the raster.
        side: The side of its squares.
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
        holes: The number of holes of each component, in the order of `labels`.
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
        half: Half the side of the squares; a power of two.
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
        half: Half the side of the squares of the covers; a power of two.

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


# Levels from c_out to the highest that are tried.
NUM_LEVELS = 120


@dataclass(frozen=True, eq=False)
class Extension:
    """What was proved above the band, inside of the field's box.

    Attributes:
        parts: The components of {c_out <= V <= level} from which robots come down, the largest.
        basin_area: Of these and of {V <= c_out}, at least, in normalised units.
        falling_area: Of all squares above c_out on which V falls, in one of these or not.
        boxes: Number of squares over which the field was bounded.
    """

    parts: tuple[Part, ...]
    basin_area: float
    falling_area: float
    boxes: int


def extend(field: GuidingField, levels: MixtureModel, conditions: Conditions) -> Extension:
    """Proves that V falls above the band where it does, and finds what leads down from there.

    Args:
        field: The field.
        levels: V.
        conditions: C1 and C2, proved.
    """
    sizes = BoxSizes.of(field)
    lower, upper = (field.cloud.normalize(corner[None])[0] for corner in field.cloud.box)
    raster = _Raster.over(lower, upper, sizes.first)
    falls = _falls(field, levels, conditions, raster.squares, sizes.cover)
    open_level = raster.lowest(falls.undecided.centers, levels.level_range(falls.undecided)[0])
    low, high = (raster.grid(bound) for bound in levels.level_range(raster.squares))
    found, reach = _parts(raster, low, high, open_level, conditions.c_out)
    parts = []
    for level, number in found:
        x, y = field.cloud.denormalize(raster.squares.centers[number]).tolist()
        parts.append(Part(level, (x, y)))
    quarters = raster.squares.quarters()
    highest = np.maximum(raster.at(quarters.centers, reach), conditions.c_out)
    leads_down = levels.level_range(quarters)[1] <= highest
    above = ~np.isnan(falls.facts[:, RATE]) & (falls.facts[:, LOW] >= conditions.c_out)
    return Extension(
        parts=tuple(parts),
        basin_area=_area_in_box(quarters[leads_down], lower, upper),
        falling_area=_area_in_box(falls.boxes[above], lower, upper),
        boxes=falls.evaluated,
    )


def _area_in_box(squares: Boxes, lower: FloatArray, upper: FloatArray) -> float:
    """Returns the area of the squares that lie in a box."""
    within = np.minimum(squares.centers - lower, upper - squares.centers).min(axis=1)
    return float((4 * squares.half[within >= squares.half] ** 2).sum())


def _falls(
    field: GuidingField,
    levels: MixtureModel,
    conditions: Conditions,
    squares: Boxes,
    smallest: float,
) -> Division:
    """Proves that V falls above c_out on squares, as far as that goes."""
    highest = float(levels.level_range(squares)[1].max()) + 1
    question = Decrease(field, levels, conditions.c_out, highest, conditions.alpha, 0.0)
    return question.explore(squares, smallest)


@dataclass(frozen=True, eq=False)
class _Raster:
    """Squares of one size in rows and columns.

    Attributes:
        squares: The squares, row by row.
        shape: Number of rows, along x, and of columns.
    """

    squares: Boxes
    shape: tuple[int, int]

    @classmethod
    def over(cls, lower: FloatArray, upper: FloatArray, half: float) -> "_Raster":
        """Returns those that cover a box, and one more around."""
        first = np.floor(lower / (2 * half)).astype(int) - 1
        last = np.ceil(upper / (2 * half)).astype(int) + 1
        axes = [2 * half * (np.arange(a, b) + 0.5) for a, b in zip(first, last, strict=True)]
        centers = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        return cls(Boxes(centers, np.full(len(centers), half)), (len(axes[0]), len(axes[1])))

    def grid(self, values: FloatArray) -> FloatArray:
        """Returns values of the squares (n,) by rows and columns."""
        return values.reshape(self.shape)

    def at(self, points: FloatArray, values: FloatArray) -> FloatArray:
        """Returns the values (rows, columns) of the squares that points (n, 2) are in."""
        return np.asarray(values[tuple(self._cells(points).T)])

    def lowest(self, points: FloatArray, values: FloatArray) -> FloatArray:
        """Returns the lowest of the values (n,) at points in each square, or infinity."""
        found = np.full(self.shape, np.inf)
        np.minimum.at(found, tuple(self._cells(points).T), values)
        return found

    def _cells(self, points: FloatArray) -> IntArray:
        side = 2 * self.squares.half[0]
        corner = self.squares.centers[0] - self.squares.half[0]
        return np.asarray(np.floor((points - corner) / side).astype(np.intp))


def _parts(
    raster: _Raster, low: FloatArray, high: FloatArray, open_level: FloatArray, c_out: float
) -> tuple[list[tuple[float, int]], FloatArray]:
    """Returns the largest parts, and the level up to which each square belongs to one.

    Each part by its level and the number of a square that is in it.

    Args:
        raster: Squares, by rows and columns as the following.
        low: V on them at least.
        high: V on them at most.
        open_level: V at least, where it is open whether V falls; infinite elsewhere.
        c_out: The level that the parts lead down to.
    """
    edge = np.ones(raster.shape, bool)
    edge[1:-1, 1:-1] = False
    open_level = np.where(edge, low, open_level)
    reach = np.full(raster.shape, -np.inf)
    parts = []
    for level in np.geomspace(c_out, high.max(), NUM_LEVELS + 1)[:0:-1]:
        labels, count = ndimage.label((high >= c_out) & (low <= level), TOUCHING)
        lowest = ndimage.minimum(open_level, labels, np.arange(1, count + 1))
        for number in np.flatnonzero(np.asarray(lowest) > level) + 1:
            cells = labels == number
            inside = cells & (low >= c_out) & (high <= level)
            # A part of one that was found at a higher level is no other.
            if inside.any() and (reach[cells] < level).all():
                parts.append((float(level), int(np.argmax(inside))))
                reach[cells] = level
    return parts, reach
