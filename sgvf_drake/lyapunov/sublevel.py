"""Sublevel sets {V <= c}: their components, their holes, the tube they make."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.lyapunov.cells import around, corners
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.paths import ReferencePath

# Cells of the raster to the half-width of the tube, which is sigma sqrt(2 c) where V is that
# of a straight line, but no more of them to one noise level; both by the dimension.
CELLS_PER_WIDTH = {2: 8, 3: 4}
CELLS_PER_SIGMA = {2: 16, 3: 8}
# Fewest and most cells along the longer axis of the box.
CELL_RANGE = {2: (300, 4_000), 3: (48, 2_000)}


@dataclass(frozen=True)
class Component:
    """A component of a sublevel set.

    Attributes:
        holes: Number of its holes: in space of those that go through it, as that of a ring.
        pieces: The pieces of the path that lie in it.
        cavities: Number of the places in space that it encloses on all sides.
    """

    holes: int
    pieces: tuple[int, ...]
    cavities: int = 0


@dataclass(frozen=True, eq=False)
class SublevelSet:
    """{V <= c}, on a raster that resolves its tube.

    Attributes:
        level: c.
        components: Its components, by the pieces of the path in them.
        area: Its area inside the box; in space its volume.
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
            (component.holes, component.cavities) == (int(closed[component.pieces[0]]), 0)
            for component in self.components
        )


def sublevel_set(
    function: LyapunovFunction,
    level: float,
    reference: ReferencePath,
    box: tuple[FloatArray, FloatArray],
) -> SublevelSet:
    """Returns the sublevel set of a level, found on a raster of cells over the box.

    Args:
        function: V, in the plane or in space.
        level: c.
        reference: The path; a component without waypoints of it has no pieces.
        box: Lower and upper corner.
    """
    lower, upper = box
    size = float((upper - lower).max())
    step = size / _num_cells(function, level, size)
    # A box whose sides are whole multiples up to rounding needs no cells beyond it.
    shape = np.ceil((upper - lower) / step - 1e-9).astype(np.intp)
    cells = Raster(_cells_inside(function, level, lower, step, shape))
    pieces = _pieces_in(cells, function.mixture.points, reference, lower, step)
    # What is farthest from the path is on the edge.
    edge = cells.numbers[cells.on_edge]
    centers = lower + (edge + 0.5) * step
    first_or_last = np.stack([edge == 0, edge == shape - 1])
    return SublevelSet(
        level=level,
        components=tuple(
            Component(cells.holes[label], held, cells.cavities[label])
            for label, held in enumerate(pieces)
        ),
        area=float(len(cells.numbers) * step ** len(lower)),
        half_width=float(reference.project(centers).distance.max(initial=0.0)),
        compact=not (function(_on_border(centers, first_or_last, box)) <= level).any(),
    )


def _on_border(
    centers: FloatArray, first_or_last: BoolArray, box: tuple[FloatArray, FloatArray]
) -> FloatArray:
    """Returns where the outermost cells are next to the border of the box, (k, d).

    Args:
        centers: The centres of cells, (n, d).
        first_or_last: Whether each is a first, and a last, one along each axis, (2, n, d).
        box: Lower and upper corner.
    """
    end, cell, axis = np.nonzero(first_or_last)
    x = centers[cell]
    x[np.arange(len(x)), axis] = np.stack(box)[end, axis]
    return x


def _num_cells(function: LyapunovFunction, level: float, size: float) -> int:
    """Returns the number of cells along the longer axis."""
    dim = function.dim
    width = np.sqrt(2 * max(level, 0.0)) / CELLS_PER_WIDTH[dim]
    step = function.sigma * max(1 / CELLS_PER_SIGMA[dim], width)
    return int(np.clip(np.ceil(size / step), *CELL_RANGE[dim]))


def _cells_inside(
    function: LyapunovFunction, level: float, lower: FloatArray, step: float, shape: IntArray
) -> IntArray:
    """Returns the numbers (n, d) of the cells with V <= level at their centre, by halving.

    The slope of sqrt(V) is at most 1 / (sqrt(2) sigma), since V >= 0 and its Hessian is at most
    I / sigma^2; so many blocks of cells are inside or outside as a whole.
    """
    dim, root = len(shape), np.sqrt(max(level, 0.0))
    blocks, side = np.zeros((1, dim), np.intp), 1 << int(shape.max() - 1).bit_length()
    inside = blocks[:0]

    def divided(blocks: IntArray) -> IntArray:
        parts = (2 * blocks[:, None] + corners(dim)).reshape(-1, dim)
        return parts[(side * parts < shape).all(axis=1)]

    while side > 1:
        roots = np.sqrt(np.maximum(function(lower + (blocks + 0.5) * (side * step)), 0))
        # To the corners of a block, half a diagonal away.
        change = np.sqrt(dim) * side * step / 2 / (np.sqrt(2) * function.sigma)
        whole = roots + change <= root
        mixed = ~whole & (roots - change <= root)
        side //= 2
        inside = divided(np.concatenate([inside, blocks[whole]]))
        blocks = divided(blocks[mixed])
    low = function(lower + (blocks + 0.5) * step) <= level
    return np.concatenate([inside, blocks[low]])


class Raster:
    """Cells of a regular grid, of which those with a common side hang together.

    Attributes:
        numbers: (n, d) column, row and so on of each cell, in order.
        label: (n,) its component, from 0, in the order of their first cells.
        on_edge: (n,) whether it lacks a neighbour.
        holes: The number of holes of each component, as of a `Component`.
        cavities: The number of its cavities; in the plane there are none.
    """

    def __init__(self, numbers: IntArray) -> None:
        """Takes the numbers of distinct cells, (n, d), none negative."""
        # One number for each cell, with room for the two next to the first and to the last.
        shape = numbers.max(axis=0, initial=0) + 5
        self._strides = np.append(np.cumprod(shape[:0:-1])[::-1], 1)
        self._limit = shape - 3
        keys = self._key(numbers)
        order = np.argsort(keys)
        self.numbers, self._keys = numbers[order], keys[order]
        count, self.label = _joined(self._keys, self._strides)
        beside = [
            _find(self._keys, self._keys + step) for step in (*self._strides, *-self._strides)
        ]
        self.on_edge = (np.array(beside) < 0).any(axis=0)
        self.cavities = [0] * count
        if numbers.shape[1] == 3:
            self.cavities = [self._cavities(label) for label in range(count)]
        # Euler and Poincare: of a component, 1 - holes + cavities.
        self.holes = [
            1 + cavities - int(euler)
            for cavities, euler in zip(self.cavities, self._euler(count), strict=True)
        ]

    def label_at(self, numbers: IntArray) -> IntArray:
        """Returns the components of the cells with these numbers (k, d), or -1, (k,)."""
        at = _find(self._keys, self._key(np.clip(numbers, -1, self._limit)))
        return np.append(self.label, -1)[at]

    def _key(self, numbers: IntArray) -> IntArray:
        return np.asarray((numbers + 2) @ self._strides)

    def _euler(self, count: int) -> FloatArray:
        """Returns the Euler characteristic of each component, (count,).

        That is cells less pairs with a common side, plus fours around a corner of a square,
        less eights around a corner of a cube.
        """
        offsets = corners(len(self._strides))
        there = [_find(self._keys, self._keys + step) >= 0 for step in offsets @ self._strides]
        total = np.zeros(count)
        for offset in offsets:
            part = (offsets <= offset).all(axis=1)
            full = np.array(there)[part].all(axis=0)
            total += (-1.0) ** offset.sum() * np.bincount(self.label, full, count)
        return total

    def _cavities(self, label: int) -> int:
        """Returns the number of surfaces of a component beside the one around it.

        Each is a part of the cells next to it that hangs together, if only across corners.
        """
        steps = around(len(self._strides)) @ self._strides
        own = self._keys[self.label == label]
        edge = self._keys[(self.label == label) & self.on_edge]
        shell = np.setdiff1d(edge[:, None] + steps, own)
        return _joined(shell, steps[len(steps) // 2 + 1 :])[0] - 1


def _find(keys: IntArray, wanted: IntArray) -> IntArray:
    """Returns where numbers (k,) are among others in order, (n,); -1: nowhere, (k,)."""
    at = np.searchsorted(keys, wanted)
    return np.where(np.append(keys, -1)[at] == wanted, at, -1)


def _joined(keys: IntArray, steps: IntArray) -> tuple[int, IntArray]:
    """Returns how many parts keys in order, (n,), make, and the part of each, (n,).

    Two keys are of one part where their difference is one of the steps.
    """
    start = np.tile(np.arange(len(keys)), len(steps))
    end = _find(keys, np.add.outer(steps, keys).ravel())
    pairs = np.stack([start, end])[:, end >= 0]
    graph = coo_array((np.ones(pairs.shape[1]), pairs), shape=(len(keys),) * 2)
    count, label = connected_components(graph, directed=False)
    return count, label


def _pieces_in(
    cells: Raster,
    points: FloatArray,
    reference: ReferencePath,
    lower: FloatArray,
    step: float,
) -> Sequence[tuple[int, ...]]:
    """Returns the pieces in each component: those with most of their waypoints there."""
    at = cells.label_at(((points - lower) / step).astype(np.intp))
    piece = reference.project(points).piece
    found: list[set[int]] = [set() for _ in cells.holes]
    for number in np.unique(piece):
        held = at[(piece == number) & (at >= 0)]
        if len(held):
            found[int(np.bincount(held).argmax())].add(int(number))
    return [tuple(sorted(pieces)) for pieces in found]
