"""What a certificate says of a field as a machine evaluates it.

Tubes, walls and squares of the certificate are proved anew of all functions that are no further
from m than the machine's errors, bounded over each patch.  So they hold of the machine's own m
as well, which jumps from one rounded value to another: of motions with
|x_dot - m(x)| <= error.  What rests on derivatives is not said of those: that a closed orbit
is the only one, and what almost every robot does.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

import numpy as np
from threadpoolctl import threadpool_limits

from sgvf_drake.certificate.arithmetic import ARITHMETICS, ExportedField
from sgvf_drake.certificate.basin import Basin
from sgvf_drake.certificate.by_tubes import floor, prove_by_tubes
from sgvf_drake.certificate.certificate import Certificate
from sgvf_drake.certificate.certification import ONE_THREAD, known_tubes, prove_squares
from sgvf_drake.certificate.kernels import check_rounding
from sgvf_drake.certificate.walls import Walls
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import Piece, ReferencePath
from sgvf_drake.progress import Progress, no_progress

# Bounds of errors that are close enough: m crosses walls at a tenth of its size at the least,
# and has one direction on most squares; of the others they have to be as close.
CLOSE, ROUGH = 1e-3, 1e-2


@dataclass(frozen=True)
class ExportedCertificate:
    """What is proved of a field as a machine evaluates it.

    Attributes:
        arithmetic: `double`, `mixed` or `float`; see `arithmetic.ARITHMETICS`.
        certified: Whether what enters the tube of each piece follows it.
        reason: Why, in one line.
        error: How far the machine's m can be from the exact one over tubes and walls, at most.
        box_error: The same over the squares outside of the walls; None: there are none.
        e_star: Of each piece, the disturbance that each pair of walls tolerated.
        e_star_left: What it tolerates beside the machine's errors; 0.0 where nothing is proved.
        area_fraction: The part of the box from which robots come to a tube; None: not proved.
    """

    arithmetic: str
    certified: bool
    reason: str
    error: float
    box_error: float | None
    e_star: tuple[tuple[float, ...], ...]
    e_star_left: tuple[tuple[float, ...], ...]
    area_fraction: float | None


def check_exported(
    certificate: Certificate,
    field: GuidingField,
    arithmetic: str,
    *,
    progress: Progress = no_progress,
) -> ExportedCertificate:
    """Proves a certificate anew of a field as a machine evaluates it.

    Args:
        certificate: That of the field.
        field: The field, as exact as its stored weights.
        arithmetic: `double`, `mixed` or `float`.
        progress: Told how far it is.

    Raises:
        ConfigurationError: If the certificate is that of another field, or of nothing; or if
            nothing bounds the errors of the field in this arithmetic.
        RuntimeError: If the process does not round to nearest.
    """
    if arithmetic not in ARITHMETICS:
        raise ConfigurationError(
            f"nothing bounds the errors of {arithmetic}; of {', '.join(ARITHMETICS)} they are "
            "bounded"
        )
    if certificate.field_digest != field_digest(field):
        raise ConfigurationError("the certificate is that of another field")
    if not certificate.certified:
        raise ConfigurationError("the certificate certifies nothing")
    check_rounding()
    machine = ARITHMETICS[arithmetic]
    around, outside, roughly = (
        ExportedField(field, machine, enough) for enough in (CLOSE, CLOSE, ROUGH)
    )

    def prove(walls: Sequence[Walls]) -> Basin | None:
        progress("tubes and walls", 1, 1)
        return prove_squares(certificate, outside, walls, progress, roughly)

    progress("tubes and walls", 0, 1)
    with threadpool_limits(**ONE_THREAD):
        known = known_tubes(certificate, around)
        found = prove_by_tubes(field, _path_of(certificate, field), known, prove)
    e_star = tuple(piece.e_star for piece in certificate.pieces)
    # Walls are divided into more parts, so that their bounds may even be above the known ones.
    left = tuple(
        tuple(map(min, own.e_star, before)) + (0.0,) * (len(before) - len(own.e_star))
        for own, before in zip(found.pieces, e_star, strict=True)
    )
    return ExportedCertificate(
        arithmetic=arithmetic,
        certified=found.certified,
        reason=_reason(found, around.largest, e_star, left),
        error=float(around.largest),
        box_error=None if found.cells is None else float(max(outside.largest, roughly.largest)),
        e_star=e_star,
        e_star_left=left,
        area_fraction=found.area_fraction,
    )


def _path_of(certificate: Certificate, field: GuidingField) -> ReferencePath:
    """Returns the lines of the tubes: the pieces that the certificate is about.

    It may be of another path than `field.path`, as of one piece of two.
    """
    if not certificate.tubes:
        raise ConfigurationError("the certificate certifies nothing")
    pieces = []
    for tube in certificate.tubes:
        assert tube is not None, "a piece without a tube is not certified"
        line = tube.rows[: len(tube.sections), 0]
        pieces.append(Piece(field.cloud.denormalize(line), tube.closed))
    return ReferencePath(tuple(pieces))


def _reason(
    found: Certificate,
    error: float,
    e_star: Sequence[tuple[float, ...]],
    left: Sequence[tuple[float, ...]],
) -> str:
    said = f"m is off by {ceiling(error)} at most over tubes and walls"
    if not found.certified:
        return f"NOT certified as exported: {said}, and {found.reason}"
    said = f"certified as exported: {said}"
    if any(e_star):
        before, after = (
            f"{min(map(min, some)):.3g} to {max(map(max, some)):.3g}"
            for some in (tuple(filter(None, e_star)), tuple(filter(None, left)))
        )
        said += f"; e* was {before}, {after} is left"
    if found.area_fraction is None:
        return f"{said}; what enters the tube of a piece follows it"
    return f"{said}; robots from {floor(found.area_fraction)} of the box come to a tube"


def ceiling(value: float) -> str:
    """Returns a number of two digits that is no less."""
    if not (np.isfinite(value) and value > 0):
        return f"{value:.2g}"
    scale = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.ceil(value / scale) * scale:.2g}"
