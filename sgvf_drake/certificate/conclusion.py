"""What a field is certified of, from what was proved of its basin, its tube and its orbits."""

from dataclasses import dataclass, replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import consequences, speed
from sgvf_drake.certificate.division import Division
from sgvf_drake.certificate.field_model import has_dual
from sgvf_drake.certificate.inner import Inner
from sgvf_drake.certificate.orbits import Contraction, Ring, Turning
from sgvf_drake.certificate.squares import Squares
from sgvf_drake.certificate.statement import Certificate, Conditions, PieceResult
from sgvf_drake.certificate.topology import Shape
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import Reference


@dataclass(frozen=True, eq=False)
class Outer:
    """What was proved of the basin and the tube.

    Attributes:
        conditions: C1 and C2.
        reference: The path.
        falls: What C1 came to.
        moves: What C2 came to.
        shape: The components and holes of the tube.
    """

    conditions: Conditions
    reference: Reference
    falls: Division
    moves: Division
    shape: Shape


def conclude(field: GuidingField, outer: Outer, inner: Inner | None) -> Certificate:
    """Returns the certificate of a field from what was proved of it."""
    c, falls = outer.conditions, outer.falls
    found = consequences.rates(falls, c.c_in, c.c_out)
    unit = field.cloud.unit_length
    lower, upper = field.cloud.box
    box = float(np.prod((upper - lower) / unit))
    pieces, boxes = _pieces(field, outer, inner)
    missing = [k + 1 for k, piece in enumerate(pieces) if not piece.orbit_exists]
    reason = "every piece has a closed orbit in its part of the tube"
    if missing:
        reason = f"no orbit is proved of piece {', '.join(map(str, missing))}"
    widths = [
        consequences.tube_half_width(field, shape, outer.reference)
        for shape in (outer.shape, *([] if inner is None else [inner.shape]))
    ]
    return Certificate(
        certified=not missing,
        reason=reason,
        field_digest=field_digest(field),
        conditions=c,
        inner=None if inner is None else inner.conditions,
        sigma=c.sigma * unit,
        alpha=float(found.alpha.min()) / unit,
        delta=float(np.nanmin(outer.moves.facts[:, speed.SPEED])),
        tube_half_width=widths[0],
        orbit_half_width=min(widths),
        area_fraction=consequences.basin_area(falls, c.c_out) / box,
        decrease_fraction=consequences.falling_area(falls, c.c_in, c.c_out) / box,
        entry_time_bound=found.entry_time * unit,
        levels=tuple(found.levels.tolist()),
        e_star=tuple(found.e_star.tolist()),
        # The Hessian of V is at most I / sigma^2.
        step_bound=2 * c.sigma**2 * found.step * unit,
        pieces=pieces,
        boxes=boxes + falls.evaluated + outer.moves.evaluated,
    )


def _pieces(
    field: GuidingField, outer: Outer, inner: Inner | None
) -> tuple[tuple[PieceResult, ...], int]:
    """Returns what is proved of each piece, and over how many squares.

    In a forward invariant ring without a zero there is a closed orbit around its hole, by the
    theorem of Poincare and Bendixson; an orbit around nothing would have a zero inside, in the
    ring, which has none.
    """
    squares = Squares.of(field)
    results, boxes = [], 0 if inner is None else inner.boxes
    components = consequences.pieces_in(field, outer.shape, outer.reference)
    for number, points in enumerate(consequences.points_of(outer.reference)):
        component = components[number]
        holes = None if component is None else outer.shape.holes[component - 1]
        result = PieceResult(holes, bool(holes == 1 and outer.reference.closed[number]))
        if component is not None and result.orbit_exists:
            ring = Ring.of(field, outer.conditions, outer.shape, component, squares.ring)
            if inner is not None:
                ring = ring.inside(field, inner.conditions, inner.shape, squares.thin)
            result, evaluated = _orbit(field, ring, result, field.cloud.normalize(points))
            boxes += evaluated
        results.append(result)
    return tuple(results), boxes


def _orbit(
    field: GuidingField, ring: Ring, result: PieceResult, points: FloatArray
) -> tuple[PieceResult, int]:
    """Returns what is proved of the orbit about a piece, and over how many squares."""
    boxes, unit, last = 0, field.cloud.unit_length, Squares.of(field).last
    if has_dual(field) and ring.is_whole:
        contraction = Contraction(field, ring.levels, ring.c_in).prove(ring.squares, last)
        result = replace(result, orbit_unique=contraction.proved or None)
        boxes += contraction.evaluated
    turning = Turning.about(field, ring.levels, ring.c_in, points.mean(axis=0), points)
    turns = turning.prove(ring.squares, last)
    if turns.proved:
        low, high = turning.lap_time(turns)
        result = replace(result, lap_time_low=low * unit, lap_time_high=high * unit)
    return result, boxes + turns.evaluated
