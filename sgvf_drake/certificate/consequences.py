"""What follows from C1 and C2, from the bounds over squares."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.annulus import Annulus
from sgvf_drake.certificate.decrease import HIGH, LOW, MARGIN, RATE, STEP
from sgvf_drake.certificate.division import Division
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.topology import Shape
from sgvf_drake.fields import GuidingField
from sgvf_drake.paths import Reference, ReferencePath, TreeReference

# Intervals of levels on which the rate and the margin are told.
NUM_INTERVALS = 200
# Points on each side of a polygon at which its distance from the path is measured.
PARTS = 8


@dataclass(frozen=True, eq=False)
class Rates:
    """How fast V falls on a band, by intervals of levels.  All are bounds from below.

    Attributes:
        levels: (k + 1,) from c_in to c_out.
        alpha: (k,) -V_dot between each level and the next, per normalised unit of length.
        e_star: (k,) the inward speed of m across the levels.
        step: -V_dot / |m|^2 in the whole band.
    """

    levels: FloatArray
    alpha: FloatArray
    e_star: FloatArray
    step: float

    @property
    def entry_time(self) -> float:
        """Bound of the time from c_out to c_in: the integral of dc / alpha(c).

        In normalised units of length at |m| = 1.  With one alpha for all levels the bound is
        longer many times over.
        """
        return float((np.diff(self.levels) / self.alpha).sum() * (1 + SLACK * NUM_INTERVALS))


def rates(decrease: Division, c_in: float, c_out: float) -> Rates:
    """Returns how fast V falls on a band on which C1 is proved."""
    facts = decrease.facts[~np.isnan(decrease.facts[:, RATE])]
    levels = np.geomspace(c_in, c_out, NUM_INTERVALS + 1)
    alpha, e_star = np.empty(NUM_INTERVALS), np.empty(NUM_INTERVALS)
    for k in range(NUM_INTERVALS):
        there = (facts[:, LOW] <= levels[k + 1]) & (facts[:, HIGH] >= levels[k])
        alpha[k] = -facts[there, RATE].max()
        e_star[k] = facts[there, MARGIN].min()
    return Rates(levels, alpha, e_star, float(facts[:, STEP].min()))


def falling_area(decrease: Division, c_in: float, c_out: float) -> float:
    """Returns the area of squares inside of the band, on all of which V was proved to fall."""
    facts = decrease.facts
    inside = (facts[:, LOW] >= c_in) & (facts[:, HIGH] <= c_out)
    return float((4 * decrease.boxes.half[inside] ** 2).sum())


def tube_half_width(field: GuidingField, shape: Shape, reference: Reference) -> float:
    """Returns the largest distance of the tube from the path, at most, in the field's unit."""
    cover = shape.cover
    centers = cover.lower + cover.side * (np.argwhere(shape.labels > 0) + 0.5)
    distance = reference.project(field.cloud.denormalize(centers)).distance.max()
    return float(distance + cover.side / np.sqrt(2) * field.cloud.unit_length)


def annuli_half_width(
    field: GuidingField, annuli: Iterable[Annulus | None], reference: Reference
) -> float | None:
    """Returns the largest distance of rings from the path, at most, in the field's unit.

    None where there are no rings.
    """
    distances = []
    for annulus in annuli:
        for border in annulus.borders if annulus is not None else ():
            step = np.roll(border, -1, axis=0) - border
            shares = np.arange(PARTS)[:, None, None] / PARTS
            points = (border + shares * step).reshape(-1, 2)
            between = np.linalg.norm(step, axis=1).max() / (2 * PARTS)
            off = reference.project(field.cloud.denormalize(points)).distance.max()
            distances.append(float(off + (1 + SLACK) * between * field.cloud.unit_length))
    return max(distances, default=None)


def pieces_in(field: GuidingField, shape: Shape, reference: Reference) -> list[int | None]:
    """Returns the component, from 1, that each piece of the path lies in alone; or None."""
    found: list[int | None] = []
    for points in points_of(reference):
        numbers = np.unique(shape.component_of(field.cloud.normalize(points)))
        alone = len(numbers) == 1 and numbers[0] > 0
        found.append(int(numbers[0]) if alone else None)
    return [number if found.count(number) == 1 else None for number in found]


def points_of(reference: Reference) -> list[FloatArray]:
    """Returns points (M, 2) on each piece of a path."""
    if isinstance(reference, ReferencePath):
        return [piece.vertices for piece in reference.pieces]
    assert isinstance(reference, TreeReference), type(reference)
    return [reference.points[piece.order] for piece in reference.pieces]
