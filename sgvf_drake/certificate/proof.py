"""The proof of given conditions, or how it ends."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.conclusion import ProposeRings, Proved, conclude
from sgvf_drake.certificate.decrease import Decrease
from sgvf_drake.certificate.division import Division
from sgvf_drake.certificate.mixture_model import MixtureModel, mixture_of
from sgvf_drake.certificate.speed import Speed
from sgvf_drake.certificate.squares import HALF_WIDTH, Squares
from sgvf_drake.certificate.statement import Certificate, Conditions
from sgvf_drake.certificate.topology import shape_of_band
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import Reference


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
    reference: Reference,
    propose: ProposeRings,
) -> Attempt:
    """Proves conditions of a field, and what follows from them for the pieces of a path.

    Args:
        field: The field.
        conditions: What is to be proved.
        reference: The path.
        propose: Gives thin rings around the closed orbit of a piece, the best first.
    """
    squares = Squares.of(field)
    levels = MixtureModel(mixture_of(field, conditions.sigma), conditions.lowest)
    basin = levels.squares_below(conditions.c_out, squares.everything, squares.first)
    if not len(basin) or np.abs(basin.centers).max() + squares.first >= HALF_WIDTH:
        return Attempt(failed(field, conditions, "{V <= c_out} is not a set in the square"))
    c = conditions
    falls = Decrease(field, levels, c.c_in, c.c_out, c.alpha, c.share).prove(
        basin, squares.last
    )
    if not falls.proved:
        return _undone(field, conditions, "V falls along m on the band", [falls])
    tube = levels.squares_below(c.c_in, squares.everything, squares.ring)
    moves = Speed(field, levels, c.c_in, c.delta, c.share).prove(tube, squares.last)
    if not moves.proved:
        return _undone(field, conditions, "m is nowhere zero in the tube", [falls, moves])
    shape = shape_of_band(levels, c.c_in, c.c_out, squares.cover)
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
