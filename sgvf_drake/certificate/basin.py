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

Walks along a slanted line that leads to a saddle go astray over squares beside it.  So `fences`
are laid around such lines, into which no robot comes from outside.  Who is outside walks on
squares that are not all within a fence; who is within for good, on those that are not all
outside.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.cells import SIDES, UNIT, Cells
from sgvf_drake.certificate.fence_search import FINE, fence_upstream, fences_around_zeros
from sgvf_drake.certificate.fences import Fence, Fenced, Fences
from sgvf_drake.certificate.field_model import (
    PerturbedField,
    direction_dual,
    direction_model,
    has_dual,
)
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.certificate.walls import Walls
from sgvf_drake.fields import GuidingField
from sgvf_drake.progress import Progress, no_progress

PlanarField = GuidingField | PerturbedField

Ask = Callable[[Boxes], FloatArray]
"""From squares to a fact of each (n,)."""

# Directions u that are tried.
ANGLES = np.linspace(0, 2 * np.pi, 32, endpoint=False)
DIRECTIONS = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)
# What is known of m on a square, but for a positive factor: of its part across each of `SIDES`,
# along the axis of that, at least and at most; and of m . u for each direction, at least.
LEAST, MOST, ALONG = slice(0, 4), slice(4, 8), slice(8, 8 + len(DIRECTIONS))
# And div m, at least; after that, how fast m leads away from each closed fence (`_away`).  Both
# are asked where robots may stay.
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
        fences: Fences that robots cross outward alone.
        comes: (n,) whether every robot from a square comes between the walls.
        area: The part of the box that these make up.
        almost: The part from which almost every robot comes there.
        excluded: The sets in which robots may stay.
        evaluated: Over how many squares the field was bounded.
    """

    cells: Cells
    fences: tuple[Fence, ...]
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
        fenced: How they lie to fences.
        goal: (n,) which are between walls.
        facts: (n, 9 + u + f) of the others; NaN of these, and where nothing was asked yet.
    """

    cells: Cells
    fenced: Fenced
    goal: BoolArray
    facts: FloatArray

    @classmethod
    def of(
        cls, field: PlanarField, cells: Cells, walls: Sequence[Walls], fences: Fences
    ) -> "_Known":
        """Finds out about squares."""
        boxes, goal = cells.boxes, np.zeros(len(cells), bool)
        for one in walls:
            goal |= one.hold(boxes)[0]
        facts = np.full((len(cells), 1 + GROWS + len(fences.closed)), np.nan)
        asked = boxes[~goal]
        chunks = (asked[first : first + CHUNK] for first in range(0, len(asked), CHUNK))
        facts[~goal, :GROWS] = np.concatenate(
            [np.empty((0, GROWS)), *(facts_of(field, chunk) for chunk in chunks)]
        )
        return cls(cells, fences.around(boxes), goal, facts)

    def beside(self, fences: Fences) -> "_Known":
        """Returns the same with other fences."""
        facts = np.full((len(self.cells), 1 + GROWS + len(fences.closed)), np.nan)
        facts[:, : 1 + GROWS] = self.facts[:, : 1 + GROWS]
        return _Known(self.cells, fences.around(self.cells.boxes), self.goal, facts)

    def asked(self, rows: BoolArray, column: int, ask: Ask) -> FloatArray:
        """Returns facts (n,) that are asked of some squares (n,) alone, and of each once."""
        unknown = rows & np.isnan(self.facts[:, column])
        boxes = self.cells[unknown].boxes
        chunks = (boxes[first : first + CHUNK] for first in range(0, len(boxes), CHUNK))
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            found = [np.empty(0), *(ask(chunk) for chunk in chunks)]
        self.facts[unknown, column] = np.concatenate(found)
        return self.facts[:, column]

    def growing(self, field: PlanarField, rows: BoolArray) -> BoolArray:
        """Tells on which of some squares (n,) div m > 0."""
        if not has_dual(field):
            return np.zeros_like(rows)
        return rows & (self.asked(rows, GROWS, partial(_divergence, field)) > 0)

    @property
    def evaluated(self) -> int:
        """Over how many squares the field was bounded."""
        return int((~self.goal).sum())

    def replaced(self, rows: BoolArray, other: "_Known") -> "_Known":
        """Returns what is known of these squares, but for other ones in the place of some."""
        return _Known(
            self.cells[~rows].joined(other.cells),
            self.fenced.replaced(rows, other.fenced),
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
    """How some squares lead to each other.

    Attributes:
        after: (n, n) which square leads to which; the goal to none.
        out: (n,) which lead out of the box.
        labels: (n,) the set of squares that lead to each other.
        stays: (n,) whether orbits may stay in the set.
    """

    after: csr_array
    out: BoolArray
    labels: IntArray
    stays: BoolArray

    @classmethod
    def of(cls, known: "_Known", ways: IntArray, out: BoolArray, rows: BoolArray) -> "_Graph":
        """Returns that of some squares (n,), by the ways (w, 2) between all."""
        n = len(rows)
        source, target = ways[rows[ways].all(axis=1)].T
        after = csr_array((np.ones(len(source), np.int8), (source, target)), shape=(n, n))
        labels = connected_components(after, directed=True, connection="strong")[1]
        stays = ~_above_zero(labels, known.facts[:, ALONG]) & ~known.goal & rows
        return cls(after, out & rows, labels, stays)

    def going_away(self, field: PlanarField, known: "_Known", fences: Fences) -> "_Graph":
        """Returns the same without the sets in which robots go away from inside a fence."""
        stays = self.stays
        for column, fence in enumerate(fences.closed, GROWS + 1):
            away = known.asked(stays, column, partial(_away, field, fence))
            stays = stays & ~_above_zero(self.labels, away[:, None])
        return replace(self, stays=stays)

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


@dataclass(frozen=True, eq=False)
class _Graphs:
    """How squares lead to each other, and what that says.

    Attributes:
        outside: The graph of the squares that are not all within a fence.
        inside: That of the squares that are not all outside of fences.
    """

    outside: _Graph
    inside: _Graph

    @property
    def stays(self) -> BoolArray:
        """In which squares (n,) robots may stay: for good outside of fences, or within."""
        return self.outside.stays | self.inside.stays


Look = Callable[[GuidingField, _Known, _Graphs], list[Fence]]
"""Proposes fences."""


def find_basin(
    field: GuidingField, walls: Sequence[Walls], progress: Progress = no_progress
) -> Basin:
    """Proves from where robots come between walls, and divides squares where that helps.

    Args:
        field: The field, in the plane.
        walls: Walls that are proved.
        progress: Told how far it is.
    """
    fences, lost = Fences.proved(field, ()), 1.0
    looks: list[Look] = [_beside_lines, _around_zeros]
    known = _Known.of(field, _around(walls), walls, fences)
    evaluated = known.evaluated
    for number in count():
        progress("cells", min(number, ROUNDS), ROUNDS)
        graphs = _graphs(field, known, fences)
        divisible = _staying(field, known, graphs)
        if not 0 < divisible.sum() <= MOST_AT_ONCE:
            leads = ~_comes(known, graphs)
            before, lost = lost, _part_of_box(field, known.cells, leads)
            gains = before - lost > GAIN
            divisible = leads & ~known.fenced.within & (known.cells.size > 1) & gains
            # Fences around zeros come first, and others where nothing else helps.
            if lost > FEW and looks and (len(looks) > 1 or not gains):
                fences = fences.joined(Fences.proved(field, looks.pop()(field, known, graphs)))
                known = known.beside(fences)
                divisible = known.fenced.met & (UNIT * known.cells.size > FINE)
                if looks and not divisible.any():
                    continue
        if not 0 < divisible.sum() <= MOST_AT_ONCE:
            break
        parts = _Known.of(field, known.cells[divisible].quarters(), walls, fences)
        evaluated += parts.evaluated
        known = known.replaced(divisible, parts)
    progress("cells", ROUNDS, ROUNDS)
    return replace(_basin(field, known, graphs, fences), evaluated=evaluated)


def _around_zeros(field: GuidingField, known: _Known, graphs: _Graphs) -> list[Fence]:
    return fences_around_zeros(field)


def _beside_lines(field: GuidingField, known: _Known, graphs: _Graphs) -> list[Fence]:
    """Returns fences upstream of where robots may stay outside of fences."""
    graph, boxes = graphs.outside, known.cells.boxes
    fences: list[Fence] = []
    left = graph.stays & ~known.fenced.touched
    while left.any():
        # What is downstream comes first: its fence holds what is upstream too.
        reached = breadth_first_order(graph.after, np.argmax(left), return_predecessors=False)
        last = reached[left[reached]][-1]
        left[graph.labels == graph.labels[last]] = False
        if (fence := fence_upstream(field, boxes.centers[last])) is not None:
            fences.append(fence)
            left[left] = ~Fences((fence,)).around(boxes[left]).touched
    return fences


def _staying(field: PlanarField, known: _Known, graphs: _Graphs) -> BoolArray:
    """Tells which squares (n,) to divide of those where robots may stay."""
    found = graphs.stays & (known.cells.size > 1)
    if _part_of_box(field, known.cells, found) > FEW:
        return found
    return found & ~known.growing(field, found)


def prove_basin(
    field: PlanarField,
    cells: Cells,
    walls: Sequence[Walls],
    fences: Sequence[Fence] = (),
    roughly: PlanarField | None = None,
) -> Basin:
    """Proves from which squares robots come between walls.

    Args:
        field: The field, in the plane.
        cells: Squares that cover the box.
        walls: Walls that are proved.
        fences: Fences, proved or not.
        roughly: The field with bounds that cost less; the others are then asked only of squares
            of which these do not prove it.
    """
    proved = Fences.proved(field, fences)
    known = _Known.of(roughly or field, cells, walls, proved)
    graphs = _graphs(field, known, proved)
    if roughly is not None:
        lost = ~_comes(known, graphs)
        known = known.replaced(lost, _Known.of(field, known.cells[lost], walls, proved))
        graphs = _graphs(field, known, proved)
    return _basin(field, known, graphs, proved)


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


def _graphs(field: PlanarField, known: _Known, fences: Fences) -> _Graphs:
    ways, out = _ways(known)
    outside = _Graph.of(known, ways, out, ~known.fenced.within)
    inside = _Graph.of(known, ways, out, known.fenced.touched)
    return _Graphs(outside.going_away(field, known, fences), inside)


def _ways(known: _Known) -> tuple[IntArray, BoolArray]:
    """Returns which squares lead to which (w, 2), and which (n,) out of the box."""
    cells, goal = known.cells, known.goal
    least, most = known.facts[:, LEAST], known.facts[:, MOST]
    out, ways = np.zeros(len(cells), bool), []
    for k, (axis, sign) in enumerate(SIDES):
        beyond = cells.neighbours(axis, sign)
        own = np.flatnonzero(beyond != -2)
        other, low, high = beyond[own], least[own, k], most[own, k]
        # Squares of one size share the side, of which they know by themselves.
        alike = (other >= 0) & (cells.size[own] == cells.size[other])
        low[alike] = np.fmax(low[alike], least[other[alike], k ^ 1])
        high[alike] = np.fmin(high[alike], most[other[alike], k ^ 1])
        forwards, backwards = (~(high < 0), ~(low > 0))[::sign]
        forwards &= ~goal[own]
        out[own] |= forwards & (other == -1)
        forwards &= other >= 0
        # Those of another size do not come to it from the other side.
        backwards &= (other >= 0) & ~goal[other] & ~alike
        pairs = np.column_stack([own, other])
        ways += [pairs[forwards], pairs[backwards, ::-1]]
    return np.concatenate(ways), out


def _comes(known: _Known, graphs: _Graphs) -> BoolArray:
    """Tells from which squares (n,) every robot comes between walls."""
    outside, fenced = graphs.outside, known.fenced
    lost = outside.leads_to(outside.stays | outside.out | fenced.at_gate)
    return known.goal | ~(lost | fenced.touched)


def _above_zero(labels: IntArray, facts: FloatArray) -> BoolArray:
    """Tells which squares (n,) are of a set on which one of the facts (n, f) is above zero."""
    order = np.argsort(labels, kind="stable")
    first = np.searchsorted(labels[order], np.arange(labels.max() + 1))
    least = np.minimum.reduceat(facts[order], first, axis=0)
    # NaN is not above zero.
    return np.any(least > 0, axis=1)[labels]


def _basin(field: PlanarField, known: _Known, graphs: _Graphs, fences: Fences) -> Basin:
    """Returns what graphs say of the box."""
    cells, grows = known.cells, known.growing(field, graphs.stays)
    comes, excluded = _comes(known, graphs), []
    whole = _Graph.of(known, *_ways(known), np.ones_like(comes))
    # Who passes gates again and again is neither outside nor inside for good.
    never = whole.stays & known.fenced.at_gate
    for graph in (graphs.outside, graphs.inside):
        sets, left = _excluded(field, known, graph, grows)
        excluded += sets
        never |= graph.stays & ~left
    almost = comes | ~whole.leads_to(never | whole.out)
    return Basin(
        cells,
        fences.fences,
        comes,
        _part_of_box(field, cells, comes),
        _part_of_box(field, cells, almost),
        tuple(sorted(excluded, key=lambda one: -one.area)),
        len(cells),
    )


def _excluded(
    field: PlanarField, known: _Known, graph: _Graph, grows: BoolArray
) -> tuple[list[ExcludedSet], BoolArray]:
    """Returns the sets of a graph in which robots may stay, and in which div m > 0, (n,)."""
    rows = np.flatnonzero(graph.stays)
    _, numbers = np.unique(graph.labels[rows], return_inverse=True)
    left = np.bincount(numbers, ~grows[rows]) == 0
    places = field.cloud.denormalize(known.cells.boxes.centers[rows])
    x, y = (np.bincount(numbers, place) / np.bincount(numbers) for place in places.T)
    areas = np.bincount(numbers, _parts_of_box(field, known.cells)[rows])
    sets = [
        ExcludedSet((x, y), area, is_left)
        for x, y, area, is_left in zip(
            x.tolist(), y.tolist(), areas.tolist(), left.tolist(), strict=True
        )
    ]
    growing = np.zeros_like(graph.stays)
    growing[rows] = left[numbers]
    return sets, growing


def _divergence(field: PlanarField, boxes: Boxes) -> FloatArray:
    """Returns what div m is on squares (n,) at least, of m times a positive function."""
    return direction_dual(field, boxes.patches).divergence.lower[:, 0]


def _away(field: PlanarField, fence: Fence, boxes: Boxes) -> FloatArray:
    """Returns how fast m leads away from the middle of a fence on squares (n,), at least.

    That is m . Q (z - c), by `Fence.ellipse`, of m times a positive function.
    """
    center, Q = fence.ellipse
    off = TaylorModel.position(boxes.patches).shifted(-center)
    outward = [off.weighted(np.broadcast_to(row, off.value.shape)) for row in Q]
    m = direction_model(field, boxes.patches)
    return m.dot(outward[0].joined(*outward[1:])).lower[:, 0]


def _part_of_box(field: PlanarField, cells: Cells, rows: BoolArray) -> float:
    """Returns the part of the field's box that some squares make up."""
    return float((1 - SLACK * len(cells)) * _parts_of_box(field, cells)[rows].sum())


def _parts_of_box(field: PlanarField, cells: Cells) -> FloatArray:
    """Returns the part (n,) of the field's box that each square makes up."""
    lower, upper = (field.cloud.normalize(corner) for corner in field.cloud.box)
    return cells.areas_in(lower, upper) / np.prod(upper - lower)
