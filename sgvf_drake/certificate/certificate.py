"""The certificate: what was proved of a field, and the file that says it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from sgvf_drake.certificate.basin import ExcludedSet
from sgvf_drake.certificate.cells import Cells
from sgvf_drake.certificate.document import Document, bounds_hold
from sgvf_drake.certificate.fences import Fence
from sgvf_drake.certificate.levels import Conditions, Levels
from sgvf_drake.certificate.tube import Tube
from sgvf_drake.certificate.vehicle_claim import VehicleResult
from sgvf_drake.certificate.walls import Walls


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
class Certificate(Document):
    """A proof of path following, or what is in its way.

    Lengths are in the unit of the waypoints.

    Attributes:
        certified: Whether every piece of the path has a thin tube: what enters it follows the
            piece for ever, or to rest at its end.
        reason: Why it is so or not, in words.
        field_digest: That of the field.
        tubes: A thin tube around the orbit of each piece; None: none was found.
        walls: The walls around each of these, between which all comes to it; None: there are
            none, as of open pieces and in space.
        orbit_half_width: Largest distance between the thin tubes and the path, at most.
        fences: Fences that robots cross outward alone, for the squares.
        cells: The code of the squares that the box was divided into; None, as the following:
            from where robots come between walls was not asked.
        area_fraction: Part of the box from which every robot comes between walls, at least.
        almost_fraction: Part of the box from which almost every robot does, at least.
        excluded: The sets of squares in which robots may stay, the largest first.
        pieces: What is proved of each piece.
        levels: What is proved of level sets of V; None: it was not asked.
        vehicle: What is proved of a vehicle that flies along the field; None: it was not asked.
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
    fences: tuple[Fence, ...] = ()
    cells: str | None = None
    area_fraction: float | None = None
    almost_fraction: float | None = None
    excluded: tuple[ExcludedSet, ...] = ()
    pieces: tuple[PieceResult, ...] = ()
    levels: Levels | None = None
    vehicle: VehicleResult | None = None
    counterexample: tuple[float, float] | None = None
    boxes: int = 0

    FORMAT, VERSION = "sgvf_drake.certificate", 4

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

    @classmethod
    def _of(cls, body: Mapping[str, Any]) -> "Certificate":
        point, levels, vehicle = (body[key] for key in ("counterexample", "levels", "vehicle"))
        if body["cells"] is not None:
            # What is no code is told here.
            Cells.of(body["cells"])
        return cls(
            **{
                **body,
                "tubes": tuple(tube and Tube.of(tube) for tube in body["tubes"]),
                "walls": tuple(walls and Walls.of(walls) for walls in body["walls"]),
                "fences": tuple(map(Fence.of, body["fences"])),
                "excluded": tuple(map(ExcludedSet.of, body["excluded"])),
                "levels": None if levels is None else Levels.of(levels),
                "vehicle": None if vehicle is None else VehicleResult.of(vehicle),
                "pieces": tuple(map(PieceResult.of, body["pieces"])),
                "counterexample": None if point is None else tuple(point),
            }
        )

    def is_as_strong_as(self, other: "Certificate", tolerance: float = 1e-9) -> bool:
        """Whether this one proves what another claims, but for rounding.

        On other machines the last bits of bounds differ.
        """
        mine, claimed = ((*_parts(one), _conditions(one), _kinds(one)) for one in (self, other))
        if mine != claimed:
            return False
        compared: list[tuple[Any, Any, tuple[str, ...], tuple[str, ...]]] = [
            (self, other, ("area_fraction", "almost_fraction"), ("orbit_half_width",)),
            *((*both, *OF_PIECES) for both in zip(self.pieces, other.pieces, strict=True)),
        ]
        if self.levels is not None and other.levels is not None:
            compared.append((self.levels, other.levels, *OF_LEVELS))
        if other.vehicle is not None and (
            self.vehicle is None or not self.vehicle.is_as_strong_as(other.vehicle, tolerance)
        ):
            return False
        return all(bounds_hold(*one, tolerance) for one in compared)

    def refused(self, reason: str) -> "Certificate":
        """Returns the same as not certified, with a reason before its own."""
        return replace(self, certified=False, reason=f"{reason}; {self.reason}")


def _parts(certificate: Certificate) -> tuple[Any, ...]:
    one = certificate
    return one.certified, one.tubes, one.walls, one.fences, one.cells


def _conditions(certificate: Certificate) -> Conditions | None:
    return None if certificate.levels is None else certificate.levels.conditions


def _kinds(certificate: Certificate) -> list[tuple[bool, bool | None]]:
    return [(piece.orbit_exists, piece.orbit_unique) for piece in certificate.pieces]


# What a claim may be lower in than what is proved, and higher in.
OF_PIECES = (
    ("lap_time_low", "e_star"),
    ("lap_time_high", "tube_half_width", "rest_radius", "wall_half_widths", "entry_times"),
)
OF_LEVELS = (
    ("alpha", "delta", "decrease_fraction", "step_bound", "e_star"),
    ("tube_half_width", "entry_time_bound"),
)
