"""Legs of a route: at one intended direction each, from a disk across the path to the next.

A disk is a section of a tube: a segment in the plane, a parallelogram in space.  For a constant
intended direction g, m(x, g) is a field of the position alone, and a leg is a tube of it.  What
enters a chain of legs through a disk that the first section of the first leg holds, with g
switched at once where a leg ends, leaves through the last section of the last leg, if **each
last section lies in the first of the next leg**.  This is decided on whole numbers (`lies_in`),
so that no rounding comes between.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product
import math
from typing import Any

import numpy as np

from sgvf_drake.certificate.tube import Tube, TubeProof, prove_tube
from sgvf_drake.fields import DirectedField, HeldField

LONGEST = 1 + 1e-9
"""Intended directions are no longer, but for rounding."""

Disk = tuple[tuple[int, ...], ...]
"""The middle of a disk and the d - 1 halves of its sides, as rows of d whole numbers: ticks."""


@dataclass(frozen=True)
class Leg:
    """A tube of a directed field at a constant intended direction.

    Attributes:
        direction: g, (d,).
        tube: The tube; an open one.

    Raises:
        ValueError: If g is not of the space of the tube, or longer than 1, or the tube closed.
    """

    direction: tuple[float, ...]
    tube: Tube

    def __post_init__(self) -> None:
        length, dim = math.hypot(*self.direction), len(self.tube.sections[0])
        if len(self.direction) != dim or not length <= LONGEST or self.tube.closed:
            raise ValueError("a leg is an open tube at an intended direction of its space")

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "Leg":
        """Returns the leg of a JSON object.

        Raises:
            KeyError: If something is missing.
            TypeError: If it is not the object of a leg.
            ValueError: If it is none, by what is said of the class.
        """
        return cls(tuple(map(float, body["direction"])), Tube.of(body["tube"]))

    def field(self, field: DirectedField) -> HeldField:
        """Returns the field of the position alone that it is a tube of."""
        return field.heading(np.array(self.direction))


@dataclass(frozen=True)
class ProvedLeg:
    """A leg, and what is proved of its tube."""

    leg: Leg
    proof: TubeProof


def prove_leg(field: DirectedField, leg: Leg) -> ProvedLeg:
    """Proves that what enters a leg leaves it through its last section."""
    return ProvedLeg(leg, prove_tube(leg.field(field), leg.tube))


def are_chained(legs: Sequence[Leg], start: Disk, end: Disk | None) -> bool:
    """Whether legs lead on from disk to disk, without a gap.

    Args:
        legs: One or more.
        start: The first section of the first leg holds it.
        end: It holds the last section of the last leg; None: that one ends at rest.
    """
    sections = [(leg.tube.sections[0], leg.tube.sections[-1]) for leg in legs]
    joints = [(last, first) for (_, last), (first, _) in pairwise(sections)]
    joints.append((start, sections[0][0]))
    if end is not None:
        joints.append((sections[-1][1], end))
    rests = [leg.tube.rest is not None for leg in legs]
    return rests == [*[False] * (len(legs) - 1), end is None] and all(
        lies_in(inner, outer) for inner, outer in joints
    )


def lies_in(inner: Disk, outer: Disk) -> bool:
    """Whether all points of one disk, in the plane or in space, are points of another.

    A disk is convex, so its corners tell.  A point p of the plane of the outer one, of middle q
    and sides A, has the coordinates s with p - q = A s, so that det(A^T A) s is the adjugate of
    A^T A times A^T (p - q).  It is decided on whole numbers, of which Python's have no bounds.
    """
    (p, *sides), (q, *others) = (np.array(disk, object) for disk in (inner, outer))
    signs = np.array(list(product((-1, 1), repeat=len(sides))), object)
    offsets = p - q + signs @ np.array(sides)
    A = np.array(others).T
    G = A.T @ A
    if len(G) == 1:
        det, adjugate = G[0, 0], np.array([[1]], object)
    else:
        det = G[0, 0] * G[1, 1] - G[0, 1] ** 2
        adjugate = np.array([[G[1, 1], -G[0, 1]], [-G[0, 1], G[0, 0]]])
    scaled = offsets @ A @ adjugate
    return bool(
        det > 0 and (np.abs(scaled) <= det).all() and (scaled @ A.T == det * offsets).all()
    )
