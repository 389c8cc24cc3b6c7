"""The certificate: what was proved of a field, and the file that says it."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
import hashlib
import json
import math
from pathlib import Path
from typing import Any

from sgvf_drake.certificate.basin import ExcludedSet
from sgvf_drake.certificate.cells import Cells
from sgvf_drake.certificate.levels import Conditions, Levels
from sgvf_drake.certificate.tube import Tube
from sgvf_drake.certificate.walls import Walls
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.storage import write_whole

FORMAT = "sgvf_drake.certificate"
VERSION = 3


@dataclass(frozen=True)
class PieceResult:
    """What is proved of one piece of the path.

    Times are those at |m| = 1: at speed v, they are divided by v.

    Attributes:
        orbit_exists: Whether m has a closed orbit in its thin tube, that goes around once.
        orbit_unique: Whether it is the only one there, and attracts all that enters; None: it
            is not known.
        lap_time_low: Time of a lap on the closed orbit in the thin tube, or of the way through
            an open one, at least; None, as the following: no such tube was found.
        lap_time_high: The same, at most.
        tube_half_width: Largest distance of the thin tube from the line along its middle.
        rest_radius: Of the ball at the end of an open tube, in which all that comes rests.
        wall_half_widths: Largest distance of each pair of walls from that line, from the tube
            outwards.
        e_star: The disturbance that m tolerates on each of these, at least: what is between
            them stays there under x_dot = m + d with |d| below it.
        entry_times: Time from between these to the thin tube, at most.
    """

    orbit_exists: bool
    orbit_unique: bool | None = None
    lap_time_low: float | None = None
    lap_time_high: float | None = None
    tube_half_width: float | None = None
    rest_radius: float | None = None
    wall_half_widths: tuple[float, ...] = ()
    e_star: tuple[float, ...] = ()
    entry_times: tuple[float, ...] = ()

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "PieceResult":
        """Returns the result of a JSON object."""
        tuples = ("wall_half_widths", "e_star", "entry_times")
        return cls(**{**body, **{name: tuple(body[name]) for name in tuples}})


@dataclass(frozen=True)
class Certificate:
    """A proof of path following, or what is in its way.

    Lengths are in the unit of the waypoints.

    Attributes:
        certified: Whether every piece of the path has a thin tube: what enters it follows the
            piece for ever, or to rest at its end.
        reason: Why it is so or not, in words.
        field_digest: Of the field.
        tubes: Of each piece of the path a thin tube around its orbit; None: none was found.
        walls: The walls around each of these, between which all comes to it; None: there are
            none, as of open pieces and in space.
        orbit_half_width: Largest distance between the thin tubes and the path, at most.
        cells: The code of the squares that the box was divided into; None, as the following:
            from where robots come between walls was not asked.
        area_fraction: Part of the box from which every robot comes between walls, at least.
        almost_fraction: Part of the box from which almost every robot does, at least.
        excluded: The sets of squares in which robots may stay, the largest first.
        pieces: Of each piece of the path.
        levels: What is proved of level sets of V; None: it was not asked.
        counterexample: (2,) a point where m vanishes on a piece without a tube; None: none was
            found.
        boxes: Number of squares and other patches over which the field was bounded.
    """

    certified: bool
    reason: str
    field_digest: str
    tubes: tuple[Tube | None, ...] = ()
    walls: tuple[Walls | None, ...] = ()
    orbit_half_width: float | None = None
    cells: str | None = None
    area_fraction: float | None = None
    almost_fraction: float | None = None
    excluded: tuple[ExcludedSet, ...] = ()
    pieces: tuple[PieceResult, ...] = ()
    levels: Levels | None = None
    counterexample: tuple[float, float] | None = None
    boxes: int = 0

    @property
    def e_star_max(self) -> float | None:
        """The largest disturbance under which robots stay near every piece; None: unknown."""
        largest = [max(piece.e_star, default=0.0) for piece in self.pieces]
        return min(largest, default=0.0) or None

    @property
    def entry_time_bound(self) -> float | None:
        """The time from between the outermost walls of any piece to its tube, at most."""
        return max(
            (piece.entry_times[-1] for piece in self.pieces if piece.entry_times), default=None
        )

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Writes the certificate as JSON, whole or not at all.

        Raises:
            OutputExistsError: The file exists and `overwrite` is false.
            OSError: The folder does not exist or cannot be written.
        """
        write_whole(Path(path), self.to_json().encode(), overwrite=overwrite)

    def to_json(self) -> str:
        """Returns the text of the file, a line for each key; its digest is that of the rest."""
        body = asdict(self)
        content = {"format": FORMAT, "version": VERSION, "digest": _digest(body), **body}
        lines = (f" {json.dumps(key)}: {json.dumps(value)}" for key, value in content.items())
        return "{\n" + ",\n".join(lines) + "\n}\n"

    @classmethod
    def load(cls, path: str | Path) -> "Certificate":
        """Reads a certificate.

        Raises:
            ConfigurationError: The file is missing, damaged, foreign or of another version, or
                anything in it was changed.
        """
        try:
            text = Path(path).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigurationError(f"{path}: cannot be read ({error})") from None
        try:
            return cls.from_json(text)
        except ConfigurationError as error:
            raise ConfigurationError(f"{path}: {error}") from None

    @classmethod
    def from_json(cls, text: str) -> "Certificate":
        """Returns the certificate of a text of `to_json`; see `load`."""
        try:
            body = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise ConfigurationError(f"no JSON document ({error})") from None
        if not isinstance(body, dict) or body.pop("format", None) != FORMAT:
            raise ConfigurationError("not a certificate of sgvf_drake")
        if (version := body.pop("version", None)) != VERSION:
            raise ConfigurationError(
                f"a certificate of version {version}, not of {VERSION}: certify the field anew"
            )
        if body.pop("digest", None) != _digest(body):
            raise ConfigurationError("the certificate was changed after it was written")
        try:
            return cls._of(body)
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigurationError(f"not a whole certificate ({error})") from None

    @classmethod
    def _of(cls, body: Mapping[str, Any]) -> "Certificate":
        names = {field.name for field in fields(cls)}
        if set(body) != names:
            raise KeyError(*sorted(names ^ set(body)))
        point, levels = body["counterexample"], body["levels"]
        if body["cells"] is not None:
            # What is no code is told here.
            Cells.of(body["cells"])
        return cls(
            **{
                **body,
                "tubes": tuple(tube and Tube.of(tube) for tube in body["tubes"]),
                "walls": tuple(walls and Walls.of(walls) for walls in body["walls"]),
                "excluded": tuple(map(ExcludedSet.of, body["excluded"])),
                "levels": None if levels is None else Levels.of(levels),
                "pieces": tuple(map(PieceResult.of, body["pieces"])),
                "counterexample": None if point is None else tuple(point),
            }
        )

    def is_as_strong_as(self, other: "Certificate", tolerance: float = 1e-9) -> bool:
        """Whether this one proves what another claims, but for rounding.

        On other machines the last bits of bounds differ.
        """
        mine, claimed = (
            (one.certified, one.tubes, one.walls, one.cells, _conditions(one))
            for one in (self, other)
        )
        if mine != claimed or len(self.pieces) != len(other.pieces):
            return False
        at_least, at_most = ("area_fraction", "almost_fraction"), ("orbit_half_width",)
        pairs = list(_pairs(self, other, at_least, at_most))
        for here, there in zip(self.pieces, other.pieces, strict=True):
            if (here.orbit_exists, here.orbit_unique) != (
                there.orbit_exists,
                there.orbit_unique,
            ):
                return False
            pairs += _pairs(here, there, OF_PIECES_AT_LEAST, OF_PIECES_AT_MOST)
        if self.levels is not None and other.levels is not None:
            pairs += _pairs(self.levels, other.levels, OF_LEVELS_AT_LEAST, OF_LEVELS_AT_MOST)
        return all(_at_least(a, b, tolerance) for a, b in pairs)

    def refused(self, reason: str) -> "Certificate":
        """Returns the same as not certified, with a reason before its own."""
        return replace(self, certified=False, reason=f"{reason}; {self.reason}")


def _conditions(certificate: Certificate) -> Conditions | None:
    return None if certificate.levels is None else certificate.levels.conditions


def _kind(piece: PieceResult) -> tuple[bool, bool | None]:
    return piece.orbit_exists, piece.orbit_unique


# What a claim may be weaker in than what is proved.
OF_PIECES_AT_LEAST = ("lap_time_low", "e_star")
OF_PIECES_AT_MOST = (
    *("lap_time_high", "tube_half_width", "rest_radius", "wall_half_widths", "entry_times"),
)
OF_LEVELS_AT_LEAST = ("alpha", "delta", "decrease_fraction", "step_bound", "e_star")
OF_LEVELS_AT_MOST = ("tube_half_width", "entry_time_bound")


def _pairs(
    mine: Any, claimed: Any, at_least: Sequence[str], at_most: Sequence[str]
) -> Iterator[tuple[Any, Any]]:
    """Yields what has to be as large as what."""
    for name in at_least:
        yield getattr(mine, name), getattr(claimed, name)
    for name in at_most:
        yield getattr(claimed, name), getattr(mine, name)


def _at_least(a: Any, b: Any, tolerance: float) -> bool:
    """Whether a number, or each of some, is as large as another, but for a tolerance."""
    if isinstance(a, tuple):
        return len(a) == len(b) and all(
            _at_least(x, y, tolerance) for x, y in zip(a, b, strict=True)
        )
    return (a is None) == (b is None) and (a is None or a >= b - tolerance * math.fabs(b))


def _digest(body: Mapping[str, Any]) -> str:
    canonical = json.dumps(body, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()
