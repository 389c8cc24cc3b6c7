"""Files that are no tables in text: GPX, missions of QGroundControl, NumPy's .npy and .npz."""

from array import array
import io
from pathlib import Path
from tokenize import TokenError
import warnings
from xml.parsers import expat
import zipfile
import zlib

import numpy as np

from sgvf_drake.clouds.source import MOST_BYTES, MOST_ROWS, READABLE, ZIP
from sgvf_drake.clouds.tables import ArrayTable, Rows, array_of, looks_transposed
from sgvf_drake.exceptions import PointCloudError

MISSION_HEADER = "QGC WPL"
MISSION_FIELDS = 12

PLACES = {16, 17, 18, 19, 21, 22, 31, 82, 84, 85}
"""MAVLink commands that fly to a place: waypoint, loiter, land, take off, spline waypoint."""

JUMP = 177
"""MAVLink's command to go on with another item."""

GLOBAL_FRAMES = {0, 3, 5, 6, 10, 11}
"""MAVLink frames whose coordinates are degrees."""

GPX_POINTS = {"trkpt": "track", "rtept": "route", "wpt": "waypoints"}
"""Elements that hold a place, by what they make up; the first that a file has are taken."""

GPX_PIECES = {"trkseg", "rte"}

# What NumPy and zipfile raise of damaged, encrypted and lying files.
_NUMPY_FAULTS = (
    *(ValueError, TypeError, EOFError, OSError, OverflowError, MemoryError),
    *(RuntimeError, SyntaxError, TokenError, zipfile.BadZipFile, zlib.error),
)


def parse_gpx(path: Path, text: str) -> ArrayTable:
    """Reads the tracks of a GPX file, or else its routes, or else its waypoints.

    Segments of tracks, and routes, are pieces.  Entities and document types are refused, so
    that no file expands to more than it holds.

    Raises:
        PointCloudError: If it is not well-formed, no GPX, or holds no points.
    """
    reader = _GpxReader(path)
    reader.parse(text)
    kinds = [tag for tag in GPX_POINTS if len(reader.places[tag])]
    if not kinds:
        raise PointCloudError(f"{path} holds no waypoints: no track, route or waypoint has any")
    taken, *others = kinds
    values = np.array(reader.values[taken]).reshape(-1, 3)
    rows = Rows(values, np.array(reader.places[taken], dtype=np.intp), reader.breaks[taken])
    names = ["lat", "lon", "ele"]
    if np.isnan(values[:, 2]).all():
        names, rows = names[:2], Rows(values[:, :2], rows.places, rows.breaks)
    left = [f"{len(reader.places[tag])} points of its {GPX_POINTS[tag]}" for tag in others]
    notes = [f"left out: {' and '.join(left)}"] if left else []
    return ArrayTable(
        path, f"GPX {GPX_POINTS[taken]}", names, len(names), notes=notes, rows=rows
    )


class _GpxReader:
    """Collects the places of a GPX file, without ever holding its tree."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.values = {tag: array("d") for tag in GPX_POINTS}
        self.places: dict[str, list[int]] = {tag: [] for tag in GPX_POINTS}
        self.breaks: dict[str, list[int]] = {tag: [] for tag in GPX_POINTS}
        self._depth = 0
        self._point: str | None = None
        self._height: list[str] | None = None

    def parse(self, text: str) -> None:
        parser = self._parser = expat.ParserCreate(namespace_separator=" ")
        parser.buffer_text = True
        parser.StartElementHandler = self._start
        parser.EndElementHandler = self._end
        parser.CharacterDataHandler = self._text
        parser.StartDoctypeDeclHandler = self._doctype
        try:
            parser.Parse(text, True)
        except expat.ExpatError as error:
            reason = expat.ErrorString(error.code)
            raise self._error(f"not well-formed XML: {reason}", error.lineno) from None

    def _error(self, message: str, line: int | None = None) -> PointCloudError:
        return PointCloudError(
            f"{self.path}, line {line or self._parser.CurrentLineNumber}: {message}"
        )

    def _doctype(self, *_: object) -> None:
        raise self._error("XML with a DOCTYPE, which can hold entities, is not read")

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        tag = name.rpartition(" ")[2]
        if not self._depth and tag != "gpx":
            raise self._error(f"this is XML of {tag!r}, not of GPX; {READABLE}")
        self._depth += 1
        if tag in GPX_PIECES:
            for point, places in self.places.items():
                breaks = self.breaks[point]
                if places and (not breaks or breaks[-1] < len(places)):
                    breaks.append(len(places))
        elif tag in GPX_POINTS:
            if len(self.places[tag]) == MOST_ROWS:
                raise self._error(f"more than {MOST_ROWS:,} points are not read")
            place = [self._number(attributes.get(key), key) for key in ("lat", "lon")]
            self.values[tag].extend([*place, np.nan])
            self.places[tag].append(self._parser.CurrentLineNumber)
            self._point = tag
        elif tag == "ele" and self._point:
            self._height = []

    def _text(self, text: str) -> None:
        if self._height is not None:
            self._height.append(text)

    def _end(self, name: str) -> None:
        tag = name.rpartition(" ")[2]
        self._depth -= 1
        if tag == "ele" and self._point and self._height is not None:
            height = "".join(self._height)
            self.values[self._point][-1] = self._number(height, "ele") if height else np.nan
            self._height = None
        elif tag == self._point:
            self._point = None

    def _number(self, field: str | None, key: str) -> float:
        try:
            return float(field or "")
        except ValueError:
            message = f"{key} is missing" if field is None else f"{field!r} is no {key}"
            raise self._error(message) from None


def parse_mission(path: Path, text: str) -> ArrayTable:
    """Reads the waypoints of a mission of ArduPilot or QGroundControl, "QGC WPL".

    The first item is home, as ArduPilot has it.  It is left out, as are jumps and every other
    command that flies to no place; both are said.

    Raises:
        PointCloudError: If an item cannot be read, or is not in degrees.
    """
    rows: list[list[float]] = []
    lines: list[int] = []
    jumps, others, home = 0, 0, False
    for line, raw in enumerate(text.split("\n"), start=1):
        fields = raw.split()
        if line == 1 or not fields:
            continue
        where = f"{path}, line {line}"
        if len(fields) != MISSION_FIELDS:
            raise PointCloudError(f"{where}: {len(fields)} fields, not {MISSION_FIELDS}")
        try:
            item, _, frame, command = (int(field) for field in fields[:4])
            place = [float(field) for field in fields[8:11]]
        except ValueError as error:
            raise PointCloudError(f"{where}: no mission item: {error}") from None
        if item == 0:
            home = True
        elif command not in PLACES or place[:2] == [0, 0]:
            jumps += command == JUMP
            others += command != JUMP
        elif frame not in GLOBAL_FRAMES:
            raise PointCloudError(f"{where}: frame {frame} of MAVLink is not in degrees")
        else:
            rows.append(place)
            lines.append(line)
    if not rows:
        raise PointCloudError(f"{path} holds no waypoints: no item of the mission is one")
    left = [
        *(["home"] if home else []),
        *([f"{jumps} jump" + "s" * (jumps > 1)] if jumps else []),
        *([f"{others} other command" + "s" * (others > 1)] if others else []),
    ]
    notes = [f"left out: {', '.join(left)}"] if left else []
    found = Rows(array_of(rows), np.array(lines, dtype=np.intp))
    return ArrayTable(path, "QGC mission", ["lat", "lon", "alt"], 3, notes=notes, rows=found)


def parse_numpy(path: Path, data: bytes) -> ArrayTable:
    """Reads a .npy file, or a .npz file that holds one array; never a pickle.

    Raises:
        PointCloudError: If it is damaged, or holds no array (N, columns) of real numbers.
    """
    kind = ".npz" if data.startswith(ZIP) else ".npy"
    try:
        if kind == ".npz":
            data = _only_member(path, data)
        with warnings.catch_warnings():
            # Of headers that Python 2 may have written, or nobody.
            warnings.simplefilter("ignore")
            values = np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except PointCloudError:
        raise
    except _NUMPY_FAULTS as error:
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise PointCloudError(f"{path} is not a readable {kind} file: {reason}") from error
    if values.dtype.kind not in "fiu":
        raise PointCloudError(f"{path} holds {values.dtype}, not real numbers")
    if values.ndim != 2 or values.size == 0:
        raise PointCloudError(f"{path} holds an array {values.shape}; need (N, d) waypoints")
    if looks_transposed(values.shape):
        points, dim = values.shape
        raise PointCloudError(f"{path} holds {points} points in {dim}-D: transposed?")
    if len(values) > MOST_ROWS:
        raise PointCloudError(f"{path}: more than {MOST_ROWS:,} rows are not read")
    rows = Rows(values.astype(np.float64), np.arange(len(values)))
    return ArrayTable(path, "NumPy array", None, values.shape[1], place="row", rows=rows)


def _only_member(path: Path, data: bytes) -> bytes:
    """Returns the content of a .npz file with one array, in bounded memory."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = archive.namelist()
        if not names or not all(name.endswith(".npy") for name in names):
            raise PointCloudError(f"{path} is an archive without arrays; {READABLE}")
        if len(names) > 1:
            shown = ", ".join(name.removesuffix(".npy") for name in names[:8])
            raise PointCloudError(f"{path} holds {len(names)} arrays ({shown}); save one alone")
        with archive.open(names[0]) as member:
            content = member.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise PointCloudError(f"{path} unpacks to more than {MOST_BYTES // 10**6} MB")
    return content


def unreadable(path: Path, start: str) -> PointCloudError | None:
    """Returns the error of a text of another format, from how it begins."""
    if start.startswith("{") or start.startswith(("[{", "[[")):
        return PointCloudError(f"{path} holds JSON; {READABLE}")
    return None
