"""The points that are learned from, their tangents and the noise level, from a network.

Clean waypoints on closed paths are learned as they are.  All others are replaced by points
evenly spaced on the lines that were found, so that a robot finds the same density everywhere.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import networkx as nx
import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import FloatArray
from sgvf_drake.paths import PathNetwork, Piece, ReferencePath

SIGMA_DEFAULT, SIGMA_CEILING = 0.1, 1.0
"""The noise level where nothing asks for another, and the coarsest that still leaves a path in
a cloud of half-extent 4."""

SIGMA_PER_SPACING = 0.65
"""Below half the spacing the mixture falls apart into single waypoints, where robots stop."""

SIGMA_PER_SCATTER = 3.0

SIGMA_PER_GAP = 0.25
"""From two noise levels apart, the ridges of neighbouring strands are two; from four, a robot
on one does not feel the other."""

STRAND_SEPARATION, STRAND_RATIO = 1.0, 5.0
"""Strands are neighbours, and not the two sides of a corner, if the way from one to the other
along the path is longer than this in U, and this many times longer than across.  The legs of a
hairpin are such strands, so that the noise level stays below its width."""

WIDEST_GAP = SIGMA_DEFAULT / SIGMA_PER_GAP
"""Only gaps that would ask for less than the default matter."""

CLEAN_LEVEL, CLEAN_GAP = 1.25, 2.5
"""Learned as they are: waypoints that ask for at most this many times the noise level of their
path, and whose gaps along the path are at most this many of it."""

MOST_WAYPOINTS = 2_000
"""More waypoints than this are never learned as they are: they cost time and add nothing."""

SUPPORT_SPACING = 0.5
"""Distance of the points on a line, in noise levels."""


@dataclass(frozen=True, eq=False)
class Strand:
    """A line that is travelled from its first vertex to its last.

    Attributes:
        line: The polyline, normalised units.
        piece: The piece of the network that it belongs to.
        stops: Whether robots come to rest at its last vertex.
    """

    line: Piece
    piece: int
    stops: bool


@dataclass(frozen=True, eq=False)
class Support:
    """What is learned from, in normalised units.

    Attributes:
        points: (M, d).
        tangents: (M, d) unit vectors in the direction of travel.
        sigma: The noise level to learn at.
        path: The lines, in the direction of travel.
        ends: (E, d) where robots come to rest.
        spacing: Mean distance of neighbouring waypoints along the path.
        gap: Smallest distance between neighbouring strands; `WIDEST_GAP` where it is more.
        counts: The number of points on each line.
        resampled: Whether the points lie evenly on the lines, in place of the waypoints.
    """

    points: FloatArray
    tangents: FloatArray
    sigma: float
    path: ReferencePath
    ends: FloatArray
    spacing: float
    gap: float
    counts: tuple[int, ...]
    resampled: bool


def find_support(
    cloud: PointCloud, network: PathNetwork, sigma: float | None = None
) -> Support:
    """Chooses the noise level and the points to learn from.

    The path asks for a noise level below a quarter of the gaps between its strands, and at
    most `SIGMA_DEFAULT`; the waypoints ask for one above their spacing and scatter.  Points on
    the lines need only heed the path.

    Args:
        cloud: The waypoints.
        network: What was found in them.
        sigma: The noise level, normalised units; None: it follows from both.
    """
    strands = list(_strands(cloud, network))
    path = ReferencePath(tuple(strand.line for strand in strands))
    points = cloud.normalize(cloud.points)
    foot = path.project(points)
    # Copies of a waypoint are no nearer to the next one.
    spacing = float(path.lengths.sum()) / len(np.unique(points, axis=0))
    gap = _gap(strands, network)
    fine = sigma or min(SIGMA_DEFAULT, SIGMA_PER_GAP * gap)
    coarse = max(
        SIGMA_PER_SPACING * spacing,
        SIGMA_PER_SCATTER * network.scatter / network.unit_length,
    )
    arcs = [np.sort(foot.arc[foot.piece == k]) for k in range(len(strands))]
    resampled = not (
        network.dropped == 0
        and len(points) <= MOST_WAYPOINTS
        # Where a path ends, its density has to fall as that of an even one does.
        and path.closed.all()
        and coarse <= CLEAN_LEVEL * fine
        and _widest_step(path, arcs) <= CLEAN_GAP * fine
    )
    if resampled:
        level = fine
        arcs = [_evenly(line, SUPPORT_SPACING * level) for line in path.pieces]
        points = np.concatenate(
            [line.at(arc) for line, arc in zip(path.pieces, arcs, strict=True)]
        )
        piece, arc = np.repeat(np.arange(len(arcs)), list(map(len, arcs))), np.concatenate(arcs)
        width = level
    else:
        level = sigma or min(max(fine, coarse), SIGMA_CEILING)
        piece, arc, width = foot.piece, foot.arc, max(level, spacing)
    tangents = np.empty_like(points)
    for k, line in enumerate(path.pieces):
        tangents[piece == k] = tangents_at(line, arc[piece == k], width)
    stops = [strand.line.vertices[-1] for strand in strands if strand.stops]
    return Support(
        points,
        tangents,
        level,
        path,
        np.reshape(stops, (-1, cloud.dim)),
        spacing,
        gap,
        tuple(np.bincount(piece, minlength=len(strands)).tolist()),
        resampled,
    )


def tangents_at(line: Piece, arc: FloatArray, width: float) -> FloatArray:
    """Returns unit tangents (n, d) at arc lengths (n,): chords of twice the width.

    They turn around a corner within the width, as the path of a robot does.
    """
    ends = (arc - width, arc + width)
    if line.closed:
        behind, ahead = (line.at(end % line.length) for end in ends)
    else:
        behind, ahead = (line.at(np.clip(end, 0, line.length)) for end in ends)
    chords = ahead - behind
    norm = np.linalg.norm(chords, axis=1, keepdims=True)
    return np.divide(chords, norm, out=np.zeros_like(chords), where=norm > 0)


def _strands(cloud: PointCloud, network: PathNetwork) -> Iterator[Strand]:
    """The route of each piece that is one path; of other pieces every edge, outwards."""
    for route in network.routes:
        if network.is_one_way(route.piece):
            yield Strand(_normalised(cloud, route.line), route.piece, not route.closed)
    for piece in range(network.num_pieces):
        if not network.is_one_way(piece):
            yield from _outward(cloud, network, piece)


def _outward(cloud: PointCloud, network: PathNetwork, piece: int) -> Iterator[Strand]:
    """The edges of a branching piece, each away from its first end, or its first node."""
    edges = [edge for edge in network.edges if edge.piece == piece and edge.nodes is not None]
    graph = nx.Graph()
    graph.add_weighted_edges_from((*edge.nodes, edge.length) for edge in edges if edge.nodes)
    source = min(graph, key=lambda node: (network.nodes[node].kind != "end", node))
    away = nx.single_source_dijkstra_path_length(graph, source)
    for edge in edges:
        assert edge.nodes is not None
        first, last = edge.nodes
        line = _normalised(cloud, edge.line)
        if away[last] < away[first]:
            line, last = Piece(line.vertices[::-1], line.closed), first
        yield Strand(line, piece, stops=network.nodes[last].kind == "end")


def _normalised(cloud: PointCloud, line: Piece) -> Piece:
    return Piece(cloud.normalize(line.vertices), line.closed)


def _gap(strands: list[Strand], network: PathNetwork) -> float:
    """The smallest distance between neighbouring strands, `WIDEST_GAP` at most.

    Those of one piece that branches or crosses itself meet anyway.
    """
    step = WIDEST_GAP / 8
    arcs = [_evenly(strand.line, step) for strand in strands]
    points = np.concatenate([s.line.at(a) for s, a in zip(strands, arcs, strict=True)])
    number = np.repeat(np.arange(len(strands)), list(map(len, arcs)))
    arc = np.concatenate(arcs)
    period = np.array([s.line.length if s.line.closed else np.inf for s in strands])
    piece = np.array([s.piece for s in strands])
    meets = np.array([not network.is_simple(s.piece) for s in strands])
    first, second = cKDTree(points).query_pairs(WIDEST_GAP, output_type="ndarray").T
    across = np.linalg.norm(points[first] - points[second], axis=1)
    along = np.abs(arc[first] - arc[second])
    along = np.minimum(along, period[number[first]] - along)
    same = piece[number[first]] == piece[number[second]]
    along[~same] = np.inf
    along[same & meets[number[first]]] = 0.0
    apart = along > np.maximum(STRAND_SEPARATION, STRAND_RATIO * across)
    return float(across[apart].min(initial=WIDEST_GAP))


def _evenly(line: Piece, step: float) -> FloatArray:
    """Arc lengths in even steps, about as long as asked for, both ends of an open line too."""
    count = max(3, round(line.length / step))
    if line.closed:
        return np.linspace(0, line.length, count, endpoint=False)
    return np.linspace(0, line.length, count + 1)


def _widest_step(path: ReferencePath, arcs: list[FloatArray]) -> float:
    """The widest gap of waypoints along closed lines, from their arc lengths in order."""
    return max(
        float(np.diff(arc, append=arc[:1] + line.length).max(initial=0.0))
        for line, arc in zip(path.pieces, arcs, strict=True)
    )
