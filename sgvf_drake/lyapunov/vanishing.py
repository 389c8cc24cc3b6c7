"""Where the score vanishes: the paper's claim about it, measured.

The paper (Section "Score Vanishing and Singularities in Learned Vector Fields") holds that the
score vanishes mostly at low density, at high curvature, and at loops, branches and holes.  Each
part is a comparison here, of the zeros of the score with places drawn evenly; the shape of the
path is measured as the score sees it, after a blur.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
import pandas as pd
from scipy.ndimage import gaussian_filter1d
from scipy.spatial import cKDTree
from scipy.stats import mannwhitneyu, spearmanr

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov.zeros import FieldZeros, Singularities
from sgvf_drake.paths import Piece, ReferencePath

NEAR_PATH = 3.0
"""A place is on the path, or near it, within this many noise levels."""

# Cells of the grid over the box that stands for its area, or its volume.
GRID_CELLS = 201**2
# A zero of the score and one of m meet within this many noise levels.
MEETING = 1.0
# |S| sigma below this is small; so it is within half a noise level of the path.
SMALL_SCORE = 0.5
# The chance that zeros are called concentrated by accident.
SIGNIFICANCE = 0.05
# Curvatures of which the largest exceeds the median by less than this share are one.
ALIKE = 0.01
# Distance of neighbouring samples, and standard deviation of the blur along the path, in noise
# levels: a corner is as sharp as its density, and the jags of waypoints are smoothed out.
SAMPLE_SPACING = 0.5
BLUR = 2.0
# Where the blur is cut off, in its standard deviations; nearer, its derivatives are biased.
REACH = 8.0
# A piece has at least this many samples, however short it is.
FEWEST_SAMPLES = 8
# A path whose radius is more than a thousand noise levels is straight.
STRAIGHT = 1e-3


@dataclass(frozen=True, eq=False)
class PathShape:
    """A path at n places, evenly spaced along each piece.

    Attributes:
        points: (n, d) the places.
        tangents: (n, d) unit vectors along the blurred path.
        curvature: (n,) of the blurred path, not negative, per unit of length; zero where it
            is straight.
        branches: (B, d) the places where the path branches.
    """

    points: FloatArray
    tangents: FloatArray
    curvature: FloatArray
    branches: FloatArray


@dataclass(frozen=True, eq=False)
class Vanishing:
    """Where the score of a field vanishes.

    Attributes:
        score: What is at each zero of the score, one row a zero, with the columns
            indices: their Poincare indices;
            isolated: whether it is one place, and does not stand for a line of zeros;
            log_density: log p of the mixture;
            density_percentile: part of the box in which the density is lower, 0 to 1;
            path_distance: to the path;
            on_path: whether that is at most `NEAR_PATH` noise levels;
            curvature: of the path nearby, per unit of length; NaN off the path;
            guiding_norm: |m|;
            score_norm: |S| sigma;
            other_distance: to the nearest zero of m; infinite where it has none.
        guiding: The same of the zeros of m; their other_distance is that to the zeros of the
            score.
        summary: The verdicts and the numbers behind them; see `measure_vanishing`.
    """

    score: pd.DataFrame
    guiding: pd.DataFrame
    summary: dict[str, Any]


def measure_vanishing(
    field: GuidingField, found: Singularities, reference: ReferencePath
) -> Vanishing:
    """Measures where the score of a field vanishes.

    - low_density: whether the zeros of the score keep to low density, against the box;
      low_density_off_path: the same of those off the path, against the box off the path;
      high_curvature: whether those on the path keep to high curvature, against the path,
      None where the path has one curvature; branches: whether those on the path keep near
      its branches, against the path, None where it has none.
    - zeros_on_path, zeros_off_path, index_sum_on_path, index_sum_off_path: of the score.
    - density_correlation: of |S| with log p over the box off the path (Spearman's); it is
      positive where the score is small at low density.
    - median_curvature: of the path, per unit of length; curvature_correlation: of |S . T|
      with the curvature, along the path with its tangent T (Spearman's), negative where
      the score is small at high curvature, None where the path has one curvature.
    - small_score: of the places where |S| sigma is `below` some value, the `fraction` of
      the box that they are, and the parts of them `near_path` (NaN where there are none)
      and of `low_density`, in the half of the box that has the lower density.
    - score_zeros_at_guiding_zeros, guiding_zeros_at_score_zeros: how many zeros of the one
      meet one of the other; guiding_min_at_score_zeros_on_path: the smallest |m| at a zero
      of the score on the path, infinite where there is none.

    Args:
        field: The field.
        found: Its singularities.
        reference: The path, in the field's unit.

    Returns:
        What is at the zeros, and a summary by the names of `summary.json`.  Its comparisons
        are those of `concentration`; lines of zeros, which have no place, do not count in them.
    """
    sigma = field.mixture.sigma
    x = _middles(found.box)
    S = np.linalg.norm(field.score(x), axis=1) * sigma
    log_density = field.mixture.log_density(x)
    near = reference.project(x).distance <= NEAR_PATH * sigma
    shape = path_shape(reference, _junctions(field), sigma)
    score, guiding = (
        _surroundings(zeros, other, field, log_density, reference, shape)
        for zeros, other in ((found.score, found.guiding), (found.guiding, found.score))
    )
    isolated, on_path, small = score["isolated"], score["on_path"], S < SMALL_SCORE
    varies = bool(shape.curvature.max() > (1 + ALIKE) * np.median(shape.curvature))
    curvature = score.loc[isolated, "curvature"].dropna()
    along = np.abs((field.score(shape.points) * shape.tangents).sum(axis=1))
    off_path = score.loc[isolated & ~on_path, "log_density"]
    met = [int((own["other_distance"] <= MEETING * sigma).sum()) for own in (score, guiding)]
    summary = {
        "low_density": concentration(-score.loc[isolated, "log_density"], -log_density),
        "low_density_off_path": concentration(-off_path, -log_density[~near]),
        "high_curvature": concentration(curvature, shape.curvature) if varies else None,
        "branches": _near_branches(found.score.points[isolated & on_path], shape),
        "zeros_on_path": int(on_path.sum()),
        "zeros_off_path": int((~on_path).sum()),
        "index_sum_on_path": int(score.loc[on_path, "indices"].sum()),
        "index_sum_off_path": int(score.loc[~on_path, "indices"].sum()),
        "density_correlation": float(spearmanr(S[~near], log_density[~near])[0]),
        "median_curvature": float(np.median(shape.curvature)),
        "curvature_correlation": (
            float(spearmanr(along, shape.curvature)[0]) if varies else None
        ),
        "small_score": {
            "below": SMALL_SCORE,
            "fraction": float(small.mean()),
            "near_path": _share(near[small]),
            "low_density": _share(log_density[small] < np.median(log_density)),
        },
        # Where score vanishing meets a zero of m, and where not.
        "score_zeros_at_guiding_zeros": met[0],
        "guiding_zeros_at_score_zeros": met[1],
        "guiding_min_at_score_zeros_on_path": float(
            score.loc[on_path, "guiding_norm"].to_numpy().min(initial=np.inf)
        ),
    }
    return Vanishing(score, guiding, summary)


def concentration(zeros: ArrayLike, even: ArrayLike) -> dict[str, Any] | None:
    """Compares values at zeros (k,) with those at even places (n,), of what is claimed.

    Returns:
        None without any values; else probability: that a zero has more of it than an even
        place has, 0.5 where zeros do not care, 1 where every zero has the most; p_value: the
        chance of at least this probability where they do not care (one-sided Mann-Whitney
        test); holds: whether zeros concentrate there, and not by accident.
    """
    count = np.size(zeros) * np.size(even)
    if count == 0:
        return None
    test = mannwhitneyu(zeros, even, alternative="greater", method="asymptotic")
    probability, p_value = float(test.statistic / count), float(test.pvalue)
    holds = probability > 0.5 and p_value < SIGNIFICANCE
    return {"holds": holds, "probability": probability, "p_value": p_value}


def _middles(box: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Returns the middles of equal cells of a box, (n, d)."""
    dim = len(box[0])
    count = round(GRID_CELLS ** (1 / dim))
    steps = (np.arange(count) + 0.5) / count
    unit = np.stack(np.meshgrid(*[steps] * dim), axis=-1).reshape(-1, dim)
    return np.asarray(box[0] + unit * (box[1] - box[0]))


def _surroundings(
    zeros: FieldZeros,
    other: FieldZeros,
    field: GuidingField,
    log_density: FloatArray,
    reference: ReferencePath,
    shape: PathShape,
) -> pd.DataFrame:
    """Looks around zeros; `log_density` is that at places drawn evenly from the box."""
    x, mixture = zeros.points, field.mixture
    here, near = mixture.log_density(x), NEAR_PATH * mixture.sigma
    lower = np.searchsorted(np.sort(log_density), here)
    distance = reference.project(x).distance
    to_sample, sample = _nearest(shape.points, x)
    return pd.DataFrame(
        {
            "indices": np.array([zero.index for zero in zeros.zeros], np.intp),
            "isolated": np.array([zero.kind != "degenerate" for zero in zeros.zeros], bool),
            "log_density": here,
            "density_percentile": lower / len(log_density),
            "path_distance": distance,
            "on_path": distance <= near,
            "curvature": np.where(to_sample <= near, shape.curvature[sample], np.nan),
            "guiding_norm": np.linalg.norm(field(x), axis=1),
            "score_norm": np.linalg.norm(field.score(x), axis=1) * mixture.sigma,
            "other_distance": _nearest(other.points, x)[0],
        }
    )


def _near_branches(zeros: FloatArray, shape: PathShape) -> dict[str, Any] | None:
    if not len(shape.branches):
        return None
    away, even = (_nearest(shape.branches, x)[0] for x in (zeros, shape.points))
    return concentration(-away, -even)


def _nearest(points: FloatArray, x: FloatArray) -> tuple[FloatArray, IntArray]:
    """Returns the distance from x (n, d) to the nearest of points (k, d), and its number.

    Infinite, and k, where there are no points.
    """
    distance, number = cKDTree(points).query(x)
    return np.asarray(distance), np.asarray(number)


def _share(chosen: BoolArray) -> float:
    return float(chosen.mean()) if len(chosen) else np.nan


def _junctions(field: GuidingField) -> FloatArray:
    """Returns where the paths of a field branch, (B, 2)."""
    nodes = [node.place for node in field.network.nodes if node.kind == "junction"]
    return np.reshape(nodes, (-1, field.dim))


def path_shape(reference: ReferencePath, branches: FloatArray, sigma: float) -> PathShape:
    """Measures a path.

    Args:
        reference: The path.
        branches: (B, d) where it branches.
        sigma: The noise level, in the same unit.
    """
    samples = [_sample(piece, sigma) for piece in reference.pieces]
    points, tangents, curvature = (np.concatenate(part) for part in zip(*samples, strict=True))
    return PathShape(points, tangents, curvature, branches)


def _sample(piece: Piece, sigma: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns places (n, d), tangents (n, d) and curvature (n,) of one piece."""
    points = piece.sample(max(FEWEST_SAMPLES, round(piece.length / (SAMPLE_SPACING * sigma))))
    blur, mode = BLUR / SAMPLE_SPACING, "wrap" if piece.closed else "nearest"
    # The derivatives of the blurred path, in noise levels for each sample.
    along, bend = (
        gaussian_filter1d(points / sigma, blur, axis=0, order=order, mode=mode, truncate=REACH)
        for order in (1, 2)
    )
    # A path that turns back on itself has no direction there.
    speed = np.maximum(np.linalg.norm(along, axis=1), np.finfo(np.float64).eps)
    across = along[:, :, None] * bend[:, None] - along[:, None] * bend[:, :, None]
    # Every part of the area between them is there twice.
    bending = np.sqrt((across**2).sum(axis=(1, 2)) / 2) / speed**3
    bending[bending < STRAIGHT] = 0.0
    return points, along / speed[:, None], bending / sigma
