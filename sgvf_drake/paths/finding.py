"""From a cloud to its network of paths.

The ridge of the density is found on a ladder of scales.  Each scale votes for the topology
that it shows; the finest of those with nearly the most votes is taken.  In the plane, the
persistence of the alpha complex tells the number of loops independently.  Where few scales
agree, or both ways differ, the network is returned all the same, and says that it is unsure.

The paths through sparse waypoints are the shortest ones instead, unless the ridge shows where
strands meet; so are those through few and even ones, where they are sure.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import QhullError, cKDTree

from sgvf_drake.arrays import FloatArray
from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError, PointCloudError
from sgvf_drake.paths.assembly import Graph, Signature, assemble
from sgvf_drake.paths.draft import Direction, Draft
from sgvf_drake.paths.loops import Holes, find_holes
from sgvf_drake.paths.meetings import strands_pass
from sgvf_drake.paths.network import PathNetwork
from sgvf_drake.paths.ridge import THINNING_CELL, find_ridge, thin
from sgvf_drake.paths.skeleton import grow_skeleton
from sgvf_drake.paths.tours import DOUBT, PathsByTours, find_tours
from sgvf_drake.paths.valleys import runs_in_valley

FINEST_SCALE, COARSEST_SCALE = 0.02, 0.75
"""The ladder, in U: at the coarsest, circles of diameter 2.25 U are still seen as loops."""

SCALE_PER_SPACING = 0.7
"""Below this, the density falls apart into single waypoints."""

SCALE_RATIO = 2**0.25
"""Between neighbouring scales; half of its logarithm made no difference."""

FEWEST_SCALES = 7
"""The coarsest scales vote in any case."""

THICK_DIMENSION = 1.5
"""Box-counting dimension halfway between a line and an area."""

MOST_CELLS = 20_000
"""Scales at which a cloud fills more cells are left out, which bounds time and memory."""

MANY_POINTS = 4_000
"""Larger clouds are averaged over the cells of the finest scale."""

NEARLY_MOST_VOTES = 0.6
"""The finest topology with this share of the most votes is taken."""

FEW_VOTES = 2
"""With no more votes than this, the scales do not tell, and the simplest topology is taken."""

LEAST_SHARE, LEAST_SHARE_ALONE = 0.18, 0.36
"""A topology is sure if this share of the scales shows it, and persistence has as many loops;
or if this share shows it in space, where there is no second opinion."""

FEWEST_VOTES = 2
"""A topology that one scale alone shows is not sure, though all others merge strands."""

REMEDY = "more waypoints would decide, or a scale to look at (sigma)"
PASSES = ", or that they are passes of one path (passes)"
"""What would decide where the points do not."""


@dataclass(frozen=True, eq=False)
class Scale:
    """What the ridge shows at one scale.

    Attributes:
        sigma: The scale.
        graph: The graph.
        reach: The widest gap that was bridged, had there been one.
        merges: Whether a line runs between two strands, which are one at this scale.
    """

    sigma: float
    graph: Graph
    reach: float
    merges: bool


def find_paths(
    cloud: PointCloud,
    *,
    sigma: float | None = None,
    closed: bool | None = None,
    passes: bool = False,
    direction: Direction | Sequence[Direction | None] | None = None,
    start: ArrayLike | None = None,
) -> PathNetwork:
    """Finds the network of paths in a cloud, in the plane or in space.

    The order of the points never decides what is found, but where they were recorded along
    the path it tells its direction, where a recording ends, and that it goes on from one row
    to the next.  What was used is told in the messages of the network.

    Args:
        cloud: The waypoints.
        sigma: The scale in U at which to look; None: the scales vote.
        closed: Whether pieces that are one path are closed, or have ends; None: as they look.
        passes: Whether all waypoints are passes of one path, whose spread is scatter.
        direction: Of pieces that are one path, for all or one for each, the longest first:
            "ccw", "cw" or "reverse"; None: by the start, the velocities, the order of the
            points, or else counter-clockwise, and open ones from the end with the smaller x.
        start: (d,) in the unit of the waypoints: open paths start at the end nearer to it.

    Raises:
        PointCloudError: If no path is found.
        ConfigurationError: If the direction or the start does not fit what was found.
    """
    start = None if start is None else np.asarray(start, dtype=np.float64)
    if start is not None and len(start) != cloud.dim:
        raise ConfigurationError(
            f"start has {len(start)} coordinates, the waypoints have {cloud.dim}"
        )
    # The topology does not depend on the order of the points, not even in its last digit.
    points = cloud.normalize(cloud.points)
    points = points[np.lexsort(points.T[::-1])]
    weights = np.ones(len(points))
    tours = None if passes or sigma is not None else find_tours(points)
    chosen, unsure = (None, None) if tours is None else _from_tours(tours, points)
    if tours is None or not (tours.apart if tours.is_sparse else unsure is None):
        sigmas = [sigma] if sigma is not None else _ladder(points)
        if len(points) > MANY_POINTS:
            points, weights = thin(points, weights, THINNING_CELL * sigmas[0])
        scales = [_at_scale(points, weights, s) for s in sigmas]
        voted, doubt = _vote(points, scales, passes)
        # Of sparse clouds, only strands that meet are left to the ridge.
        if tours is None or not tours.is_sparse or (voted and tours.meet_in(voted.graph)):
            chosen, unsure = voted, doubt
    if chosen is None:
        what = "one path of which they are passes" if passes else "path"
        raise PointCloudError(f"the waypoints show no {what} at any scale")
    draft = Draft(cloud, points, weights, chosen.graph, chosen.sigma)
    if unsure is None and sigma is None and not passes:
        doubt = draft.doubt(_holes(points), chosen.reach)
        unsure = doubt and f"{doubt}; {_remedy([chosen.graph.signature])}"
    draft.use_recording(closed)
    draft.give_directions(direction, start)
    return draft.network(unsure)


def _ladder(points: FloatArray) -> list[float]:
    """The scales to look at: from the spacing and the scatter of the waypoints up."""
    third = cKDTree(points).query(points, k=min(4, len(points)))[0][:, -1]
    spacing = float(np.median(third)) / 1.5
    finest = max(FINEST_SCALE, SCALE_PER_SPACING * spacing)
    coarsest = max(COARSEST_SCALE, 3 * finest)
    steps = int(np.ceil(np.log(coarsest / finest) / np.log(SCALE_RATIO)))
    sigmas = [finest * SCALE_RATIO**k for k in range(steps)]
    thick = [k for k, sigma in enumerate(sigmas[:-FEWEST_SCALES]) if _is_thick(points, sigma)]
    return sigmas[max(thick, default=-1) + 1 :]


def _is_thick(points: FloatArray, sigma: float) -> bool:
    """Whether the cloud fills space at a scale, as it does below its scatter.

    By its box-counting dimension: the cells that a thin line fills are twice as many where they
    are half as large, those of a filled area four times.
    """
    fine, coarse = (
        len(np.unique(np.floor(points / cell), axis=0))
        for cell in (THINNING_CELL * sigma, 2 * THINNING_CELL * sigma)
    )
    return fine > MOST_CELLS or fine > coarse * 2**THICK_DIMENSION


def _at_scale(points: FloatArray, weights: FloatArray, sigma: float) -> Scale:
    ridge = find_ridge(points, weights, sigma)
    skeleton = grow_skeleton(ridge, points, weights, sigma)
    graph = assemble(skeleton, sigma)
    merges = bool(graph.strands) and runs_in_valley(graph, points, sigma)
    return Scale(sigma, graph, skeleton.reach, merges)


def _from_tours(tours: PathsByTours, points: FloatArray) -> tuple[Scale, str | None]:
    """The paths by tours, and why they are unsure, if they are."""
    sigma = SCALE_PER_SPACING * tours.step
    scale = Scale(sigma, tours.graph, tours.gap, merges=False)
    sure = tours.sure and _agrees(tours.graph.signature, _holes(points), scale)
    return scale, None if sure else DOUBT


def _vote(
    points: FloatArray, scales: Sequence[Scale], passes: bool
) -> tuple[Scale | None, str | None]:
    """Returns the scale whose topology is taken, if any, and why that is unsure, if it is."""
    given = len(scales) == 1
    signatures = [scale.graph.signature for scale in scales if scale.graph.strands]
    remedy = _remedy(signatures)
    # To passes of one path, the valleys between them mean nothing.
    if not passes and not all(scale.merges for scale in scales):
        scales = [scale for scale in scales if not scale.merges]
    votes: dict[Signature, list[int]] = defaultdict(list)
    for k, scale in enumerate(scales):
        if scale.graph.strands:
            votes[scale.graph.signature].append(k)
    if passes:
        votes = {s: ks for s, ks in votes.items() if _is_one_path(s)}
    if not votes:
        return None, None
    holes = None if passes or given else _holes(points)
    agreeing = {
        s: kept
        for s, ks in votes.items()
        if (kept := [k for k in ks if _agrees(s, holes, scales[k])])
    }
    pool = agreeing if any(len(ks) >= 2 for ks in agreeing.values()) else votes
    taken = _elected(pool)
    chosen = scales[_second_of_run(pool[taken])]
    if passes or given:
        return chosen, None
    if chosen.merges:
        return chosen, f"a line runs in the middle between two strands; {remedy}"
    if not _agrees(taken, holes, chosen):
        assert holes is not None
        return chosen, (
            f"the ridge shows {taken.cycles} loops, but the holes between the waypoints "
            f"{holes.loops(chosen.sigma, chosen.reach)}; {remedy}"
        )
    seen = len(votes[taken])
    share = LEAST_SHARE_ALONE if holes is None else LEAST_SHARE
    if seen < max(FEWEST_VOTES, share * len(scales)):
        return chosen, (f"only {seen} of {len(scales)} scales show these paths; {remedy}")
    if strands_pass(chosen.graph, points, chosen.sigma):
        return chosen, f"strands that meet may only pass each other; {remedy}"
    rivals = [s for s, ks in pool.items() if s != taken and len(ks) >= len(pool[taken])]
    if rivals:
        return chosen, f"as many scales show {rivals[0]}; {remedy}"
    return chosen, None


def _agrees(found: Signature, holes: Holes | None, scale: Scale) -> bool:
    """Whether persistence shows as many loops, if it can tell."""
    return holes is None or found.cycles == holes.loops(scale.sigma, scale.reach)


def _remedy(seen: Sequence[Signature]) -> str:
    return REMEDY + (PASSES if any(map(_is_one_path, seen)) else "")


def _is_one_path(found: Signature) -> bool:
    return found.pieces == 1 and not found.junctions


def _elected(votes: Mapping[Signature, Sequence[int]]) -> Signature:
    """The finest topology with nearly the most votes; where votes are few, the simplest."""
    most = max(map(len, votes.values()))
    if most <= FEW_VOTES:
        candidates = [s for s, ks in votes.items() if len(ks) >= most - 1]
        return min(candidates, key=lambda s: (s.complexity, -len(votes[s]), votes[s][0]))
    candidates = [s for s, ks in votes.items() if len(ks) >= NEARLY_MOST_VOTES * most]
    return min(candidates, key=lambda s: votes[s][0])


def _second_of_run(ks: Sequence[int]) -> int:
    """The second scale of the first run of three or more, or of the longest run."""
    runs: list[list[int]] = []
    for k in ks:
        if runs and k == runs[-1][-1] + 1:
            runs[-1].append(k)
        else:
            runs.append([k])
    longest = max(map(len, runs))
    run = next(run for run in runs if len(run) >= min(3, longest))
    return run[1] if len(run) >= 3 else run[0]


def _holes(points: FloatArray) -> Holes | None:
    """The holes between the waypoints; None where there can be none, or they tell nothing."""
    if points.shape[1] != 2:
        return None
    try:
        return find_holes(np.unique(points, axis=0))
    except QhullError:
        return None
