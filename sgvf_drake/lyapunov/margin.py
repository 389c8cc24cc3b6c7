"""How fast a field flows into a sublevel set, and so what disturbance the set tolerates."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.fields import Field
from sgvf_drake.fields.vectors import component_along
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.lyapunov.samples import Samples

# Levels at which a band is looked at, evenly in log V.
NUM_LEVELS = 24
# Points of a level set: the samples whose V is nearest, moved onto it, and those at which m
# flows in least of the samples whose V is within this factor.
LEVEL_POINTS = 2_000
WEAK_POINTS = 200
WEAK_FACTOR = 1.3
# The weakest of them are followed to weaker ones along the level set, by random steps of half
# a noise level that shrink.
CLIMBERS = 50
CLIMB_STEPS = 10
CLIMB_SHRINK = 0.7
PROJECTION_STEPS = 12
# A point is on a level set c when V is this near, relative to c.
ON_LEVEL = 1e-6
TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, eq=False)
class Margins:
    """The inward flow on the level sets of a band.

    For x_dot = m + d with |d| <= e, the set {V <= c} stays invariant while e is below
    e*(c) = min over V = c of the inward normal speed -grad V . m / |grad V|.  At speed v0
    the tolerated velocity error is v0 e*.

    Attributes:
        levels: c, (k,) rising.
        e_star: e*(c), (k,), no unit; negative where the field flows out somewhere.
        weakest: Where on each level set the flow is weakest, (k, d).
        decrease: -V_dot there, (k,), per unit of length.
    """

    levels: FloatArray
    e_star: FloatArray
    weakest: FloatArray
    decrease: FloatArray

    @property
    def largest(self) -> float:
        """The largest e* of any level: the disturbance that some set of the band bears."""
        return float(self.e_star.max())

    def at(self, level: float) -> float:
        """Returns e* at a level of the band, interpolated in log c."""
        return float(np.interp(np.log(level), np.log(self.levels), self.e_star))


def inward_margins(
    field: Field,
    function: LyapunovFunction,
    samples: Samples,
    c_in: float,
    c_out: float,
    num_levels: int = NUM_LEVELS,
) -> Margins:
    """Returns e*(c) on levels from c_in to c_out, sampled.

    Args:
        field: The field m.
        function: V.
        samples: The field where it was looked at.
        c_in: The lowest level; above zero.
        c_out: The highest.
        num_levels: Number of levels.
    """
    rng = np.random.default_rng(0)
    levels = np.geomspace(c_in, c_out, num_levels)
    V, gradient = function.value_and_gradient(samples.x)
    inward = -component_along(gradient, samples.m)
    weakest = []
    for level in levels:
        away = np.abs(np.log(np.maximum(V, TINY) / level))
        near = np.argsort(away, kind="stable")[:LEVEL_POINTS]
        close = np.flatnonzero(away < np.log(WEAK_FACTOR))
        weak = close[np.argsort(inward[close], kind="stable")[:WEAK_POINTS]]
        x = to_level_set(function, samples.x[np.union1d(near, weak)], level)
        weakest.append(_weakest(field, function, x, level, rng))
    e_star = np.array([speed for speed, _ in weakest])
    points = np.array([point for _, point in weakest])
    return Margins(levels, e_star, points, -function.along(field, points))


def to_level_set(function: LyapunovFunction, x: FloatArray, level: float) -> FloatArray:
    """Returns points (k, d) with V = level: those of (n, d) that Newton's method moves there.

    Args:
        function: V.
        x: Points, not far from the level set.
        level: The level, above zero.
    """
    for _ in range(PROJECTION_STEPS):
        V, gradient = function.value_and_gradient(x)
        if (np.abs(V - level) <= ON_LEVEL * level).all():
            break
        step = (V - level) / np.maximum((gradient**2).sum(axis=1), TINY)
        # No step is longer than a noise level: where the gradient vanishes it would be.
        step /= np.maximum(np.abs(step) * np.linalg.norm(gradient, axis=1) / function.sigma, 1)
        x = x - step[:, None] * gradient
    return x[np.abs(function(x) - level) <= ON_LEVEL * level]


def _weakest(
    field: Field,
    function: LyapunovFunction,
    x: FloatArray,
    level: float,
    rng: np.random.Generator,
) -> tuple[float, FloatArray]:
    """Returns the smallest inward normal speed on a level set, and where it is."""
    speed = -component_along(function.gradient(x), field(x))
    step = 0.5 * function.sigma
    for _ in range(CLIMB_STEPS):
        chosen = np.argsort(speed, kind="stable")[:CLIMBERS]
        x, speed = x[chosen], speed[chosen]
        trial = to_level_set(function, x + step * rng.standard_normal(x.shape), level)
        x = np.concatenate([x, trial])
        outward = component_along(function.gradient(trial), field(trial))
        speed = np.append(speed, -outward)
        step *= CLIMB_SHRINK
    worst = int(np.argmin(speed))
    return float(speed[worst]), x[worst]
