"""Whether strands that meet at a scale do meet, or only pass each other side by side.

A ridge merges strands where they are nearer to each other than its scale, and parts them
again, as those that cross do, or those that share a stretch.  But the waypoints around still
show which.  Two curves are fitted to them, in each way in which two can join four arms.  Where
curves that pass each other come nearer to the waypoints than those that cross, or where two
come much nearer than the shared stretch, the waypoints deny what the scale shows.

All lengths are in units of the cloud (U).
"""

from collections.abc import Mapping, Sequence

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.paths.assembly import (
    ARM_FAR,
    ARM_NEAR,
    Arm,
    Graph,
    links_of_two,
    pairings,
    worst_turn,
)
from sgvf_drake.paths.polyline import arc_lengths, points_at
from sgvf_drake.paths.reference import Piece, ReferencePath

SAMPLES = 10
"""Points of each arm at which a fit begins."""

ROUNDS = 4
"""How often waypoints are given to the nearer curve, and the curves are fitted to them."""

FEWEST_AROUND = 12
"""With fewer waypoints around, two curves of three coefficients each prove nothing."""

MOST_TURN = 90.0
"""Strands that run side by side, or share a stretch, leave it by less than this, in degrees."""

CLEARLY = 0.6
"""Two curves, which fit scatter better than one, come nearer by this than to one strand: by .05
to .55 where two circles nearly touch, by .7 and more at the junctions of a roundabout."""


def strands_pass(graph: Graph, points: FloatArray, sigma: float) -> bool:
    """Whether strands that meet in a graph pass each other, as the waypoints show.

    Args:
        graph: What was found at a scale.
        points: The waypoints, (N, d).
        sigma: The scale.
    """
    arms = graph.all_arms()
    crossings = [arms[node] for node in {graph.node(arm) for arm in graph.through}]
    return any(
        _pass_at_crossing(graph, own, points, sigma) for own in crossings if len(own) == 4
    ) or any(
        _pass_along_link(graph, k, [arm for pair in both[0] for arm in pair], points, sigma)
        for k, both in links_of_two(graph)
        if max(worst_turn(graph, pairing, sigma) for pairing in both) < MOST_TURN
    )


def _pass_at_crossing(
    graph: Graph, arms: Sequence[Arm], points: FloatArray, sigma: float
) -> bool:
    place = graph.places[graph.node(arms[0])]
    lines = _lines(graph, arms, sigma)
    reach = max(np.linalg.norm(line - place, axis=1).max() for line in lines.values())
    around = points[np.linalg.norm(points - place, axis=1) < reach]
    if len(around) < FEWEST_AROUND:
        return False
    crossing, *passing = _aside(lines, around, sigma)
    return min(passing) < crossing


def _pass_along_link(
    graph: Graph, link: int, arms: Sequence[Arm], points: FloatArray, sigma: float
) -> bool:
    line = Piece(graph.strands[link].path, closed=False)
    foot = ReferencePath((line,)).project(points)
    beside = (foot.distance < sigma) & (foot.arc > 0) & (foot.arc < line.length)
    if beside.sum() < FEWEST_AROUND:
        return False
    shared = np.sqrt((foot.distance[beside] ** 2).mean())
    return min(_aside(_lines(graph, arms, sigma), points[beside], sigma)) < CLEARLY * shared


def _lines(graph: Graph, arms: Sequence[Arm], sigma: float) -> dict[Arm, FloatArray]:
    """The part of each arm that shows where it goes, (n, d)."""
    lines = {}
    for arm in arms:
        path = graph.outward(arm)
        far = min(ARM_FAR * sigma, float(arc_lengths(path)[-1]))
        lines[arm] = points_at(path, np.linspace(min(ARM_NEAR * sigma, far / 2), far, SAMPLES))
    return lines


def _aside(lines: Mapping[Arm, FloatArray], around: FloatArray, sigma: float) -> list[float]:
    """How far waypoints are from two curves, for each pairing of arms; first those that cross.

    They are the longest: so are the diagonals of a quadrilateral.
    """
    joined = [[(lines[a], lines[b]) for a, b in pairing] for pairing in pairings([*lines])]
    joined.sort(key=lambda ends: -sum(np.linalg.norm(b[0] - a[0]) for a, b in ends))
    return [_fitted([Curve(*ends) for ends in pair], around, sigma) for pair in joined]


def _fitted(curves: "Sequence[Curve]", around: FloatArray, sigma: float) -> float:
    """Fits curves to the waypoints (n, d) that are nearest to each; RMS distance to them.

    Waypoints farther than sigma are those of other strands.
    """
    for _ in range(ROUNDS):
        aside = np.stack([curve.aside(around) for curve in curves])
        for k, curve in enumerate(curves):
            curve.fit(around[(aside.argmin(axis=0) == k) & (aside[k] < sigma)])
    aside = np.min([curve.aside(around) for curve in curves], axis=0)
    return float(np.sqrt((np.minimum(aside, sigma) ** 2).mean()))


class Curve:
    """A curve that joins two arms: quadratic in the distance along its chord."""

    def __init__(self, first: FloatArray, second: FloatArray) -> None:
        """Begins with one through two arms, (n, d) each."""
        ends = first.mean(axis=0), second.mean(axis=0)
        self._middle = (ends[0] + ends[1]) / 2
        chord = ends[1] - ends[0]
        self._along = chord / max(float(np.linalg.norm(chord)), 1e-12)
        self.fit(np.concatenate([first, second]))

    def _split(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Powers of the distance along the chord, (n, 3), and the rest across it, (n, d)."""
        away = points - self._middle
        t = away @ self._along
        return np.stack([np.ones_like(t), t, t**2], axis=1), away - np.outer(t, self._along)

    def fit(self, points: FloatArray) -> None:
        """Fits the curve to points (n, d), unless they are too few."""
        if len(points) >= 3:
            powers, across = self._split(points)
            self._coefficients = np.linalg.lstsq(powers, across, rcond=None)[0]

    def aside(self, points: FloatArray) -> FloatArray:
        """How far points (n, d) are from it, across its chord, (n,)."""
        powers, across = self._split(points)
        return np.asarray(np.linalg.norm(across - powers @ self._coefficients, axis=1))
