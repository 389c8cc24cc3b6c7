"""Walls around a tube in the plane: what enters between the outermost comes to the tube.

On either side of a thin tube runs a chain of closed polygons, each with a vertex for each
section of the tube.  Between two that follow each other, and two sections, is the image of a
square under the map F(t, s) of `tube`, with s growing to the left.  Over each such cell it is
proved that

- det [T, S] > 0, so that m has coordinates there, m = t_dot T + s_dot S;
- det [T, m] < 0 on the left of the tube, which is s_dot < 0, and > 0 on its right.

Neighbouring cells share a side, along which their s is the same.  So an orbit crosses all cells
from one polygon to the next, in a time that is no longer than 2 / |s_dot| in any cell, and
comes to the tube.  There is no gap: the first polygons are the walls of the tube.

Where the cells are depends on two polygons alone.  Cells fit together around each vertex once,
since their four corners there are convex, and all are the right way round.  So a point is in
as many of them, or of the tube, as the outermost polygon on the right winds more often around
it than that on the left (`Walls.hold`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.field_model import BoundedField, model_field
from sgvf_drake.certificate.kernels import SLACK, check_rounding
from sgvf_drake.certificate.tube import LARGEST, TICK, Tube, normal
from sgvf_drake.certificate.tube_cells import Answer, Division, Parts, divide
from sgvf_drake.compiling import kernel
from sgvf_drake.paths import Piece, ReferencePath

Polygon = tuple[tuple[int, int], ...]
# Beyond the rounding of coordinates, by far.
OFF = 1e-9
# Cells are halved so often, at most, along or across.
HALVINGS = 8
# Parts of cells and of walls are halved until the bound of the speed at which m crosses is such
# a part of that at the middle, or so often.
SHARP, SHARPEST, FOR_SPEED = 0.5, 0.9, 2


@dataclass(frozen=True)
class Walls:
    """Pairs of walls around a closed tube in the plane, from the tube outwards.

    Attributes:
        left: Polygons on the left of the tube, of whole numbers, in ticks.
        right: As many on its right.

    Raises:
        ValueError: If they are not as many, or not of as many points of two whole numbers up to
            `LARGEST`.
    """

    left: tuple[Polygon, ...]
    right: tuple[Polygon, ...]

    def __post_init__(self) -> None:
        if len(self.left) != len(self.right):
            raise ValueError(f"{len(self.left)} walls on the left and {len(self.right)} right")
        ticks = np.array([self.left, self.right])
        if ticks.ndim != 4 or ticks.shape[3] != 2 or ticks.dtype.kind != "i":
            raise ValueError(
                "walls are pairs of polygons with as many vertices of whole numbers"
            )
        if np.abs(ticks).max() > LARGEST:
            raise ValueError(f"walls are of whole numbers up to {LARGEST}")

    @classmethod
    def through(cls, left: FloatArray, right: FloatArray) -> "Walls":
        """Returns the walls nearest to polygons (p, K, 2) each, normalised."""
        sides = (np.rint(side / TICK).astype(int).tolist() for side in (left, right))
        return cls(*(tuple(tuple(map(tuple, wall)) for wall in side) for side in sides))

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "Walls":
        """Returns the walls of a JSON object.

        Raises:
            KeyError: If something is missing.
            TypeError: If it is not the object of walls.
            ValueError: If it is none, by what is said of the class.
        """
        sides = (body["left"], body["right"])
        return cls(*(tuple(tuple(map(tuple, wall)) for wall in side) for side in sides))

    def __len__(self) -> int:
        return len(self.left)

    def __getitem__(self, rows: slice) -> "Walls":
        return Walls(self.left[rows], self.right[rows])

    @cached_property
    def _polygons(self) -> dict[int, FloatArray]:
        """By the side, since a live flight asks for them all the time."""
        return {1: TICK * np.array(self.left, float), -1: TICK * np.array(self.right, float)}

    def polygons(self, side: int) -> FloatArray:
        """Returns the walls on the left (1) or the right (-1), (p, K, 2), normalised."""
        return self._polygons[side]

    def fit(self, tube: Tube) -> bool:
        """Whether they have a vertex for each section of a closed tube in the plane."""
        sections = np.array(tube.sections)
        return tube.closed and self.polygons(1).shape[1:] == sections.shape[:2]

    def hold(self, boxes: Boxes) -> tuple[BoolArray, BoolArray]:
        """Tells which squares (n,) are all between the outermost walls, and which none of."""
        return self._held_by(-1, boxes)

    def _held_by(self, pair: int, boxes: Boxes) -> tuple[BoolArray, BoolArray]:
        winds, apart = np.zeros(len(boxes)), np.ones(len(boxes), bool)
        for side in (1, -1):
            turns, met = meet_and_wind(self.polygons(side)[pair], boxes)
            winds -= side * turns
            apart &= ~met
        return apart & (winds > 0), apart & (winds <= 0)

    def count_around(self, points: FloatArray) -> IntArray:
        """Returns how many pairs hold each of normalised points (n, 2), from the outermost."""
        boxes = Boxes.points(points)
        held = [self._held_by(pair, boxes)[0] for pair in range(len(self))]
        return np.asarray(np.sum(held, axis=0))

    def half_widths(self, tube: Tube) -> list[float]:
        """Returns how far the vertices of each pair are from the tube's middle, at most."""
        off = np.array([self.polygons(side) - tube.rows[:-1, 0] for side in (1, -1)])
        return list(np.linalg.norm(off, axis=3).max(axis=(0, 2)).tolist())

    @property
    def narrowest(self) -> float:
        """The least distance of a vertex of an outermost wall from the other wall."""
        left, right = (Piece(self.polygons(side)[-1], closed=True) for side in (1, -1))
        return float(ReferencePath((right,)).project(left.vertices).distance.min())


def meet_and_wind(polygon: FloatArray, boxes: Boxes) -> tuple[FloatArray, BoolArray]:
    """Returns how often a polygon (K, 2) winds around squares (n,), and which it meets.

    Where it meets a square, or comes as near as rounding could hide that, the first means
    nothing.
    """
    return _around(polygon, boxes.centers, boxes.half)


@kernel
def _around(
    polygon: FloatArray, centers: FloatArray, half: FloatArray
) -> tuple[FloatArray, BoolArray]:
    """Returns the winding numbers of `meet_and_wind`, of the centres, and what is met.

    Args:
        polygon: (K, 2) its vertices.
        centers: (n, 2).
        half: (n,) half-sides.
    """
    winds, met = np.zeros(len(half)), np.zeros(len(half), np.bool_)
    for k in range(len(polygon)):
        ax, ay = polygon[k - 1]
        bx, by = polygon[k]
        dx, dy = bx - ax, by - ay
        for i in range(len(half)):
            px, py = centers[i]
            reach = half[i] + OFF
            # Which side of the line of the edge the centre is on.
            left = dx * (py - ay) - (px - ax) * dy
            if (
                min(ax, bx) <= px + reach
                and max(ax, bx) >= px - reach
                and min(ay, by) <= py + reach
                and max(ay, by) >= py - reach
                and abs(left) <= reach * (abs(dx) + abs(dy))
            ):
                met[i] = True
            # Edges that pass the height of the centre on its right, upwards less downwards.
            if (ay <= py) != (by <= py) and (dy > 0) == (left > 0):
                winds[i] += 1.0 if dy > 0 else -1.0
    return winds, met


@dataclass(frozen=True, eq=False)
class WallsProof:
    """What is proved of walls.

    Attributes:
        proved: How many pairs are proved, from the tube outwards.
        e_star: The disturbance that each of these tolerates at least: what is between the two
            walls stays there under x_dot = m + d with |d| below it.
        entry_times: The time from each of these to the tube at most, at |m| = 1 in normalised
            units of length.
        patches: How many patches the field was bounded over.
    """

    proved: int
    e_star: tuple[float, ...]
    entry_times: tuple[float, ...]
    patches: int


def prove_walls(field: BoundedField, tube: Tube, walls: Walls) -> WallsProof:
    """Proves that what enters between walls comes to the tube.

    Args:
        field: m, in the plane.
        tube: A closed tube in the plane.
        walls: Walls around it.

    Raises:
        ConfigurationError: If the field is of a kind that nothing bounds.
        RuntimeError: If the process does not round to nearest.
        ValueError: If the walls are not those of such a tube.
    """
    check_rounding()
    if not walls.fit(tube):
        raise ValueError("walls have a vertex for each section of a closed tube in the plane")
    middle, half = tube.rows[:-1, 0], tube.rows[:-1, 1]
    inner = {side: middle + side * half for side in (1, -1)}
    patches, time = 0, 0.0
    e_star, entry_times = [], []
    # What overflows is not below any bound.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for pair in range(len(walls)):
            outer = {side: walls.polygons(side)[pair] for side in (1, -1)}
            questions = [_cross(field, inner[side], outer[side], side) for side in (1, -1)]
            patches += sum(question.asked for question in questions)
            if any(len(question.open_cells) for question in questions):
                break
            time += max(float(question.facts.max()) for question in questions) * (1 + SLACK)
            margins = [_tolerated(field, outer[side], side) for side in (1, -1)]
            patches += sum(margin.asked for margin in margins)
            open_margin = any(len(margin.open_cells) for margin in margins)
            least = min(float(margin.facts.min(initial=np.inf)) for margin in margins)
            e_star.append(0.0 if open_margin else least)
            entry_times.append(time)
            inner = outer
    return WallsProof(len(e_star), tuple(e_star), tuple(entry_times), patches)


def _cross(field: BoundedField, inner: FloatArray, outer: FloatArray, side: int) -> Division:
    """Answers whether orbits cross all cells between two polygons, and how fast."""
    rows = np.stack([(inner + outer) / 2, side * (outer - inner) / 2], axis=1)
    cells = Parts(rows, np.roll(rows, -1, axis=0), np.arange(len(rows)))
    widest = np.linalg.norm([cells.start[:, 1], cells.end[:, 1]], axis=2).max(axis=0)
    ask = partial(_ask_inward, field, -side, widest)
    return divide(cells, ask, Parts.longer_halves, halvings=HALVINGS)


def _tolerated(field: BoundedField, polygon: FloatArray, side: int) -> Division:
    """Answers how fast m points inward on a wall."""
    rows = polygon[:, None]
    sides = Parts(rows, np.roll(rows, -1, axis=0), np.arange(len(rows)))
    return divide(sides, partial(_ask_tolerated, field, -side))


def _ask_inward(
    field: BoundedField, sign: int, widest: FloatArray, parts: Parts, depth: int
) -> Answer:
    """Asks whether m points towards the tube all over parts of cells, and how fast.

    That is how long it would take from the outer side of a whole cell to the inner one, at
    most: 2 / |s_dot|.

    Args:
        field: m.
        sign: See `tube._ask_wall`.
        widest: (K,) the largest |S| of the whole cells: so many times |S| of a part, or fewer,
            is the whole of what s goes over there.
        parts: The parts.
        depth: How often they were halved.
    """
    along, across = parts.columns
    outward = normal([along]).scaled(float(sign)).dot(model_field(field, parts.patches))
    volume = normal([across]).dot(along)
    inward, most = -outward.upper[:, 0], volume.upper[:, 0]
    decided = (inward > 0) & (volume.lower[:, 0] > 0)
    decided &= (inward >= SHARP * -outward.value[:, 0]) | (depth >= FOR_SPEED)
    refuted = (outward.lower[:, 0] >= 0) | (most <= 0)
    parts_of_it = widest[parts.cell] / np.linalg.norm(parts.start[:, 1], axis=1)
    times = (1 + SLACK) * 2 * parts_of_it * most / inward
    return Answer(decided & np.isfinite(times), refuted, times[:, None])


def _ask_tolerated(field: BoundedField, sign: int, parts: Parts, depth: int) -> Answer:
    """Asks how fast m points inward all over parts of walls, at least."""
    along = parts.columns[0]
    outward = normal([along]).scaled(float(sign)).dot(model_field(field, parts.patches))
    inward = -outward.upper[:, 0] / np.linalg.norm(along.value, axis=1) * (1 - SLACK)
    sharp = outward.upper[:, 0] <= SHARPEST * outward.value[:, 0]
    decided = (inward > 0) & (sharp | (depth >= FOR_SPEED))
    return Answer(decided, outward.lower[:, 0] >= 0, inward[:, None])
