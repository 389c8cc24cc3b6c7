"""What speaks against path following, with its place."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov.band import Band
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.lyapunov.margin import Margins
from sgvf_drake.lyapunov.samples import Samples
from sgvf_drake.lyapunov.scan import MIN_DECREASE
from sgvf_drake.lyapunov.singularities import Zero
from sgvf_drake.paths import Reference

# In the tube m has to be at least this long.
MIN_SPEED = 0.05
# Where no band is found, this many U about the path stand for the tube.
NEAR_PATH = 0.3
# A zero this near to an end of an open path, in U, is where the robot is to rest.
AT_END = 0.3
# Places that are named at most, the worst first.
MAX_PLACES = 12


@dataclass(frozen=True, eq=False)
class Violation:
    """Something that speaks against path following, with its place.

    Attributes:
        kind: `zero` (m vanishes where the robot has to go on), `slow` (|m| is small in the
            tube), `outward` (m does not flow into a level set of the band), or `rise` (V falls
            by less than `MIN_DECREASE` in a region outside the tube).
        point: Where, or where it is worst, (d,).
        value: |m| there, e*, or V_dot.
        V: V there.
        area: Of the region, in the unit of length squared; 0 for a point.
        counts: Whether it is inside {V <= c_out}, or near the path where there is no band:
            then path following fails.  Elsewhere it says where nothing is claimed.
        detail: The kind of a zero.
    """

    kind: str
    point: FloatArray
    value: float
    V: float
    area: float
    counts: bool
    detail: str = ""

    def __str__(self) -> str:
        at = "(" + ", ".join(f"{coordinate:.3g}" for coordinate in self.point) + ")"
        match self.kind:
            case "zero":
                return f"m vanishes at {at}, a {self.detail}"
            case "outward":
                return f"m leaves the level set V = {self.V:.3g} at {at}"
            case "slow":
                return f"|m| is only {self.value:.3g} at {at}"
            case _:
                return f"V changes by {self.value:+.3g} a unit of length at {at}"


def at_end(field: GuidingField, x: FloatArray) -> BoolArray:
    """Returns whether points (n, d) are where a robot is to rest, (n,)."""
    if not len(field.ends):
        return np.zeros(len(x), bool)
    distance = np.linalg.norm(x[:, None] - field.ends, axis=2).min(axis=1)
    return np.asarray(distance <= AT_END * field.cloud.unit_length)


@dataclass(frozen=True, eq=False)
class Search:
    """The search for what speaks against a field.

    Attributes:
        field: The field.
        function: V.
        samples: The field where it was looked at.
        band: The band on which V decreases; None: there is none.
        reference: The path.
        zeros: The zeros of m that are not at an end.
        margins: The inward flow on the levels of the band.
        V: V at the samples, (n,).
        V_dot: V_dot = grad V . m there, (n,).
    """

    field: GuidingField
    function: LyapunovFunction
    samples: Samples
    band: Band | None
    reference: Reference
    zeros: Sequence[Zero]
    margins: Margins | None
    V: FloatArray
    V_dot: FloatArray

    @property
    def violations(self) -> list[Violation]:
        """What was found: that which counts first, and there the zeros first."""
        found = [*self._zeros(), *self._slow(), *self._outward(), *self._rises()]
        return sorted(found, key=lambda violation: not violation.counts)

    @property
    def decrease_fraction(self) -> float:
        """Part of the grid on which V falls."""
        return float(1 - self._rising[self.samples.on_grid].mean())

    @property
    def slowest(self) -> float:
        """The smallest |m| in the tube (near the path without a band), away from ends."""
        return float(self._speeds_in_tube[1].min(initial=np.inf))

    def _zeros(self) -> list[Violation]:
        """Returns the zeros of m, those that trap robots first."""
        found = []
        for zero in sorted(self.zeros, key=lambda zero: not zero.stable):
            x = zero.point[None]
            V = self.function(x)
            c_out = self.band.c_out if self.band else None
            counts = bool(self._inside(x, V, c_out)[0])
            kind = f"stable {zero.kind}" if zero.kind == "focus" and zero.stable else zero.kind
            found.append(Violation("zero", zero.point, 0.0, float(V[0]), 0.0, counts, kind))
        return found

    def _outward(self) -> list[Violation]:
        """Returns the level set of the band that m leaves most, if it leaves any."""
        if self.margins is None or self.margins.e_star.min() > 0:
            return []
        worst = int(np.argmin(self.margins.e_star))
        point, level = self.margins.weakest[worst], float(self.margins.levels[worst])
        value = float(self.margins.e_star[worst])
        return [Violation("outward", point, value, level, 0.0, counts=True)]

    def _slow(self) -> list[Violation]:
        """Returns the slowest place of the tube, if it is too slow."""
        x, speed = self._speeds_in_tube
        if not len(speed) or speed.min() >= MIN_SPEED:
            return []
        worst = int(np.argmin(speed))
        V = float(self.function(x[worst : worst + 1])[0])
        return [Violation("slow", x[worst], float(speed[worst]), V, 0.0, counts=True)]

    def _rises(self) -> list[Violation]:
        """Returns the regions of the grid outside the tube where V does not fall."""
        samples = self.samples
        bad = samples.as_grid(self._rising & ~self._tube)
        labels, count = ndimage.label(bad, structure=np.ones((3, 3)))
        (x, y), found = samples.axes, []
        V_dot = samples.as_grid(self.V_dot)
        worst = ndimage.maximum_position(V_dot, labels, range(1, count + 1))
        sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
        for (row, column), size in zip(worst, sizes, strict=True):
            point = np.array([x[column], y[row]])
            V = float(samples.as_grid(self.V)[row, column])
            # Without a band, these are why there is none.
            counts = self.band is None or self.band.c_out >= V
            area = float(size * (x[1] - x[0]) * (y[1] - y[0]))
            value = float(V_dot[row, column])
            found.append(Violation("rise", point, value, V, area, counts))
        return sorted(found, key=lambda region: (not region.counts, -region.area))[:MAX_PLACES]

    @cached_property
    def _rising(self) -> BoolArray:
        """At which samples V does not fall, (n,)."""
        return self.V_dot > -MIN_DECREASE / self.field.cloud.unit_length

    @cached_property
    def _tube(self) -> BoolArray:
        """Which samples are in the tube, or near the path without a band, (n,)."""
        return self._inside(self.samples.x, self.V, self.band.c_in if self.band else None)

    @cached_property
    def _speeds_in_tube(self) -> tuple[FloatArray, FloatArray]:
        """The samples in the tube that are not at an end, (k, d), and |m| there, (k,)."""
        x, m = self.samples.x[self._tube], self.samples.m[self._tube]
        going_on = ~at_end(self.field, x)
        return x[going_on], np.linalg.norm(m[going_on], axis=1)

    def _inside(self, x: FloatArray, V: FloatArray, level: float | None) -> BoolArray:
        """Whether points are in {V <= level}, or near the path where no level is given."""
        if level is not None:
            return np.asarray(level >= V)
        distance = self.reference.project(x).distance
        return np.asarray(distance <= NEAR_PATH * self.field.cloud.unit_length)
