"""The named shapes: clouds to train on, each with the true path to measure against."""

from collections.abc import Callable
import difflib
import math

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.clouds.point_cloud import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths.reference import Piece, ReferencePath

CIRCLE_VERTICES = 4096
"""A circle is a polygon with this many corners: it departs by 3e-7 of its radius."""

POINTS_PER_PIECE = 3
"""Fewer waypoints do not tell a loop from a line."""

STAR_RATIO = math.sin(math.radians(18)) / math.sin(math.radians(54))
"""Inner over outer radius of the outline of a pentagram, 0.382."""

SAMPLINGS = ("uniform", "random")


def _circle(radius: float, x: float = 0.0, y: float = 0.0) -> Piece:
    return _polygon(CIRCLE_VERTICES, radius, x, y, first_angle=0.0)


def _polygon(
    corners: int, radius: float, x: float = 0.0, y: float = 0.0, *, first_angle: float
) -> Piece:
    angle = first_angle + 2 * np.pi * np.arange(corners) / corners
    return Piece(
        np.column_stack([x + radius * np.cos(angle), y + radius * np.sin(angle)]), closed=True
    )


def _square(half_size: float) -> Piece:
    return Piece(half_size * np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]]), closed=True)


def _star(radius: float) -> Piece:
    angle = np.pi / 2 + 2 * np.pi * np.arange(10) / 10
    radii = np.where(np.arange(10) % 2 == 0, radius, radius * STAR_RATIO)
    return Piece(np.column_stack([radii * np.cos(angle), radii * np.sin(angle)]), closed=True)


_PIECES: dict[str, Callable[[], tuple[Piece, ...]]] = {
    "concentric-circles": lambda: (_circle(2.0), _circle(4.0)),
    "separated-circles": lambda: (_circle(1.5, x=-2.0), _circle(1.5, x=2.0)),
    "concentric-flight": lambda: (_circle(1.0), _circle(2.0)),
    "separated-flight": lambda: (_circle(1.0, -1.0, 1.0), _circle(1.0, 1.0, -1.0)),
    "circle": lambda: (_circle(3.0),),
    "square": lambda: (_square(3.0),),
    "hexagon": lambda: (_polygon(6, 3.0, first_angle=0.0),),
    "octagon": lambda: (_polygon(8, 3.0, first_angle=0.0),),
    "triangle": lambda: (_polygon(3, 3.0, first_angle=np.pi / 2),),
    "star": lambda: (_star(4.0),),
}

SHAPES = tuple(_PIECES)
"""Names of the shapes.  The two for flight are in metres, the others in any unit."""


def shape_path(name: str) -> ReferencePath:
    """Returns the true path of a named shape; every piece runs counter-clockwise.

    Raises:
        ConfigurationError: if there is no shape of this name.
    """
    if name not in _PIECES:
        close = difflib.get_close_matches(str(name), SHAPES, n=1)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ConfigurationError(
            f"there is no shape {name!r}{hint} (the shapes are {', '.join(SHAPES)})"
        )
    return ReferencePath(_PIECES[name]())


def regular_polygon(corners: int, radius: float) -> ReferencePath:
    """Returns a regular polygon about the origin that rests on a side, counter-clockwise.

    Its corners have an interior angle of 180 - 360 / corners degrees.  It is the square, or
    the hexagon, of the named shapes but for its size.

    Args:
        corners: at least three.
        radius: distance of the corners from the centre.

    Raises:
        ConfigurationError: if there is no such polygon.
    """
    if corners < 3:
        raise ConfigurationError(f"a polygon needs at least 3 corners, not {corners}")
    if not (0 < radius < math.inf):
        raise ConfigurationError(f"the radius must be a positive number, not {radius}")
    first_angle = -np.pi / 2 - np.pi / corners
    return ReferencePath((_polygon(corners, radius, first_angle=first_angle),))


def make_shape(
    name: str,
    num_points: int = 200,
    noise: float = 0.0,
    seed: int = 0,
    sampling: str = "uniform",
) -> tuple[PointCloud, ReferencePath]:
    """Samples waypoints from a named shape, in random order.

    Args:
        name: one of `SHAPES`.
        num_points: N; pieces share the waypoints by their length.
        noise: standard deviation of Gaussian noise on each coordinate, in the shape's unit.
        seed: of the noise, the random sampling and the order.
        sampling: "uniform" for equal steps of arc length from the first vertex, or
            "random" for uniformly distributed arc lengths.

    Returns:
        The cloud, and the true path.

    Raises:
        ConfigurationError: if the name or a value cannot be used.
    """
    path = shape_path(name)
    fewest = POINTS_PER_PIECE * len(path.pieces)
    if num_points < fewest:
        raise ConfigurationError(
            f"{name} needs num_points of at least {fewest}, not {num_points}"
        )
    if not (0 <= noise < math.inf):
        raise ConfigurationError(f"noise must be finite and not negative, not {noise}")
    if sampling not in SAMPLINGS:
        raise ConfigurationError(
            f"sampling must be one of {', '.join(SAMPLINGS)}, not {sampling!r}"
        )
    rng = np.random.default_rng(seed)
    points = np.concatenate(
        [
            piece.sample(n)
            if sampling == "uniform"
            else piece.at(rng.uniform(0, piece.length, n))
            for piece, n in zip(path.pieces, _share(path.lengths, num_points), strict=True)
        ]
    )
    # Noise is drawn for noise 0 as well, so that the same seed gives the same order.
    points = points + noise * rng.standard_normal(points.shape)
    return PointCloud(rng.permutation(points), shape=name), path


def _share(lengths: FloatArray, num_points: int) -> list[int]:
    """Shares waypoints by length (largest remainder), at least three to each piece."""
    spare = num_points - POINTS_PER_PIECE * len(lengths)
    exact = np.maximum(num_points * lengths / lengths.sum() - POINTS_PER_PIECE, 0)
    if exact.sum() > 0:
        exact *= spare / exact.sum()
    counts = np.floor(exact).astype(int)
    by_remainder = np.argsort(counts - exact, kind="stable")
    counts[by_remainder[: spare - counts.sum()]] += 1
    return [int(count) + POINTS_PER_PIECE for count in counts]
