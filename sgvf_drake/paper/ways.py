"""How well a path was followed, by one measure for closed pieces and for branches."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments.follow import FollowResult, PathField
from sgvf_drake.experiments.workbench import Row
from sgvf_drake.metrics import (
    END_DISTANCE,
    REACH_DISTANCE,
    SETTLE_DISTANCE,
    STALL_SPAN,
    STALL_WINDOW,
    since_last,
)
from sgvf_drake.network_metrics import network_metrics
from sgvf_drake.paths import ReferencePath
from sgvf_drake.paths.finding import find_paths

# U; the bends of a trajectory are measured over chords of this length.  It is twice the
# way between two samples of a robot at full speed.
CHORD = 0.1
# Points of a path in which its crossings are found, many more than there are waypoints.
DENSE = 1_000
# Ends this near to another piece are on it, in the unit of the reference.
TOUCHING = 1e-6


@dataclass(frozen=True, eq=False)
class Ways:
    """The agents that succeed, and their ways along the path.

    Attributes:
        good: (n,) who succeeds.
        begin: (n,) the first sample of the way on which an agent is measured.
        until: (n,) the last one.
    """

    good: BoolArray
    begin: IntArray
    until: IntArray

    def each(self, values: FloatArray) -> list[FloatArray]:
        """Returns values (T, n, ...) along the way of each agent that succeeds."""
        return [
            values[self.begin[agent] : self.until[agent] + 1, agent]
            for agent in np.flatnonzero(self.good)
        ]


def find_ways(
    run: FollowResult, reference: ReferencePath, unit: float, patience: float = 1.0
) -> Ways:
    """Tells who succeeds.

    On closed pieces an agent has to lap one, and is measured over its last lap.  On branches
    there is no one way to go.  An agent has to reach the path, to stay near it over the last
    time for `STALL_WINDOW` U, and not to stall in that time except near a tip; it is measured
    from where it reaches the path to where it is in the end.

    Args:
        run: The agents.
        reference: The path, all of it closed or all of it branches from the middle out.
        unit: U.
        patience: How many times slower than 1 the field may be.
    """
    steps = len(run.times)
    if reference.closed.all():
        begin = steps - np.maximum(run.metrics.samples, 1)
        return Ways(run.metrics.lapped, begin, np.full(len(begin), steps - 1))
    near = since_last(run.errors > SETTLE_DISTANCE * unit)
    last = int(np.searchsorted(run.times, run.times[-1] - STALL_WINDOW * unit * patience))
    extent = np.linalg.norm(np.ptp(run.positions[last:], axis=0), axis=1)
    at_tip = cKDTree(_tips(reference)).query(run.positions[-1])[0] <= SETTLE_DISTANCE * unit
    good = (near <= last) & ((extent >= STALL_SPAN * unit) | at_tip)
    reached = run.errors <= REACH_DISTANCE * unit
    reached &= np.arange(steps)[:, None] >= near
    from_end = np.linalg.norm(run.positions - run.positions[-1], axis=2)
    begin = np.argmax(reached, axis=0)
    arrival = np.clip(since_last(from_end > END_DISTANCE * unit), begin, steps - 1)
    return Ways(good & reached.any(axis=0), begin, arrival)


def crossing_ways(run: FollowResult, reference: ReferencePath, field: PathField) -> Ways:
    """Tells who follows a path that crosses itself, straight over the crossings.

    An agent has to run along the parts between the crossings in their order, either way: all
    around a closed path, or to an end of an open one from where it came to it, near which it
    may stop as on a branch.  The parts are found in the path itself.

    Args:
        run: The agents.
        reference: The path, one piece.
        field: The field that they follow.
    """
    (piece,) = reference.pieces
    cloud, dense = field.cloud, piece.sample(DENSE)
    tips = piece.vertices[[0, -1]]
    near = cKDTree(tips).query(field.ends)[0] <= SETTLE_DISTANCE * cloud.unit_length
    ends = np.concatenate([tips, field.ends[near]])
    one, other = (
        network_metrics(run.times, run.positions, find_paths(PointCloud(x)), cloud.box, ends)
        for x in (dense, dense[::-1])
    )
    followed = one.followed | other.followed
    if not piece.closed:
        ways = find_ways(run, reference, cloud.unit_length)
        return replace(ways, good=ways.good & followed)
    first, until = (
        np.where(one.followed, getattr(one, name), getattr(other, name))
        for name in ("first", "until")
    )
    return Ways(followed, first, until)


def _tips(reference: ReferencePath) -> FloatArray:
    """Returns the ends of pieces that lie on no other piece, (E, d)."""
    pieces = reference.pieces
    return np.array(
        [
            end
            for k, piece in enumerate(pieces)
            for end in piece.vertices[[0, -1]]
            if len(pieces) == 1
            or ReferencePath(pieces[:k] + pieces[k + 1 :]).project(end[None]).distance[0]
            > TOUCHING
        ]
    )


def coverage(run: FollowResult, ways: Ways, cloud: PointCloud) -> float:
    """Returns the share of waypoints near which the agents that succeed pass on their ways."""
    passed = ways.each(run.positions)
    if not passed:
        return 0.0
    distance = cKDTree(np.concatenate(passed)).query(cloud.points)[0]
    return float((distance <= SETTLE_DISTANCE * cloud.unit_length).mean())


def effort(run: FollowResult, ways: Ways, unit: float) -> float | None:
    """Returns the root mean square of the curvature of the ways, 1/U.

    At a speed of one U per unit of time it is the acceleration that a vehicle needs to
    follow the agent exactly, in U over that time squared.  The curvature is that of the
    circle through three points of a trajectory, `CHORD` apart.
    """
    bends = [_curvatures(positions / unit) for positions in ways.each(run.positions)]
    values = np.concatenate([np.empty(0), *bends])
    return float(np.sqrt((values**2).mean())) if len(values) else None


def _curvatures(positions: FloatArray) -> FloatArray:
    """Returns the curvatures of the circles through neighbouring points, (T, d) in U."""
    arc = np.cumsum(np.linalg.norm(np.diff(positions, axis=0, prepend=positions[:1]), axis=1))
    chosen = np.unique(np.searchsorted(arc, np.arange(0, arc[-1], CHORD)))
    chords = np.diff(positions[chosen], axis=0)
    a, b = chords[:-1], chords[1:]
    sides = [np.linalg.norm(side, axis=1) for side in (a, b, a + b)]
    # Twice the area of the triangle, by Gram's determinant: in any dimension.
    gram = (a * a).sum(axis=1) * (b * b).sum(axis=1) - (a * b).sum(axis=1) ** 2
    product = np.maximum(np.prod(sides, axis=0), np.finfo(np.float64).tiny)
    return np.asarray(2 * np.sqrt(np.maximum(gram, 0)) / product)


def errors(run: FollowResult, ways: Ways, unit: float) -> Row:
    """Returns rms_u and max_u, the cross-track errors on the ways; None without any."""
    if not ways.good.any():
        return {"rms_u": None, "max_u": None}
    found = np.concatenate(ways.each(run.errors)) / unit
    return {"rms_u": float(np.sqrt((found**2).mean())), "max_u": float(found.max())}
