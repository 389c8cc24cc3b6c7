"""What tubes, the walls around them and the cells of the box say of the pieces of a path.

Each piece has a thin tube: what enters it follows the piece for ever, or to its end.  Around a
closed one in the plane there are walls, between which all comes to the tube; and the box is
divided into squares from which robots come between walls, or may not.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
import math

import numpy as np

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.basin import Basin
from sgvf_drake.certificate.certificate import Certificate, PieceResult
from sgvf_drake.certificate.kernels import SLACK
from sgvf_drake.certificate.tube import Tube
from sgvf_drake.certificate.tube_search import FoundTube
from sgvf_drake.certificate.walls import Walls
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.paths import Piece, ReferencePath

ProposeTube = Callable[[int, FloatArray], FoundTube | None]
"""From the number of a piece and its points, (M, d) normalised, to a tube around its orbit, the
walls around that, and what is proved of them; None: none is known."""

ProveBasin = Callable[[Sequence[Walls]], Basin | None]
"""From walls that are proved to what is proved of the box; None: nothing is."""

# Points between two sections at which the distance of a tube from the path is measured.
PARTS = 8


def prove_by_tubes(
    field: GuidingField, reference: ReferencePath, propose: ProposeTube, prove: ProveBasin
) -> Certificate:
    """Proves of each piece of a path that what enters its tube follows it, and what enters.

    Args:
        field: The field.
        reference: The path.
        propose: Gives a thin tube around the orbit of a piece, and walls.
        prove: Proves from where robots come between walls.
    """
    proposed = [
        propose(number, field.cloud.normalize(piece.vertices))
        for number, piece in enumerate(reference.pieces)
    ]
    followed = [
        found if found is not None and _follows(found, piece) else None
        for found, piece in zip(proposed, reference.pieces, strict=True)
    ]
    tubes = tuple(None if found is None else found.tube for found in followed)
    walls = tuple(None if found is None else found.walls for found in followed)
    basin = prove([one for one in walls if one is not None])
    boxes = sum(found.patches for found in proposed if found is not None)
    missing = [str(k) for k, tube in enumerate(tubes, start=1) if tube is None]
    certificate = Certificate(
        certified=not missing,
        reason=(
            "what enters the tube of a piece follows it; from where robots enter is not proved"
        ),
        field_digest=field_digest(field),
        tubes=tubes,
        walls=walls,
        orbit_half_width=orbit_half_width(field, tubes, reference),
        pieces=tuple(_result(found, field) for found in followed),
        boxes=boxes + (0 if basin is None else basin.evaluated),
    )
    if missing:
        return replace(certificate, reason=f"no tube is proved of piece {', '.join(missing)}")
    if basin is None:
        return certificate
    return replace(
        certificate,
        reason=(
            f"robots from {floor(basin.area)} of the box, and almost all robots from "
            f"{floor(basin.almost)}, come to a tube and follow its piece"
        ),
        fences=basin.fences,
        cells=basin.cells.code,
        area_fraction=basin.area,
        almost_fraction=basin.almost,
        excluded=basin.excluded,
    )


def floor(part: float) -> str:
    """Returns a part in per cent, never more than it is."""
    return f"{math.floor(1e3 * part) / 10:.1f} %"


def _follows(found: FoundTube, piece: Piece) -> bool:
    """Whether a tube is proved, and leads around a closed piece once, or to rest."""
    tube, proof = found.tube, found.proof
    ends = proof.once if tube.closed else tube.rest is not None
    return proof.proved and ends and tube.closed == piece.closed


def _result(found: FoundTube | None, field: GuidingField) -> PieceResult:
    if found is None:
        return PieceResult(orbit_exists=False)
    tube, proof, unit = found.tube, found.proof, field.cloud.unit_length
    return PieceResult(
        orbit_exists=tube.closed,
        orbit_unique=proof.unique or None,
        lap_time_low=proof.time_low * unit,
        lap_time_high=proof.time_high * unit,
        tube_half_width=tube.half_width * unit,
        rest_radius=None if tube.rest is None else tube.rest.radius * unit,
        **_of_walls(found, unit),
    )


def _of_walls(found: FoundTube, unit: float) -> dict[str, tuple[float, ...]]:
    """Returns what is proved of the walls around a tube."""
    if found.walls is None or found.walls_proof is None:
        return {}
    proof = found.walls_proof
    return {
        "e_star": proof.e_star,
        "entry_times": tuple(unit * time for time in proof.entry_times),
        "wall_half_widths": tuple(
            unit * width for width in found.walls.half_widths(found.tube)
        ),
    }


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
