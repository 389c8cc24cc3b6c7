"""Closed orbits: rings that hold one, whether it is the only one, and the time of a lap."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.boxes import Answer, Boxes, BoxSizes, Division, divide
from sgvf_drake.certificate.expansions import RECIPROCAL
from sgvf_drake.certificate.field_model import dual_field, model_field
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.certificate.patches import Patches, on_grid
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.fields import GuidingField

# Beyond the rounding of corners and middles, relative to the normalised unit, by far.
ROUNDING = 1e-12
# Angles between neighbours are at least this, and the sum of all is a turn within it.
SMALLEST_ANGLE, TURN_TOLERANCE = 1e-9, 1e-6


@dataclass(frozen=True)
class Annulus:
    """What is between two polygons whose corners lie on common rays from a centre.

    Attributes:
        center: (2,) c, in normalised units, as all lengths here.
        vertices: (K, 2) a polygon in the middle, counter-clockwise around c.
        widths: (K,) how far the two polygons are from each vertex along its ray.
    """

    center: tuple[float, float]
    vertices: tuple[tuple[float, float], ...]
    widths: tuple[float, ...]

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "Annulus":
        """Returns the ring of a JSON object.

        Raises:
            TypeError: The object is not that of a ring.
            ValueError: The same.
        """
        points = [(float(x), float(y)) for x, y in (body["center"], *body["vertices"])]
        return cls(points[0], tuple(points[1:]), tuple(map(float, body["widths"])))

    @property
    def borders(self) -> tuple[FloatArray, FloatArray]:
        """The corners (K, 2) of the inner polygon and of the outer one, on the `GRID`."""
        center, rays = np.array(self.center), self._rays
        share = np.array(self.widths)[:, None] / np.linalg.norm(rays, axis=1, keepdims=True)
        return on_grid(center + (1 - share) * rays), on_grid(center + (1 + share) * rays)

    @property
    def is_ring(self) -> bool:
        """Whether both polygons go around the centre once, one inside of the other.

        With corners on common rays that turn one way, they are star-shaped, and in each
        sector between two rays their sides do not meet.
        """
        rays, widths = self._rays, np.array(self.widths)
        radii = np.linalg.norm(rays, axis=1)
        next_rays = np.roll(rays, -1, axis=0)
        cross = rays[:, 0] * next_rays[:, 1] - rays[:, 1] * next_rays[:, 0]
        angles = np.arctan2(cross, (rays * next_rays).sum(axis=1))
        return bool(
            len(widths) == len(rays) >= 3
            and (angles > SMALLEST_ANGLE).all()
            and abs(angles.sum() - 2 * np.pi) < TURN_TOLERANCE
            and ((widths > 1e3 * ROUNDING) & (widths < radii)).all()
        )

    def squares(self, fineness: int = 1) -> Boxes:
        """Returns squares that cover the ring, about as wide as it is or a part of that.

        Args:
            fineness: So many squares from one polygon to the other.
        """
        inner, outer = self.borders
        length = np.linalg.norm(np.roll(inner, -1, axis=0) - inner, axis=1)
        along = fineness * int(np.ceil(np.median(length / (2 * np.array(self.widths)))))
        s = np.linspace(0, 1, fineness + 1)[:, None, None, None]
        t = np.linspace(0, 1, along + 1)[:, None, None]
        across = (1 - s) * inner + s * outer
        points = (1 - t) * across + t * np.roll(across, -1, axis=2)
        corners = np.stack(
            [points[i : i + fineness, j : j + along] for i in (0, 1) for j in (0, 1)]
        ).reshape(4, -1, 2)
        low, high = corners.min(axis=0), corners.max(axis=0)
        half = (high - low).max(axis=1) / 2
        return Boxes((low + high) / 2, half + ROUNDING * (1 + np.abs(high).max()))

    @property
    def _rays(self) -> FloatArray:
        return np.asarray(np.array(self.vertices).reshape(-1, 2) - self.center)


# Times that a side is halved where its bound does not tell.
HALVINGS = 5


def is_trapping(field: GuidingField, annulus: Annulus) -> tuple[bool, int]:
    """Whether m points into a ring all along its border, and how many segments that took.

    At a corner m points into the half-planes of both sides, and so into the ring.

    Args:
        field: m.
        annulus: The ring, which has to be one (`Annulus.is_ring`).
    """
    inner, outer = annulus.borders
    # Out of the ring is to the right of the outer polygon and to the left of the inner one,
    # which is to the right when that is walked backwards.
    start = np.concatenate([outer, np.roll(inner, -1, axis=0)])
    end = np.concatenate([np.roll(outer, -1, axis=0), inner])
    segments = 0
    for _ in range(HALVINGS + 1):
        side = Patches.segments(start, end)
        step = side.axes[:, :, 0]
        with np.errstate(over="ignore", invalid="ignore"):
            outward = model_field(field, side).weighted(
                np.column_stack([step[:, 1], -step[:, 0]])
            )
        segments += len(side)
        still = ~(outward.upper[:, 0] < 0)
        if not still.any():
            return True, segments
        if (outward.value - outward.remainder > 0).any():
            break
        start, end = start[still], end[still]
        middle = (start + end) / 2
        start, end = np.concatenate([start, middle]), np.concatenate([middle, end])
    return False, segments


# Of the contraction: a bound of div m from above.
DIVERGENCE = 0
# Of the turning: bounds of the angular speed, in the direction of the lap.
SLOWEST, FASTEST = range(2)
# Squares are divided until the bounds of the angular speed are so close, relative to it, or
# until they are so small, in the unit of the squares; on sectors of which there are so many.
CLOSE, FINE = 0.1, 1 / 32
NUM_SECTORS = 720


@dataclass(frozen=True, eq=False)
class Contraction:
    """The question whether div m < 0 in a ring of {V <= c_in}.

    Then, by Dulac's criterion, a ring holds one closed orbit at most: two would have an
    area between them that m makes smaller and keeps.

    Attributes:
        field: m.
        levels: V, in the field's normalised units.
        c_in: The level of the tube.
    """

    field: GuidingField
    levels: MixtureModel
    c_in: float

    def prove(self, boxes: Boxes, smallest: float) -> Division:
        """Answers it over squares that cover the ring."""
        return divide(boxes, self._ask, self._refute, smallest)

    def _ask(self, boxes: Boxes) -> Answer:
        facts = np.full((len(boxes), 1), np.nan)
        inside = self.levels.level_range(boxes)[0] <= self.c_in
        with np.errstate(over="ignore", invalid="ignore"):
            divergence = dual_field(self.field, boxes[inside].patches).divergence
            facts[inside] = divergence.upper
        decided = ~inside | (facts[:, DIVERGENCE] < 0)
        return Answer(decided, facts, int(inside.sum()))

    def _refute(self, z: FloatArray) -> BoolArray:
        jacobian = self.field.value_and_jacobian(self.field.cloud.denormalize(z))[1]
        _, V = self.levels.level_range(Boxes.points(z))
        return (self.c_in >= V) & (np.trace(jacobian, 0, 1, 2) >= 0)


@dataclass(frozen=True, eq=False)
class Turning:
    """The question how fast m turns around a point.

    Attributes:
        field: m.
        center: (2,) the point, normalised.
        side: 1 where it turns counter-clockwise, -1 where it turns clockwise.
    """

    field: GuidingField
    center: FloatArray
    side: int

    @classmethod
    def about(cls, field: GuidingField, center: FloatArray, points: FloatArray) -> "Turning":
        """Returns the question to the side to which m turns at most of some points (n, 2)."""
        question = cls(field, center, 1)
        side = 1 if np.median(question.speed_at(points)) > 0 else -1
        return replace(question, side=side)

    def prove(self, boxes: Boxes, smallest: float) -> Division:
        """Answers it over squares."""
        return divide(boxes, self._ask, self._refute, smallest)

    def _ask(self, boxes: Boxes) -> Answer:
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            speed = self._angular_speed(boxes)
        facts = np.column_stack([speed.lower, speed.upper])
        width = facts[:, FASTEST] - facts[:, SLOWEST]
        fine = boxes.half <= FINE * BoxSizes.of(self.field).unit
        decided = (facts[:, SLOWEST] > 0) & ((width <= CLOSE * facts[:, FASTEST]) | fine)
        return Answer(decided, facts, len(boxes))

    def _angular_speed(self, boxes: Boxes) -> TaylorModel:
        """Returns the models of (p x m) / |p|^2 with p = z - center, to the side."""
        p = TaylorModel.position(boxes.patches).shifted(-self.center)
        # p x m is the product of m with p, turned by a quarter.
        turned = p.functions(slice(None, None, -1)).scaled(self.side * np.array([-1.0, 1.0]))
        nearest = np.maximum(np.abs(p.value) - boxes.half[:, None], 0)
        least = float((nearest**2).sum(axis=1).min(initial=np.inf)) * (1 - SLACK)
        m = model_field(self.field, boxes.patches)
        return turned.dot(m) * p.dot(p).apply(RECIPROCAL, least=least)

    def _refute(self, z: FloatArray) -> BoolArray:
        return self.speed_at(z) <= 0

    def speed_at(self, z: FloatArray) -> FloatArray:
        """Returns the angular speed at points (n, 2), to the side."""
        p, m = z - self.center, self.field(self.field.cloud.denormalize(z))
        cross = p[:, 0] * m[:, 1] - p[:, 1] * m[:, 0]
        return np.asarray(self.side * cross / (p**2).sum(axis=1))

    def lap_time(self, turning: Division) -> tuple[float, float]:
        """Returns bounds of the time of a lap in normalised units, from what was proved.

        While the orbit is in a sector it turns no slower and no faster than m does anywhere in
        the part of that sector that the squares cover.
        """
        boxes, facts = turning.boxes, turning.facts
        p = boxes.centers - self.center
        width = np.arcsin(np.minimum(np.sqrt(2) * boxes.half / np.linalg.norm(p, axis=1), 1))
        angle = np.arctan2(p[:, 1], p[:, 0])
        sector = 2 * np.pi / NUM_SECTORS
        # Beyond rounding by far.
        first = np.floor((angle - width - 1e-9) / sector).astype(int)
        last = np.floor((angle + width + 1e-9) / sector).astype(int)
        slowest, fastest = np.full(NUM_SECTORS, np.inf), np.zeros(NUM_SECTORS)
        for step in range(int((last - first).max()) + 1):
            at = np.minimum(first + step, last) % NUM_SECTORS
            np.minimum.at(slowest, at, facts[:, SLOWEST])
            np.maximum.at(fastest, at, facts[:, FASTEST])
        rounding = SLACK * NUM_SECTORS
        return (
            float((sector / fastest).sum() * (1 - rounding)),
            float((sector / slowest).sum() * (1 + rounding)),
        )
