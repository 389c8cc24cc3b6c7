"""Where the edges of a graph run: fitted to the waypoints along its routes.

The ridge has the topology, but it is drawn inwards where a path bends, by sigma^2 / 2 times
the curvature, and it is distorted near nodes, where the waypoints of several arms mix.  So the
waypoints are put in the order of the route that they lie on.  Where they are clean or sparse,
a line runs through them; otherwise it is a local regression along the route.

All lengths are in units of the cloud (U).
"""

from dataclasses import dataclass
import math

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.ndimage import median_filter, percentile_filter
from scipy.stats import chi2

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.paths.assembly import CONTRACTION, Arm, Graph
from sgvf_drake.paths.polyline import arc_lengths, points_at
from sgvf_drake.paths.reference import Piece, ReferencePath

SPARSE = 0.3
"""Waypoints farther apart than this, in U, cannot tell noise from corners: a line runs through
them."""

RUN = 5
"""Waypoints in a run whose distances from a parabola are scatter: few, so that sparse waypoints
on a bend still lie on one."""

CLEAN = 0.1
"""Waypoints whose scatter is less than this share of their spacing are on the path."""

BUNDLE = 3.0
"""Waypoints that scatter by this many spacings are of several passes, with an end each."""

ALONE, DETOUR = 1.3, 1.5
"""A waypoint is a stray, and no corner, if it is this many steps away from both neighbours and
to visit it is a detour of this many."""

STEPS, STEP_PERCENTILE = 21, 75
"""Three of four steps of a line around a place are no longer than one: each stray makes two
that are."""

WIDTH = math.sqrt(12)
"""Width of a bundle in its scatter, if its passes are spread evenly."""

BANDWIDTH = 1.5
"""Standard deviation of the kernel of a fit, in spacings or scatters, whichever is larger."""

FEWEST_FITTED = 5

NEIGHBOURHOOD = 51
"""Runs whose median tells the scatter around a place."""

MOST_FITTED = 2_000
"""Waypoints of a longer route are averaged to this many before a line is fitted."""

CHUNK = 256
"""Places at which a fit is computed at once, to bound the memory."""

SAMPLES_PER_SIGMA = 4.0
"""Vertices of an edge per sigma."""


@dataclass(frozen=True, eq=False)
class Chain:
    """A route: arms in order, each the start of an edge as it is travelled.

    Attributes:
        arms: The arm at which the route enters each edge.
        closed: Whether it returns to where it starts.
    """

    arms: tuple[Arm, ...]
    closed: bool


@dataclass(frozen=True, eq=False)
class Ordered:
    """Waypoints in the order of the route that they lie on.

    Attributes:
        index: The number of each, (n,).
        arc: Arc length on the route's rough line, rising, (n,).
        points: (n, d).
        weights: How many waypoints each stands for, (n,).
    """

    index: IntArray
    arc: FloatArray
    points: FloatArray
    weights: FloatArray


@dataclass(frozen=True, eq=False)
class Course:
    """The geometry of a route.

    Attributes:
        line: Its polyline.
        at_nodes: Arc length at the start of each edge; and at the end, of an open one.
        scatter: Standard deviation of its waypoints across it, in each direction.
        waypoints: The waypoints that lie on it.
        arc: Their arc lengths on it.
    """

    line: Piece
    at_nodes: FloatArray
    scatter: float
    waypoints: IntArray
    arc: FloatArray


def chains(graph: Graph) -> list[Chain]:
    """Follows the strands straight through crossings; every strand is on one route."""
    seen: set[int] = set()
    found = []
    loose = [
        (k, side)
        for k, strand in graph.strands.items()
        for side in (0, 1)
        if strand.ends is not None and (k, side) not in graph.through
    ]
    # Open routes first, from their ends; what is left is closed.
    for start in [*loose, *((k, 0) for k in graph.strands)]:
        if start[0] in seen:
            continue
        arms = [start]
        seen.add(start[0])
        while True:
            onward = graph.through.get((arms[-1][0], 1 - arms[-1][1]))
            if onward is None or onward[0] in seen:
                break
            arms.append(onward)
            seen.add(onward[0])
        is_loop = graph.strands[start[0]].ends is None
        found.append(Chain(tuple(arms), closed=is_loop or onward is not None))
    return found


def place_nodes(graph: Graph, sigma: float) -> None:
    """Moves each node to where the lines of its arms meet best, in least squares."""
    for node, arms in graph.all_arms().items():
        if len(arms) < 3:
            continue
        matrix = np.zeros((len(graph.places[node]),) * 2)
        vector = np.zeros(len(matrix))
        for arm in arms:
            path = graph.outward(arm)
            # Its first part is bent towards the node.
            reach = min(2 * CONTRACTION * sigma, float(arc_lengths(path)[-1]))
            line = points_at(path, reach * np.linspace(0.25, 1, 10))
            middle = line.mean(axis=0)
            along = np.asarray(np.linalg.svd(line - middle)[2][0], dtype=np.float64)
            across = np.eye(len(along)) - np.outer(along, along)
            matrix += across
            vector += across @ middle
        place = np.asarray(np.linalg.lstsq(matrix, vector, rcond=None)[0], dtype=np.float64)
        if np.linalg.norm(place - graph.places[node]) < CONTRACTION * sigma:
            graph.places[node] = place


def fit_courses(
    graph: Graph, routes: list[Chain], points: FloatArray, weights: FloatArray, sigma: float
) -> list[Course]:
    """Fits every route to the waypoints (N, d) that lie on it; `weights` (N,) count them."""
    rough = [rough_line(graph, chain, sigma) for chain in routes]
    foot = ReferencePath(tuple(line for line, _ in rough)).project(points)
    near = foot.distance < CONTRACTION * sigma
    courses = []
    for k, (chain, (line, marks)) in enumerate(zip(routes, rough, strict=True)):
        index = np.flatnonzero(near & (foot.piece == k))
        index = index[np.argsort(foot.arc[index], kind="stable")]
        own = Ordered(index, foot.arc[index], points[index], weights[index])
        if len(index) < RUN:
            courses.append(Course(line, marks, 0.0, index, own.arc))
            continue
        first, last = chain.arms[0], chain.arms[-1]
        ends = [(0.0, first), (line.length, (last[0], 1 - last[1]))]
        pinned = [
            s for s, arm in ends if not chain.closed and len(graph.arms(graph.node(arm))) > 1
        ]
        courses.append(_fit(line, marks, pinned, own, sigma))
    return courses


def rough_line(graph: Graph, chain: Chain, sigma: float) -> tuple[Piece, FloatArray]:
    """Joins the ridge of a route's strands, straight through nodes, where the ridge bends.

    It goes on straight beyond loose ends, since waypoints lie beyond those of the ridge.

    Returns:
        The polyline, and its arc length at the start of each strand and at the end.
    """
    parts: list[FloatArray] = []
    marks, length = [0.0], 0.0
    reach = CONTRACTION * sigma
    for arm in chain.arms:
        path = graph.outward(arm)
        if graph.strands[arm[0]].ends is not None:
            path = _led_to(path, graph, arm, reach)
            path = _led_to(path[::-1], graph, (arm[0], 1 - arm[1]), reach)[::-1]
        parts.append(path[1:] if parts else path)
        length += arc_lengths(path)[-1]
        marks.append(length)
    line = np.concatenate(parts)
    if chain.closed:
        return Piece(line[:-1], closed=True), np.array(marks)
    return Piece(line, closed=False), np.array(marks)


def _led_to(path: FloatArray, graph: Graph, arm: Arm, reach: float) -> FloatArray:
    """Begins an arm at its node: straight from a junction, or beyond the end of the ridge."""
    node = graph.node(arm)
    if node in graph.exact_ends:
        return path
    length = arc_lengths(path)[-1]
    if len(graph.arms(node)) == 1:
        # The direction of its last sigma.
        second = int(np.searchsorted(arc_lengths(path), reach / CONTRACTION))
        back = path[0] - path[min(max(second, 1), len(path) - 1)]
        return np.concatenate([[path[0] + reach * back / np.linalg.norm(back)], path])
    place = graph.places[node]
    far = np.linalg.norm(path - place, axis=1) > min(reach, length / 3)
    return np.concatenate([[place], path[int(np.argmax(far)) :]])


def _fit(
    rough: Piece, marks: FloatArray, pinned: list[float], own: Ordered, sigma: float
) -> Course:
    """Fits a line to waypoints along a rough one.

    Args:
        rough: The rough line.
        marks: Arc lengths on it whose places are wanted.
        pinned: Arc lengths where the fitted line meets it.
        own: The waypoints.
        sigma: The scale.
    """
    period = rough.length if rough.closed else None
    spacing = rough.length / float(own.weights.sum())
    scatter = _scatter_around(own, period, sigma)
    fitted = own
    if period is None and float(np.median(scatter)) > BUNDLE * spacing:
        rough = _with_straight_ends(rough, marks, pinned, own.arc, scatter, sigma)
        own = _ordered_along(rough, own)
        fitted = _without_overhang(own, pinned, step=2 * sigma)
        scatter = _scatter_around(fitted, period, sigma)
    as_they_are = spacing > SPARSE or float(np.median(scatter)) < CLEAN * spacing
    if as_they_are:
        own = fitted = _without_spikes(fitted, rough.closed)
    u, x, w = _averaged(fitted, rough.length / MOST_FITTED)
    for s in pinned:
        at = int(s > 0) * len(u)
        u, w = np.insert(u, at, s), np.insert(w, at, 100 * w.max())
        x = np.insert(x, at, rough.at(np.array([s])), axis=0)
    first, last = (0.0, rough.length) if rough.closed else (u[0], u[-1])
    marks = np.clip(marks, first, last)
    count = int(np.ceil((last - first) * SAMPLES_PER_SIGMA / sigma)) + 2
    samples = np.union1d(marks, u if as_they_are else np.linspace(first, last, count))
    samples = samples[samples < last] if rough.closed else samples
    if as_they_are:
        vertices = np.column_stack([np.interp(samples, u, c, period=period) for c in x.T])
    else:
        width = BANDWIDTH * np.maximum(spacing, np.interp(samples, fitted.arc, scatter))
        vertices = _regressed(samples, u, x, w, width, period)
    line = Piece(vertices, rough.closed)
    # Arc lengths on the rough line become those on the fitted one.
    known = np.append(samples, rough.length) if rough.closed else samples
    lengths = np.append(line.arc, line.length)[: len(known)]
    return Course(
        line,
        np.interp(marks, known, lengths),
        _spread(line, fitted),
        own.index,
        np.interp(own.arc, known, lengths),
    )


def _with_straight_ends(
    rough: Piece,
    marks: FloatArray,
    pinned: list[float],
    arc: FloatArray,
    scatter: FloatArray,
    sigma: float,
) -> Piece:
    """Goes on straight where less of a line is left than the bundle is wide.

    There its waypoints spread more across it than along it, so its ridge may turn across.
    It keeps the direction of a stretch before, as long as nodes are wide.  Arc lengths stay as
    they are.

    Args:
        rough: The line, which goes on straight beyond the ends of its ridge.
        marks: Arc lengths of its nodes.
        pinned: Arc lengths of the ends that are nodes, and no ends of the bundle.
        arc: Arc lengths of the waypoints, rising, (n,).
        scatter: Their scatter across the line, (n,).
        sigma: The scale.
    """
    length, reach = rough.length, CONTRACTION * sigma
    first = 0.0 if 0.0 in pinned else _width_at_start(arc, scatter, marks[1], sigma)
    last = length
    if not any(s > 0 for s in pinned):
        last -= _width_at_start(length - arc[::-1], scatter[::-1], length - marks[-2], sigma)
    inner = rough.arc[(rough.arc > first) & (rough.arc < last)]
    line = rough.at(np.concatenate([[first], inner, [last]]))
    if first > 0:
        line = np.concatenate([_ahead(rough, first + reach, first, first), line])
    if last < length:
        line = np.concatenate([line, _ahead(rough, last - reach, last, length - last)])
    return Piece(line, closed=False)


def _width_at_start(
    arc: FloatArray, scatter: FloatArray, next_node: float, sigma: float
) -> float:
    """The first arc length at which as much of a line lies behind as its bundle is wide."""
    enough = arc - CONTRACTION * sigma >= WIDTH * scatter + sigma
    return float(min(arc[np.argmax(enough)] if enough.any() else np.inf, next_node / 3))


def _ahead(line: Piece, before: float, at: float, distance: float) -> FloatArray:
    """The place so far ahead of one arc length, seen from another, (1, d)."""
    places = line.at(np.array([before, at]))
    step = places[1] - places[0]
    return np.asarray(places[1:] + distance * step / np.linalg.norm(step))


def _scatter_around(own: Ordered, period: float | None, sigma: float) -> FloatArray:
    """The RMS of the scatter of the waypoints around each, as far as nodes are wide, (n,).

    Where a few strands of a bundle part or pass each other, the scatter itself jumps, and a
    line that is fitted as wide as it would follow one strand, then another.
    """
    arc, squares = own.arc, local_scatter(own.arc, own.points, period) ** 2
    if period is not None:
        arc = np.concatenate([arc - period, arc, arc + period])
        squares = np.tile(squares, 3)
    total = np.concatenate([[0.0], np.cumsum(squares)])
    first = np.searchsorted(arc, own.arc - CONTRACTION * sigma)
    last = np.searchsorted(arc, own.arc + CONTRACTION * sigma, side="right")
    return np.asarray(np.sqrt((total[last] - total[first]) / (last - first)))


def _ordered_along(line: Piece, own: Ordered) -> Ordered:
    """Puts waypoints in their order along another line."""
    arc = ReferencePath((line,)).project(own.points).arc
    order = np.argsort(arc, kind="stable")
    return Ordered(own.index[order], arc[order], own.points[order], own.weights[order])


def _without_overhang(own: Ordered, pinned: list[float], step: float) -> Ordered:
    """Leaves out the waypoints beyond the ends of half of several passes.

    Along steps of the arc, those beyond have less than half of the median density.
    """
    edges = np.arange(own.arc[0], own.arc[-1] + step, step)
    density = np.histogram(own.arc, edges, weights=own.weights)[0]
    full = np.flatnonzero(density >= np.median(density) / 2)
    # At a node there is no end.
    first = own.arc[0] if 0.0 in pinned else edges[full[0]]
    last = own.arc[-1] if any(s > 0 for s in pinned) else edges[full[-1] + 1]
    kept = (own.arc >= first) & (own.arc <= last)
    return Ordered(own.index[kept], own.arc[kept], own.points[kept], own.weights[kept])


def _without_spikes(own: Ordered, closed: bool) -> Ordered:
    """Leaves out the waypoints beside a line that runs through all others; the worst first."""
    steps = np.linalg.norm(np.diff(own.points, axis=0, append=own.points[:1]), axis=1)
    around = percentile_filter(steps, STEP_PERCENTILE, STEPS, mode="wrap")
    kept = np.arange(len(own.index))
    while len(kept) > RUN:
        x = own.points[kept]
        before, after = np.roll(x, 1, axis=0), np.roll(x, -1, axis=0)
        back, ahead = np.linalg.norm(x - before, axis=1), np.linalg.norm(x - after, axis=1)
        detour = back + ahead - np.linalg.norm(after - before, axis=1)
        step = around[kept]
        stray = (np.minimum(back, ahead) > ALONE * step) & (detour > DETOUR * step)
        if not closed:
            stray[[0, -1]] = False
        if not stray.any():
            break
        kept = np.delete(kept, int(np.argmax(np.where(stray, detour, 0))))
    return Ordered(own.index[kept], own.arc[kept], own.points[kept], own.weights[kept])


def _spread(line: Piece, own: Ordered) -> float:
    """Standard deviation of waypoints across a line, in each direction."""
    squares = ReferencePath((line,)).project(own.points).distance ** 2
    across = own.points.shape[1] - 1
    return float(np.sqrt(np.average(squares, weights=own.weights) / across))


def _averaged(own: Ordered, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Averages waypoints within each step of arc length; returns arc, place, weight."""
    group = np.unique(np.floor(own.arc / step), return_inverse=True)[1]
    total = np.bincount(group, own.weights).astype(np.float64)
    columns = (own.arc, *own.points.T)
    means = np.column_stack([np.bincount(group, own.weights * x) / total for x in columns])
    return means[:, 0], means[:, 1:], total


def _regressed(
    s: FloatArray,
    u: FloatArray,
    x: FloatArray,
    w: FloatArray,
    width: FloatArray,
    period: float | None,
) -> FloatArray:
    """Returns local quadratic regressions at arc lengths `s` of points x(u) with weights w.

    Quadratic, so that a bend is not drawn inwards.  The kernel is Gaussian, with a standard
    deviation `width` at each of `s`, or more where few points lie within.
    """
    if period is not None:
        u = np.concatenate([u - period, u, u + period])
        x, w = np.tile(x, (3, 1)), np.tile(w, 3)
    if len(s) > CHUNK:
        parts = range(0, len(s), CHUNK)
        return np.concatenate(
            [_regressed(s[k : k + CHUNK], u, x, w, width[k : k + CHUNK], None) for k in parts]
        )
    away = np.abs(u - s[:, None])
    few = min(FEWEST_FITTED, len(u)) - 1
    h = np.maximum(width, np.partition(away, few, axis=1)[:, few])[:, None]
    t = (u - s[:, None]) / h
    kernel = w * np.exp(-(t**2) / 2)
    moments = np.stack([(kernel * t**k).sum(axis=1) for k in range(5)], axis=1)
    matrix = moments[:, np.add.outer(np.arange(3), np.arange(3))]
    right = np.stack([(kernel * t**k) @ x for k in range(3)], axis=1)
    ridge = 1e-9 * moments[:, :1, None] * np.eye(3)
    return np.asarray(np.linalg.solve(matrix + ridge, right)[:, 0])


def local_scatter(arc: FloatArray, points: FloatArray, period: float | None) -> FloatArray:
    """Standard deviation across the path around each of waypoints (n, d) in order, (n,).

    It is the median residual of parabolas through runs of them over their arc lengths (n,):
    parabolas, so that a bend does not count as scatter; the median, so that corners do not.
    """
    half = RUN // 2
    if period is not None:
        points = np.concatenate([points[-half:], points, points[:half]])
        arc = np.concatenate([arc[-half:] - period, arc, arc[:half] + period])
    runs = np.swapaxes(sliding_window_view(points, RUN, axis=0), 1, 2)
    t = sliding_window_view(arc, RUN)
    t = t - t.mean(axis=1, keepdims=True)
    t = t / np.maximum(np.abs(t).max(axis=1, keepdims=True), 1e-12)
    design = np.stack([np.ones_like(t), t, t**2], axis=2)
    squares = ((runs - design @ (np.linalg.pinv(design) @ runs)) ** 2).sum(axis=(1, 2))
    around = median_filter(squares, NEIGHBOURHOOD, mode="reflect" if period is None else "wrap")
    # A residual has as many degrees of freedom as the run has spare waypoints, across.
    freedom = (RUN - 3) * (points.shape[1] - 1)
    scatter = np.sqrt(around / chi2.median(freedom))
    return scatter if period is not None else np.pad(scatter, half, mode="edge")
