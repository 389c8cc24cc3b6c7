"""The proof of path following under given conditions, or how it ends.

C1 and C2 are proved over squares, the tube's components and holes are counted, and then each
piece of the path is told what follows for it: a closed orbit, its uniqueness, its lap time.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.boxes import HALF_WIDTH, BoxSizes, Division
from sgvf_drake.certificate.by_tubes import (
    ProposeTube,
    ProvedTube,
    orbit_half_width,
    with_tube,
)
from sgvf_drake.certificate.certificate import Certificate, PieceResult
from sgvf_drake.certificate.conditions import (
    SPEED,
    Conditions,
    Contraction,
    Decrease,
    Speed,
    falling_area,
    rates,
)
from sgvf_drake.certificate.field_model import has_dual
from sgvf_drake.certificate.mixture_model import MixtureModel, mixture_of
from sgvf_drake.certificate.sublevel_sets import Shape, extend, shape_of_band
from sgvf_drake.certificate.tube import Tube
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import ReferencePath


@dataclass(frozen=True, eq=False)
class Attempt:
    """A proof, or how it ended.

    Attributes:
        certificate: What was proved.
        obstacle: (2,) in normalised units, where a condition on the band does not hold or was
            not decided; None: there is no such place.
    """

    certificate: Certificate
    obstacle: FloatArray | None = None


def prove(
    field: GuidingField,
    conditions: Conditions,
    reference: ReferencePath,
    propose: ProposeTube,
) -> Attempt:
    """Proves conditions of a field, and what follows from them for the pieces of a path.

    Args:
        field: The field.
        conditions: What is to be proved.
        reference: The path.
        propose: Gives a thin tube around the closed orbit of a piece.
    """
    sizes = BoxSizes.of(field)
    levels = MixtureModel(mixture_of(field, conditions.sigma), conditions.lowest)
    basin = levels.squares_below(conditions.c_out, sizes.everything, sizes.first)
    if not len(basin) or np.abs(basin.centers).max() + sizes.first >= HALF_WIDTH:
        return Attempt(failed(field, conditions, "{V <= c_out} is not a set in the square"))
    c = conditions
    falls = Decrease(field, levels, c.c_in, c.c_out, c.alpha, c.share).prove(basin, sizes.last)
    if not falls.proved:
        return _undone(field, conditions, "V falls along m on the band", [falls])
    tube = levels.squares_below(c.c_in, sizes.everything, sizes.ring)
    moves = Speed(field, levels, c.c_in, c.delta, c.share).prove(tube, sizes.last)
    if not moves.proved:
        return _undone(field, conditions, "m is nowhere zero in the tube", [falls, moves])
    shape = shape_of_band(levels, c.c_in, c.c_out, sizes.cover)
    if shape is None:
        return Attempt(failed(field, conditions, "the band is too thin for the covers"))
    proved = Proved(conditions, reference, levels, falls, moves, shape)
    return Attempt(conclude(field, proved, propose))


def _undone(
    field: GuidingField, conditions: Conditions, what: str, divisions: list[Division]
) -> Attempt:
    """Returns what the last of some divisions left open or refuted."""
    last, boxes = divisions[-1], sum(division.evaluated for division in divisions)
    refuted = last.counterexample
    if refuted is None:
        reason = f"it is undecided on {len(last.undecided)} squares whether {what}"
        undecided = len(last.undecided)
        certificate = failed(field, conditions, reason, boxes=boxes, undecided=undecided)
        return Attempt(certificate, last.undecided.centers[0])
    x, y = field.cloud.denormalize(refuted).tolist()
    reason = f"it is not so that {what}, at ({x:.4g}, {y:.4g})"
    certificate = failed(field, conditions, reason, boxes=boxes, counterexample=(x, y))
    return Attempt(certificate, refuted)


def failed(
    field: GuidingField, conditions: Conditions | None, reason: str, **facts: Any
) -> Certificate:
    """Returns a certificate that certifies nothing, with a reason."""
    return Certificate(False, reason, field_digest(field), conditions, **facts)


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
    reference: ReferencePath
    levels: MixtureModel
    falls: Division
    moves: Division
    shape: Shape


@dataclass(frozen=True, eq=False)
class _Orbit:
    """What is proved of the closed orbit of a piece.

    Attributes:
        result: What was found, in words and numbers.
        tube: A thin tube around it; None: none is known.
        boxes: Over how many squares and other patches the field was bounded.
    """

    result: PieceResult
    tube: Tube | None = None
    boxes: int = 0


def conclude(field: GuidingField, proved: Proved, propose: ProposeTube) -> Certificate:
    """Returns the certificate of a field from what was proved of it."""
    c, falls = proved.conditions, proved.falls
    found = rates(falls, c.c_in, c.c_out)
    unit = field.cloud.unit_length
    lower, upper = field.cloud.box
    box = float(np.prod((upper - lower) / unit))
    orbits = _orbits(field, proved, propose)
    missing = [k + 1 for k, orbit in enumerate(orbits) if not orbit.result.orbit_exists]
    reason = "every piece has a closed orbit in its part of the tube"
    if missing:
        reason = f"no orbit is proved of piece {', '.join(map(str, missing))}"
    above = extend(field, proved.levels, c)
    tubes = tuple(orbit.tube for orbit in orbits)
    boxes = falls.evaluated + proved.moves.evaluated + above.boxes
    boxes += sum(orbit.boxes for orbit in orbits)
    falling = falling_area(falls, c.c_in, c.c_out) + above.falling_area
    return Certificate(
        certified=not missing,
        reason=reason,
        field_digest=field_digest(field),
        conditions=c,
        tubes=tubes,
        sigma=c.sigma * unit,
        alpha=float(found.alpha.min()) / unit,
        delta=float(np.nanmin(proved.moves.facts[:, SPEED])),
        tube_half_width=tube_half_width(field, proved.shape, proved.reference),
        orbit_half_width=orbit_half_width(field, tubes, proved.reference),
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


def _orbits(field: GuidingField, proved: Proved, propose: ProposeTube) -> list[_Orbit]:
    """Returns what is proved of the orbit of each piece.

    In a forward invariant ring without a zero there is a closed orbit around its hole, by the
    theorem of Poincare and Bendixson; an orbit around nothing would have a zero inside, in the
    ring, which has none.
    """
    orbits = []
    components = pieces_in(field, proved.shape, proved.reference)
    for number, piece in enumerate(proved.reference.pieces):
        component = components[number]
        holes = None if component is None else proved.shape.holes[component - 1]
        result = PieceResult(holes, bool(holes == 1 and proved.reference.closed[number]))
        if component is None or not result.orbit_exists:
            orbits.append(_Orbit(result))
            continue
        orbit = _uniqueness(field, proved, component, result)
        found = propose(number, field.cloud.normalize(piece.vertices))
        orbits.append(orbit if found is None else _lap(field, proved, component, found, orbit))
    return orbits


def _uniqueness(
    field: GuidingField, proved: Proved, component: int, result: PieceResult
) -> _Orbit:
    """Returns an orbit in a component with one hole, by whether it is the only one."""
    if not has_dual(field):
        return _Orbit(result)
    sizes = BoxSizes.of(field)
    ring = proved.shape.squares_of(component, sizes.ring)
    contraction = Contraction(field, proved.levels, proved.conditions.c_in)
    found = contraction.prove(ring, sizes.last)
    return _Orbit(replace(result, orbit_unique=found.proved or None), boxes=found.evaluated)


def _lap(
    field: GuidingField, proved: Proved, component: int, found: ProvedTube, orbit: _Orbit
) -> _Orbit:
    """Returns an orbit with the time of its lap, where a tube in its component holds it."""
    tube, proof = found
    orbit = replace(orbit, boxes=orbit.boxes + proof.patches)
    # Where the chain may pass its first section twice, its time may be that of several laps.
    if not (proof.proved and proof.once and _is_within(proved, component, tube)):
        return orbit
    return replace(orbit, result=with_tube(orbit.result, found, field), tube=tube)


def _is_within(proved: Proved, component: int, tube: Tube) -> bool:
    """Whether a tube lies in the component of {V <= c_out} that holds one of {V <= c_in}.

    A closed orbit in it is then in that component of {V <= c_in}, since V falls above.  The
    tube hangs together, so one of its points tells which component it is in.
    """
    highest = proved.levels.level_range(tube.boxes)[1].max()
    at = proved.shape.component_of(tube.rows[:1, 0])[0]
    return bool(highest <= proved.conditions.c_out and at == component)


def tube_half_width(field: GuidingField, shape: Shape, reference: ReferencePath) -> float:
    """Returns the largest distance of the tube from the path, at most, in the field's unit."""
    cover = shape.cover
    centers = cover.lower + cover.side * (np.argwhere(shape.labels > 0) + 0.5)
    distance = reference.project(field.cloud.denormalize(centers)).distance.max()
    return float(distance + cover.side / np.sqrt(2) * field.cloud.unit_length)


def pieces_in(field: GuidingField, shape: Shape, reference: ReferencePath) -> list[int | None]:
    """Returns the component, from 1, that each piece of the path lies in alone; or None."""
    found: list[int | None] = []
    for piece in reference.pieces:
        numbers = np.unique(shape.component_of(field.cloud.normalize(piece.vertices)))
        alone = len(numbers) == 1 and numbers[0] > 0
        found.append(int(numbers[0]) if alone else None)
    return [number if found.count(number) == 1 else None for number in found]
