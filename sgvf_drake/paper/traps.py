"""What a field does at the corners of a polygon: where it traps, stops and slows agents."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.experiments.follow import FollowResult
from sgvf_drake.fields import GuidingField
from sgvf_drake.metrics import SETTLE_DISTANCE, STALL_SPAN, STALL_WINDOW
from sgvf_drake.paths import ReferencePath
from sgvf_drake.paths.shapes import regular_polygon

RADIUS = 3.0
"""How far the corners are from the centre, in the unit of the waypoints."""

NEAR = 0.5
"""Near a corner: within this many U of it."""

SIDE_SAMPLES = 100
"""Places along each side where the field is read, at the middles of equal parts."""

# The middle of a side, in which the way along it is read: this part of it.
MIDDLE = 0.2


def polygon(corners: int) -> ReferencePath:
    """Returns the regular polygon that has so many corners."""
    return regular_polygon(corners, RADIUS)


def even_share(corners: int, unit: float) -> float:
    """Returns the part of a polygon that is within `NEAR` of a corner along it."""
    return min(1.0, 2 * NEAR * corners * unit / polygon(corners).longest)


def places(points: FloatArray, corners: int, unit: float) -> pd.DataFrame:
    """Returns where points are, seen from the corners of a polygon.

    Args:
        points: (n, 2) in the unit of the waypoints, near the polygon.
        corners: Number of corners of the polygon.
        unit: U in the unit of the waypoints.

    Returns:
        One row a point: the nearest `corner`, numbered counter-clockwise, and the `distance`
        from it; whether that is `near`; the arc length from it counter-clockwise, `offset`;
        how far `outside` of the nearest side's line the point is, negative inside of the
        polygon; and how far `from_path`.  Lengths in U.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    path = polygon(corners)
    vertices, side = path.pieces[0].vertices, path.longest / corners
    projection = path.project(points)
    number = np.round(projection.arc / side).astype(np.intp)
    middles = (vertices + np.roll(vertices, -1, axis=0)) / 2
    apothem = np.linalg.norm(middles[0])
    distance = np.linalg.norm(points - vertices[number % corners], axis=1) / unit
    return pd.DataFrame(
        {
            "corner": number % corners,
            "distance": distance,
            "near": distance <= NEAR,
            "offset": (projection.arc - number * side) / unit,
            "outside": ((points @ middles.T / apothem).max(axis=1) - apothem) / unit,
            "from_path": projection.distance / unit,
        }
    )


def along_sides(field: GuidingField, corners: int) -> dict[str, FloatArray]:
    """Returns what a field does along a polygon, (corners, SIDE_SAMPLES) each.

    Side k begins at corner k and runs counter-clockwise.

    Returns:
        |m| as `speed`, and its part along the side as `progress`.
    """
    start = polygon(corners).pieces[0].vertices
    side = np.roll(start, -1, axis=0) - start
    steps = (np.arange(SIDE_SAMPLES) + 0.5) / SIDE_SAMPLES
    points = start[:, None] + steps[:, None] * side[:, None]
    s, v = field.components(points.reshape(-1, 2))
    m = (s + v).reshape(points.shape)
    direction = side / np.linalg.norm(side, axis=1)[:, None]
    return {
        "speed": np.linalg.norm(m, axis=2),
        "progress": np.einsum("kij,kj->ki", m, direction),
    }


def ways(progress: FloatArray) -> FloatArray:
    """Returns which way a field runs in the middle of each side, 1 or -1: (corners,).

    Args:
        progress: (corners, samples) part of m along each side.
    """
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
    return np.asarray(polygon(corners).pieces[0].vertices[number])


def find_traps(row: Mapping[str, Any], progress: FloatArray) -> pd.DataFrame:
    """Returns the traps of a field m: its stable zeros that are on the polygon.

    Args:
        row: What was measured of the field: unit, zeros, zeros_stable and zeros_score.
        progress: (corners, samples) part of m along each side.

    Returns:
        The `places` of the traps, and besides: how far `along` in the direction of travel the
        trap is from the nearest corner, in U and negative before it; whether the field runs
        along both sides of the corner towards it, or away from it, a `clash`: then the trap is
        not the corner's but a change of direction, and `along` is NaN; and the `score` |s|,
        which |v| is equal to there.
    """
    table = places(row["zeros"], len(progress), row["unit"])
    table["score"] = row["zeros_score"]
    stable = np.array(row["zeros_stable"], bool)
    table = table[stable & (table["from_path"] <= SETTLE_DISTANCE)]
    way, corner = ways(progress), table["corner"].to_numpy()
    clash = way[corner - 1] != way[corner]
    along = np.where(clash, np.nan, table["offset"] * way[corner])
    return table.assign(along=along, clash=clash)


def examine(
    row: Mapping[str, Any], along: Mapping[str, FloatArray], corners: int
) -> dict[str, Any]:
    """Returns what tables and claims need of a field; shares from 0 to 1, lengths in U.

    Args:
        row: What was measured of the field: unit, final, stalled, lapped, paused, rms, max,
            undecided, and what `find_traps` needs.
        along: `speed` and `progress` from `along_sides`.
        corners: Number of corners of the polygon.

    Returns:
        `figures`: even: the part of the path that is near a corner; stalled, stalled_near,
        lapped, paused: shares of the starts; near: share of the stalled ones that are near a
        corner (NaN without any); trapped: share of the corners with a trap nearby,
        trapped_locally: without a clash; undecided: cells of the search for zeros; turns: on
        how many corners the field runs against itself; speed_corner, speed_side: see
        `slow_down`; rms, max.  And `traps`: the traps near corners, one dict each; and the
        `slowest_corner` (2,).
    """
    unit = row["unit"]
    stalled = np.array(row["stalled"], bool)
    near = places(row["final"], corners, unit)["near"].to_numpy()
    traps = find_traps(row, along["progress"])
    traps = traps[traps["near"]]
    way = ways(along["progress"])
    side = polygon(corners).longest / corners / unit
    speed_corner, speed_side = slow_down(along["speed"], side)
    figures = {
        "even": even_share(corners, unit),
        "stalled": stalled.mean(),
        "stalled_near": (stalled & near).mean(),
        "near": near[stalled].mean() if stalled.any() else np.nan,
        "lapped": np.mean(row["lapped"]),
        "paused": np.mean(row["paused"]),
        "trapped": traps["corner"].nunique() / corners,
        "trapped_locally": traps.loc[~traps["clash"], "corner"].nunique() / corners,
        "undecided": int(row["undecided"]),
        "turns": int((way != np.roll(way, 1)).sum()),
        "speed_corner": speed_corner,
        "speed_side": speed_side,
        "rms": np.nan if row["rms"] is None else row["rms"] / unit,
        "max": np.nan if row["max"] is None else row["max"] / unit,
    }
    return {
        "figures": figures,
        "traps": traps.to_dict("records"),
        "slowest_corner": slowest_corner(along["speed"]),
    }


def paused(run: FollowResult, unit: float) -> BoolArray:
    """Returns who stood still on the path for a while, as one does that stalls, and went on.

    Returns:
        (n,), False for those that stall in the end.
    """
    samples = round(STALL_WINDOW * unit / (run.times[1] - run.times[0])) + 1
    if samples > len(run.times):
        return np.zeros(run.positions.shape[1], bool)
    first = samples // 2
    inside = slice(first, first + len(run.times) - samples + 1)
    low, high = (
        extreme(run.positions, samples, axis=0)[inside]
        for extreme in (minimum_filter1d, maximum_filter1d)
    )
    farthest = maximum_filter1d(run.errors, samples, axis=0)[inside]
    still = np.linalg.norm(high - low, axis=2) < STALL_SPAN * unit
    still &= farthest <= SETTLE_DISTANCE * unit
    return np.asarray(still.any(axis=0) & ~run.metrics.stalled)
