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
    results: list[PieceResult] = []
    tubes: list[Tube | None] = []
    patches = 0
    for number, piece in enumerate(reference.pieces):
        found = propose(number, field.cloud.normalize(piece.vertices))
        result, tube = PieceResult(None, orbit_exists=False), None
        if found is not None:
            patches += found[1].patches
            if _follows(found, piece):
                tube = found[0]
                result = with_tube(PieceResult(None, piece.closed), found, field)
                result = replace(result, orbit_unique=found[1].unique or None)
        results.append(result)
        tubes.append(tube)
    missing = [str(k) for k, tube in enumerate(tubes, start=1) if tube is None]
    reason = "what enters the tube of a piece follows it; from where robots enter is not proved"
    if missing:
        reason = f"no tube is proved of piece {', '.join(missing)}"
    return Certificate(
        certified=not missing,
        reason=reason,
        field_digest=field_digest(field),
        tubes=tuple(tubes),
        orbit_half_width=orbit_half_width(field, tubes, reference),
        pieces=tuple(results),
        boxes=patches,
    )


def _follows(found: ProvedTube, piece: Piece) -> bool:
    """Whether a tube is proved, and leads around a closed piece once, or to rest."""
    tube, proof = found
    ends = proof.once if tube.closed else tube.rest is not None
    return proof.proved and ends and tube.closed == piece.closed


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
        middles = field.cloud.denormalize(tube.rows[:, 0])
        line = Piece(middles, closed=False)
        for points, path in ((piece.at(_dense(piece)), line), (line.at(_dense(line)), piece)):
            steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
            off = ReferencePath((path,)).project(points).distance.max()
            distances.append(off + (1 + SLACK) * (steps.max() / 2 + tube.half_width * unit))
    return float(max(distances)) if distances else None


def _dense(line: Piece) -> FloatArray:
    """Returns arc lengths all along a line, (n,)."""
    return np.linspace(0, line.length, PARTS * len(line.vertices) + 1)
