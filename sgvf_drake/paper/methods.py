"""The clouds, and the ways from a cloud to a field, that are compared with each other.

Waypoints come in an order to the methods that need one; the cases say in which.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments.clouds import true_path
from sgvf_drake.experiments.follow import PathField
from sgvf_drake.fields import (
    AlgebraicCurve,
    CurveField,
    FourierCurve,
    ImplicitField,
    LagrangeCurve,
    ParametricField,
    PursuitField,
)
from sgvf_drake.paper.training import trained
from sgvf_drake.paths import ReferencePath
from sgvf_drake.paths.finding import find_paths

NUM_POINTS = 200
# U; the noise of the noisy clouds of the quality suites, whose half-extent is about 4.
NOISE = 0.05
# U; shorter waves are taken for noise where a curve is smoothed.  Ten waypoints to a wave
# leave about half of the noise, and cut a right-angled corner by 0.05 U.
WAVELENGTH = 1.0
# Demonstrations of one motion: how many, the waypoints of each, and the standard deviation of
# the shift of each, U.
PASSES, POINTS_OF_PASS, SHIFT = 5, 80, 0.1


@dataclass(frozen=True)
class Case:
    """Waypoints, evenly spaced on a path piece after piece.

    Attributes:
        label: What it is called in tables.
        path: One of `clouds.PATHS`.
        noise: Standard deviation on each coordinate, U.
        shuffled: Whether they are in random order.
        passes: Whether they are demonstrations of the path, one after the other, each of
            them shifted as a whole.
        crosses: Whether the path crosses itself, and is to be followed straight over.
    """

    label: str
    path: str
    noise: float = 0.0
    shuffled: bool = False
    passes: bool = False
    crosses: bool = False


CASES = {
    "ordered": Case("ordered", "trefoil"),
    "shuffled": Case("shuffled", "trefoil", shuffled=True),
    "noisy": Case("noisy", "trefoil", NOISE, shuffled=True),
    "branching": Case("branching", "fork"),
    "pieces": Case("two pieces", "concentric-circles"),
    "corners": Case("corners", "square"),
    "eight": Case("figure-eight", "eight", crosses=True),
    "course": Case("race course", "course", NOISE, shuffled=True, crosses=True),
    "demonstrations": Case("demonstrations", "stroke", passes=True, crosses=True),
    "streets": Case("streets", "streets"),
    "space": Case("knot in space", "knot", shuffled=True),
}


@dataclass(frozen=True)
class Method:
    """A way from waypoints to a field.

    Attributes:
        label: What it is called in tables.
        build: Makes the field of a cloud; the number is the seed.
        takes_order: Whether it takes the order of the waypoints for that of the path.
    """

    label: str
    build: Callable[[PointCloud, int], PathField]
    takes_order: bool = False


def _learned(recipe: str, **settings: Any) -> Callable[[PointCloud, int], PathField]:
    return lambda cloud, seed: trained(cloud, recipe, seed, **settings).field


def _sorted_curves(cloud: PointCloud) -> list[FourierCurve]:
    """Each route of the network of a cloud, through its waypoints in their order on it."""
    path = find_paths(cloud).path
    foot = path.project(cloud.points)
    by_arc = np.argsort(foot.arc, kind="stable")
    return [
        FourierCurve.through(cloud, by_arc[foot.piece[by_arc] == number], line.closed)
        for number, line in enumerate(path.pieces)
    ]


def _smoothed(cloud: PointCloud) -> CurveField:
    return CurveField(cloud, [curve.smoothed(WAVELENGTH) for curve in _sorted_curves(cloud)])


def _parametric(cloud: PointCloud) -> ParametricField:
    """Around the longest of the smoothed curves, closed if it is open."""
    longest = max(_sorted_curves(cloud), key=lambda curve: curve.length)
    return ParametricField(cloud, FourierCurve(longest.points).smoothed(WAVELENGTH))


METHODS = {
    "paper": Method("SGVF (paper's recipe)", _learned("paper")),
    "robust": Method("SGVF (robust)", _learned("robust")),
    "exact": Method("SGVF (exact mixture)", _learned("exact")),
    "implicit": Method(
        "implicit curve", lambda cloud, _: ImplicitField(cloud, AlgebraicCurve.fit(cloud))
    ),
    "fourier": Method(
        "Fourier", lambda cloud, _: CurveField(cloud, [FourierCurve.through(cloud)]), True
    ),
    "lagrange": Method(
        "Lagrange", lambda cloud, _: CurveField(cloud, [LagrangeCurve.through(cloud)]), True
    ),
    "parametric": Method(
        "parametric",
        lambda cloud, _: ParametricField(cloud, FourierCurve.through(cloud)),
        True,
    ),
    "pursuit": Method("pursuit", lambda cloud, _: PursuitField(cloud), True),
    "sorted": Method(
        "Fourier (sorted first)", lambda cloud, _: CurveField(cloud, _sorted_curves(cloud))
    ),
    "smoothed": Method("Fourier (sorted, smoothed)", lambda cloud, _: _smoothed(cloud)),
    "guided": Method("parametric (sorted, smoothed)", lambda cloud, _: _parametric(cloud)),
    "directed": Method("directed SGVF (robust)", _learned("robust", anyway=False)),
    "strands": Method("directed SGVF (exact mixture)", _learned("exact", anyway=False)),
}
DIRECTED = ("directed", "strands")
"""Fields that know their heading, for paths that cross or branch."""
LEARNED = ("paper", "robust", "exact", *DIRECTED)
"""Those whose field, or part of it, is learned."""


def make_case(case: Case, seed: int) -> tuple[PointCloud, ReferencePath]:
    """Returns the waypoints of a case in the order in which they are given, and the path."""
    path = true_path(case.path)
    shares = np.round(NUM_POINTS * path.lengths / path.lengths.sum()).astype(int)
    points = np.concatenate(
        [piece.sample(int(n)) for piece, n in zip(path.pieces, shares, strict=True)]
    )
    rng = np.random.default_rng([seed, 2])
    unit = PointCloud(points).unit_length
    if case.passes:
        (piece,) = path.pieces
        shifts = SHIFT * unit * rng.standard_normal((PASSES, path.dim))
        points = np.concatenate([piece.sample(POINTS_OF_PASS) + shift for shift in shifts])
    if case.noise > 0:
        points = points + case.noise * unit * rng.standard_normal(points.shape)
    return PointCloud(rng.permutation(points) if case.shuffled else points), path
