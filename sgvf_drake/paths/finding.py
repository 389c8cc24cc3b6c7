"""From a cloud to its network of paths.

The ridge of the density is found on a ladder of scales.  Each scale votes for the topology that
it shows; the finest of those with nearly the most votes is taken.  In the plane, the persistence
of the alpha complex tells the number of loops independently.  Where few scales agree, or both
ways differ, the network is returned all the same, and says that it is unsure.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import QhullError, cKDTree

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import PointCloudError
from sgvf_drake.paths.assembly import Graph, Signature, assemble
from sgvf_drake.paths.building import number
from sgvf_drake.paths.geometry import chains, fit_courses, place_nodes
from sgvf_drake.paths.loops import count_loops
from sgvf_drake.paths.network import PathNetwork
from sgvf_drake.paths.point_cloud import PointCloud
from sgvf_drake.paths.reference import Piece
from sgvf_drake.paths.ridge import THINNING_CELL, find_ridge, thin
from sgvf_drake.paths.skeleton import grow_skeleton

FINEST_SCALE, COARSEST_SCALE = 0.02, 0.75
"""The ladder, in U: at the coarsest, circles of diameter 2.25 U are still seen as loops."""

SCALE_PER_SPACING = 0.7
"""Below this, the density falls apart into single waypoints."""

SCALE_RATIO = 2**0.25

FEWEST_SCALES = 7

THICK_DIMENSION = 1.5

MOST_CELLS = 20_000
"""Scales at which a cloud fills more cells are left out, which bounds time and memory."""

MANY_POINTS = 4_000
"""Larger clouds are averaged over the cells of the finest scale."""

NEARLY_MOST_VOTES = 0.6
"""The finest topology with this share of the most votes is taken."""


@dataclass(frozen=True, eq=False)
class Scale:
    """What the ridge shows at one scale."""

    sigma: float
    graph: Graph
    dropped: float

    @property
    def signature(self) -> Signature:
        return self.graph.signature


def find_paths(cloud: PointCloud, *, sigma: float | None = None) -> PathNetwork:
    """Finds the network of paths in a cloud, in any order and dimension.

    Args:
        cloud: The waypoints.
        sigma: The scale in U at which to look; None: the scales vote.

    Raises:
        PointCloudError: If no path is found.
    """
    # The result does not depend on the order of the points, not even in its last digit.
    order = np.lexsort(cloud.points.T[::-1])
    points = cloud.normalize(cloud.points[order])
    sigmas = [sigma] if sigma is not None else _ladder(points)
    weights = np.ones(len(points))
    if len(points) > MANY_POINTS:
        points, weights = thin(points, weights, THINNING_CELL * sigmas[0])
    scales = [_at_scale(points, weights, s) for s in sigmas]
    chosen, unsure = _vote(points, scales)
    return _network(cloud, points, weights, chosen, unsure)


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
    skeleton = grow_skeleton(ridge.points, points, weights, sigma)
    return Scale(sigma, assemble(skeleton, sigma), ridge.dropped)


def _vote(points: FloatArray, scales: Sequence[Scale]) -> tuple[Scale, str | None]:
    """Returns the scale whose topology is taken, and why that is unsure, if it is."""
    votes: dict[Signature, list[int]] = defaultdict(list)
    for k, scale in enumerate(scales):
        if scale.graph.strands:
            votes[scale.signature].append(k)
    if not votes:
        raise PointCloudError("the waypoints show no path at any scale")
    loops = _count_loops(points)
    agreeing = {s: ks for s, ks in votes.items() if loops is None or s.cycles == loops}
    pool = agreeing if any(len(ks) >= 2 for ks in agreeing.values()) else votes
    most = max(map(len, pool.values()))
    taken = min(
        (s for s, ks in pool.items() if len(ks) >= NEARLY_MOST_VOTES * most),
        key=lambda s: pool[s][0],
    )
    return scales[_second_of_run(pool[taken])], None


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


def _count_loops(points: FloatArray) -> int | None:
    """The number of loops by persistence; None where it cannot be told."""
    if points.shape[1] != 2:
        return None
    try:
        return count_loops(np.unique(points, axis=0))
    except QhullError:
        return None


def _network(
    cloud: PointCloud,
    points: FloatArray,
    weights: FloatArray,
    scale: Scale,
    unsure: str | None,
) -> PathNetwork:
    graph, sigma = scale.graph, scale.sigma
    place_nodes(graph, sigma)
    routes = chains(graph)
    courses = fit_courses(graph, routes, points, weights, sigma)
    nodes, edges, found = number(graph, routes, courses, weights)
    U = cloud.unit_length
    length = sum(course.line.length for course in courses)
    squares = sum(
        course.scatter**2 * weights[course.waypoints].sum() for course in courses
    )
    kept = sum(float(weights[course.waypoints].sum()) for course in courses)
    return PathNetwork(
        nodes=tuple(replace(node, place=cloud.denormalize(node.place)) for node in nodes),
        edges=tuple(
            replace(edge, line=_moved(cloud, edge.line), scatter=edge.scatter * U)
            for edge in edges
        ),
        routes=tuple(replace(route, line=_moved(cloud, route.line)) for route in found),
        unit_length=U,
        sigma=sigma * U,
        scatter=float(np.sqrt(squares / max(kept, 1.0))) * U,
        spacing=length / cloud.num_points * U,
        dropped=round(float(weights.sum() - kept)),
        unsure=unsure,
    )


def _moved(cloud: PointCloud, line: Piece) -> Piece:
    return Piece(cloud.denormalize(line.vertices), line.closed)
