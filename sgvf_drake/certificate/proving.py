"""From a field to its certificate: samples propose the levels, bounds over squares prove."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate import consequences, speed
from sgvf_drake.certificate.boxes import Boxes
from sgvf_drake.certificate.consequences import Rates
from sgvf_drake.certificate.decrease import Decrease
from sgvf_drake.certificate.division import Division
from sgvf_drake.certificate.field_model import has_dual, model_field
from sgvf_drake.certificate.inner import find_inner, lowest_of, mixture_of, prove_inner
from sgvf_drake.certificate.mixture_model import MixtureModel
from sgvf_drake.certificate.orbits import Contraction, Ring, Turning
from sgvf_drake.certificate.speed import Speed
from sgvf_drake.certificate.statement import Certificate, Conditions, PieceResult
from sgvf_drake.certificate.topology import Shape, shape_of_band
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.lyapunov import (
    LyapunovFunction,
    find_guiding_zeros,
    learned_path,
    search_band,
    take_samples,
)
from sgvf_drake.paths import Reference
from sgvf_drake.progress import Progress, no_progress

# Everything is proved inside of this square, normalised units; the waypoints are within 4.
HALF_WIDTH = 8.0
# What is to be proved: V falls by more than this in every normalised unit of length, and m is
# at least so fast in the tube; and how sharp the bounds are to be.
ALPHA, DELTA, SHARE = 0.01, 0.05, 0.5
# A level at which V does not fall is left out of the band with this margin, so many times.
LEVEL_MARGIN, LEVEL_FLOOR = 0.03, 0.005
ATTEMPTS = 12
# A band on which V changes by less is none.
MIN_BAND = 0.1


@dataclass(frozen=True)
class Sizes:
    """Half-sides of squares, in proportion to the scale on which a field turns.

    Attributes:
        unit: The largest power of two that is no larger than the noise level of the field.
    """

    unit: float

    @classmethod
    def of(cls, field: GuidingField) -> "Sizes":
        """Returns the sizes for a field."""
        return cls(2.0 ** np.floor(np.log2(min(field.sigma, 1.0))))

    @property
    def first(self) -> float:
        """Of the squares over which a field is bounded first."""
        return self.unit / 2

    @property
    def ring(self) -> float:
        """Of those in the tube."""
        return self.unit / 4

    @property
    def cover(self) -> float:
        """Of the covers whose components and holes are counted."""
        return self.unit / 8

    @property
    def thin(self) -> float:
        """Of those of the thinner tube."""
        return self.unit / 16

    @property
    def last(self) -> float:
        """Of squares that are divided no more."""
        return self.unit / 1024


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


def certify(
    field: GuidingField, reference: Reference | None = None, *, progress: Progress = no_progress
) -> Certificate:
    """Proves that robots follow a planar field along its path, or says what is in the way.

    Args:
        field: The field.
        reference: The path, for its pieces and the width of the tube; None: `learned_path`.
        progress: Told how far it is.

    Raises:
        ConfigurationError: The field is not planar, or is of a kind that nothing bounds.
    """
    if field.dim != 2:
        raise ConfigurationError(f"only planar fields are certified, not one of {field.dim}-D")
    # What nothing bounds is told before the search.
    model_field(field, Boxes.square(Sizes.of(field).cover))
    reference = learned_path(field) if reference is None else reference
    samples = take_samples(field)
    stops = find_guiding_zeros(field).points
    band = search_band(field, samples, reference, stops=stops, progress=progress)
    if band is None:
        return _without_band(field, reference, stops)
    sigma = band.function.sigma / field.cloud.unit_length
    lowest = lowest_of(mixture_of(field, sigma))
    proposed = Conditions(sigma, lowest, band.c_in, band.c_out, ALPHA, DELTA, SHARE)
    return _prove_narrowing(field, proposed, reference, progress)


def check(
    certificate: Certificate, field: GuidingField, reference: Reference | None = None
) -> Certificate:
    """Proves a certificate anew, without the search.

    Returns:
        What was proved; it is certified where it is as strong as what was claimed.

    Raises:
        ConfigurationError: The certificate is that of another field, or of nothing.
    """
    if certificate.field_digest != field_digest(field):
        raise ConfigurationError("the certificate is that of another field")
    if certificate.conditions is None or not certificate.certified:
        raise ConfigurationError("the certificate certifies nothing")
    reference = learned_path(field) if reference is None else reference
    found = prove(field, certificate.conditions, reference, certificate.inner).certificate
    if not found.is_as_strong_as(certificate):
        return found.refused("what is claimed is not what is proved")
    return found


def prove(
    field: GuidingField,
    conditions: Conditions,
    reference: Reference,
    inner: Conditions | None = None,
    *,
    search: bool = False,
) -> Attempt:
    """Proves conditions of a field, and what follows from them for the pieces of a path.

    Args:
        field: The field.
        conditions: What is to be proved.
        reference: The path.
        inner: Those of a thinner tube inside, for the orbits; None: there is none.
        search: Whether one is searched for.
    """
    sizes = Sizes.of(field)
    levels = MixtureModel(mixture_of(field, conditions.sigma), conditions.lowest)
    basin = levels.squares_below(conditions.c_out, Boxes.square(HALF_WIDTH), sizes.first)
    if not len(basin) or np.abs(basin.centers).max() + sizes.first >= HALF_WIDTH:
        return Attempt(_failed(field, conditions, "{V <= c_out} is not a set in the square"))
    c = conditions
    falls = Decrease(field, levels, c.c_in, c.c_out, c.alpha, c.share).prove(basin, sizes.last)
    if not falls.proved:
        return _undone(field, conditions, "V falls along m on the band", [falls])
    tube = levels.squares_below(c.c_in, Boxes.square(HALF_WIDTH), sizes.ring)
    moves = Speed(field, levels, c.c_in, c.delta, c.share).prove(tube, sizes.last)
    if not moves.proved:
        return _undone(field, conditions, "m is nowhere zero in the tube", [falls, moves])
    shape = shape_of_band(levels, c.c_in, c.c_out, HALF_WIDTH, sizes.cover)
    if shape is None:
        return Attempt(_failed(field, conditions, "the band is too thin for the covers"))
    outer = Outer(conditions, reference, falls, moves, shape)
    cover = levels.squares_below(c.c_in, Boxes.square(HALF_WIDTH), sizes.cover)
    halves = (sizes.ring, sizes.thin)
    if search:
        found = find_inner(field, conditions, cover, HALF_WIDTH, halves, sizes.last)
    elif inner is not None:
        found = _known_inner(field, inner, cover)
    else:
        found = None
    return Attempt(_certificate(field, outer, found))


def _known_inner(
    field: GuidingField, inner: Conditions, cover: Boxes
) -> tuple[Conditions, Shape, int] | None:
    sizes = Sizes.of(field)
    proved = prove_inner(field, inner, cover, HALF_WIDTH, (sizes.ring, sizes.thin), sizes.last)
    if proved is None or not proved[0].proved or proved[1] is None:
        return None
    return inner, proved[1], proved[0].evaluated


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


def _prove_narrowing(
    field: GuidingField, conditions: Conditions, reference: Reference, progress: Progress
) -> Certificate:
    """Proves conditions on the band that is left where V was found not to fall."""
    function = LyapunovFunction(mixture_of(field, conditions.sigma))
    boxes = 0
    for number in range(ATTEMPTS):
        attempt = prove(field, conditions, reference, search=True)
        boxes += attempt.certificate.boxes
        progress("prove", number + 1, ATTEMPTS)
        if attempt.obstacle is None:
            break
        narrowed = _narrowed(conditions, float(function(attempt.obstacle[None])[0]))
        if narrowed is None:
            break
        conditions = narrowed
    progress("prove", ATTEMPTS, ATTEMPTS)
    return replace(attempt.certificate, boxes=boxes)


def _narrowed(conditions: Conditions, level: float) -> Conditions | None:
    """Returns conditions whose band leaves a level out; None: nothing is left of it."""
    c_in, c_out = conditions.c_in, conditions.c_out
    if level < c_in:
        # Of the tube, in which m has to move: a higher tube holds the place too.
        return None
    if level**2 < c_in * c_out:
        c_in = (1 + LEVEL_MARGIN) * level + LEVEL_FLOOR
    else:
        c_out = (1 - LEVEL_MARGIN) * level
    if c_out - c_in < MIN_BAND:
        return None
    return replace(conditions, c_in=c_in, c_out=c_out)


def _certificate(
    field: GuidingField, outer: Outer, inner: tuple[Conditions, Shape, int] | None
) -> Certificate:
    c, falls = outer.conditions, outer.falls
    found: Rates = consequences.rates(falls, c.c_in, c.c_out)
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
        for shape in (outer.shape, *([] if inner is None else [inner[1]]))
    ]
    return Certificate(
        certified=not missing,
        reason=reason,
        field_digest=field_digest(field),
        conditions=c,
        inner=None if inner is None else inner[0],
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
    field: GuidingField, outer: Outer, inner: tuple[Conditions, Shape, int] | None
) -> tuple[tuple[PieceResult, ...], int]:
    """Returns what is proved of each piece, and over how many squares.

    In a forward invariant ring without a zero there is a closed orbit around its hole, by the
    theorem of Poincare and Bendixson; an orbit around nothing would have a zero inside, in the
    ring, which has none.
    """
    sizes = Sizes.of(field)
    results, boxes = [], 0 if inner is None else inner[2]
    components = consequences.pieces_in(field, outer.shape, outer.reference)
    for number, points in enumerate(consequences.points_of(outer.reference)):
        component = components[number]
        holes = None if component is None else outer.shape.holes[component - 1]
        result = PieceResult(holes, bool(holes == 1 and outer.reference.closed[number]))
        if component is not None and result.orbit_exists:
            ring = Ring.of(field, outer.conditions, outer.shape, component, sizes.ring)
            if inner is not None:
                ring = ring.inside(field, *inner[:2], sizes.thin)
            result, evaluated = _orbit(field, ring, result, field.cloud.normalize(points))
            boxes += evaluated
        results.append(result)
    return tuple(results), boxes


def _orbit(
    field: GuidingField, ring: Ring, result: PieceResult, points: FloatArray
) -> tuple[PieceResult, int]:
    """Returns what is proved of the orbit about a piece, and over how many squares."""
    boxes, unit, last = 0, field.cloud.unit_length, Sizes.of(field).last
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


def _undone(
    field: GuidingField, conditions: Conditions, what: str, divisions: list[Division]
) -> Attempt:
    """Returns what the last of some divisions left open or refuted."""
    last, boxes = divisions[-1], sum(division.evaluated for division in divisions)
    refuted = last.counterexample
    if refuted is None:
        reason = f"it is undecided on {len(last.undecided)} squares whether {what}"
        undecided = len(last.undecided)
        failed = _failed(field, conditions, reason, boxes=boxes, undecided=undecided)
        return Attempt(failed, last.undecided.centers[0])
    x, y = field.cloud.denormalize(refuted).tolist()
    reason = f"it is not so that {what}, at ({x:.4g}, {y:.4g})"
    failed = _failed(field, conditions, reason, boxes=boxes, counterexample=(x, y))
    return Attempt(failed, refuted)


def _without_band(field: GuidingField, reference: Reference, stops: FloatArray) -> Certificate:
    """Returns what samples say where they show no band: a zero of m on the path, if any."""
    reason = "V falls on no band of levels with a tube about each piece, by samples"
    if not len(stops):
        return _failed(field, None, reason)
    x, y = stops[np.argmin(reference.project(stops).distance)].tolist()
    reason += f"; m vanishes at ({x:.4g}, {y:.4g})"
    return _failed(field, None, reason, counterexample=(x, y))


def _failed(
    field: GuidingField, conditions: Conditions | None, reason: str, **facts: Any
) -> Certificate:
    return Certificate(False, reason, field_digest(field), conditions, **facts)
