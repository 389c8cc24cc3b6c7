"""Walls around a tube in the plane: what enters between the outermost comes to the tube.

On either side of a thin tube runs a chain of closed polygons, each with a vertex for each
section of the tube.  Between two that follow each other, and two sections, is the image of a
square under the map F(t, s) of `tube`, with s above zero on the left.  Over each such cell it is
proved that

- det [T, S] > 0, so that m has coordinates there, m = t_dot T + s_dot S;
- det [T, m] < 0 on the left of the tube, which is s_dot < 0, and > 0 on the right.

Neighbouring cells share a side, along which their s is the same.  So |s| falls for ever, and by
more than some number in each unit of time, until the tube is reached.  There is no gap: the first
polygons are the walls of the tube.

Where the cells are depends on two polygons alone.  They fit together like a map (four convex
corners around each vertex have less than two full turns, so they have one), and each covers what
it does with the same orientation.  So a point is in as many cells as the right polygon winds more
often around it than the left one (`Walls.hold`).
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.field_model import BoundedField, model_field
from sgvf_drake.certificate.kernels import SLACK, check_rounding
from sgvf_drake.certificate.tube import LARGEST, TICK, Tube, normal
from sgvf_drake.certificate.tube_cells import Answer, Parts, divide
from sgvf_drake.paths import Piece, ReferencePath

Polygon = tuple[tuple[int, int], ...]
# Beyond the error of a projected distance, and the rounding of a winding number, by far.
OFF = 1e-5
# Walls are halved until the bound of the speed at which m crosses is so sharp, or so often.
SHARP, FOR_MARGIN = 0.95, 3
# Points whose winding numbers are counted at a time.
CHUNK = 2000


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
        ticks = np.array([self.left, self.right])
        if ticks.ndim != 4 or ticks.shape[3] != 2 or ticks.dtype.kind != "i":
            raise ValueError("walls are pairs of polygons with as many vertices of whole numbers")
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

    def polygons(self, side: int) -> FloatArray:
        """Returns the walls on the left (1) or the right (-1), (p, K, 2), normalised."""
        return TICK * np.array(self.left if side > 0 else self.right, float)

    def hold(self, boxes: Boxes) -> BoolArray:
        """Tells which squares (n,) are all between the outermost walls."""
        outer = {side: self.polygons(side)[-1] for side in (1, -1)}
        border = ReferencePath(tuple(Piece(line, closed=True) for line in outer.values()))
        apart = border.project(boxes.centers).distance > np.sqrt(2) * boxes.half + OFF
        x = boxes.centers[apart]
        held = np.zeros(len(boxes), bool)
        held[apart] = winding_numbers(outer[-1], x) > winding_numbers(outer[1], x)
        return held


def winding_numbers(polygon: FloatArray, x: FloatArray) -> FloatArray:
    """Returns how often a polygon (K, 2) winds around points (n, 2) that are off it, (n,)."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    parts = []
    for first in range(0, len(x), CHUNK):
        p = x[first : first + CHUNK, None]
        # Edges that pass the height of the point on its right, upwards less downwards.
        left = np.sign(
            (b[:, 0] - a[:, 0]) * (p[..., 1] - a[:, 1])
            - (p[..., 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
        )
        up = (a[:, 1] <= p[..., 1]).astype(int) - (b[:, 1] <= p[..., 1])
        parts.append(np.where(up == left, up, 0).sum(axis=1))
    return np.concatenate(parts) if parts else np.zeros(0)


@dataclass(frozen=True, eq=False)
class WallsProof:
    """What is proved of walls.

    Attributes:
        proved: How many pairs are proved, from the tube outwards.
        e_star: The disturbance that each of these tolerates at least: what is between the two
            walls stays there under x_dot = m + d with |d| below it.
        patches: How many patches the field was bounded over.
    """

    proved: int
    e_star: tuple[float, ...]
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
    if not tube.closed or np.array(walls.left).shape[1:] != (len(tube.sections), 2):
        raise ValueError("walls have a vertex for each section of a closed tube in the plane")
    middle, half = tube.rows[:-1, 0], tube.rows[:-1, 1]
    inner = {side: middle + side * half for side in (1, -1)}
    patches, e_star = 0, []
    # What overflows is not below any bound.
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        for pair in range(len(walls)):
            tolerated = []
            for side in (1, -1):
                outer = walls.polygons(side)[pair]
                cells = _between(inner[side], outer, side)
                found = divide(cells, partial(_ask_inward, field, -side), Parts.longer_halves)
                patches += found.asked
                if len(found.open_cells):
                    return WallsProof(pair, tuple(e_star), patches)
                wall = divide(_along(outer), partial(_ask_tolerated, field, -side))
                patches += wall.asked
                tolerated.append(float(wall.facts.min()) if not len(wall.open_cells) else 0.0)
                inner[side] = outer
            e_star.append(min(tolerated))
    return WallsProof(len(walls), tuple(e_star), patches)


def _between(inner: FloatArray, outer: FloatArray, side: int) -> Parts:
    """Returns the cells between two polygons."""
    rows = np.stack([(inner + outer) / 2, side * (outer - inner) / 2], axis=1)
    return Parts(rows, np.roll(rows, -1, axis=0), np.arange(len(rows)))


def _along(polygon: FloatArray) -> Parts:
    """Returns the sides of a polygon."""
    rows = polygon[:, None]
    return Parts(rows, np.roll(rows, -1, axis=0), np.arange(len(rows)))


def _ask_inward(field: BoundedField, sign: int, parts: Parts, _: int) -> Answer:
    """Asks whether m points towards the tube all over parts of cells; see `tube._ask_wall`."""
    along, across = parts.columns
    outward = normal([along]).scaled(float(sign)).dot(model_field(field, parts.patches))
    volume = normal([across]).dot(along)
    decided = (outward.upper[:, 0] < 0) & (volume.lower[:, 0] > 0)
    refuted = (outward.lower[:, 0] >= 0) | (volume.upper[:, 0] <= 0)
    return Answer(decided, refuted, np.empty((len(parts), 0)))


def _ask_tolerated(field: BoundedField, sign: int, parts: Parts, depth: int) -> Answer:
    """Asks how fast m points inward all over parts of walls, at least."""
    along = parts.columns[0]
    outward = normal([along]).scaled(float(sign)).dot(model_field(field, parts.patches))
    sharp = outward.upper[:, 0] <= SHARP * outward.value[:, 0]
    inward = -outward.upper[:, 0] / np.linalg.norm(along.value, axis=1) * (1 - SLACK)
    decided = (inward > 0) & (sharp | (depth >= FOR_MARGIN))
    return Answer(decided, outward.lower[:, 0] >= 0, inward[:, None])
