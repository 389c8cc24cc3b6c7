"""What a field is certified of, from what was proved of its basin, its tube and its orbits."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import consequences, speed
from sgvf_drake.certificate.annulus import Annulus
from sgvf_drake.certificate.division import Division
from sgvf_drake.certificate.extension import extend
from sgvf_drake.certificate.field_model import has_dual
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.certificate.orbits import Contraction, Turning
from sgvf_drake.certificate.squares import Squares
from sgvf_drake.certificate.statement import Certificate, Conditions, PieceResult
from sgvf_drake.certificate.topology import Shape
from sgvf_drake.certificate.trapping import is_trapping
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import Reference

ProposeRings = Callable[[int, FloatArray], Iterable[Annulus]]
"""From the number of a piece and its points, (M, 2) normalised, to rings around its orbit."""


# How finely a ring is covered to bound the time of a lap.
FINENESS = (1, 2)


@dataclass(frozen=True, eq=False)
class Proved:
    """What was proved of the basin and the tube.

    Attributes:
        conditions: C1 and C2.
        reference: The path.
        levels: V.
        falls: What C1 came to.
        moves: What C2 came to.
        shape: The components and holes of the tube.
    """

    conditions: Conditions
    reference: Reference
    levels: MixtureModel
    falls: Division
    moves: Division
    shape: Shape


@dataclass(frozen=True, eq=False)
class _Orbit:
    """What is proved of the closed orbit of a piece.

    Attributes:
        result: In words and numbers.
        annulus: A ring that holds it; None: none is known.
        boxes: Over how many squares the field was bounded.
    """

    result: PieceResult
    annulus: Annulus | None = None
    boxes: int = 0


def conclude(field: GuidingField, proved: Proved, propose: ProposeRings) -> Certificate:
    """Returns the certificate of a field from what was proved of it."""
    c, falls = proved.conditions, proved.falls
    found = consequences.rates(falls, c.c_in, c.c_out)
    unit = field.cloud.unit_length
    lower, upper = field.cloud.box
    box = float(np.prod((upper - lower) / unit))
    orbits = _orbits(field, proved, propose)
    missing = [k + 1 for k, orbit in enumerate(orbits) if not orbit.result.orbit_exists]
    reason = "every piece has a closed orbit in its part of the tube"
    if missing:
        reason = f"no orbit is proved of piece {', '.join(map(str, missing))}"
    above = extend(field, proved.levels, c)
    annuli = tuple(orbit.annulus for orbit in orbits)
    boxes = falls.evaluated + proved.moves.evaluated + above.boxes
    boxes += sum(orbit.boxes for orbit in orbits)
    falling = consequences.falling_area(falls, c.c_in, c.c_out) + above.falling_area
    return Certificate(
        certified=not missing,
        reason=reason,
        field_digest=field_digest(field),
        conditions=c,
        annuli=annuli,
        sigma=c.sigma * unit,
        alpha=float(found.alpha.min()) / unit,
        delta=float(np.nanmin(proved.moves.facts[:, speed.SPEED])),
        tube_half_width=consequences.tube_half_width(field, proved.shape, proved.reference),
        orbit_half_width=consequences.annuli_half_width(field, annuli, proved.reference),
        parts=above.parts,
        area_fraction=above.basin_area / box,
        decrease_fraction=falling / box,
        entry_time_bound=found.entry_time * unit,
        levels=tuple(found.levels.tolist()),
        e_star=tuple(found.e_star.tolist()),
        # The Hessian of V is at most I / sigma^2.
        step_bound=2 * c.sigma**2 * found.step * unit,
        pieces=tuple(orbit.result for orbit in orbits),
        boxes=boxes,
    )


def _orbits(field: GuidingField, proved: Proved, propose: ProposeRings) -> list[_Orbit]:
    """Returns what is proved of the orbit of each piece.

    In a forward invariant ring without a zero there is a closed orbit around its hole, by the
    theorem of Poincare and Bendixson; an orbit around nothing would have a zero inside, in the
    ring, which has none.
    """
    orbits = []
    components = consequences.pieces_in(field, proved.shape, proved.reference)
    for number, points in enumerate(consequences.points_of(proved.reference)):
        component = components[number]
        holes = None if component is None else proved.shape.holes[component - 1]
        result = PieceResult(holes, bool(holes == 1 and proved.reference.closed[number]))
        if component is None or not result.orbit_exists:
            orbits.append(_Orbit(result))
            continue
        orbit = _uniqueness(field, proved, component, result)
        normalised = field.cloud.normalize(points)
        for annulus in propose(number, normalised):
            orbit = _lap(field, proved, component, annulus, orbit)
            if orbit.annulus is not None:
                break
        orbits.append(orbit)
    return orbits


def _uniqueness(
    field: GuidingField, proved: Proved, component: int, result: PieceResult
) -> _Orbit:
    """Returns an orbit in a component with one hole, by whether it is the only one."""
    if not has_dual(field):
        return _Orbit(result)
    squares = Squares.of(field)
    ring = proved.shape.squares_of(component, squares.ring)
    contraction = Contraction(field, proved.levels, proved.conditions.c_in)
    found = contraction.prove(ring, squares.last)
    return _Orbit(replace(result, orbit_unique=found.proved or None), boxes=found.evaluated)


def _lap(
    field: GuidingField, proved: Proved, component: int, annulus: Annulus, orbit: _Orbit
) -> _Orbit:
    """Returns an orbit with the time of its lap, where a ring in its component holds it."""
    if not _is_within(proved, component, annulus):
        return orbit
    unit = field.cloud.unit_length
    traps, boxes = is_trapping(field, annulus)
    orbit = replace(orbit, boxes=orbit.boxes + boxes)
    if not traps:
        return orbit
    turning = Turning.about(field, np.array(annulus.center), np.array(annulus.vertices))
    for fineness in FINENESS:
        turns = turning.prove(annulus.squares(fineness), Squares.of(field).last)
        orbit = replace(orbit, boxes=orbit.boxes + turns.evaluated)
        if turns.proved:
            low, high = turning.lap_time(turns)
            result = replace(orbit.result, lap_time_low=low * unit, lap_time_high=high * unit)
            return replace(orbit, result=result, annulus=annulus)
    return orbit


def _is_within(proved: Proved, component: int, annulus: Annulus) -> bool:
    """Whether a ring lies in the component of {V <= c_out} that holds one of the tube.

    A closed orbit in it is then in that component of the tube, since V falls above.  The ring
    hangs together, so one of its points tells which component it is in.
    """
    if not annulus.is_ring:
        return False
    highest = proved.levels.level_range(annulus.squares())[1].max()
    point = np.array(annulus.vertices[:1])
    return bool(
        highest <= proved.conditions.c_out and proved.shape.component_of(point)[0] == component
    )
