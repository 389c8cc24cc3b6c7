"""Fences: closed polygons in the plane that robots cross outward alone.

On a side of a polygon let m point to its right all along.  Then who crosses the side lowers how
often the polygon winds around him.  So **who starts where it winds around not at all, or less
than that, stays there**, as long as he does not pass a *gate*: a side of which this is not
proved.  At a vertex between two such sides m points to the right of both, which is out.  The
polygon may meet itself.

What does not change where m points does not matter: m is replaced by a positive multiple.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.cells import HALF
from sgvf_drake.certificate.field_model import BoundedField, direction_model
from sgvf_drake.certificate.tube import LARGEST, TICK, normal
from sgvf_drake.certificate.tube_cells import Answer, Parts, divide
from sgvf_drake.certificate.walls import Polygon, meet_and_wind


@dataclass(frozen=True)
class Fence:
    """A closed polygon that winds around what it keeps robots out of.

    Attributes:
        polygon: Its vertices, of whole numbers, in ticks.

    Raises:
        ValueError: If they are not pairs of whole numbers up to `LARGEST`.
    """

    polygon: Polygon

    def __post_init__(self) -> None:
        ticks = np.array(self.polygon)
        if ticks.ndim != 2 or ticks.shape[1] != 2 or ticks.dtype.kind != "i":
            raise ValueError("a fence is a polygon with vertices of two whole numbers")
        if np.abs(ticks).max() > LARGEST:
            raise ValueError(f"a fence is of whole numbers up to {LARGEST}")

    @classmethod
    def through(cls, points: FloatArray) -> "Fence":
        """Returns the fence nearest to a polygon (K, 2), normalised."""
        return cls(tuple(map(tuple, np.rint(points / TICK).astype(int).tolist())))

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "Fence":
        """Returns the fence of a JSON object.

        Raises:
            KeyError: If something is missing.
            ValueError: If it is none.
        """
        return cls(tuple(map(tuple, body["polygon"])))

    @cached_property
    def vertices(self) -> FloatArray:
        """The vertices (K, 2), normalised."""
        return TICK * np.array(self.polygon, float)

    @cached_property
    def ellipse(self) -> tuple[FloatArray, FloatArray]:
        """The middle c (2,) of its vertices, and Q (2, 2) with (z - c) . Q (z - c) about 1."""
        off = self.vertices - self.vertices.mean(axis=0)
        return self.vertices.mean(axis=0), np.linalg.inv(2 * off.T @ off / len(off))


@dataclass(frozen=True, eq=False)
class Fences:
    """Fences, and what is proved of them.

    Attributes:
        fences: The fences.
        gates: (g, 2, 2) the sides in the box of which it is not proved that m leads out.
    """

    fences: tuple[Fence, ...]
    gates: FloatArray = field(default_factory=partial(np.empty, (0, 2, 2)))

    @classmethod
    def proved(cls, field: BoundedField, fences: Sequence[Fence]) -> "Fences":
        """Finds the gates of fences."""
        gates = [np.empty((0, 2, 2)), *(_gates(field, fence.vertices) for fence in fences)]
        return cls(tuple(fences), np.concatenate(gates))

    def joined(self, other: "Fences") -> "Fences":
        """Returns these and others."""
        return Fences(self.fences + other.fences, np.concatenate([self.gates, other.gates]))

    @cached_property
    def closed(self) -> list[Fence]:
        """Those that lie in the box."""
        return [fence for fence in self.fences if np.abs(fence.vertices).max() < HALF]

    def around(self, boxes: Boxes) -> "Fenced":
        """Finds out how squares lie to the fences."""
        within, met, at_gate = (np.zeros(len(boxes), bool) for _ in range(3))
        for fence in self.fences:
            winds, here = meet_and_wind(fence.vertices, boxes)
            within |= ~here & (winds > 0)
            met |= here
        for gate in self.gates:
            at_gate |= meet_and_wind(gate, boxes)[1]
        return Fenced(within, met, at_gate)


@dataclass(frozen=True, eq=False)
class Fenced:
    """How n squares lie to fences.

    Attributes:
        within: (n,) which are all within one, where robots from outside do not come.
        met: (n,) which meet one.
        at_gate: (n,) which meet a gate.
    """

    within: BoolArray
    met: BoolArray
    at_gate: BoolArray

    @property
    def touched(self) -> BoolArray:
        """Which (n,) are not all outside."""
        return self.within | self.met

    def replaced(self, rows: BoolArray, other: "Fenced") -> "Fenced":
        """Returns the same, but for those of other squares in the place of some."""
        return Fenced(
            np.concatenate([self.within[~rows], other.within]),
            np.concatenate([self.met[~rows], other.met]),
            np.concatenate([self.at_gate[~rows], other.at_gate]),
        )


def _gates(field: BoundedField, vertices: FloatArray) -> FloatArray:
    sides = np.stack([vertices, np.roll(vertices, -1, axis=0)], axis=1)
    beyond = (sides > HALF).all(axis=1) | (sides < -HALF).all(axis=1)
    sides = sides[~np.any(beyond, axis=1)]
    parts = Parts(sides[:, :1], sides[:, 1:], np.arange(len(sides)))
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        found = divide(parts, partial(_ask_outward, field))
    return np.asarray(sides[np.unique(found.open_cells)])


def _ask_outward(field: BoundedField, parts: Parts, _: int) -> Answer:
    """Asks whether m points to the right all along parts of sides."""
    rightward = normal(parts.columns).dot(direction_model(field, parts.patches))
    lower, upper = rightward.lower[:, 0], rightward.upper[:, 0]
    return Answer(lower > 0, upper <= 0, np.empty((len(parts), 0)))
