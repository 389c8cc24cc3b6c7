"""Where the score vanishes: the paper's claim about it, measured.

The paper (Section "Score Vanishing and Singularities in Learned Vector Fields") holds that the
score vanishes mostly at low density, at high curvature, and at loops, branches and holes.  Each
part is a comparison here, of the zeros of the score with places drawn evenly.
"""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from scipy.stats import mannwhitneyu, spearmanr

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov.path_shape import PathShape, path_shape
from sgvf_drake.lyapunov.singularities import Singularities
from sgvf_drake.lyapunov.surroundings import BoxSamples, Surroundings, nearest
from sgvf_drake.paths import Reference

# A zero of the score and one of m meet within this many noise levels.
MEETING = 1.0
# |S| sigma below this is small; so it is within half a noise level of the path.
SMALL_SCORE = 0.5
# The chance that zeros are called concentrated by accident.
SIGNIFICANCE = 0.05
# Curvatures of which the largest exceeds the median by less than this share are one.
ALIKE = 0.01


@dataclass(frozen=True)
class Concentration:
    """Whether zeros keep to some kind of place, more than places drawn evenly do.

    Attributes:
        probability: That a zero has more of what is claimed than an even place has: 0.5
            where zeros do not care, 1 where every zero has the most.
        p_value: The chance of at least this probability where they do not care (one-sided
            Mann-Whitney test).
    """

    probability: float
    p_value: float

    @classmethod
    def of(cls, zeros: FloatArray, even: FloatArray) -> "Concentration | None":
        """Compares values at zeros (k,) with those at even places (n,); None: no values."""
        if not (len(zeros) and len(even)):
            return None
        test = mannwhitneyu(zeros, even, alternative="greater", method="asymptotic")
        return cls(float(test.statistic / (len(zeros) * len(even))), float(test.pvalue))

    @property
    def holds(self) -> bool:
        """Whether zeros concentrate there, and not by accident."""
        return self.probability > 0.5 and self.p_value < SIGNIFICANCE


@dataclass(frozen=True, eq=False)
class Vanishing:
    """Where the score of a field vanishes.

    Lines of zeros, which have no place, do not count in the comparisons.

    Attributes:
        score: What is at the zeros of the score.
        guiding: What is at the zeros of m.
        low_density: Whether the zeros of the score keep to low density, against the box.
        low_density_off_path: The same of those off the path, against the box off the path.
        high_curvature: Whether those on the path keep to high curvature, against the path;
            None: the path has one curvature, or there are none.
        branches: Whether those on the path keep near its branches, against the path; None:
            it has no branch, or there are none.
        density_correlation: Of |S| with log p over the box off the path (Spearman's); it is
            positive where the score is small at low density.
        median_curvature: Of the path, per unit of length.
        curvature_correlation: Of |S . T| with the curvature, along the path with its tangent
            T (Spearman's); negative where the score is small at high curvature.  None: the
            path has one curvature.
        small_fraction: Part of the box in which |S| sigma is below `SMALL_SCORE`.
        small_near_path: Part of that near the path; NaN where the score is small nowhere.
        small_low_density: Part of it in the half of the box that has the lower density.
        sigma: The noise level, in the unit of the waypoints.
    """

    score: Surroundings
    guiding: Surroundings
    low_density: Concentration | None
    low_density_off_path: Concentration | None
    high_curvature: Concentration | None
    branches: Concentration | None
    density_correlation: float
    median_curvature: float
    curvature_correlation: float | None
    small_fraction: float
    small_near_path: float
    small_low_density: float
    sigma: float

    def summary(self) -> dict[str, Any]:
        """Returns the verdicts and the numbers behind them."""
        on_path, indices = self.score.on_path, self.score.indices
        claims = ("low_density", "low_density_off_path", "high_curvature", "branches")
        return {
            **{name: _verdict(getattr(self, name)) for name in claims},
            "zeros_on_path": int(on_path.sum()),
            "zeros_off_path": int((~on_path).sum()),
            "index_sum_on_path": int(indices[on_path].sum()),
            "index_sum_off_path": int(indices[~on_path].sum()),
            "density_correlation": self.density_correlation,
            "median_curvature": self.median_curvature,
            "curvature_correlation": self.curvature_correlation,
            "small_score": {
                "below": SMALL_SCORE,
                "fraction": self.small_fraction,
                "near_path": self.small_near_path,
                "low_density": self.small_low_density,
            },
            # Where score vanishing meets a zero of m, and where not.
            "score_zeros_at_guiding_zeros": self._meeting(self.score),
            "guiding_zeros_at_score_zeros": self._meeting(self.guiding),
            "guiding_min_at_score_zeros_on_path": float(
                self.score.guiding_norm[on_path].min(initial=np.inf)
            ),
        }

    def _meeting(self, zeros: Surroundings) -> int:
        return int((zeros.other_distance <= MEETING * self.sigma).sum())


def measure_vanishing(
    field: GuidingField, found: Singularities, reference: Reference
) -> Vanishing:
    """Measures where the score of a planar field vanishes.

    Args:
        field: The field.
        found: Its singularities.
        reference: The path, in the field's unit.
    """
    sigma = field.mixture.sigma
    samples = BoxSamples.of(field, found.box, reference)
    shape = path_shape(reference, field.cloud, sigma)
    score, guiding = (
        Surroundings.of(zeros, other, field, samples, reference, shape)
        for zeros, other in ((found.score, found.guiding), (found.guiding, found.score))
    )
    isolated, off = score.isolated, ~samples.on_path
    small = samples.score < SMALL_SCORE
    return Vanishing(
        score=score,
        guiding=guiding,
        low_density=Concentration.of(-score.log_density[isolated], -samples.log_density),
        low_density_off_path=Concentration.of(
            -score.log_density[isolated & ~score.on_path], -samples.log_density[off]
        ),
        high_curvature=_at_curvature(score.curvature[isolated], shape),
        branches=_near_branches(found.score.points[isolated & score.on_path], shape),
        density_correlation=float(spearmanr(samples.score[off], samples.log_density[off])[0]),
        median_curvature=float(np.median(shape.curvature)),
        curvature_correlation=_curvature_correlation(field, shape),
        small_fraction=float(small.mean()),
        small_near_path=_share(samples.on_path[small]),
        small_low_density=_share(samples.log_density[small] < np.median(samples.log_density)),
        sigma=sigma,
    )


def _at_curvature(curvature: FloatArray, shape: PathShape) -> Concentration | None:
    if _has_one_curvature(shape):
        return None
    return Concentration.of(curvature[np.isfinite(curvature)], shape.curvature)


def _near_branches(zeros: FloatArray, shape: PathShape) -> Concentration | None:
    if not len(shape.branches):
        return None
    away, even = (nearest(shape.branches, x)[0] for x in (zeros, shape.points))
    return Concentration.of(-away, -even)


def _curvature_correlation(field: GuidingField, shape: PathShape) -> float | None:
    if _has_one_curvature(shape):
        return None
    along = np.abs((field.score(shape.points) * shape.tangents).sum(axis=1))
    return float(spearmanr(along, shape.curvature)[0])


def _has_one_curvature(shape: PathShape) -> bool:
    return bool(shape.curvature.max() <= (1 + ALIKE) * np.median(shape.curvature))


def _share(chosen: BoolArray) -> float:
    return float(chosen.mean()) if len(chosen) else np.nan


def _verdict(claim: Concentration | None) -> dict[str, Any] | None:
    return None if claim is None else {"holds": claim.holds, **asdict(claim)}
