"""The certificate: what was proved of a field, and the file that says it."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
import hashlib
import json
import math
from pathlib import Path
from typing import Any

from sgvf_drake.certificate.conditions import Conditions
from sgvf_drake.certificate.tube import Tube
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.storage import write_whole

FORMAT = "sgvf_drake.certificate"
VERSION = 2


@dataclass(frozen=True)
class Part:
    """A component of {c_out <= V <= level} on which V falls, so that it leads down to c_out.

    Attributes:
        level: The upper level.
        point: (2,) a point of it, in the unit of the waypoints.
    """

    level: float
    point: tuple[float, float]

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "Part":
        """Returns the part of a JSON object."""
        x, y = body["point"]
        return cls(float(body["level"]), (float(x), float(y)))


@dataclass(frozen=True)
class PieceResult:
    """What is proved of one piece of the path.

    Attributes:
        holes: Of the component of the tube that it lies in; None: it lies in none alone.
        orbit_exists: Whether m has a closed orbit in that component, and it goes around its
            hole once.
        orbit_unique: Whether it is the only one there, and attracts all that enters; None: it
            is not known.
        lap_time_low: Time of a lap on the closed orbit in the thin tube, or of the way through
            an open one, at least; None, as the following: no such tube was found.
        lap_time_high: The same, at most.
        tube_half_width: Largest distance of the thin tube from the line along its middle.
        rest_radius: Of the ball at the end of an open tube, in which all that comes rests.
    """

    holes: int | None
    orbit_exists: bool
    orbit_unique: bool | None = None
    lap_time_low: float | None = None
    lap_time_high: float | None = None
    tube_half_width: float | None = None
    rest_radius: float | None = None


@dataclass(frozen=True)
class Certificate:
    """A proof of path following, or what is in its way.

    Lengths are in the unit of the waypoints, and times those at |m| = 1: at speed v, all
    times are divided by v.

    Attributes:
        certified: Whether every piece of the path has a proved closed orbit, in the tube that
            every robot from {V <= c_out} enters and stays in; of open paths, and in space,
            whether every piece has a thin tube.
        reason: Why it is so or not, in words.
        field_digest: Of the field.
        conditions: What was to be proved of V; None: samples showed nothing to prove, or the
            path is open or in space.
        tubes: Of each piece of the path a thin tube around its orbit; None: none was found.
        sigma: The noise level of V; None, as the following, where nothing was proved.
        alpha: The rate at which V falls in the band at least, per unit of length.
        delta: |m| in the tube at least.
        tube_half_width: Largest distance of {V <= c_in} from the path, at most.
        orbit_half_width: Largest distance between the thin tubes and the path, at most.
        parts: What leads down to {V <= c_out} from above.
        area_fraction: Area of {V <= c_out} and these parts over that of the box, at least.
        decrease_fraction: Part of the box where V was proved to fall, in these parts or not.
        entry_time_bound: Time from V = c_out to the tube, at most.
        levels: Levels of V from c_in to c_out.
        e_star: The disturbance that m tolerates on the levels between each and the next, at
            least: {V <= c} stays invariant under x_dot = m + d with |d| below it.
        step_bound: V falls with Euler steps of m that are shorter in time, from anywhere in
            the band.
        pieces: Of each piece of the path.
        counterexample: (2,) a point where a condition does not hold; None: none was found.
        boxes: Number of squares over which the field was bounded.
        undecided: Number of squares on which nothing was decided.
    """

    certified: bool
    reason: str
    field_digest: str
    conditions: Conditions | None = None
    tubes: tuple[Tube | None, ...] = ()
    sigma: float | None = None
    alpha: float | None = None
    delta: float | None = None
    tube_half_width: float | None = None
    orbit_half_width: float | None = None
    parts: tuple[Part, ...] = ()
    area_fraction: float | None = None
    decrease_fraction: float | None = None
    entry_time_bound: float | None = None
    levels: tuple[float, ...] = ()
    e_star: tuple[float, ...] = ()
    step_bound: float | None = None
    pieces: tuple[PieceResult, ...] = ()
    counterexample: tuple[float, float] | None = None
    boxes: int = 0
    undecided: int = 0

    @property
    def e_star_max(self) -> float | None:
        """The largest of `e_star`."""
        return max(self.e_star, default=None)

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
        point, conditions = body["counterexample"], body["conditions"]
        return cls(
            **{
                **body,
                "conditions": None if conditions is None else Conditions(**conditions),
                "tubes": tuple(tube and Tube.of(tube) for tube in body["tubes"]),
                "parts": tuple(map(Part.of, body["parts"])),
                "levels": tuple(body["levels"]),
                "e_star": tuple(body["e_star"]),
                "pieces": tuple(PieceResult(**piece) for piece in body["pieces"]),
                "counterexample": None if point is None else tuple(point),
            }
        )

    def is_as_strong_as(self, other: "Certificate", tolerance: float = 1e-9) -> bool:
        """Whether this one proves what another claims, but for rounding.

        On other machines the last bits of bounds differ.
        """
        mine, claimed = ((one.certified, one.conditions, one.tubes) for one in (self, other))
        if mine != claimed:
            return False
        if [_kind(piece) for piece in self.pieces] != [_kind(piece) for piece in other.pieces]:
            return False
        at_least = ("alpha", "delta", "area_fraction", "decrease_fraction", "step_bound")
        at_most = ("tube_half_width", "orbit_half_width", "entry_time_bound")
        pairs = [(getattr(self, name), getattr(other, name)) for name in at_least]
        pairs += [(getattr(other, name), getattr(self, name)) for name in at_most]
        pairs += [(self.sigma, other.sigma), (other.sigma, self.sigma)]
        if len(self.levels) != len(other.levels) or len(self.e_star) != len(other.e_star):
            return False
        pairs += zip(self.levels, other.levels, strict=True)
        pairs += zip(other.levels, self.levels, strict=True)
        pairs += zip(self.e_star, other.e_star, strict=True)
        for here, there in zip(self.pieces, other.pieces, strict=True):
            pairs.append((here.lap_time_low, there.lap_time_low))
            pairs.append((there.lap_time_high, here.lap_time_high))
            pairs.append((there.tube_half_width, here.tube_half_width))
            pairs.append((there.rest_radius, here.rest_radius))
        return all(
            (a is None) == (b is None) and (a is None or a >= b - tolerance * math.fabs(b))
            for a, b in pairs
        )

    def refused(self, reason: str) -> "Certificate":
        """Returns the same as not certified, with a reason before its own."""
        return replace(self, certified=False, reason=f"{reason}; {self.reason}")


def _kind(piece: PieceResult) -> tuple[int | None, bool, bool | None]:
    return piece.holes, piece.orbit_exists, piece.orbit_unique


def _digest(body: Mapping[str, Any]) -> str:
    canonical = json.dumps(body, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(canonical.encode()).hexdigest()
