"""The paper's Section IV: assumptions, lemma and robustness bound, as printed and corrected."""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.spatial.distance import pdist

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.fields import GuidingField, ScoreField, TangentField
from sgvf_drake.fields.vectors import cosine, curl_share
from sgvf_drake.lyapunov.function import LyapunovFunction
from sgvf_drake.lyapunov.samples import Samples

QUANTILES = (0.5, 0.9, 0.95, 0.99)
# Random samples at which Jacobians are taken, and pairs of points on one level set.
JACOBIAN_SAMPLES = 5_000
PAIR_LEVELS = 40
PAIR_NEIGHBOURS = 400


def spread(values: FloatArray, x: FloatArray) -> dict[str, Any]:
    """Returns how a quantity that should be small, (n,) at points (n, d), spreads over them.

    Returns:
        Its `mean`; its quantiles `QUANTILES` as `q50` to `q99`; its largest value `max`, and
        the point `where` it is largest, (d,).
    """
    quantiles = zip(QUANTILES, np.quantile(values, QUANTILES), strict=True)
    return {
        "mean": float(values.mean()),
        **{f"q{100 * q:.0f}": float(value) for q, value in quantiles},
        "max": float(values.max()),
        "where": x[np.argmax(values)],
    }


def check_assumptions(
    field: GuidingField, function: LyapunovFunction, samples: Samples, seed: int = 0
) -> dict[str, Any]:
    """Measures A1 and A2 over the box (paper, Section IV); A3 is a matter of trajectories.

    - a1_score_lipschitz: the largest |J_S| of the learned score, per unit of length
      squared; a1_exact_lipschitz: the same of the exact score, which is grad log P of a
      density; a1_score_curl: the median of |curl S| / |J_S|, zero for a gradient.
    - a2_cosine (A2 i): |cos(s, v)| of the parts of m = s + v; a2_cosine_networks:
      |cos(S, v)| of the raw score and the tangent, before they are put together;
      a2_cosine_gradient: |cos(grad V, v)|, which is what the decrease of V rests on.
    - a2_length_error (A2 ii): | |m| - 1 |.
    - a2_lipschitz_along_level_sets (A2 iii): the largest |J_v tau| of unit vectors tau
      along the level set, per unit of length, whose largest is the local Lipschitz constant L;
      a2_lipschitz_between_points: the largest |v(x) - v(y)| / |x - y| over pairs of points
      of the grid whose V is nearly the same, also across from each other and between
      strands.

    Args:
        field: The field.
        function: V, whose gradient and level sets are meant.
        samples: The field at the points of a grid; only these count, since they are even.
        seed: Of the points at which Jacobians are taken.

    Returns:
        By the names of `summary.json`; of what should be small the `spread`.
    """
    x, s, v = (values[samples.on_grid] for values in (samples.x, samples.s, samples.v))
    rng = np.random.default_rng(seed)
    at = rng.choice(len(x), min(JACOBIAN_SAMPLES, len(x)), replace=False)
    J_S = ScoreField(field).value_and_jacobian(x[at])[1]
    gradient, hessian = function.gradient_and_hessian(x[at])
    return {
        "a1_score_lipschitz": float(np.linalg.norm(J_S, ord=2, axis=(1, 2)).max()),
        "a1_exact_lipschitz": float(np.linalg.norm(hessian, ord=2, axis=(1, 2)).max()),
        "a1_score_curl": float(np.median(curl_share(J_S))),
        "a2_cosine": spread(np.abs(cosine(s, v)), x),
        "a2_cosine_networks": spread(np.abs(cosine(field.score(x), field.tangent(x))), x),
        "a2_cosine_gradient": spread(np.abs(cosine(function.gradient(x), v)), x),
        "a2_length_error": spread(np.abs(np.linalg.norm(s + v, axis=1) - 1), x),
        "a2_lipschitz_along_level_sets": _along_level_sets(field, x[at], gradient),
        "a2_lipschitz_between_points": _between_points(field, function, x),
    }


def check_lemma(function: LyapunovFunction, samples: Samples) -> dict[str, Any]:
    """Measures Lemma 1 on the grid as it stands and as it should: V_dot along the learned m.

    Returns:
        By the names of `summary.json`, paper_error: the `spread` of | -s . m + |s|^2 | =
        |s . v|, by which the paper's V_dot = -s . m misses -|s|^2; paper_falling_fraction: the
        part of the box where that is negative; falling_fraction: the part with grad V . m < 0,
        where V decreases; sign_agreement: the part where the two have the same sign; v_dot:
        the `spread` of the true V_dot.
    """
    x, s, v = (values[samples.on_grid] for values in (samples.x, samples.s, samples.v))
    paper = -(s * (s + v)).sum(axis=1)
    V_dot = function.derivative(x, s + v)
    return {
        "paper_error": spread(np.abs((s * v).sum(axis=1)), x),
        "paper_falling_fraction": float((paper < 0).mean()),
        "falling_fraction": float((V_dot < 0).mean()),
        "sign_agreement": float(((paper < 0) == (V_dot < 0)).mean()),
        "v_dot": spread(V_dot, x),
    }


def _along_level_sets(
    field: GuidingField, x: FloatArray, gradient: FloatArray
) -> dict[str, Any]:
    J_v = TangentField(field).value_and_jacobian(x)[1]
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    n = gradient / np.maximum(length, np.finfo(np.float64).tiny)
    # A quarter turn of n in every plane of two axes: T T^T = 1 - n n^T.
    pairs = list(combinations(range(field.dim), 2))
    T = np.zeros((*n.shape, len(pairs)))
    for column, (i, j) in enumerate(pairs):
        T[:, i, column], T[:, j, column] = -n[:, j], n[:, i]
    change = np.einsum("nij,njk->nik", J_v, T)
    squares = np.linalg.eigvalsh(change.swapaxes(1, 2) @ change)
    return spread(np.sqrt(np.maximum(squares[:, -1], 0)), x)


def _between_points(field: GuidingField, function: LyapunovFunction, x: FloatArray) -> float:
    """Returns the largest slope of v between points whose V is nearly the same."""
    order = np.argsort(function(x), kind="stable")
    starts = np.linspace(0, max(len(x) - PAIR_NEIGHBOURS, 0), PAIR_LEVELS).astype(int)
    largest = 0.0
    for start in starts:
        points = x[order[start : start + PAIR_NEIGHBOURS]]
        apart, change = pdist(points), pdist(field.tangent(points))
        distinct = apart > 0
        largest = max(largest, float((change[distinct] / apart[distinct]).max(initial=0.0)))
    return largest


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
