"""C1: V falls along m on a band of levels, by bounds of V_dot over squares."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.division import Answer, Division, divide
from sgvf_drake.certificate.field_model import model_field
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.certificate.taylor_model import TaylorModel
from sgvf_drake.fields import GuidingField

LOW, HIGH, RATE, MARGIN, STEP = range(5)
"""Columns of the facts of a square: bounds of V; a bound from above of V_dot where V is in the
band; bounds from below there of -V_dot / |grad V|, the speed at which m crosses the levels, and
of -V_dot / |m|^2."""


@dataclass(frozen=True, eq=False)
class Decrease:
    """The question whether V_dot <= -alpha wherever c_in <= V <= c_out.

    Attributes:
        field: m.
        levels: V, in the field's normalised units.
        c_in: The lowest level of the band.
        c_out: The highest.
        alpha: The rate, per normalised unit of length.
        share: Squares are divided until the bound of V_dot is at least this part of V_dot at
            their centre; at zero alpha alone is proved, which says little of the rate.
    """

    field: GuidingField
    levels: MixtureModel
    c_in: float
    c_out: float
    alpha: float
    share: float

    def prove(self, boxes: Boxes, smallest: float) -> Division:
        """Answers it over squares that cover the band."""
        return divide(boxes, self._ask, self._refute, smallest)

    def explore(self, boxes: Boxes, smallest: float) -> Division:
        """Answers it on as many squares as it can; on the others it is undecided."""
        return divide(boxes, self._ask, lambda z: np.zeros(len(z), bool), smallest)

    def _ask(self, boxes: Boxes) -> Answer:
        facts = np.full((len(boxes), 5), np.nan)
        facts[:, LOW], facts[:, HIGH] = self.levels.level_range(boxes)
        inside = self._touches(facts)
        with np.errstate(over="ignore", invalid="ignore"):
            gradient = self.levels.gradient(boxes[inside])
            V = self.levels.level(boxes[inside], gradient)
            facts[inside, LOW] = np.fmax(facts[inside, LOW], V.lower[:, 0])
            facts[inside, HIGH] = np.fmin(facts[inside, HIGH], V.upper[:, 0])
            still = self._touches(facts[inside])
            inside[inside] = still
            V, gradient = V[still], gradient[still]
            m = model_field(self.field, boxes[inside])
            V_dot = gradient.dot(m)
            rate = self._rate(V_dot, V)
            steepest, fastest = (
                (1 + SLACK) * np.linalg.norm(models.magnitude, axis=1)
                for models in (gradient, m)
            )
            facts[inside, RATE:] = np.column_stack(
                [rate, -rate / steepest, -rate / ((1 + SLACK) * fastest**2)]
            )
        # What is not a number is not below anything either.
        decided = ~inside
        wanted = -np.maximum(self.alpha, self.share * np.abs(V_dot.value[:, 0]))
        decided[inside] = rate <= wanted
        return Answer(decided, facts, int(inside.sum()))

    def _touches(self, facts: FloatArray) -> BoolArray:
        return (facts[:, HIGH] >= self.c_in) & (facts[:, LOW] <= self.c_out)

    def _rate(self, V_dot: TaylorModel, V: TaylorModel) -> FloatArray:
        """Returns a bound of V_dot where V is in the band, (n,)."""
        rate = V_dot.upper[:, 0]
        # On the rim of the band, V_dot has to be bounded on one side of the level alone: where
        # V >= c_in it is at most V_dot + k (V - c_in), for any k >= 0.  This varies least with
        # the k that takes out what V_dot and V have in common.
        slopes = V.jacobian[..., 0]
        common = (V_dot.jacobian[..., 0] * slopes).sum(axis=1) / (slopes**2).sum(axis=1)
        rims = ((self.c_in, np.maximum(-common, 0)), (self.c_out, np.minimum(-common, 0)))
        for level, k in rims:
            on_one_side = V_dot + V.shifted(-level).weighted(k[:, None])
            rate = np.fmin(rate, on_one_side.upper[:, 0])
        return rate

    def _refute(self, z: FloatArray) -> BoolArray:
        score = self.levels.mixture.score(z)
        V = self.levels.level_range(Boxes(z, np.zeros(len(z))))
        m = self.field(self.field.cloud.denormalize(z))
        V_dot = -(score * m).sum(axis=1)
        return (V[0] >= self.c_in) & (V[1] <= self.c_out) & (V_dot > -self.alpha)
