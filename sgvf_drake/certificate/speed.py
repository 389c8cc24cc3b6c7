"""C2: m is nowhere zero on the tube {V <= c_in}, by bounds of it along a direction."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.division import Answer, Division, divide
from sgvf_drake.certificate.field_model import model_field
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.fields import GuidingField

SPEED = 0
"""The only column of the facts of a square: a bound of |m| from below."""


@dataclass(frozen=True, eq=False)
class Speed:
    """The question whether |m| >= delta wherever V <= c_in.

    Attributes:
        field: m.
        levels: V, in the field's normalised units.
        c_in: The level of the tube.
        delta: The speed.
        share: Squares are divided until the bound of |m| is at least this part of |m| at their
            centre.
    """

    field: GuidingField
    levels: MixtureModel
    c_in: float
    delta: float
    share: float

    def prove(self, boxes: Boxes, smallest: float) -> Division:
        """Answers it over squares that cover the tube."""
        return divide(boxes, self._ask, self._refute, smallest)

    def _ask(self, boxes: Boxes) -> Answer:
        facts = np.full((len(boxes), 1), np.nan)
        inside = self.levels.level_range(boxes)[0] <= self.c_in
        with np.errstate(over="ignore", invalid="ignore"):
            m = model_field(self.field, boxes[inside])
            # By the direction of m at the centre; a direction need not be exactly of length
            # one to bound |m|, but not longer.
            length = np.linalg.norm(m.value, axis=1, keepdims=True)
            along = m.weighted(m.value / ((1 + SLACK) * length))
            facts[inside, SPEED] = along.lower[:, 0]
        decided = ~inside
        wanted = np.maximum(self.delta, self.share * length[:, 0])
        decided[inside] = facts[inside, SPEED] >= wanted
        return Answer(decided, facts, int(inside.sum()))

    def _refute(self, z: FloatArray) -> BoolArray:
        _, V = self.levels.level_range(Boxes(z, np.zeros(len(z))))
        m = self.field(self.field.cloud.denormalize(z))
        return (self.c_in >= V) & (np.linalg.norm(m, axis=1) < self.delta)
