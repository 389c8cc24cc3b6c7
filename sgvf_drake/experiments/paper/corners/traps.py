"""Where agents stall on a polygon, where the field traps them, and how it slows down there."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray, IntArray
from sgvf_drake.experiments.paper.corners.trials import RADIUS
from sgvf_drake.metrics import SETTLE_DISTANCE
from sgvf_drake.paths.shapes import regular_polygon

NEAR = 0.5
"""Near a corner: within this many U of it."""

# The middle of a side, in which the way along it is read: this part of it.
MIDDLE = 0.2


@dataclass(frozen=True, eq=False)
class Places:
    """Points near a polygon, seen from its corners; lengths in U.

    Attributes:
        corner: (n,) the nearest corner, numbered counter-clockwise.
        distance: (n,) from it.
        offset: (n,) arc length from it along the polygon, counter-clockwise.
        outside: (n,) distance from the nearest side's line, negative inside of the polygon.
        from_path: (n,) distance from the polygon.
    """

    corner: IntArray
    distance: FloatArray
    offset: FloatArray
    outside: FloatArray
    from_path: FloatArray

    @classmethod
    def of(cls, points: FloatArray, corners: int, unit: float) -> "Places":
        """Places points (n, 2) of the polygon of a trial.

        Args:
            points: In the unit of the waypoints.
            corners: Of the polygon.
            unit: U.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        path = regular_polygon(corners, RADIUS)
        vertices, side = path.pieces[0].vertices, path.longest / corners
        projection = path.project(points)
        number = np.round(projection.arc / side).astype(np.intp)
        middles = (vertices + np.roll(vertices, -1, axis=0)) / 2
        apothem = np.linalg.norm(middles[0])
        beyond = (points @ middles.T / apothem).max(axis=1) - apothem
        return cls(
            corner=number % corners,
            distance=np.linalg.norm(points - vertices[number % corners], axis=1) / unit,
            offset=(projection.arc - number * side) / unit,
            outside=beyond / unit,
            from_path=projection.distance / unit,
        )

    @property
    def near(self) -> BoolArray:
        """Whether the corner is within `NEAR`, (n,)."""
        return np.asarray(self.distance <= NEAR)


def even_share(corners: int, unit: float) -> float:
    """Returns the part of the polygon that is within `NEAR` of a corner along it."""
    return min(1.0, 2 * NEAR * corners * unit / regular_polygon(corners, RADIUS).longest)


@dataclass(frozen=True, eq=False)
class Traps:
    """The stable zeros of a field m that are on the polygon, k of them.

    Attributes:
        places: Where they are.
        along: (k,) arc length from the nearest corner in the direction of travel, U: negative
            before the corner; NaN where the field runs against itself.
        clash: (k,) whether the field leads to the corner along both of its sides, or away
            from it: then the trap is not the corner's but a change of direction.
        score: (k,) |s| there, which |v| is equal to.
    """

    places: Places
    along: FloatArray
    clash: BoolArray
    score: FloatArray

    @classmethod
    def of(cls, row: Mapping[str, Any], progress: FloatArray) -> "Traps":
        """Takes them from what was measured of a field.

        Args:
            row: See `corners_trials.measure_corners`.
            progress: (corners, samples) part of m along each side.
        """
        points = np.array(row["zeros"], dtype=np.float64).reshape(-1, 2)
        places = Places.of(points, len(progress), row["unit"])
        chosen = np.array(row["zeros_stable"], bool) & (places.from_path <= SETTLE_DISTANCE)
        places = Places.of(points[chosen], len(progress), row["unit"])
        after = ways(progress)
        before, after = after[places.corner - 1], after[places.corner]
        clash = before != after
        along = np.where(clash, np.nan, places.offset * after)
        return cls(places, along, clash, np.array(row["zeros_score"])[chosen])

    @property
    def at_corners(self) -> FloatArray:
        """Of those near a corner: along, outside, and the distance from the corner, (k, 3)."""
        columns = (self.along, self.places.outside, self.places.distance)
        return np.column_stack(columns)[self.places.near]


def ways(progress: FloatArray) -> FloatArray:
    """Returns which way the field runs in the middle of each side, 1 or -1: (corners,)."""
    samples = progress.shape[1]
    skip = round((1 - MIDDLE) / 2 * samples)
    return np.where(progress[:, skip : samples - skip].mean(axis=1) >= 0, 1.0, -1.0)


def slow_down(speed: FloatArray, side: float) -> tuple[float, float]:
    """Returns the least |m| near corners and about the middles of sides, means over them.

    Both are over the same length of path, 2 `NEAR`.

    Args:
        speed: (corners, samples) |m| along each side, at the middles of equal parts.
        side: Its length, U.
    """
    samples = speed.shape[1]
    half = max(1, round(NEAR / side * samples))
    # Around corner k: the end of side k - 1 and the beginning of side k.
    around = np.concatenate([np.roll(speed, 1, axis=0)[:, -half:], speed[:, :half]], axis=1)
    middle = samples // 2
    between = speed[:, max(0, middle - half) : middle + half]
    return float(around.min(axis=1).mean()), float(between.min(axis=1).mean())


def slowest_corner(speed: FloatArray) -> FloatArray:
    """Returns the corner (2,) nearest to the least |m| along the sides; see `slow_down`."""
    corners, samples = speed.shape
    side, sample = np.unravel_index(speed.argmin(), speed.shape)
    number = (int(side) + round((float(sample) + 0.5) / samples)) % corners
    return np.asarray(regular_polygon(corners, RADIUS).pieces[0].vertices[number])


def examine(
    row: Mapping[str, Any], along: Mapping[str, FloatArray], corners: int
) -> dict[str, Any]:
    """Returns the figures of one field; shares between 0 and 1, lengths in U.

    Args:
        row: See `corners_trials.measure_corners`.
        along: `speed` and `progress` along the sides, (corners, samples).
        corners: Of the polygon.

    Returns:
        stalled, stalled_near, lapped, paused: shares of the starts; near: share of the
        stalled ones that are near a corner (NaN without any); trapped: share of the corners
        with a trap nearby, trapped_locally: without a clash; undecided: cells of the search
        for zeros; turns: on how many corners the field runs against itself; speed_corner,
        speed_side: see `slow_down`; rms, max.
    """
    unit = row["unit"]
    stalled = np.array(row["stalled"], bool)
    near = Places.of(row["final"], corners, unit).near
    traps = Traps.of(row, along["progress"])
    way = ways(along["progress"])
    side = regular_polygon(corners, RADIUS).longest / corners / unit
    speed_corner, speed_side = slow_down(along["speed"], side)
    return {
        "stalled": stalled.mean(),
        "stalled_near": (stalled & near).mean(),
        "near": near[stalled].mean() if stalled.any() else np.nan,
        "lapped": np.mean(row["lapped"]),
        "paused": np.mean(row["paused"]),
        "trapped": _share_of_corners(traps, traps.places.near, corners),
        "trapped_locally": _share_of_corners(traps, traps.places.near & ~traps.clash, corners),
        "undecided": int(row["undecided"]),
        "turns": int((way != np.roll(way, 1)).sum()),
        "speed_corner": speed_corner,
        "speed_side": speed_side,
        "rms": _in_units(row["rms"], unit),
        "max": _in_units(row["max"], unit),
    }


def _share_of_corners(traps: Traps, chosen: BoolArray, corners: int) -> float:
    return len(set(traps.places.corner[chosen].tolist())) / corners


def _in_units(length: float | None, unit: float) -> float:
    return np.nan if length is None else length / unit
