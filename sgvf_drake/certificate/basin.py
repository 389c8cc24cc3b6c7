"""From where robots come between the walls: a graph of squares over the box.

An orbit goes from a square to a neighbour through their common side.  It cannot where m has the
strict opposite sign across all of the closed side, shorter squares beside longer ones included;
through a corner it passes two sides at once.  So orbits are walks on the graph of what is left.

A walk stays at last among squares of which each leads to each, or in one of them.  An orbit
cannot stay where m . u > 0 for one direction u on all of these (`_moves`).  So from squares
from which no walk leads to a set that has no such u, or out of the box, every orbit comes to
the goal in bounded time: to a square all of which is between walls.

What is **excluded** are the other sets: around zeros, and what leads there.  Where div m > 0
all over one, the points that stay in it for ever are of measure zero, because m carries them
into themselves and their area would grow.  So almost every robot leaves it.  Where robots go
does not change if m is multiplied by a positive function, so that of `direction_model` will do.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.cells import SIDES, UNIT, Cells
from sgvf_drake.certificate.field_model import (
    PerturbedField,
    direction_dual,
    direction_model,
    has_dual,
)
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.walls import Walls
from sgvf_drake.fields import GuidingField
from sgvf_drake.progress import Progress, no_progress

PlanarField = GuidingField | PerturbedField

# Directions u that are tried.
ANGLES = np.linspace(0, 2 * np.pi, 32, endpoint=False)
DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
# What is known of m on a square, but for a positive factor: of its part across each of `SIDES`,
# along the axis of that, at least and at most; and of m . u for each direction, at least.
LEAST, MOST, ALONG = slice(0, 4), slice(4, 8), slice(8, 8 + len(DIRECTIONS))
# And whether div m > 0 on it, 1 or 0: asked where robots may stay.
GROWS = ALONG.stop
# Squares that are asked about at once.
CHUNK = 1000
# Sets in which robots may stay are divided as a whole while they are more than this part of the
# box, and then where div m > 0 is not known; no more squares than so many at once.
FEW, MOST_AT_ONCE = 0.03, 15_000
# What leads there is divided while robots are proved to come from so much more of the box.
GAIN = 0.005
# As often as squares are divided in all, about: for who is told of the progress.
ROUNDS = 12
# Squares on walls are divided to this part of the distance between them.
FIT = 0.25


@dataclass(frozen=True)
class ExcludedSet:
    """Squares that lead to each other, in which robots may stay.

    Attributes:
        center: (2,) the middle of its squares, in the unit of the waypoints.
        area: Its part of the box.
        left_by_almost_all: Whether it is proved that almost every robot leaves it.
    """

    center: tuple[float, float]
    area: float
    left_by_almost_all: bool

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "ExcludedSet":
        """Returns the set of a JSON object."""
        x, y = body["center"]
        return cls((float(x), float(y)), float(body["area"]), bool(body["left_by_almost_all"]))


@dataclass(frozen=True, eq=False)
class Basin:
    """What is proved of the box.

    Attributes:
        cells: Squares that cover it.
        comes: (n,) whether every robot from a square comes between the walls.
        area: The part of the box that these make up.
        almost: The part from which almost every robot comes there.
        excluded: The sets in which robots may stay.
        evaluated: Over how many squares the field was bounded.
    """

    cells: Cells
    comes: BoolArray
    area: float
    almost: float
    excluded: tuple[ExcludedSet, ...]
    evaluated: int


@dataclass(frozen=True, eq=False)
class _Known:
    """Squares and what is known of them.

    Attributes:
        cells: The squares.
        goal: (n,) which are between walls.
        facts: (n, 9 + u) of the others; NaN of these, and where nothing was asked yet.
    """

    cells: Cells
    goal: BoolArray
    facts: FloatArray

    @classmethod
    def of(cls, field: PlanarField, cells: Cells, walls: Sequence[Walls]) -> "_Known":
        """Finds out about squares."""
        boxes, goal = cells.boxes, np.zeros(len(cells), bool)
        for one in walls:
            goal |= one.hold(boxes)[0]
        facts, asked = np.full((len(cells), 1 + GROWS), np.nan), boxes[~goal]
        chunks = (asked[first : first + CHUNK] for first in range(0, len(asked), CHUNK))
        facts[~goal, :GROWS] = np.concatenate(
            [np.empty((0, GROWS)), *(facts_of(field, chunk) for chunk in chunks)]
        )
        return cls(cells, goal, facts)

    def growing(self, field: PlanarField, rows: BoolArray) -> BoolArray:
        """Tells on which of some squares (n,) div m > 0; each is asked once."""
        unknown = rows & np.isnan(self.facts[:, GROWS])
        self.facts[unknown, GROWS] = _grows(field, self.cells[unknown].boxes)
        return rows & (self.facts[:, GROWS] == 1)

    @property
    def evaluated(self) -> int:
        """Over how many squares the field was bounded."""
        return int((~self.goal).sum())

    def replaced(self, rows: BoolArray, other: "_Known") -> "_Known":
        """Returns what is known of these squares, but for other ones in the place of some."""
        return _Known(
            self.cells[~rows].joined(other.cells),
            np.concatenate([self.goal[~rows], other.goal]),
            np.concatenate([self.facts[~rows], other.facts]),
        )


def facts_of(field: PlanarField, boxes: Boxes) -> FloatArray:
    """Returns what is known of m on squares, by the columns above, (n, 8 + u)."""
    # What overflows is not above any bound, nor below one.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        m = direction_model(field, boxes.patches)
        sides = [m.functions(slice(axis, axis + 1)).at_end(axis, sign) for axis, sign in SIDES]
        along = [m.weighted(np.broadcast_to(u, m.value.shape)).lower for u in DIRECTIONS]
        least, most = [side.lower for side in sides], [side.upper for side in sides]
        return np.concatenate([*least, *most, *along], axis=1)


@dataclass(frozen=True, eq=False)
class _Graph:
    """How squares lead to each other.

    Attributes:
        after: (n, n) which square leads to which; the goal to none.
        goal: (n,) which are between the walls.
        out: (n,) which lead out of the box.
        labels: (n,) the set of squares that lead to each other.
        stays: (n,) whether orbits may stay in the set.
    """

    after: csr_array
    goal: BoolArray
    out: BoolArray
    labels: IntArray
    stays: BoolArray

    def leads_to(self, targets: BoolArray) -> BoolArray:
        """Tells from which squares (n,) a walk leads to one of some."""
        n = len(targets)
        # One more square, before which all of these are.
        source, target = self.after.nonzero()
        last = np.flatnonzero(targets)
        back = csr_array(
            (
                np.ones(len(source) + len(last), np.int8),
                (
                    np.concatenate([target, np.full(len(last), n)]),
                    np.concatenate([source, last]),
                ),
            ),
            shape=(n + 1, n + 1),
        )
        reached = np.zeros(n + 1, bool)
        reached[breadth_first_order(back, n, return_predecessors=False)] = True
        return reached[:n]


def find_basin(
    field: PlanarField, walls: Sequence[Walls], progress: Progress = no_progress
) -> Basin:
    """Proves from where robots come between walls, and divides squares where that helps.

    Args:
        field: The field, in the plane.
        walls: Walls that are proved.
        progress: Told how far it is.
    """
    known, lost = _Known.of(field, _around(walls), walls), 1.0
    evaluated = known.evaluated
    for number in count():
        progress("cells", min(number, ROUNDS), ROUNDS)
        graph = _graph(known)
        divisible = _staying(field, known, graph)
        if not divisible.any():
            before, leads = lost, ~graph.goal & graph.leads_to(graph.stays | graph.out)
            lost = _part_of_box(field, known.cells, leads)
            divisible = leads & (known.cells.size > 1) & (before - lost > GAIN)
        if not 0 < divisible.sum() <= MOST_AT_ONCE:
            break
        parts = _Known.of(field, known.cells[divisible].quarters(), walls)
        evaluated += parts.evaluated
        known = known.replaced(divisible, parts)
    progress("cells", ROUNDS, ROUNDS)
    return replace(_basin(field, known, graph), evaluated=evaluated)


def _staying(field: PlanarField, known: _Known, graph: _Graph) -> BoolArray:
    """Tells which squares (n,) to divide of those where robots may stay."""
    found = graph.stays & (known.cells.size > 1)
    if _part_of_box(field, known.cells, found) > FEW:
        return found
    return found & ~known.growing(field, found)


def prove_basin(field: PlanarField, cells: Cells, walls: Sequence[Walls]) -> Basin:
    """Proves from which squares robots come between walls.

    Args:
        field: The field, in the plane.
        cells: Squares that cover the box.
        walls: Walls that are proved.
    """
    known = _Known.of(field, cells, walls)
    return _basin(field, known, _graph(known))


def _around(walls: Sequence[Walls]) -> Cells:
    """Returns squares that are small on walls, where the way in has to be seen."""
    cells = Cells.first()
    for one in walls:
        while True:
            held, apart = one.hold(cells.boxes)
            coarse = (
                ~held & ~apart & (UNIT * cells.size > FIT * one.narrowest) & (cells.size > 1)
            )
            if not coarse.any():
                break
            cells = cells[~coarse].joined(cells[coarse].quarters())
    return cells


def _graph(known: _Known) -> _Graph:
    cells, facts, goal = known.cells, known.facts, known.goal
    n = len(cells)
    source, target, may = [], [], []
    out = np.zeros(n, bool)
    for k, (axis, sign) in enumerate(SIDES):
        beyond = cells.neighbours(axis, sign)
        outward = sign * facts[:, [LEAST.start + k, MOST.start + k]][:, ::sign]
        forwards, backwards = ~(outward[:, 1] < 0), ~(outward[:, 0] > 0)
        out |= (beyond == -1) & forwards & ~goal
        own = np.flatnonzero(beyond >= 0)
        source += [own, beyond[own]]
        target += [beyond[own], own]
        may += [forwards[own], backwards[own]]
    ways = np.concatenate(source) * n + np.concatenate(target)
    # Squares of one size are each other's neighbours: both have to let pass.
    order = np.argsort(ways, kind="stable")
    ways, first = np.unique(ways[order], return_index=True)
    ways = ways[np.logical_and.reduceat(np.concatenate(may)[order], first)]
    ways = ways[~goal[ways // n]]
    after = csr_array((np.ones(len(ways), np.int8), (ways // n, ways % n)), shape=(n, n))
    labels = connected_components(after, directed=True, connection="strong")[1]
    return _Graph(after, goal, out, labels, ~_moves(labels, facts)[labels] & ~goal)


def _moves(labels: IntArray, facts: FloatArray) -> BoolArray:
    """Tells of which sets there is a u with m . u > 0 on all of their squares."""
    order = np.argsort(labels, kind="stable")
    first = np.searchsorted(labels[order], np.arange(labels.max() + 1))
    least = np.minimum.reduceat(facts[order, ALONG], first, axis=0)
    # NaN is not above zero.
    return np.asarray((least > 0).any(axis=1))


def _basin(field: PlanarField, known: _Known, graph: _Graph) -> Basin:
    """Returns what a graph says of the box."""
    cells, grows = known.cells, known.growing(field, graph.stays)
    numbers, of_set = np.unique(graph.labels[graph.stays], return_inverse=True)
    left = np.bincount(of_set, ~grows[graph.stays]) == 0
    never = graph.stays.copy()
    never[graph.stays] = ~left[of_set]
    comes = graph.goal | ~graph.leads_to(graph.stays | graph.out)
    almost = graph.goal | ~graph.leads_to(never | graph.out)
    x, y = field.cloud.denormalize(cells.boxes.centers).T
    excluded = []
    for number, is_left in zip(numbers, left, strict=True):
        one = graph.labels == number
        center = (float(x[one].mean()), float(y[one].mean()))
        excluded.append(ExcludedSet(center, _part_of_box(field, cells, one), bool(is_left)))
    return Basin(
        cells,
        comes,
        _part_of_box(field, cells, comes),
        _part_of_box(field, cells, almost),
        tuple(sorted(excluded, key=lambda one: -one.area)),
        len(cells),
    )


def _grows(field: PlanarField, boxes: Boxes) -> BoolArray:
    """Tells on which squares (n,) div m > 0, of m times a positive function."""
    if not has_dual(field):
        return np.zeros(len(boxes), bool)
    chunks = (boxes[first : first + CHUNK] for first in range(0, len(boxes), CHUNK))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        lower = [
            direction_dual(field, chunk.patches).divergence.lower[:, 0] for chunk in chunks
        ]
    return np.concatenate(lower) > 0 if lower else np.zeros(0, bool)


def _part_of_box(field: PlanarField, cells: Cells, rows: BoolArray) -> float:
    """Returns the part of the field's box that some squares make up."""
    lower, upper = (field.cloud.normalize(corner) for corner in field.cloud.box)
    area = cells.areas_in(lower, upper)[rows].sum() / np.prod(upper - lower)
    return float((1 - SLACK * len(cells)) * area)
