"""The points that a directed field is learned from: evenly on the edges of a network."""

from collections.abc import Iterator
from dataclasses import dataclass

import networkx as nx
import numpy as np
from scipy.spatial import cKDTree

from sgvf_drake.arrays import BoolArray, IntArray
from sgvf_drake.clouds import PointCloud
from sgvf_drake.fields import FloatArray, StrandMixture
from sgvf_drake.learning.support import (
    SIGMA_DEFAULT,
    SIGMA_PER_GAP,
    STRAND_SEPARATION,
    SUPPORT_SPACING,
    WIDEST_GAP,
    tangents_at,
)
from sgvf_drake.paths import PathNetwork, Piece

SHARPEST_CROSSING = np.radians(10.0)
"""Strands that part from a node at this angle or more are no neighbours for that."""

ACUTE = np.radians(133.0)
"""A line turns by more than this at a tip: its legs then enclose less than 47 degrees, and a
robot that heads into it is not turned by the leg behind, which is seen along its heading.
Measured: through a tip of 48 degrees inside an edge robots pass, at one of 46 they rest."""

TIP = 3.0
"""A tip is where the chords of this many noise levels before and after a place turn so."""

SIGMAS_PER_EDGE = 6.0
"""Between two nodes a robot turns towards both: some three noise levels before each."""


@dataclass(frozen=True, eq=False)
class StrandSupport:
    """What is learned from, in normalised units.

    Attributes:
        mixture: Points on the edges, with their directions.
        ends: (E, d) where robots come to rest.
        counts: The number of points on each edge.
        spacing: Mean distance of neighbouring waypoints along the paths.
        gap: Smallest distance between strands that do not meet there; `WIDEST_GAP` where it
            is more.
        messages: What robots cannot do on it, a sentence each.
    """

    mixture: StrandMixture
    ends: FloatArray
    counts: tuple[int, ...]
    spacing: float
    gap: float
    messages: tuple[str, ...]

    @property
    def sigma(self) -> float:
        """The noise level to learn at."""
        return self.mixture.sigma


def find_strands(
    cloud: PointCloud, network: PathNetwork, sigma: float | None = None
) -> StrandSupport:
    """Puts points on the edges of a network, half a noise level apart.

    The noise level is below a quarter of the gap between strands that do not meet there, a
    sixth of the shortest edge between two nodes, and `SIGMA_DEFAULT`.

    Args:
        cloud: The waypoints, whose extent is the normalisation.
        network: What was found in them.
        sigma: The noise level, normalised units; None: by that rule.
    """
    lines = [Piece(cloud.normalize(e.line.vertices), e.line.closed) for e in network.edges]
    gap = _gap(network, lines)
    if sigma is None:
        sigma = min(SIGMA_DEFAULT, SIGMA_PER_GAP * gap, _room(network, lines))
    arcs = [_evenly(line, SUPPORT_SPACING * sigma) for line in lines]
    one_way = [network.is_one_way(edge.piece) for edge in network.edges]
    counts = tuple(map(len, arcs))
    mixture = StrandMixture(
        np.concatenate([line.at(arc) for line, arc in zip(lines, arcs, strict=True)]),
        np.concatenate(
            [tangents_at(line, arc, sigma) for line, arc in zip(lines, arcs, strict=True)]
        ),
        np.repeat(one_way, counts),
        sigma,
    )
    ends = np.reshape(
        [network.nodes[end].place for end in resting_ends(network)], (-1, cloud.dim)
    )
    spacing = network.spacing / network.unit_length
    messages = tuple(_tips(network, lines, sigma))
    return StrandSupport(mixture, cloud.normalize(ends), counts, spacing, gap, messages)


def _tips(network: PathNetwork, lines: list[Piece], sigma: float) -> Iterator[str]:
    """Names the edges that are travelled either way and have an acute tip."""
    for number, (edge, line) in enumerate(zip(network.edges, lines, strict=True), start=1):
        reach = TIP * sigma
        if network.is_one_way(edge.piece) or line.length < 2 * reach:
            continue
        arc = np.arange(reach, line.length - reach, SUPPORT_SPACING * sigma)
        before, at, after = (line.at(arc + shift) for shift in (-reach, 0.0, reach))
        into, out = at - before, after - at
        norms = np.linalg.norm(into, axis=1) * np.linalg.norm(out, axis=1)
        if ((into * out).sum(axis=1) < np.cos(ACUTE) * norms).any():
            yield (
                f"edge {number} has an acute tip, at which robots that follow no route come to "
                "rest"
            )


def resting_ends(network: PathNetwork) -> list[int]:
    """The ends at which robots come to rest: the last of a path, all those of a network."""
    found = [
        number
        for number, node in enumerate(network.nodes)
        if node.kind == "end" and not network.is_one_way(node.piece)
    ]
    for route in network.routes:
        nodes = network.edges[route.edges[-1]].nodes
        if network.is_one_way(route.piece) and not route.closed and nodes is not None:
            found.append(nodes[1])
    return found


def _evenly(line: Piece, step: float) -> FloatArray:
    """Arc lengths in steps of about this length; half a step from both ends of an open line.

    Edges that meet at a node, or go on through it, then have one density all along.
    """
    count = max(3, round(line.length / step))
    return (np.arange(count) + 0.5) * line.length / count


def _room(network: PathNetwork, lines: list[Piece]) -> float:
    """A sixth of the shortest edge between two nodes that are no ends."""
    lengths = [
        line.length
        for edge, line in zip(network.edges, lines, strict=True)
        if edge.nodes is not None
        and all(network.nodes[node].kind == "junction" for node in edge.nodes)
    ]
    return min(lengths, default=np.inf) / SIGMAS_PER_EDGE


def _gap(network: PathNetwork, lines: list[Piece]) -> float:
    """The smallest distance between strands that do not meet there, `WIDEST_GAP` at most."""
    step = WIDEST_GAP / 8
    arcs = [_evenly(line, step) for line in lines]
    points = np.concatenate([line.at(arc) for line, arc in zip(lines, arcs, strict=True)])
    number = np.repeat(np.arange(len(lines)), list(map(len, arcs)))
    arc = np.concatenate(arcs)
    pairs = cKDTree(points).query_pairs(WIDEST_GAP, output_type="ndarray")
    across = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    along = _along(network, lines, number[pairs], arc[pairs])
    ratio = 1 / np.sin(SHARPEST_CROSSING / 2)
    apart = along > np.maximum(STRAND_SEPARATION, ratio * across)
    return float(across[apart].min(initial=WIDEST_GAP))


def _along(
    network: PathNetwork, lines: list[Piece], edge: IntArray, arc: FloatArray
) -> FloatArray:
    """The shortest ways along the network between pairs of places, (n, 2) each."""
    lengths = np.array([line.length for line in lines])
    graph = nx.MultiGraph()
    graph.add_nodes_from(range(len(network.nodes)))
    for k, found in enumerate(network.edges):
        if found.nodes is not None:
            graph.add_edge(*found.nodes, weight=lengths[k])
    between = np.full((len(network.nodes),) * 2, np.inf)
    for node, reached in nx.all_pairs_dijkstra_path_length(graph):
        between[node, list(reached)] = list(reached.values())
    closed = np.array([line.closed for line in lines])
    same: BoolArray = edge[:, 0] == edge[:, 1]
    direct = np.abs(arc[:, 0] - arc[:, 1])
    direct = np.minimum(
        direct, np.where(closed[edge[:, 0]], lengths[edge[:, 0]] - direct, np.inf)
    )
    way = np.where(same, direct, np.inf)
    if len(network.nodes) == 0:
        return way
    # By way of a node at either end of each edge; of closed ones there is none.
    nodes = np.array([edge_.nodes or (0, 0) for edge_ in network.edges])
    for first in (0, 1):
        for second in (0, 1):
            out = [
                np.where(side == 0, arc[:, k], lengths[edge[:, k]] - arc[:, k])
                for k, side in enumerate((first, second))
            ]
            around = between[nodes[edge[:, 0], first], nodes[edge[:, 1], second]] + sum(out)
            way = np.minimum(way, np.where(closed[edge].any(axis=1), np.inf, around))
    return way
