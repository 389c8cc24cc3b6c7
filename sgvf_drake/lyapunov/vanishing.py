"""Where the score vanishes: the paper's claim about it, measured.

The paper (Section "Score Vanishing and Singularities in Learned Vector Fields") holds that the
score vanishes mostly at low density, at high curvature, and at loops, branches and holes.  Each
part is a comparison here, of the zeros of the score with places drawn evenly; the shape of the
path is measured as the score sees it, after a blur.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from scipy.stats import mannwhitneyu, spearmanr

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov.zeros import FieldZeros, Singularities
from sgvf_drake.paths import Piece, Reference, ReferencePath, TreeReference, trace_pieces

NEAR_PATH = 3.0
"""A place is on the path, or near it, within this many noise levels."""

# Cells along each axis of the grid over the box that stands for its area.
GRID_SIZE = 201
# A zero of the score and one of m meet within this many noise levels.
MEETING = 1.0
# |S| sigma below this is small; so it is within half a noise level of the path.
SMALL_SCORE = 0.5
# The chance that zeros are called concentrated by accident.
SIGNIFICANCE = 0.05
# Curvatures of which the largest exceeds the median by less than this share are one.
ALIKE = 0.01
# Distance of neighbouring samples, and standard deviation of the blur along the path, in noise
# levels: a corner is as sharp as its density, and the jags of a tree are smoothed out.
SAMPLE_SPACING = 0.5
BLUR = 2.0
# Where the blur is cut off, in its standard deviations; nearer, its derivatives are biased.
REACH = 8.0
# A piece has at least this many samples, however short it is.
FEWEST_SAMPLES = 8
# A path whose radius is more than a thousand noise levels is straight.
STRAIGHT = 1e-3
# A branch of the tree is longer than this many noise levels; shorter ones are noise.
BRANCH_LENGTH = 6.0


@dataclass(frozen=True, eq=False)
class PathShape:
    """A planar path at n places, evenly spaced along each piece.

    Attributes:
        points: (n, 2) the places.
        tangents: (n, 2) unit vectors along the blurred path.
        curvature: (n,) of the blurred path, not negative, per unit of length; zero where it
            is straight.
        branches: (B, 2) the waypoints at which the path branches.
    """

    points: FloatArray
    tangents: FloatArray
    curvature: FloatArray
    branches: FloatArray


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
class Surroundings:
    """What is at each of k zeros.

    Attributes:
        indices: (k,) their Poincare indices.
        isolated: (k,) whether it is one place, and does not stand for a line of zeros.
        log_density: (k,) log p of the mixture.
        density_percentile: (k,) part of the box in which the density is lower, 0 to 1.
        path_distance: (k,) to the path.
        on_path: (k,) whether that is at most `NEAR_PATH` noise levels.
        curvature: (k,) of the path nearby, per unit of length; NaN off the path, and on a side
            branch, whose curvature is not known.
        guiding_norm: (k,) |m|.
        score_norm: (k,) |S| sigma.
        other_distance: (k,) to the nearest zero of another field; infinite where it has none.
    """

    indices: IntArray
    isolated: BoolArray
    log_density: FloatArray
    density_percentile: FloatArray
    path_distance: FloatArray
    on_path: BoolArray
    curvature: FloatArray
    guiding_norm: FloatArray
    score_norm: FloatArray
    other_distance: FloatArray

    def at(self, number: int) -> dict[str, Any]:
        """Returns what is around one of the zeros, by name."""
        of_zero = ("indices", "isolated")
        names = (column.name for column in fields(self) if column.name not in of_zero)
        return {name: getattr(self, name)[number] for name in names}


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
        zeros_on_path: Number of the zeros of the score on the path.
        zeros_off_path: Number of the others.
        index_sum_on_path: Sum of the indices of those on the path.
        index_sum_off_path: Sum of the indices of the others.
        density_correlation: Of |S| with log p over the box off the path (Spearman's); it is
            positive where the score is small at low density.
        median_curvature: Of the path, per unit of length.
        curvature_correlation: Of |S . T| with the curvature, along the path with its tangent
            T (Spearman's); negative where the score is small at high curvature.  None: the
            path has one curvature.
        small_score: Of the places where |S| sigma is `below` some value: the `fraction` of
            the box that they are, and the parts of them `near_path` (NaN where there are
            none) and of `low_density`, in the half of the box that has the lower density.
        score_zeros_at_guiding_zeros: Number of the zeros of the score that meet one of m.
        guiding_zeros_at_score_zeros: Number of the zeros of m that meet one of the score.
        guiding_min_at_score_zeros_on_path: The smallest |m| at a zero of the score on the
            path; infinite where there is none.
    """

    score: Surroundings
    guiding: Surroundings
    low_density: Concentration | None
    low_density_off_path: Concentration | None
    high_curvature: Concentration | None
    branches: Concentration | None
    zeros_on_path: int
    zeros_off_path: int
    index_sum_on_path: int
    index_sum_off_path: int
    density_correlation: float
    median_curvature: float
    curvature_correlation: float | None
    small_score: dict[str, float]
    score_zeros_at_guiding_zeros: int
    guiding_zeros_at_score_zeros: int
    guiding_min_at_score_zeros_on_path: float

    def summary(self) -> dict[str, Any]:
        """Returns the verdicts and the numbers behind them, by the names of `summary.json`."""
        found = {}
        for column in fields(self)[2:]:
            value = getattr(self, column.name)
            is_claim = isinstance(value, Concentration)
            found[column.name] = {"holds": value.holds, **asdict(value)} if is_claim else value
        return found


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
    x = _middles(found.box)
    S = np.linalg.norm(field.score(x), axis=1) * sigma
    log_density = field.mixture.log_density(x)
    near = reference.project(x).distance <= NEAR_PATH * sigma
    shape = path_shape(reference, field.cloud, sigma)
    score, guiding = (
        _surroundings(zeros, other, field, log_density, reference, shape)
        for zeros, other in ((found.score, found.guiding), (found.guiding, found.score))
    )
    isolated, on_path, small = score.isolated, score.on_path, S < SMALL_SCORE
    varies = bool(shape.curvature.max() > (1 + ALIKE) * np.median(shape.curvature))
    curvature = score.curvature[isolated & np.isfinite(score.curvature)]
    along = np.abs((field.score(shape.points) * shape.tangents).sum(axis=1))
    return Vanishing(
        score=score,
        guiding=guiding,
        low_density=Concentration.of(-score.log_density[isolated], -log_density),
        low_density_off_path=Concentration.of(
            -score.log_density[isolated & ~on_path], -log_density[~near]
        ),
        high_curvature=Concentration.of(curvature, shape.curvature) if varies else None,
        branches=_near_branches(found.score.points[isolated & on_path], shape),
        zeros_on_path=int(on_path.sum()),
        zeros_off_path=int((~on_path).sum()),
        index_sum_on_path=int(score.indices[on_path].sum()),
        index_sum_off_path=int(score.indices[~on_path].sum()),
        density_correlation=float(spearmanr(S[~near], log_density[~near])[0]),
        median_curvature=float(np.median(shape.curvature)),
        curvature_correlation=float(spearmanr(along, shape.curvature)[0]) if varies else None,
        small_score={
            "below": SMALL_SCORE,
            "fraction": float(small.mean()),
            "near_path": _share(near[small]),
            "low_density": _share(log_density[small] < np.median(log_density)),
        },
        # Where score vanishing meets a zero of m, and where not.
        score_zeros_at_guiding_zeros=int((score.other_distance <= MEETING * sigma).sum()),
        guiding_zeros_at_score_zeros=int((guiding.other_distance <= MEETING * sigma).sum()),
        guiding_min_at_score_zeros_on_path=float(
            score.guiding_norm[on_path].min(initial=np.inf)
        ),
    )


def _middles(box: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Returns the middles of equal cells of a box, (n, 2)."""
    steps = (np.arange(GRID_SIZE) + 0.5) / GRID_SIZE
    unit = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return np.asarray(box[0] + unit * (box[1] - box[0]))


def _surroundings(
    zeros: FieldZeros,
    other: FieldZeros,
    field: GuidingField,
    log_density: FloatArray,
    reference: Reference,
    shape: PathShape,
) -> Surroundings:
    """Looks around the zeros of m or of the score of a field.

    Args:
        zeros: The zeros.
        other: Those of another field, the nearest of which are wanted.
        field: The guiding field.
        log_density: (n,) log p at places drawn evenly from the box.
        reference: The path.
        shape: The shape of the path.
    """
    x, mixture = zeros.points, field.mixture
    here, near = mixture.log_density(x), NEAR_PATH * mixture.sigma
    lower = np.searchsorted(np.sort(log_density), here)
    distance = reference.project(x).distance
    to_sample, sample = _nearest(shape.points, x)
    return Surroundings(
        indices=np.array([zero.index for zero in zeros.zeros], np.intp),
        isolated=np.array([zero.kind != "degenerate" for zero in zeros.zeros], bool),
        log_density=here,
        density_percentile=lower / len(log_density),
        path_distance=distance,
        on_path=distance <= near,
        curvature=np.where(to_sample <= near, shape.curvature[sample], np.nan),
        guiding_norm=np.linalg.norm(field(x), axis=1),
        score_norm=np.linalg.norm(field.score(x), axis=1) * mixture.sigma,
        other_distance=_nearest(other.points, x)[0],
    )


def _near_branches(zeros: FloatArray, shape: PathShape) -> Concentration | None:
    if not len(shape.branches):
        return None
    away, even = (_nearest(shape.branches, x)[0] for x in (zeros, shape.points))
    return Concentration.of(-away, -even)


def _nearest(points: FloatArray, x: FloatArray) -> tuple[FloatArray, IntArray]:
    """Returns the distance from x (n, 2) to the nearest of points (k, 2), and its number.

    Infinite, and k, where there are no points.
    """
    distance, number = cKDTree(points).query(x)
    return np.asarray(distance), np.asarray(number)


def _share(chosen: BoolArray) -> float:
    return float(chosen.mean()) if len(chosen) else np.nan


def path_shape(reference: Reference, cloud: PointCloud, sigma: float) -> PathShape:
    """Measures a path.

    Args:
        reference: The path; of a tree, its longest path without the branches.
        cloud: The waypoints, of whose tree the branches are taken.
        sigma: The noise level, in the same unit.
    """
    samples = [_sample(piece, sigma) for piece in _polylines(reference)]
    points, tangents, curvature = (np.concatenate(part) for part in zip(*samples, strict=True))
    return PathShape(points, tangents, curvature, _branches(cloud.points, sigma))


def _polylines(reference: Reference) -> Sequence[Piece]:
    if isinstance(reference, ReferencePath):
        return reference.pieces
    assert isinstance(reference, TreeReference), type(reference)
    # An isolated waypoint is no line.
    return [
        Piece(reference.points[piece.order], piece.closed)
        for piece in reference.pieces
        if len(piece.order) > 1
    ]


def _sample(piece: Piece, sigma: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns places (n, 2), tangents (n, 2) and curvature (n,) of one piece."""
    points = piece.sample(max(FEWEST_SAMPLES, round(piece.length / (SAMPLE_SPACING * sigma))))
    blur, mode = BLUR / SAMPLE_SPACING, "wrap" if piece.closed else "nearest"
    # The derivatives of the blurred path, in noise levels for each sample.
    along, bend = (
        gaussian_filter1d(points / sigma, blur, axis=0, order=order, mode=mode, truncate=REACH)
        for order in (1, 2)
    )
    # A path that turns back on itself has no direction there.
    speed = np.maximum(np.linalg.norm(along, axis=1), np.finfo(np.float64).eps)
    cross = along[:, 0] * bend[:, 1] - along[:, 1] * bend[:, 0]
    bending = np.abs(cross) / speed**3
    bending[bending < STRAIGHT] = 0.0
    return points, along / speed[:, None], bending / sigma


def _branches(points: FloatArray, sigma: float) -> FloatArray:
    """Returns the waypoints at which long side branches leave the longest paths, (B, 2)."""
    found = [np.empty(0, np.intp)]
    for piece in trace_pieces(points):
        first, second = piece.edges.T
        lengths = np.linalg.norm(points[first] - points[second], axis=1)
        # A sparse graph holds no edges of length zero, as between copies of a waypoint.
        some = lengths > 0
        graph = coo_array(
            (lengths[some], (first[some], second[some])), shape=(len(points), len(points))
        )
        aside, _, source = dijkstra(
            graph.tocsr(),
            directed=False,
            indices=piece.order,
            min_only=True,
            return_predecessors=True,
        )
        far = np.isfinite(aside) & (aside > BRANCH_LENGTH * sigma)
        found.append(np.unique(source[far]))
    return points[np.concatenate(found)]
