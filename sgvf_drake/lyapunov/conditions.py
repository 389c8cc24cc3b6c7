"""The paper's Section IV: assumptions, lemma and robustness bound, as printed and corrected."""

from collections.abc import Callable
from dataclasses import dataclass

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


@dataclass(frozen=True, eq=False)
class Spread:
    """How a quantity that should be small spreads over the samples.

    Attributes:
        mean: Its mean.
        quantiles: Its quantiles `QUANTILES`.
        largest: Its largest value.
        where: The point at which it is largest, (d,).
    """

    mean: float
    quantiles: FloatArray
    largest: float
    where: FloatArray

    @classmethod
    def of(cls, values: FloatArray, x: FloatArray) -> "Spread":
        """Returns the spread of values (n,) at points (n, d)."""
        worst = int(np.argmax(values))
        quantiles = np.quantile(values, QUANTILES)
        return cls(float(values.mean()), quantiles, float(values[worst]), x[worst])

    def summary(self) -> dict[str, object]:
        """Returns it by the names of `summary.json`."""
        named = {
            f"q{100 * q:.0f}": float(v) for q, v in zip(QUANTILES, self.quantiles, strict=True)
        }
        return {"mean": self.mean, **named, "max": self.largest, "where": self.where}


@dataclass(frozen=True)
class Assumptions:
    """What the samples say of A1 and A2 (A3 is a matter of sublevel sets and trajectories).

    Attributes:
        score_lipschitz: (A1) Largest |J_S| of the learned score, per unit of length squared.
        exact_lipschitz: The same of the exact score, which is grad log P of a density.
        score_curl: Median of |curl S| / |J_S|: zero for a gradient.
        cosine: (A2 i) |cos(s, v)| of the parts of m = s + v.
        network_cosine: |cos(S, v)| of the raw score and the tangent, before they are put
            together.
        gradient_cosine: |cos(grad V, v)|, which is what the decrease of V rests on.
        length: (A2 ii) | |m| - 1 |.
        along_level_sets: (A2 iii) Largest |J_v tau| with tau along the level set, per unit of
            length: the local Lipschitz constant L.
        between_points: The largest |v(x) - v(y)| / |x - y| over pairs of points of the grid
            whose V is nearly the same, also across from each other and between strands.
    """

    score_lipschitz: float
    exact_lipschitz: float
    score_curl: float
    cosine: Spread
    network_cosine: Spread
    gradient_cosine: Spread
    length: Spread
    along_level_sets: Spread
    between_points: float

    def summary(self) -> dict[str, object]:
        """Returns them by the names of `summary.json`."""
        return {
            "a1_score_lipschitz": self.score_lipschitz,
            "a1_exact_lipschitz": self.exact_lipschitz,
            "a1_score_curl": self.score_curl,
            "a2_cosine": self.cosine.summary(),
            "a2_cosine_networks": self.network_cosine.summary(),
            "a2_cosine_gradient": self.gradient_cosine.summary(),
            "a2_length_error": self.length.summary(),
            "a2_lipschitz_along_level_sets": self.along_level_sets.summary(),
            "a2_lipschitz_between_points": self.between_points,
        }


@dataclass(frozen=True)
class Lemma:
    """Lemma 1 as it stands and as it should: V_dot along the learned m, over the box.

    Attributes:
        paper_error: | -s . m + |s|^2 | = |s . v|, by which the paper's V_dot = -s . m misses
            -|s|^2.
        paper_share: Part of the box with -s . m < 0, where the paper's V_dot is negative.
        true_share: Part of the box with grad V . m < 0, where V decreases.
        sign_agreement: Part of the box where the two have the same sign.
        rise: V_dot where it is largest: mean over the box, quantiles, largest, where.
    """

    paper_error: Spread
    paper_share: float
    true_share: float
    sign_agreement: float
    rise: Spread

    def summary(self) -> dict[str, object]:
        """Returns it by the names of `summary.json`."""
        return {
            "paper_error": self.paper_error.summary(),
            "paper_falling_fraction": self.paper_share,
            "falling_fraction": self.true_share,
            "sign_agreement": self.sign_agreement,
            "v_dot": self.rise.summary(),
        }


def check_assumptions(
    field: GuidingField, function: LyapunovFunction, samples: Samples, seed: int = 0
) -> Assumptions:
    """Measures A1 and A2 over the box (paper, Section IV).

    Args:
        field: The field.
        function: V, whose gradient and level sets are meant.
        samples: The field at the points of a grid; only these count, since they are even.
        seed: Of the points at which Jacobians are taken.
    """
    x, s, v = (values[samples.on_grid] for values in (samples.x, samples.s, samples.v))
    rng = np.random.default_rng(seed)
    at = rng.choice(len(x), min(JACOBIAN_SAMPLES, len(x)), replace=False)
    J_S = ScoreField(field).value_and_jacobian(x[at])[1]
    gradient, hessian = function.gradient_and_hessian(x[at])
    return Assumptions(
        score_lipschitz=float(np.linalg.norm(J_S, ord=2, axis=(1, 2)).max()),
        exact_lipschitz=float(np.linalg.norm(hessian, ord=2, axis=(1, 2)).max()),
        score_curl=float(np.median(curl_share(J_S))),
        cosine=Spread.of(np.abs(cosine(s, v)), x),
        network_cosine=Spread.of(np.abs(cosine(field.score(x), field.tangent(x))), x),
        gradient_cosine=Spread.of(np.abs(cosine(function.gradient(x), v)), x),
        length=Spread.of(np.abs(np.linalg.norm(s + v, axis=1) - 1), x),
        along_level_sets=_along_level_sets(field, x[at], gradient),
        between_points=_between_points(field, function, x),
    )


def check_lemma(function: LyapunovFunction, samples: Samples) -> Lemma:
    """Measures Lemma 1 on the grid, with the paper's V_dot and with the true one."""
    x, s, v = (values[samples.on_grid] for values in (samples.x, samples.s, samples.v))
    paper = -(s * (s + v)).sum(axis=1)
    V_dot = function.derivative(x, s + v)
    return Lemma(
        paper_error=Spread.of(np.abs((s * v).sum(axis=1)), x),
        paper_share=float((paper < 0).mean()),
        true_share=float((V_dot < 0).mean()),
        sign_agreement=float(((paper < 0) == (V_dot < 0)).mean()),
        rise=Spread.of(V_dot, x),
    )


def _along_level_sets(field: GuidingField, x: FloatArray, gradient: FloatArray) -> Spread:
    J_v = TangentField(field).value_and_jacobian(x)[1]
    tau = gradient[:, ::-1] * [-1.0, 1.0]
    length = np.maximum(np.linalg.norm(tau, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    change = np.einsum("nij,nj->ni", J_v, tau / length)
    return Spread.of(np.linalg.norm(change, axis=1), x)


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
