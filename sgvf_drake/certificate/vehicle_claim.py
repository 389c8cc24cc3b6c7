"""What is claimed of the flight of a vehicle along a field, and its proof anew."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
import math
from typing import Any

from sgvf_drake.certificate.document import bounds_hold
from sgvf_drake.certificate.field_model import ExactField
from sgvf_drake.certificate.flown_field import bound_flown, least_progress, region
from sgvf_drake.certificate.tube import Tube
from sgvf_drake.certificate.vehicle import (
    CLIMB,
    MARGIN,
    ErrorBounds,
    VehicleLaw,
    prove_stage,
)
from sgvf_drake.certificate.walls import Walls


@dataclass(frozen=True)
class VehicleProposal:
    """What is to be proved of the flight along one piece.

    Attributes:
        pairs: The vehicle stays between the walls of this number, from 1 at the tube.
        error: The horizontal |e| stays below this part of the speed.
        reach: How far the law looks ahead and back at most, normalised.
        change: The bound that is asked for `FlownBounds.along_change`.
        start: Bounds of the errors at the start.
        held: Bounds of the errors from then on.
    """

    pairs: int
    error: float
    reach: float
    change: float
    start: ErrorBounds
    held: ErrorBounds

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "VehicleProposal":
        """Returns the proposal of a JSON object."""
        start, held = ErrorBounds(**body["start"]), ErrorBounds(**body["held"])
        return cls(**{**body, "start": start, "held": held})


@dataclass(frozen=True)
class VehiclePiece:
    """What is proved of the flight along one piece; SI units.  None: it has no bound.

    Attributes:
        proposal: What it is proved by.
        failures: What is not proved, in words; empty: all is.
        half_width: Of the walls that the vehicle stays between, from the tube's middle.
        altitude_error: Of the altitude.
        velocity_error: Of the horizontal one, from the start on.
        tolerated: What the walls tolerate of that.
        progress: At least how fast it goes from section to section of the tube.
        final: Bounds of the errors after `settling`.
        settling: s.
        tilt: Between thrust and demanded thrust, rad, from the start on.
        tilt_demanded: Of the demanded thrust, rad.
        forces: The least and the largest force of a propeller.
        causes: What each cause makes of the velocity error.
        patches: Over how many patches the field was bounded.
    """

    proposal: VehicleProposal
    failures: tuple[str, ...]
    half_width: float | None = None
    altitude_error: float | None = None
    velocity_error: float | None = None
    tolerated: float | None = None
    progress: float | None = None
    final: ErrorBounds | None = None
    settling: float | None = None
    tilt: float | None = None
    tilt_demanded: float | None = None
    forces: tuple[float | None, float | None] = (None, None)
    causes: Mapping[str, float] | None = None
    patches: int = 0

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "VehiclePiece":
        """Returns the result of a JSON object."""
        return cls(
            **{
                **body,
                "proposal": VehicleProposal.of(body["proposal"]),
                "failures": tuple(body["failures"]),
                "final": body["final"] and ErrorBounds(**body["final"]),
                "forces": tuple(body["forces"]),
            }
        )


@dataclass(frozen=True)
class VehicleResult:
    """What is proved of the flight of a vehicle.

    Attributes:
        law: The vehicle.
        scale: Metres in a unit of the waypoints.
        disturbance: The acceleration that is tolerated, m/s^2.
        pieces: Of each piece what is proved; None: nothing was proposed.
    """

    law: VehicleLaw
    scale: float
    disturbance: float
    pieces: tuple[VehiclePiece | None, ...]

    @classmethod
    def of(cls, body: Mapping[str, Any]) -> "VehicleResult":
        """Returns the result of a JSON object."""
        law = VehicleLaw(**{**body["law"], "inertia": tuple(body["law"]["inertia"])})
        pieces = tuple(piece and VehiclePiece.of(piece) for piece in body["pieces"])
        return cls(law, body["scale"], body["disturbance"], pieces)

    @property
    def proved(self) -> bool:
        """Whether the flight is proved along every piece."""
        return all(piece is not None and not piece.failures for piece in self.pieces)

    def is_as_strong_as(self, other: "VehicleResult", tolerance: float) -> bool:
        """Whether this one proves what another claims, but for rounding."""
        given = (self.law, self.scale, self.disturbance, len(self.pieces))
        if given != (other.law, other.scale, other.disturbance, len(other.pieces)):
            return False
        for mine, claimed in zip(self.pieces, other.pieces, strict=True):
            if claimed is None or claimed.failures:
                continue
            if mine is None or mine.failures or mine.proposal != claimed.proposal:
                return False
            at_most = ("half_width", "altitude_error", "velocity_error", "tilt")
            if not bounds_hold(mine, claimed, ("tolerated", "progress"), at_most, tolerance):
                return False
        return True


def prove_piece(
    field: ExactField,
    tube: Tube,
    walls: Walls,
    e_star: Sequence[float],
    proposal: VehicleProposal,
    law: VehicleLaw,
    unit: float,
    disturbance: float,
) -> VehiclePiece:
    """Proves that a vehicle stays between walls, from all errors within bounds.

    Args:
        field: m, in the plane, as it is flown.
        tube: A tube that is proved.
        walls: Walls that are proved.
        e_star: What they tolerate.
        proposal: What is to be proved.
        law: The vehicle.
        unit: Metres in a normalised unit.
        disturbance: Of the acceleration that nobody knows of, m/s^2.
    """
    if not 1 <= proposal.pairs <= len(e_star):
        return VehiclePiece(proposal, (f"there are no walls of number {proposal.pairs}",))
    cells = region(tube, walls, proposal.pairs)
    bounds = bound_flown(
        field, cells, error=proposal.error, reach=proposal.reach, target=proposal.change
    )
    if bounds is None:
        return VehiclePiece(proposal, ("the field is not proved to bend as proposed",))
    held = proposal.held
    proof = prove_stage(law, proposal.start, held, bounds, unit, disturbance)
    failures, fed = list(proof.failures), proof.at_start
    tolerated = law.speed * e_star[proposal.pairs - 1]
    if not held.velocity * (1 + MARGIN) < tolerated:
        failures.append(
            f"a velocity error of {held.velocity:.4g} m/s, of which the walls tolerate "
            f"{tolerated:.4g}"
        )
    progress = law.speed * least_progress(field, cells) - held.velocity
    if not progress > 0:
        failures.append("the vehicle is not proved to go on along the path")
    top, climb = law.max_climb, CLIMB * held.climb
    return VehiclePiece(
        proposal,
        tuple(failures),
        half_width=walls.half_widths(tube)[proposal.pairs - 1] * unit,
        altitude_error=top / law.altitude_gain * math.atanh(min(climb / top, 0.999)),
        velocity_error=_finite(held.velocity),
        tolerated=tolerated,
        progress=_finite(progress),
        final=proof.final,
        settling=_finite(proof.settling),
        tilt=_finite(fed.tilt),
        tilt_demanded=_finite(fed.tilt_demanded),
        forces=(_finite(fed.least_force), _finite(fed.most_force)),
        causes=proof.causes,
        patches=bounds.patches,
    )


def _finite(bound: float) -> float | None:
    return bound if math.isfinite(bound) else None
