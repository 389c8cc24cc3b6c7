"""How often a planar field turns along a closed curve: its winding number."""

from collections.abc import Callable

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError

# Between two neighbouring samples of the curve the field turns by less than this, in radians:
# a quarter of the half turn at which the sense of a step becomes ambiguous.
LARGEST_STEP = np.pi / 4
# A step is halved so often; where the field still jumps after that, it has a zero, since
# float64 knows no points in between.
MOST_HALVINGS = 48
# Parts of a curve to begin with, where nothing is known of the field: one that turns all the
# way around within a step would pass for one that does not turn.
SAMPLES = 256
# Sides of the polygon that stands for a circle, before any are halved.
CIRCLE_SIDES = 64

Values = Callable[[FloatArray], FloatArray]


def winding_number(field: Values, vertices: FloatArray, spacing: float | None = None) -> int:
    """Returns how often a field turns, counter-clockwise, along a closed polyline.

    By the Poincare-Hopf theorem this is the sum of the indices of the zeros inside of a
    curve that runs counter-clockwise and does not cross itself.

    Args:
        field: (n, 2) -> (n, 2).
        vertices: (V, 2) of the polyline; the last one is joined to the first.
        spacing: Sides longer than this are cut to begin with: the length over which the
            field changes; None: a 256th of the curve.

    Raises:
        ConfigurationError: The field vanishes on the curve; the message names the place.
    """
    ends = np.roll(vertices, -1, axis=0)
    if spacing is None:
        spacing = float(np.linalg.norm(ends - vertices, axis=1).sum()) / SAMPLES
    starts, ends = cut(vertices, ends, spacing)
    return round(turning(field, starts, ends) / (2 * np.pi))


def box_corners(box: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Returns the corners of a planar box, (4, 2), counter-clockwise."""
    (left, bottom), (right, top) = box
    return np.array([[left, bottom], [right, bottom], [right, top], [left, top]])


def circle(center: FloatArray, radius: float) -> FloatArray:
    """Returns a polygon around a circle's centre, (64, 2), counter-clockwise."""
    angle = 2 * np.pi * np.arange(CIRCLE_SIDES) / CIRCLE_SIDES
    return center + radius * np.column_stack([np.cos(angle), np.sin(angle)])


def cut(starts: FloatArray, ends: FloatArray, spacing: float) -> tuple[FloatArray, FloatArray]:
    """Cuts segments (S, 2), (S, 2) into equal parts no longer than `spacing`."""
    lengths = np.linalg.norm(ends - starts, axis=1)
    parts = np.maximum(np.ceil(lengths / spacing), 1).astype(np.intp)
    segment = np.repeat(np.arange(len(parts)), parts)
    number = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    begin, along = starts[segment], (ends - starts)[segment]
    first = (number / parts[segment])[:, None]
    last = ((number + 1) / parts[segment])[:, None]
    return begin + first * along, begin + last * along


def turning(field: Values, starts: FloatArray, ends: FloatArray) -> float:
    """Returns the angle by which a field turns along segments, summed over all, in radians.

    Every step is halved until the field turns by less than `LARGEST_STEP` in it.

    Args:
        field: (n, 2) -> (n, 2).
        starts: (S, 2) first end of each segment.
        ends: (S, 2) last end.

    Raises:
        ConfigurationError: The field vanishes on a segment; the message names the place.
    """
    total = 0.0
    first, last = _nonzero(field, starts), _nonzero(field, ends)
    for _ in range(MOST_HALVINGS):
        cross = first[:, 0] * last[:, 1] - first[:, 1] * last[:, 0]
        step = np.arctan2(cross, (first * last).sum(axis=1))
        wide = np.abs(step) >= LARGEST_STEP
        total += float(step[~wide].sum())
        if not wide.any():
            return total
        starts, ends, first, last = starts[wide], ends[wide], first[wide], last[wide]
        middle = (starts + ends) / 2
        between = _nonzero(field, middle)
        starts, ends = np.concatenate([starts, middle]), np.concatenate([middle, ends])
        first, last = np.concatenate([first, between]), np.concatenate([between, last])
    raise _vanishes(starts[0])


def _nonzero(field: Values, x: FloatArray) -> FloatArray:
    """Returns the direction of a field at points, (n, 2)."""
    value = field(x)
    norm = np.linalg.norm(value, axis=1, keepdims=True)
    zero = np.flatnonzero(norm[:, 0] == 0)
    if len(zero):
        raise _vanishes(x[zero[0]])
    return value / norm


def _vanishes(point: FloatArray) -> ConfigurationError:
    return ConfigurationError(
        f"the field vanishes at {point.tolist()}, on the curve around which it is to turn"
    )
