"""The robustness bound of the paper's Section IV in three forms, and where each holds."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.fields.vectors import cosine
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.lyapunov.samples import Samples

# The cosine error eps is taken at each point, where the bounds are sharpest; to be useful a
# bound also has to be negative for the eps that covers this part of the box.
EPS_QUANTILE = 0.95
# Rounding, relative to the size of the terms.
ROUNDING = 1e-9
# A bound that is missed by no more than this part of full speed nearly holds.
NEARLY = 0.01

Decrease = Callable[[FloatArray], FloatArray]


@dataclass(frozen=True, eq=False)
class Bound:
    """One form of the bound on V_dot.

    Attributes:
        name: `paper`, `squashed` or `gradient`.
        holds: Where V_dot is not above the bound with the eps of that point, (n,).
        decreases: Where the bound is negative with the eps that covers `EPS_QUANTILE` of the
            box, so that it promises a decrease, (n,).
        excess: By how much V_dot is above the bound, over |s| or |S|, (n,); negative where
            it holds.
    """

    name: str
    holds: BoolArray
    decreases: BoolArray
    excess: FloatArray

    def summary(self) -> dict[str, float]:
        """Returns the parts of the box where it holds and where it promises a decrease."""
        return {
            "holds_fraction": float(self.holds.mean()),
            "nearly_holds_fraction": float((self.excess <= NEARLY).mean()),
            "decrease_fraction": float(self.decreases.mean()),
            "excess_median": float(np.median(self.excess)),
            "excess_max": float(self.excess.max()),
        }


def robustness_bounds(function: LyapunovFunction, samples: Samples) -> tuple[Bound, ...]:
    """Returns the three bounds on the grid, for m = s + v with |s . v| <= eps |s| |v|.

    - `paper`: V_dot <= -(1 - eps |v|) |s|^2 for V_dot = -s . m, as printed.  It does not
      follow: |s| < 1, so the cross term eps |s| |v| is larger than eps |v| |s|^2.
    - `squashed`: V_dot <= -|s| (|s| - eps |v|), which does follow from grad V = -s; but s is
      squashed and no gradient.
    - `gradient`: V_dot <= -|S| (|s| - eps |v|) for the true V_dot = grad V . m with
      grad V = -S.  It needs s along S; here S is the exact score and s the learned one, so
      the bound is missed by what their directions differ, |s| (1 - cos(s, S)).
    """
    x, s, v = (values[samples.on_grid] for values in (samples.x, samples.s, samples.v))
    S = -function.gradient(x)
    s_norm, v_norm = (np.linalg.norm(vector, axis=1) for vector in (s, v))
    squashed_eps, gradient_eps = np.abs(cosine(s, v)), np.abs(cosine(S, v))

    def shrink(eps: FloatArray) -> FloatArray:
        return np.asarray(s_norm - eps * v_norm)

    def bound(name: str, direction: FloatArray, eps: FloatArray, decrease: Decrease) -> Bound:
        # Everything over |direction|, which is |s| or |S|.
        length = np.maximum(np.linalg.norm(direction, axis=1), np.finfo(np.float64).tiny)
        V_dot = -(direction * (s + v)).sum(axis=1) / length
        excess = V_dot + decrease(eps)
        cover = np.full_like(eps, np.quantile(eps, EPS_QUANTILE))
        return Bound(name, excess <= ROUNDING * (s_norm + v_norm), decrease(cover) > 0, excess)

    return (
        bound("paper", s, squashed_eps, lambda eps: (1 - eps * v_norm) * s_norm),
        bound("squashed", s, squashed_eps, shrink),
        bound("gradient", S, gradient_eps, shrink),
    )
