"""The options of a training as plain Python values, or an error."""

from collections.abc import Callable
import math
import operator
from typing import Any

from sgvf_drake.learning.direction import DIRECTIONS


def _natural(value: Any) -> int:
    number = int(operator.index(value))
    if number < 0:
        raise ValueError
    return number


def _count(value: Any) -> int:
    number = _natural(value)
    if number == 0:
        raise ValueError
    return number


def _positive(value: Any) -> float:
    if not (math.isfinite(value) and value > 0):
        raise ValueError
    return float(value)


def _weight(value: Any) -> float:
    if not (math.isfinite(value) and value >= 0):
        raise ValueError
    return float(value)


def _widths(value: Any) -> tuple[int, ...]:
    if len(value) == 0:
        raise ValueError
    return tuple(_count(width) for width in value)


def _point(value: Any) -> tuple[float, ...]:
    point = tuple(float(coordinate) for coordinate in value)
    if not all(map(math.isfinite, point)):
        raise ValueError
    return point


def _flag(value: Any) -> bool:
    if not isinstance(value, bool):
        raise ValueError
    return value


def _direction(value: Any) -> Any:
    choices = (value,) if isinstance(value, str) else tuple(value)
    if not set(choices) <= {*DIRECTIONS, None}:
        raise ValueError
    return value if isinstance(value, str) else choices


# By the name of the option; they raise ValueError, TypeError or OverflowError.
CONVERSIONS: dict[str, Callable[[Any], Any]] = {
    "seed": _natural,
    "open": _flag,
    "direction": _direction,
    "start": _point,
    "max_restarts": _natural,
    "sigma_min": _positive,
    "gain": _positive,
    "frequency_std": _positive,
    "num_frequencies": _natural,
    "exact_target": _flag,
    "score_hidden": _widths,
    "score_iterations": _count,
    "tangent_hidden": _widths,
    "tangent_iterations": _count,
    "unit_weight": _weight,
    "orthogonality_weight": _weight,
    "direction_weight": _weight,
    "hint_weight": _weight,
    "projection": _flag,
}
