"""Where V falls along a field, as seen from samples and from between them."""

from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.vectors import component_along
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.lyapunov.samples import Samples

# V has to fall by more than this in every U of travel (at |m| = 1).
MIN_DECREASE = 0.01
# So many samples on each of so many levels of a band are followed to worse places, by steps
# of half a noise level that shrink to a hundredth of it.
CLIMBERS = 20
CLIMB_LEVELS = 24
CLIMB_STEPS = 20
CLIMB_SHRINK = 0.82


@dataclass(frozen=True, eq=False)
class Scan:
    """V, its gradient and V_dot at the samples of a field.

    Attributes:
        field: The field m.
        function: V.
        x: The samples, (n, d).
        V: V there, (n,).
        gradient: grad V, (n, d).
        outward: The speed of m along grad V, (n,).
        V_dot: grad V . m, (n,).
        min_decrease: What V has to fall by, per unit of length.
        border_level: The smallest V on the border of the box.
    """

    field: GuidingField
    function: LyapunovFunction
    x: FloatArray
    V: FloatArray
    gradient: FloatArray
    outward: FloatArray
    V_dot: FloatArray
    min_decrease: float
    border_level: float

    @classmethod
    def of(cls, field: GuidingField, function: LyapunovFunction, samples: Samples) -> "Scan":
        V, gradient = function.value_and_gradient(samples.x)
        grid = samples.as_grid(V)
        border = min(grid[0].min(), grid[-1].min(), grid[:, 0].min(), grid[:, -1].min())
        outward = component_along(gradient, samples.m)
        V_dot = (gradient * samples.m).sum(axis=1)
        min_decrease = MIN_DECREASE / field.cloud.unit_length
        return cls(
            field,
            function,
            samples.x,
            V,
            gradient,
            outward,
            V_dot,
            min_decrease,
            float(border),
        )

    @property
    def bad_levels(self) -> FloatArray:
        """The levels at which V was seen not to fall."""
        return self.V[self.V_dot > -self.min_decrease]

    def smallest_decrease(self, c_in: float, c_out: float) -> float:
        """Returns the smallest -V_dot at the samples of a band; infinite where it has none."""
        inside = (c_in <= self.V) & (c_out >= self.V)
        return -float(self.V_dot[inside].max(initial=-np.inf))

    def climb(
        self, c_in: float, c_out: float, rng: np.random.Generator
    ) -> tuple[FloatArray, FloatArray]:
        """Returns V and V_dot at points of a band where m flows in least, (k,) each.

        On levels all over the band, the samples with the smallest inward normal speed are
        pushed to where it is smaller still, by trial: what lies between them is to be found.
        """
        weakest = self._weakest(c_in, c_out)
        x, V, V_dot = self.x[weakest], self.V[weakest], self.V_dot[weakest]
        outward = self.outward[weakest]
        step = 0.5 * self.function.sigma
        for _ in range(CLIMB_STEPS):
            trial = x + step * rng.standard_normal(x.shape)
            trial_V, gradient = self.function.value_and_gradient(trial)
            trial_m = self.field(trial)
            trial_V_dot = (gradient * trial_m).sum(axis=1)
            trial_outward = component_along(gradient, trial_m)
            better = (trial_outward > outward) & (c_in <= trial_V) & (trial_V <= c_out)
            x = np.where(better[:, None], trial, x)
            V, V_dot, outward = (
                np.where(better, new, old)
                for new, old in (
                    (trial_V, V),
                    (trial_V_dot, V_dot),
                    (trial_outward, outward),
                )
            )
            step *= CLIMB_SHRINK
        return V, V_dot

    def _weakest(self, c_in: float, c_out: float) -> IntArray:
        """Returns the samples with the smallest inward speed on the levels of a band."""
        inside = np.flatnonzero((c_in <= self.V) & (c_out >= self.V))
        edges = np.geomspace(c_in, c_out, CLIMB_LEVELS + 1)[1:-1]
        level = np.digitize(self.V[inside], edges)
        outward = self.outward[inside]
        order = np.lexsort((-outward, level))
        # How many samples of its level come before each.
        first = np.searchsorted(level[order], level[order])
        return inside[order[np.arange(len(order)) - first < CLIMBERS]]
