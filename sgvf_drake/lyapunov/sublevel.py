"""Sublevel sets {V <= c} in the plane: their components, their holes, the tube they make."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.paths import ReferencePath

# Cells of the raster to the half-width of the tube, which is sigma sqrt(2 c) where V is that
# of a straight line, but no more of them to one noise level.
CELLS_PER_WIDTH = 8
CELLS_PER_SIGMA = 16
# Fewest and most cells along the longer axis of the box.
CELL_RANGE = (300, 4_000)
# Cells along each side of the blocks that are looked at first.
BLOCK = 8


@dataclass(frozen=True)
class Component:
    """A component of a sublevel set.

    Attributes:
        holes: Number of its holes.
        pieces: The pieces of the path that lie in it.
    """

    holes: int
    pieces: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SublevelSet:
    """{V <= c}, on a raster that resolves its tube.

    Attributes:
        level: c.
        components: Its components, by the pieces of the path in them.
        area: Its area inside the box.
        half_width: Largest distance of its points from the path.
        compact: Whether it stays inside the box.
    """

    level: float
    components: tuple[Component, ...]
    area: float
    half_width: float
    compact: bool

    def follows(self, closed: BoolArray) -> bool:
        """Whether it is one tube for each piece: a ring for a closed one, else without hole.

        Args:
            closed: Whether each piece is closed, (P,).
        """
        expected = sorted((piece,) for piece in range(len(closed)))
        return sorted(c.pieces for c in self.components) == expected and all(
            component.holes == int(closed[component.pieces[0]]) for component in self.components
        )


def sublevel_set(
    function: LyapunovFunction,
    level: float,
    reference: ReferencePath,
    box: tuple[FloatArray, FloatArray],
) -> SublevelSet:
    """Returns the sublevel set of a level, found on a raster of cells over the box.

    Args:
        function: V, planar.
        level: c.
        reference: The path; a component without waypoints of it has no pieces.
        box: Lower and upper corner.
    """
    lower, upper = box
    size = float((upper - lower).max())
    step = size / _num_cells(function, level, size)
    inside = _raster(function, level, lower, upper, step)
    labels, count = ndimage.label(inside)
    # What is farthest from the path is on the edge.
    edge = np.argwhere(inside & ~ndimage.binary_erosion(inside))
    pieces = _pieces_in(labels, function.mixture.points, reference, lower, step)
    border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    distance = reference.project(lower + (edge + 0.5) * step).distance
    return SublevelSet(
        level=level,
        components=tuple(
            Component(_holes(labels, label), pieces[label - 1]) for label in range(1, count + 1)
        ),
        area=float(inside.sum() * step**2),
        half_width=float(distance.max(initial=0.0)),
        compact=not border.any(),
    )


def _num_cells(function: LyapunovFunction, level: float, size: float) -> int:
    """Returns the number of cells along the longer axis."""
    width = np.sqrt(2 * max(level, 0.0)) / CELLS_PER_WIDTH
    step = function.sigma * max(1 / CELLS_PER_SIGMA, width)
    return int(np.clip(np.ceil(size / step), *CELL_RANGE))


def _raster(
    function: LyapunovFunction, level: float, lower: FloatArray, upper: FloatArray, step: float
) -> BoolArray:
    """Returns which cells have V <= level at their centre, (nx, ny), by whole blocks first."""
    blocks = np.maximum(np.ceil((upper - lower) / (step * BLOCK)).astype(int), 1)
    corner = np.indices(tuple(blocks)).reshape(2, -1).T * BLOCK
    center = lower + (corner + BLOCK / 2) * step
    V, slope = function(center), np.linalg.norm(function.gradient(center), axis=1)
    # Within the radius r of a block V changes by less than this: its curvature is at most
    # 1 / sigma^2, and not below minus a few times that where V is low.
    r = step * BLOCK / np.sqrt(2)
    change = slope * r + 2 * (r / function.sigma) ** 2
    inside = np.zeros(blocks * BLOCK, bool)
    for i, j in corner[V + change <= level]:
        inside[i : i + BLOCK, j : j + BLOCK] = True
    mixed = corner[np.abs(V - level) < change]
    offsets = np.indices((BLOCK, BLOCK)).reshape(2, -1).T
    cells = (mixed[:, None] + offsets).reshape(-1, 2)
    inside[tuple(cells.T)] = function(lower + (cells + 0.5) * step) <= level
    return inside


def _pieces_in(
    labels: IntArray,
    points: FloatArray,
    reference: ReferencePath,
    lower: FloatArray,
    step: float,
) -> Sequence[tuple[int, ...]]:
    """Returns the pieces in each component: those with most of their waypoints there."""
    cells = np.clip(((points - lower) / step).astype(int), 0, np.array(labels.shape) - 1)
    at = labels[tuple(cells.T)]
    piece = reference.project(points).piece
    found: list[set[int]] = [set() for _ in range(labels.max(initial=0))]
    for number in np.unique(piece):
        held = at[(piece == number) & (at > 0)]
        if len(held):
            found[int(np.bincount(held).argmax()) - 1].add(int(number))
    return [tuple(sorted(pieces)) for pieces in found]


def _holes(labels: IntArray, label: int) -> int:
    """Returns the number of holes of a component: what it encloses, in connected parts."""
    window = ndimage.find_objects(labels, max_label=label)[label - 1]
    component = labels[window] == label
    enclosed = ndimage.binary_fill_holes(component) & ~component
    # The complement of a set that is connected along edges is connected across corners too.
    return int(ndimage.label(enclosed, structure=np.ones((3, 3)))[1])
