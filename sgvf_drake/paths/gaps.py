"""Whether what was found lies in gaps between the waypoints.

Where waypoints lie at random, the way along a path to the next one is exponentially
distributed.  A node from which they keep away on all arms is none.  And two ends may only be
those of a gap where the waypoints around are farther apart than on average, or the path bends.

All lengths are in units of the cloud (U).
"""

from collections.abc import Sequence
import itertools

import numpy as np
from scipy.stats import gamma

from sgvf_drake.paths.assembly import ARM_FAR, Graph
from sgvf_drake.paths.geometry import Chain, Course
from sgvf_drake.paths.polyline import aim
from sgvf_drake.paths.skeleton import Sampling

ACCIDENT = 1e-3
"""That waypoints keep so far away from any node of a network, though all are nodes."""

LAST = 10
"""Steps between the last waypoints of a path, which tell how far apart they are at its end."""

TINY = 1e-12

HEADS_FOR = 0.5
"""A path that goes on heads for where it does to within 60 degrees, from one end at least."""


def keep_away(graph: Graph, routes: Sequence[Chain], courses: Sequence[Course]) -> bool:
    """Whether waypoints keep away from a node, more than by accident.

    The sum of the ways to the first waypoint on each arm has a gamma distribution if they lie
    at random, and is shorter if they are even.
    """
    ways: dict[int, list[float]] = {node: [] for node in graph.places}
    for chain, course in zip(routes, courses, strict=True):
        marks = itertools.pairwise(course.at_nodes)
        for (k, side), (begin, end) in zip(chain.arms, marks, strict=True):
            if graph.strands[k].ends is None:
                continue
            # Waypoints that are there twice make none nearer.
            own = np.unique(course.arc[(course.arc > begin) & (course.arc < end)])
            rate = (1 + len(own)) / max(end - begin, TINY)
            first, last = own.min(initial=end) - begin, end - own.max(initial=begin)
            ways[graph.node((k, side))].append(rate * first)
            ways[graph.node((k, 1 - side))].append(rate * last)
    chances = [gamma.sf(sum(own), len(own)) for own in ways.values() if len(own) > 2]
    # That of any among them.
    return bool(chances and len(chances) * min(chances) < ACCIDENT)


def may_go_on(
    graph: Graph, routes: Sequence[Chain], courses: Sequence[Course], sigma: float
) -> bool:
    """Whether a path may go on from one end to another, over a gap as its waypoints leave."""
    count = sum(len(course.arc) for course in courses)
    tips = []
    for chain, course in zip(routes, courses, strict=True):
        for end, along in ((0, 1), (-1, -1)):
            k, side = chain.arms[end]
            inner = chain.closed or len(graph.arms(graph.node((k, side ^ -end)))) > 1
            if inner or len(course.arc) <= LAST:
                continue
            steps = np.diff(course.arc)[::along]
            uneven = min(1.0, float(steps.std() / max(steps.mean(), TINY)))
            rate = 1 / max(float(steps[:LAST].mean()), TINY)
            place, inward = aim(course.line.vertices[::along], 0.0, ARM_FAR * sigma)
            ahead = -inward / max(float(np.linalg.norm(inward)), TINY)
            tips.append((place, ahead, Sampling(count, rate, uneven).longest_gap))
    for (place, ahead, gap), (goal, facing, its) in itertools.combinations(tips, 2):
        step = goal - place
        length = float(np.linalg.norm(step))
        if length < max(gap, its) and max(ahead @ step, -facing @ step) > HEADS_FOR * length:
            return True
    return False
