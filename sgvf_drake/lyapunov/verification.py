"""The sampled check of path following: what holds, what does not, and where."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov.band import SIGMA_RATIOS, Band, search_band
from sgvf_drake.lyapunov.bounds import Bound, robustness_bounds
from sgvf_drake.lyapunov.conditions import (
    Assumptions,
    Lemma,
    check_assumptions,
    check_lemma,
)
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.lyapunov.learned_path import learned_path
from sgvf_drake.lyapunov.margin import Margins, inward_margins
from sgvf_drake.lyapunov.samples import Samples, take_samples
from sgvf_drake.lyapunov.singularities import FieldZeros, find_guiding_zeros
from sgvf_drake.lyapunov.violations import Search, Violation, at_end
from sgvf_drake.paths import Reference
from sgvf_drake.progress import Progress, no_progress


@dataclass(frozen=True, eq=False)
class Verification:
    """What the sampled checks found.  Nothing here is proved.

    Attributes:
        function: V, at the noise level of the band, or that of the field without one.
        samples: The field where it was looked at.
        band: The band on which V decreases; None: there is none with a tube about each piece.
        margins: The inward flow on its levels.
        assumptions: A1 and A2 of the paper, measured.
        lemma: Lemma 1, in the paper's form and with the true gradient.
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
    assumptions: Assumptions
    lemma: Lemma
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
    reference: Reference | None = None,
    seed: int = 0,
    ratios: Sequence[float] = SIGMA_RATIOS,
    progress: Progress = no_progress,
) -> Verification:
    """Checks the conditions of path following on samples of a planar field.

    Args:
        field: The field.
        reference: The path, for its pieces and the width of the tube; None: `learned_path`.
        seed: Of the random samples.
        ratios: The noise levels of V to try, in those of the field.
        progress: Told how far it is.

    Raises:
        ConfigurationError: The field is not planar.
    """
    reference = learned_path(field) if reference is None else reference
    samples = take_samples(field, seed)
    progress("sample", 1, 1)
    zeros = find_guiding_zeros(field)
    progress("zeros", 1, 1)
    # Where an open path ends, m has to vanish.
    on_the_way = [zero for zero in zeros.zeros if not at_end(field, zero.point[None])[0]]
    stops = np.array([zero.point for zero in on_the_way]).reshape(-1, 2)
    band = search_band(field, samples, reference, ratios, seed, stops, progress)
    function = LyapunovFunction.of(field) if band is None else band.function
    margins = None
    if band is not None:
        margins = inward_margins(field, function, samples, band.c_in, band.c_out)
    V, gradient = function.value_and_gradient(samples.x)
    V_dot = (gradient * samples.m).sum(axis=1)
    search = Search(field, function, samples, band, reference, on_the_way, margins, V, V_dot)
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
        slowest=search.slowest,
        decrease_fraction=search.decrease_fraction,
        violations=search.violations,
    )
