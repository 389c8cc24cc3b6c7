"""The sampled check of path following: what holds, what speaks against it, and where."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any

import numpy as np
from scipy import ndimage

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.fields import GuidingField, check_position_alone
from sgvf_drake.lyapunov.band import MIN_DECREASE, SIGMA_RATIOS, Band, search_band
from sgvf_drake.lyapunov.conditions import (
    Bound,
    check_assumptions,
    check_lemma,
    robustness_bounds,
)
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.lyapunov.margin import Margins, inward_margins
from sgvf_drake.lyapunov.samples import Samples, take_samples
from sgvf_drake.lyapunov.zeros import FieldZeros, Zero, find_guiding_zeros
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress

# In the tube m has to be at least this long.
MIN_SPEED = 0.05
# Where no band is found, this many U about the path stand for the tube.
STAND_IN = 0.3
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
        area: The area of the region, in the unit of length squared; in space its volume, in
            the unit cubed; 0 for a point.
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


@dataclass(frozen=True, eq=False)
class Verification:
    """What the sampled checks found.  Nothing here is proved.

    Attributes:
        function: V, at the noise level of the band, or that of the field without one.
        samples: The field where it was looked at.
        band: The band on which V decreases; None: there is none with a tube about each piece.
        margins: The inward flow on its levels.
        assumptions: A1 and A2 of the paper, measured; see `check_assumptions`.
        lemma: Lemma 1, in the paper's form and with the true gradient; see `check_lemma`.
        bounds: The three robustness bounds.
        zeros: The zeros of m in the box, with what the search could not decide.
        slowest: The smallest |m| in the tube (near the path without a band), away from ends.
        decrease_fraction: Part of the box where V falls.
        violations: What speaks against it, that which counts first.
    """

    function: LyapunovFunction
    samples: Samples
    band: Band | None
    margins: Margins | None
    assumptions: dict[str, Any]
    lemma: dict[str, Any]
    bounds: Sequence[Bound]
    zeros: FieldZeros
    slowest: float
    decrease_fraction: float
    violations: Sequence[Violation]

    @property
    def holds(self) -> bool:
        """Whether every sampled condition holds: from {V <= c_out} robots follow the path."""
        return self.band is not None and not any(v.counts for v in self.violations)

    @property
    def alpha(self) -> float | None:
        """The smallest -V_dot that was found in the band, per unit of length."""
        if self.band is None or self.margins is None:
            return None
        return min(self.band.decrease, float(self.margins.decrease.min()))

    @property
    def reason(self) -> str:
        """Why it holds or not, in words."""
        counting = [str(violation) for violation in self.violations if violation.counts]
        if self.band is None:
            counting.insert(0, "V decreases on no band of levels with a tube about each piece")
        if counting:
            return "; ".join(counting[:3])
        assert self.band is not None
        c_in, c_out = self.band.c_in, self.band.c_out
        return (
            f"V decreases from {c_out:.3g} to {c_in:.3g}, and |m| >= {self.slowest:.3g} below"
        )


def verify(
    field: GuidingField,
    reference: ReferencePath | None = None,
    seed: int = 0,
    ratios: Sequence[float] = SIGMA_RATIOS,
    progress: Progress = no_progress,
) -> Verification:
    """Checks the conditions of path following on samples of a field in the plane or in space.

    Args:
        field: The field.
        reference: The path, for its pieces and the width of the tube; None: `field.path`.
        seed: Of the random samples.
        ratios: The noise levels of V to try, in those of the field.
        progress: Told how far it is.

    Raises:
        ConfigurationError: The field is neither planar nor spatial, or a directed one.
    """
    check_position_alone(field)
    reference = field.path if reference is None else reference
    samples = take_samples(field, seed)
    progress("sample", 1, 1)
    zeros = find_guiding_zeros(field)
    progress("zeros", 1, 1)
    # Where an open path ends, m has to vanish.
    on_the_way = [zero for zero in zeros.zeros if not _at_end(field, zero.point[None])[0]]
    stops = np.array([zero.point for zero in on_the_way]).reshape(-1, field.dim)
    band = search_band(field, samples, reference, ratios, seed, stops, progress)
    function = LyapunovFunction.of(field) if band is None else band.function
    margins = None
    if band is not None:
        margins = inward_margins(field, function, samples, band.c_in, band.c_out)
    places = _Places(field, function, samples, band, reference)
    violations = [*places.zeros(on_the_way), *places.slow(), *places.rises()]
    if margins is not None:
        violations += _outward(margins)
    order = ("zero", "slow", "outward", "rise")
    violations.sort(key=lambda found: (not found.counts, order.index(found.kind)))
    progress("conditions", 1, 1)
    return Verification(
        function=function,
        samples=samples,
        band=band,
        margins=margins,
        assumptions=check_assumptions(field, function, samples, seed),
        lemma=check_lemma(function, samples),
        bounds=robustness_bounds(function, samples),
        zeros=zeros,
        slowest=float(places.speeds_in_tube[1].min(initial=np.inf)),
        decrease_fraction=float(1 - places.rising[samples.on_grid].mean()),
        violations=violations,
    )


def _at_end(field: GuidingField, x: FloatArray) -> BoolArray:
    """Returns whether points (n, d) are where a robot is to rest, (n,)."""
    if not len(field.ends):
        return np.zeros(len(x), bool)
    distance = np.linalg.norm(x[:, None] - field.ends, axis=2).min(axis=1)
    return np.asarray(distance <= AT_END * field.cloud.unit_length)


def _outward(margins: Margins) -> list[Violation]:
    """Returns the level set of the band that m leaves most, if it leaves any."""
    worst = int(np.argmin(margins.e_star))
    value, level = float(margins.e_star[worst]), float(margins.levels[worst])
    if value > 0:
        return []
    return [Violation("outward", margins.weakest[worst], value, level, 0.0, counts=True)]


@dataclass(frozen=True, eq=False)
class _Places:
    """The samples at which something speaks against a field; see `Verification`."""

    field: GuidingField
    function: LyapunovFunction
    samples: Samples
    band: Band | None
    reference: ReferencePath

    def zeros(self, zeros: Sequence[Zero]) -> list[Violation]:
        """Returns zeros of m on the way, those that trap robots first."""
        found = []
        for zero in sorted(zeros, key=lambda zero: not zero.stable):
            x = zero.point[None]
            V = self.function(x)
            c_out = self.band.c_out if self.band else None
            counts = bool(self._inside(x, V, c_out)[0])
            kind = f"stable {zero.kind}" if zero.kind == "focus" and zero.stable else zero.kind
            found.append(Violation("zero", zero.point, 0.0, float(V[0]), 0.0, counts, kind))
        return found

    def slow(self) -> list[Violation]:
        """Returns the slowest place of the tube, if it is too slow."""
        x, speed = self.speeds_in_tube
        worst = int(np.argmin(speed)) if len(speed) else 0
        if not len(speed) or speed[worst] >= MIN_SPEED:
            return []
        V = float(self.function(x[worst : worst + 1])[0])
        return [Violation("slow", x[worst], float(speed[worst]), V, 0.0, counts=True)]

    def rises(self) -> list[Violation]:
        """Returns the regions of the grid outside the tube where V does not fall."""
        axes, as_grid = self.samples.axes, self.samples.as_grid
        steps = [axis[1] - axis[0] for axis in axes]
        V, V_dot = (as_grid(values) for values in self._levels)
        touching = np.ones((3,) * len(axes))
        labels, count = ndimage.label(as_grid(self.rising & ~self._tube), touching)
        worst = ndimage.maximum_position(V_dot, labels, range(1, count + 1))
        sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
        found = []
        for at, size in zip(worst, sizes, strict=True):
            point = np.array([axis[i] for axis, i in zip(axes, at[::-1], strict=True)])
            # Without a band, these are why there is none.
            counts = self.band is None or self.band.c_out >= V[at]
            value, area = float(V_dot[at]), float(math.prod((size, *steps)))
            found.append(Violation("rise", point, value, float(V[at]), area, bool(counts)))
        return sorted(found, key=lambda region: (not region.counts, -region.area))[:MAX_PLACES]

    @cached_property
    def rising(self) -> BoolArray:
        """At which samples V does not fall, (n,)."""
        return self._levels[1] > -MIN_DECREASE / self.field.cloud.unit_length

    @cached_property
    def speeds_in_tube(self) -> tuple[FloatArray, FloatArray]:
        """The samples in the tube that are not at an end, (k, d), and |m| there, (k,)."""
        x, m = self.samples.x[self._tube], self.samples.m[self._tube]
        going_on = ~_at_end(self.field, x)
        return x[going_on], np.linalg.norm(m[going_on], axis=1)

    @cached_property
    def _levels(self) -> tuple[FloatArray, FloatArray]:
        """V and V_dot = grad V . m at the samples, (n,) each."""
        V, gradient = self.function.value_and_gradient(self.samples.x)
        return V, (gradient * self.samples.m).sum(axis=1)

    @cached_property
    def _tube(self) -> BoolArray:
        """Which samples are in the tube, or near the path without a band, (n,)."""
        c_in = self.band.c_in if self.band else None
        return self._inside(self.samples.x, self._levels[0], c_in)

    def _inside(self, x: FloatArray, V: FloatArray, level: float | None) -> BoolArray:
        """Whether points are in {V <= level}, or near the path where no level is given."""
        if level is not None:
            return np.asarray(level >= V)
        distance = self.reference.project(x).distance
        return np.asarray(distance <= STAND_IN * self.field.cloud.unit_length)
