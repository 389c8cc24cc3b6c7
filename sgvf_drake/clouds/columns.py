"""Which columns of a table are coordinates, and of what: known by their names, or chosen.

A name is cut into words: "field.pose.pose.position.x", "px", "X [m]" and "posX" all have an
axis and words around it.  Columns whose words agree but for the axis belong together.  Where
names leave a choice it is the user's, never a guess.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
import re
import shlex
from typing import Literal

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.clouds.tables import Table, looks_transposed
from sgvf_drake.exceptions import PointCloudError

Frame = Literal["plain", "enu", "ned", "degrees"]
"""What coordinates are along: axes of the user's; east, north, up; north, east, down; or
latitude and longitude, in degrees."""

AXES = {
    **{"x": "x", "y": "y", "z": "z"},
    **{"e": "e", "east": "e", "easting": "e", "n": "n", "north": "n", "northing": "n"},
    **{"u": "u", "up": "u", "d": "d", "down": "d"},
    **{"lat": "lat", "latitude": "lat", "lon": "lon", "lng": "lon", "long": "lon"},
    **{"longitude": "lon", "alt": "alt", "altitude": "alt", "ele": "alt", "elevation": "alt"},
    **{"height": "alt", "hgt": "alt"},
}
"""Words for the axes."""

UNITS = {
    *("m", "mm", "cm", "km", "ft", "meter", "meters", "metre", "metres", "mps", "s", "ms"),
    *("deg", "degree", "degrees"),
}
"""Words that are only units, and tell no columns apart."""

POSITION_WORDS = {
    *("p", "pos", "position", "pose", "point", "t", "translation", "transform", "location"),
    *(
        "coord",
        "field",
        "gps",
        "utm",
        "local",
        "global",
        "world",
        "map",
        "odom",
        "mocap",
        "enu",
        "ned",
    ),
}
"""In front of its axis, a coordinate has one of these words or none."""

VELOCITY_WORDS = {"v", "vel", "velocity", "dot", "speed"}

OTHER_WORDS = {
    *("a", "acc", "accel", "acceleration", "linear", "angular", "twist", "gyro", "w", "omega"),
    *("q", "quat", "quaternion", "orientation", "rot", "rotation", "mag", "force", "torque"),
    *("std", "var", "variance", "cov", "covariance", "sigma", "err", "error", "bias", "jerk"),
    *("normvec", "normal", "magnetic", "vector"),
}
"""Words of what has axes too, but is neither a position nor a velocity along them.  A twist
of ROS is one along the axes of the robot."""

SETS = (("x", "y", "z"), ("e", "n", "u"), ("e", "n", "d"), ("lat", "lon"))
"""Axes that belong together; the first two of each are needed.  An altitude beside degrees is
taken where it is asked for."""

TUM = ("time", "x", "y", "z", "qx", "qy", "qz", "qw")
KITTI = ("r00", "r01", "r02", "x", "r10", "r11", "r12", "y", "r20", "r21", "r22", "z")

KITTI_NOTE = "y points down, as in a camera; the ground is --columns x,z"

UNIT_TOLERANCE = 1e-2
"""How far the length of a quaternion, or a product of axes, is from what it should be."""


@dataclass(frozen=True)
class Choice:
    """Columns of coordinates.

    Attributes:
        columns: Their numbers.
        axes: Their axes, as far as names tell: "x", "e", "lat", or "".
        velocities: The numbers of the columns of velocities along the same axes, if any.
    """

    columns: tuple[int, ...]
    axes: tuple[str, ...]
    velocities: tuple[int, ...] = ()

    @property
    def frame(self) -> Frame:
        if {"lat", "lon"} <= set(self.axes) <= {"lat", "lon", "alt"}:
            return "degrees"
        if set(self.axes) == {"n", "e", "d"}:
            return "ned"
        return "enu" if set(self.axes) in ({"e", "n"}, {"e", "n", "u"}) else "plain"


@dataclass(frozen=True)
class _Name:
    """What a name says: its axis, the words around it, and whether it is of a velocity."""

    axis: str
    words: tuple[str, ...]
    moves: bool


def choose_columns(table: Table, columns: Sequence[str | int] | None) -> Choice:
    """Chooses the columns of the coordinates and of their velocities.

    Args:
        table: The table.
        columns: Those that the user wants, by name or number; None: as names tell.

    Raises:
        PointCloudError: If there are no such columns, or if the user has to choose.
    """
    names = [_understand(name) for name in table.names or ()]
    if columns is None:
        return _with_velocities(_known_columns(table, names), names)
    numbers = tuple(_column_number(table, column) for column in columns)
    if len(numbers) < 2:
        raise table.error(f"a point needs two columns or more, not {len(numbers)}")
    repeated = [number for number in numbers if numbers.count(number) > 1]
    if repeated:
        raise table.error(f"column {repeated[0]} is chosen twice")
    known = [names[number] if names else None for number in numbers]
    axes = tuple("" if name is None or name.moves else name.axis for name in known)
    choice = Choice(numbers, axes)
    if choice.frame in ("degrees", "ned"):
        # These are turned into east and north, so the order that they are given in is none.
        order = ("lat", "lon", "alt") if choice.frame == "degrees" else ("e", "n", "d")
        pairs = sorted(zip(axes, numbers, strict=True), key=lambda pair: order.index(pair[0]))
        axes, numbers = zip(*pairs, strict=True)
        if len(set(axes)) < len(axes):
            raise table.error("two of the chosen columns are along the same axis")
    return _with_velocities(Choice(numbers, axes), names)


def altitude_of(table: Table) -> str | None:
    """Returns the name of the first column that is an altitude, if there is one."""
    for name in table.names or ():
        known = _understand(name)
        if known is not None and known.axis == "alt" and not known.moves:
            return name
    return None


def name_trajectory(table: Table) -> tuple[str, Sequence[str], Sequence[str]] | None:
    """Recognises trajectories whose columns have no names, by how many and how they agree.

    Returns:
        "TUM trajectory" or "KITTI poses", the names of the columns, and what is to be said;
        or None.
    """
    if table.names is not None or table.num_columns not in (len(TUM), len(KITTI)):
        return None
    try:
        values = table.numbers(range(table.num_columns)).values
    except PointCloudError:
        return None
    values = values[~np.isnan(values).all(axis=1)]
    if len(TUM) == table.num_columns:
        fits = np.abs(np.linalg.norm(values[:, 4:], axis=1) - 1) <= UNIT_TOLERANCE
        return ("TUM trajectory", TUM, ()) if fits.all() else None
    rotation = values.reshape(-1, 3, 4)[..., :3]
    product = rotation @ rotation.transpose(0, 2, 1) - np.eye(3)
    fits = (np.abs(product) <= UNIT_TOLERANCE).all(axis=(1, 2))
    fits &= np.linalg.det(rotation) > 0
    return ("KITTI poses", KITTI, (KITTI_NOTE,)) if fits.all() else None


def _known_columns(table: Table, names: Sequence[_Name | None]) -> Choice:
    """The columns that the names tell, or the only two."""
    if table.names is None:
        if table.num_columns == 2:
            return Choice((0, 1), ("", ""))
        raise _unnamed(table)
    found = []
    for members in _families(names, moves=False).values():
        for wanted in SETS:
            axes = tuple(axis for axis in wanted if axis in members)
            # East and north alone are of both frames; with down they are of the second.
            if axes[:2] != wanted[:2] or (wanted[2:] == ("d",) and "d" not in axes):
                continue
            if wanted[2:] == ("u",) and "d" in members:
                continue
            if any(len(members[axis]) > 1 for axis in axes):
                raise _undecided(table, "columns with the same meaning", members[axes[0]])
            found.append(Choice(tuple(members[axis][0] for axis in axes), axes))
    if len(found) > 1:
        firsts = found[0].columns[:2]
        raise _undecided(table, f"{len(found)} sets of them", firsts)
    if not found:
        raise _undecided(table, "none has a name known as one", (0, 1))
    return found[0]


def _with_velocities(choice: Choice, names: Sequence[_Name | None]) -> Choice:
    """Adds the columns of the velocities along the axes of the coordinates, if there are any.

    Velocities along x and y, beside degrees or north, east and down, are along axes that
    nobody can tell, and are not taken.
    """
    height = tuple("u" for _ in choice.axes[2:])
    axes = ("e", "n", *height) if choice.frame == "degrees" else choice.axes
    any_axes = choice.frame == "enu" or "" in axes
    candidates = []
    for words, members in _families(names, moves=True).items():
        if set(axes) <= set(members):
            wanted: Sequence[str] = axes
        elif any_axes and len(members) == len(axes):
            wanted = sorted(members)
        else:
            continue
        columns = tuple(number for axis in wanted for number in members[axis])
        if len(columns) == len(axes) and not {*columns} & {*choice.columns}:
            candidates.append((len(words), columns))
    candidates.sort()
    # The plainest is meant, as vx beside vx_filtered.
    if not candidates or [length for length, _ in candidates].count(candidates[0][0]) > 1:
        return choice
    return Choice(choice.columns, choice.axes, candidates[0][1])


def _families(
    names: Iterable[_Name | None], moves: bool
) -> dict[tuple[str, ...], dict[str, list[int]]]:
    """The numbers of the columns by their words, and by their axes."""
    families: dict[tuple[str, ...], dict[str, list[int]]] = {}
    for number, name in enumerate(names):
        if name is not None and name.moves == moves:
            members = families.setdefault(name.words, {})
            members.setdefault(name.axis, []).append(number)
    return families


def _understand(name: str) -> _Name | None:
    """Returns the axis of a column and the words around it; None if it has no axis."""
    words = _words(name)
    places = [place for place, word in enumerate(words) if word in AXES]
    if len(places) > 1:
        # As in "x_d", where a letter is no axis.
        places = [place for place in places if words[place] in ("x", "y", "z")]
    if len(places) != 1:
        return None
    (place,) = places
    axis, front, back = AXES[words[place]], words[:place], words[place + 1 :]
    around = (*front, *(word for word in back if word not in UNITS))
    if OTHER_WORDS & {*around}:
        return None
    if VELOCITY_WORDS & {*around}:
        return _Name(axis, around, moves=True)
    if axis in ("lat", "lon", "alt"):
        # Unmistakable in any place, but for their unit.
        return None if "rad" in name.lower() else _Name(axis, around, moves=False)
    if front and not POSITION_WORDS & {*front}:
        return None
    if "ned" in around:
        axis = {"x": "n", "y": "e", "z": "d"}.get(axis, axis)
    return _Name(axis, around, moves=False)


def _words(name: str) -> list[str]:
    """Cuts a name into words in small letters, without what it has in brackets."""
    text = re.sub(r"[\[(]([012])[\])]", lambda match: "_" + "xyz"[int(match[1])], name)
    text = re.sub(r"\[[^\]]*\]|\([^)]*\)", " ", text)
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", text)
    words = [word.lower() for word in re.split(r"[^A-Za-z0-9]+", text) if word]
    cut = []
    for word in words:
        match = re.fullmatch(r"(pos|vel|acc|[pvaqtw])([xyz])|v([neud])", word)
        after = re.fullmatch(r"([xyz])(dot|vel|pos)", word)
        if after:
            cut += [after[1], after[2]]
        elif match:
            cut += ["v", match[3]] if match[3] else [match[1], match[2]]
        else:
            cut.append(word)
    return cut


def _column_number(table: Table, column: str | int) -> int:
    if isinstance(column, str) and not column.isdecimal():
        if table.names is not None and column in table.names:
            if list(table.names).count(column) > 1:
                raise table.error(f"two columns are named {column!r}")
            return list(table.names).index(column)
        raise table.error(f"there is no column {column!r}; it has {table.columns_text}")
    number = int(column)
    if not 0 <= number < table.num_columns:
        last = table.num_columns - 1
        raise table.error(f"there is no column {number}; it has columns 0 to {last}")
    return number


def _undecided(table: Table, reason: str, example: Sequence[int]) -> PointCloudError:
    """The error that leaves the choice among named columns to the user."""
    names = list(table.names or ())
    if len(names) < 2:
        return table.error(f"a point needs two columns or more, not {len(names)}")
    by_name = [names[number] for number in example[:2]]
    if any(names.count(name) > 1 or not name or "," in name for name in by_name):
        by_name = [str(number) for number in example[:2]]
    return table.error(
        f"cannot tell which columns are coordinates ({reason}): it has {table.columns_text}; "
        f"choose, as in --columns {shlex.quote(','.join(by_name))}"
    )


def _unnamed(table: Table) -> PointCloudError:
    """The error that leaves the choice among columns without names to the user."""
    width = table.num_columns
    if width < 2:
        return table.error(f"a point needs two columns or more, not {width}")
    try:
        values = table.numbers(range(width)).values
    except PointCloudError:
        values = np.empty((0, width))
    if looks_transposed(values.shape):
        return table.error(f"{len(values)} points in {width}-D: transposed?")
    constant = _constant(values)
    moving = [str(number) for number in range(width) if number not in constant]
    plane = ",".join(moving[:2]) if len(moving) >= 2 else "0,1"
    space = f" (or --columns {','.join(moving[:3])} in space)" if len(moving) > 2 else ""
    still = f"; column {constant[0]} is constant" if constant else ""
    return table.error(
        f"cannot tell which of its {width} columns without names are coordinates{still}; "
        f"choose with --columns {plane}{space}"
    )


def _constant(values: FloatArray) -> list[int]:
    """The columns that have one and the same value in all rows, of two or more."""
    if len(values) < 2:
        return []
    return [int(number) for number in np.flatnonzero((values == values[0]).all(axis=0))]
