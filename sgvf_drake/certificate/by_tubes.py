"""What thin tubes say of the pieces of a path, with levels of V around them or without.

Of open paths, and in space, no levels of V are bounded.  There each piece still has a tube:
what enters it follows the piece for ever, or to its end.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.certificate import Certificate, PieceResult
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.tube import Tube, TubeProof
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import Piece, ReferencePath

ProvedTube = tuple[Tube, TubeProof]

ProposeTube = Callable[[int, FloatArray], ProvedTube | None]
"""From the number of a piece and its points, (M, d) normalised, to a tube around its orbit, and
what is proved of it; None: none is known."""

# Points between two sections at which the distance of a tube from the path is measured.
PARTS = 8


def prove_by_tubes(
    field: GuidingField, reference: ReferencePath, propose: ProposeTube
) -> Certificate:
    """Proves of each piece of a path that what enters its tube follows it.

    Args:
        field: The field.
        reference: The path.
        propose: Gives a thin tube around the orbit of a piece.
    """
    proposed = [
        propose(number, field.cloud.normalize(piece.vertices))
        for number, piece in enumerate(reference.pieces)
    ]
    followed = [
        found if found is not None and _follows(found, piece) else None
        for found, piece in zip(proposed, reference.pieces, strict=True)
    ]
    tubes = tuple(found and found[0] for found in followed)
    missing = [str(k) for k, tube in enumerate(tubes, start=1) if tube is None]
    reason = "what enters the tube of a piece follows it; from where robots enter is not proved"
    if missing:
        reason = f"no tube is proved of piece {', '.join(missing)}"
    return Certificate(
        certified=not missing,
        reason=reason,
        field_digest=field_digest(field),
        tubes=tubes,
        orbit_half_width=orbit_half_width(field, tubes, reference),
        pieces=tuple(_result(found, field) for found in followed),
        boxes=sum(found[1].patches for found in proposed if found is not None),
    )


def _follows(found: ProvedTube, piece: Piece) -> bool:
    """Whether a tube is proved, and leads around a closed piece once, or to rest."""
    tube, proof = found
    ends = proof.once if tube.closed else tube.rest is not None
    return proof.proved and ends and tube.closed == piece.closed


def _result(found: ProvedTube | None, field: GuidingField) -> PieceResult:
    if found is None:
        return PieceResult(None, orbit_exists=False)
    tube, proof = found
    result = PieceResult(None, orbit_exists=tube.closed, orbit_unique=proof.unique or None)
    return with_tube(result, found, field)


def with_tube(result: PieceResult, found: ProvedTube, field: GuidingField) -> PieceResult:
    """Returns what is proved of a piece, with what its tube says."""
    tube, proof = found
    unit = field.cloud.unit_length
    return replace(
        result,
        lap_time_low=proof.time_low * unit,
        lap_time_high=proof.time_high * unit,
        tube_half_width=tube.half_width * unit,
        rest_radius=None if tube.rest is None else tube.rest.radius * unit,
    )


def orbit_half_width(
    field: GuidingField, tubes: Sequence[Tube | None], reference: ReferencePath
) -> float | None:
    """Returns the largest distance between tubes and their pieces, at most.

    In the unit of the field; None where there are no tubes.

    Args:
        field: The field.
        tubes: Of each piece its tube, or None.
        reference: The path.
    """
    unit, distances = field.cloud.unit_length, []
    for piece, tube in zip(reference.pieces, tubes, strict=True):
        if tube is None:
            continue
        line = Piece(field.cloud.denormalize(tube.rows[:, 0]), closed=False)
        for one, other in ((piece, line), (line, piece)):
            count = PARTS * len(one.vertices)
            points = one.at(np.linspace(0, one.length, count + 1))
            off = ReferencePath((other,)).project(points).distance.max()
            between = one.length / (2 * count)
            distances.append(off + (1 + SLACK) * (between + tube.half_width * unit))
    return float(max(distances)) if distances else None
