"""Waypoints from a file: what it is, which columns are taken, and what is said of them.

Every problem is one PointCloudError that names the file and, in text, the line.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
import re

import numpy as np

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.clouds.columns import Choice, altitude_of, choose_columns, name_trajectory
from sgvf_drake.clouds.formats import (
    MISSION_HEADER,
    parse_gpx,
    parse_mission,
    parse_numpy,
    unreadable,
)
from sgvf_drake.clouds.geodesy import Origin, east_north_up, middle, origin_text
from sgvf_drake.clouds.source import ZIP, decode, read_bytes
from sgvf_drake.clouds.tables import Rows, Table
from sgvf_drake.clouds.text_table import parse_text

NUMPY = b"\x93NUMPY"

FARTHEST = 500e3
"""Metres from the origin, beyond which places in degrees are no path on a tangent plane."""

UNIT_IN_NAME = re.compile(r"[\[(_ ](m|mm|cm|km|ft)[\])]?$")
"""Units of length at the end of a name: "x_m", "X [mm]"."""

SMALLEST_PART = 1e-9
"""An extent below this part of the largest one is told as none."""

SINGLE_POINTS = 0.5
"""Blank lines are layout, and separate nothing, if more of the pieces than this part of them
are single points."""


@dataclass(frozen=True, eq=False)
class Recording:
    """What a file holds.

    Attributes:
        points: (N, d), finite, in the unit of the file; in metres where it has degrees.
        velocities: (N, d), zero where they are not known; None where the file names none.
        breaks: The points in front of which the recording was interrupted, rising.
        origin: Where east, north and up are zero, of a file in degrees.
        messages: What was read and what was made of it, a line each.
    """

    points: FloatArray
    velocities: FloatArray | None
    breaks: tuple[int, ...]
    origin: Origin | None
    messages: tuple[str, ...]


def read_recording(
    path: str | Path,
    columns: str | Sequence[str | int] | None = None,
    origin: Origin | None = None,
) -> Recording:
    """Reads waypoints in the order of the file.

    What a file is follows from its content: a table in text (see `text_table.parse_text`),
    GPX, a mission of QGroundControl, .npy or .npz.  Each may be compressed by gzip.  Latitudes
    and longitudes become metres along east and north, and up where the altitude is chosen;
    north, east and down become east, north and up.  Rows without numbers and blank lines
    separate pieces.

    Args:
        path: The file.
        columns: The columns of the coordinates, by name or by number, counted from 0; a text
            of digits is a number, so "0,1" works, as does "x_m,y_m".  By default those whose
            names say so, or both of two columns without names.
        origin: Where east, north and up are zero, for a file in degrees; by default amid its
            places.

    Raises:
        PointCloudError: If the file cannot be read, or a line or a column cannot be used; if
            it leaves a choice of the columns.
    """
    path = Path(path)
    table = _parse(path, read_bytes(path))
    trajectory = name_trajectory(table)
    if trajectory is not None:
        kind, names, notes = trajectory
        table = replace(table, kind=kind, names=names, notes=notes)
    if isinstance(columns, str):
        columns = [name.strip() for name in columns.split(",")]
    choice = choose_columns(table, columns)
    rows = _present(table, choice)
    dim = len(choice.columns)
    points, velocities = rows.values[:, :dim], rows.values[:, dim:]
    said = [*table.notes, *_left_out(table, choice)]
    if choice.frame == "degrees":
        points, origin = _local(table, points, rows.places, origin)
    else:
        origin = None
        if choice.frame == "ned":
            points = points * [1, 1, -1]
            velocities = velocities * [1, 1, -1] if choice.velocities else velocities
            said.append("north, east, down became east, north, up")
    breaks = _breaks(rows, len(points))
    told = _told(table, choice, points, breaks, origin)
    said += [*_constant(table, choice, points), *_below_ground(table, choice, points)]
    return Recording(
        points,
        np.nan_to_num(velocities, nan=0.0) if velocities.shape[1] else None,
        breaks,
        origin,
        (told, *(f"{path.name}: {note}" for note in said)),
    )


def _parse(path: Path, data: bytes) -> Table:
    suffix = Path(path.stem if path.suffix.lower() == ".gz" else path.name).suffix.lower()
    if data.startswith((NUMPY, ZIP)) or suffix in (".npy", ".npz"):
        return parse_numpy(path, data)
    text = decode(path, data)
    start = text[:100].lstrip()
    if start.startswith("<"):
        return parse_gpx(path, text.lstrip())
    if start.startswith(MISSION_HEADER):
        return parse_mission(path, text)
    refused = unreadable(path, start)
    if refused:
        raise refused
    return parse_text(path, text)


def _present(table: Table, choice: Choice) -> Rows:
    """The rows with coordinates; those without any are breaks between the others."""
    rows = table.numbers([*choice.columns, *choice.velocities])
    points = rows.values[:, : len(choice.columns)]
    missing = np.isnan(points)
    gone = missing.all(axis=1)
    infinite = np.isinf(rows.values).any(axis=1)
    for bad, what in ((infinite, "is not finite"), (missing.any(axis=1) & ~gone, "is missing")):
        if bad.any():
            first = int(np.flatnonzero(bad)[0])
            faults = np.isinf(rows.values[first]) | np.isnan(rows.values[first])
            column = [*choice.columns, *choice.velocities][int(np.flatnonzero(faults)[0])]
            raise table.error(f"{table.label(column)} {what}", int(rows.places[first]))
    if gone.all():
        raise table.error("it holds no waypoints: every coordinate is missing")
    kept = np.cumsum(~gone)
    breaks = {int(kept[place - 1]) for place in rows.breaks if place}
    breaks |= {int(kept[place]) for place in np.flatnonzero(gone)}
    return Rows(rows.values[~gone], rows.places[~gone], sorted(breaks))


def _breaks(rows: Rows, num_points: int) -> tuple[int, ...]:
    breaks = [place for place in rows.breaks if 0 < place < num_points]
    sizes = np.diff([0, *breaks, num_points])
    return () if (sizes == 1).mean() > SINGLE_POINTS else tuple(breaks)


def _local(
    table: Table, degrees: FloatArray, places: IntArray, origin: Origin | None
) -> tuple[FloatArray, Origin]:
    """Turns degrees into metres along east and north, and up where there is an altitude."""
    for axis, (name, largest) in enumerate((("latitude", 90), ("longitude", 360))):
        bad = np.flatnonzero(np.abs(degrees[:, axis]) > largest)
        if len(bad):
            value, place = degrees[bad[0], axis], int(places[bad[0]])
            raise table.error(f"{value:.10g} is no {name} in degrees", place)
    latitude, longitude = degrees[:, 0], degrees[:, 1]
    height = degrees[:, 2] if degrees.shape[1] > 2 else np.zeros(len(degrees))
    # Amid most of the places, where a few are far away.
    near = origin or middle(*_typical(latitude, longitude))
    origin = origin or middle(latitude, longitude)
    local = east_north_up(latitude, longitude, height, near)
    far = np.flatnonzero(np.linalg.norm(local, axis=1) > FARTHEST)
    if len(far):
        place = int(places[far[0]])
        away = np.linalg.norm(local[far[0]]) / 1e3
        raise table.error(
            f"{latitude[far[0]]:.6g}, {longitude[far[0]]:.6g} is {away:,.0f} km from "
            f"{origin_text(near)}, too far for a path; is it a place?",
            place,
        )
    local = east_north_up(latitude, longitude, height, origin)
    return local[:, : degrees.shape[1]], origin


def _typical(latitude: FloatArray, longitude: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The place in the middle of the order along latitude and longitude, an array of one."""
    turned = (longitude - longitude[0] + 180) % 360 - 180
    middle_longitude = longitude[0] + np.median(turned)
    return np.array([np.median(latitude)]), np.array([middle_longitude])


def _told(
    table: Table,
    choice: Choice,
    points: FloatArray,
    breaks: tuple[int, ...],
    origin: Origin | None,
) -> str:
    """What was read, in one line."""
    pieces = f" in {len(breaks) + 1} pieces" if breaks else ""
    names = [str(table.names[column] if table.names else column) for column in choice.columns]
    taken = ("" if table.names else "columns ") + ", ".join(names)
    unit = _unit(table, choice)
    if origin is not None:
        axes = "east, north, up" if points.shape[1] > 2 else "east, north"
        taken, unit = f"{taken} to metres {axes} about {origin_text(origin)}", "m"
    moving = ", velocities " + ", ".join(map(table.label, choice.velocities))
    # Numbers of any size: a cloud that spans too much is refused as a whole.
    with np.errstate(over="ignore"):
        spans = np.ptp(points, axis=0)
    # Less than that is rounding.
    spans = np.where(spans > SMALLEST_PART * spans.max(), spans, 0)
    extent = " x ".join(_length(value) + (f" {unit}" if unit else "") for value in spans)
    return (
        f"{table.path.name}: {table.kind}, {len(points)} points{pieces}, {taken}"
        f"{moving if choice.velocities else ''}, {extent}"
    )


def _unit(table: Table, choice: Choice) -> str:
    """The unit of all coordinates, where the file tells it."""
    units = set()
    for column in choice.columns:
        match = UNIT_IN_NAME.search(table.names[column]) if table.names else None
        units.add(table.units.get(column) or (match[1] if match else ""))
    return units.pop() if len(units) == 1 else ""


def _left_out(table: Table, choice: Choice) -> list[str]:
    """A note on an altitude that was not taken."""
    height = altitude_of(table)
    if height is None or choice.frame != "degrees" or len(choice.columns) > 2:
        return []
    names = [table.label(column) for column in choice.columns]
    return [f"{height} left out; take it with --columns {','.join([*names, height])}"]


def _constant(table: Table, choice: Choice, points: FloatArray) -> list[str]:
    """A note on a coordinate that is the same everywhere, with what to do."""
    still = [int(axis) for axis in np.flatnonzero((points == points[0]).all(axis=0))]
    if len(points) < 2 or not still or len(still) == points.shape[1]:
        return []
    column = choice.columns[still[0]]
    note = f"{table.label(column)} is constant ({points[0, still[0]]:.6g})"
    if points.shape[1] > 2:
        others = [other for other in choice.columns if other != column]
        labels = [str(table.names[other] if table.names else other) for other in others]
        note += f"; for a path in the plane take --columns {','.join(labels)}"
    return [note]


def _below_ground(table: Table, choice: Choice, points: FloatArray) -> list[str]:
    """A note where no point in space is above the ground, as where z points down."""
    if points.shape[1] != 3 or choice.frame != "plain" or not (points[:, 2] < 0).all():
        return []
    name = table.label(choice.columns[2])
    return [f"{name} is below the ground; are these north, east, down?"]


def _length(value: float) -> str:
    return f"{value:.0f}" if value >= 1000 else f"{value:.3g}"
