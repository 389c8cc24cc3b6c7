"""Closed orbits in rings: is there one only, and how long does a lap take?"""

from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.division import Answer, Division, divide
from sgvf_drake.certificate.expansions import RECIPROCAL
from sgvf_drake.certificate.field_model import dual_field, model_field
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.certificate.squares import Squares
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.fields import GuidingField

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
            divergence = dual_field(self.field, boxes[inside]).divergence
            facts[inside] = divergence.upper
        decided = ~inside | (facts[:, DIVERGENCE] < 0)
        return Answer(decided, facts, int(inside.sum()))

    def _refute(self, z: FloatArray) -> BoolArray:
        jacobian = self.field.value_and_jacobian(self.field.cloud.denormalize(z))[1]
        _, V = self.levels.level_range(Boxes(z, np.zeros(len(z))))
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
        fine = boxes.half <= FINE * Squares.of(self.field).unit
        decided = (facts[:, SLOWEST] > 0) & ((width <= CLOSE * facts[:, FASTEST]) | fine)
        return Answer(decided, facts, len(boxes))

    def _angular_speed(self, boxes: Boxes) -> TaylorModel:
        """Returns the models of (p x m) / |p|^2 with p = z - center, to the side."""
        position = TaylorModel.position(boxes)
        p = position + TaylorModel.constant(
            boxes.half, np.broadcast_to(-self.center, boxes.centers.shape)
        )
        # p x m is the product of m with p, turned by a quarter.
        quarter = np.array([-self.side, self.side], float)
        turned = TaylorModel(
            p.half, p.parts[..., ::-1] * quarter, np.ascontiguousarray(p.remainder[:, ::-1])
        )
        nearest = np.maximum(np.abs(p.value) - boxes.half[:, None], 0)
        least = float((nearest**2).sum(axis=1).min(initial=np.inf)) * (1 - SLACK)
        m = model_field(self.field, boxes)
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
