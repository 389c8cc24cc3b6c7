"""From a field to its certificate: orbits and samples propose, bounds over patches prove."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.basin import Basin, PlanarField, find_basin, prove_basin
from sgvf_drake.certificate.boxes import Boxes, BoxSizes
from sgvf_drake.certificate.by_tubes import ProposeTube, prove_by_tubes
from sgvf_drake.certificate.cells import Cells
from sgvf_drake.certificate.certificate import Certificate
from sgvf_drake.certificate.field_model import BoundedField, model_field
from sgvf_drake.certificate.kernels import check_rounding
from sgvf_drake.certificate.level_search import find_levels
from sgvf_drake.certificate.levels import LevelsProof, prove_levels
from sgvf_drake.certificate.tube import prove_tube
from sgvf_drake.certificate.tube_search import FoundTube, find_tube
from sgvf_drake.certificate.vehicle import VehicleLaw
from sgvf_drake.certificate.vehicle_claim import (
    VehiclePiece,
    VehicleProposal,
    VehicleResult,
    prove_piece,
)
from sgvf_drake.certificate.walls import Walls, prove_walls
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField, check_position_alone
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.lyapunov import find_guiding_zeros
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress

# The matrices are small: more threads cost more than they bring, many times over where other
# processes run.
ONE_THREAD: dict[str, Any] = {"limits": 1, "user_api": "blas"}


def certify(
    field: GuidingField,
    reference: ReferencePath | None = None,
    *,
    levels: bool = False,
    progress: Progress = no_progress,
) -> Certificate:
    """Proves that robots follow a field along its path, or says what is in the way.

    Of closed paths in the plane, from where; of open ones, and in space, what enters a tube.

    Args:
        field: The field.
        reference: The path, whose pieces are followed; None: `field.path`.
        levels: Whether level sets of V are proved too, of closed paths in the plane: how fast V
            falls, and what each level tolerates.  It takes several times as long.
        progress: Told how far it is.

    Raises:
        ConfigurationError: The field is of a kind that nothing bounds, or levels are asked for
            of an open path or in space.
        RuntimeError: The process does not round to nearest.
    """
    check_position_alone(field)
    check_rounding()
    has_levels = field.dim == 2 and not len(field.ends)
    if levels and not has_levels:
        raise ConfigurationError("levels of V are proved of closed paths in the plane only")
    # What nothing bounds is told before the search.
    middle = Boxes(np.zeros((1, field.dim)), np.array([BoxSizes.of(field).cover]))
    model_field(field, middle.patches)
    reference = field.path if reference is None else reference
    count = len(reference.pieces)

    def propose(number: int, points: FloatArray) -> FoundTube | None:
        progress("tubes and walls", number, count)
        return find_tube(field, points, closed=bool(reference.closed[number]))

    def prove(walls: Sequence[Walls]) -> Basin | None:
        progress("tubes and walls", count, count)
        return find_basin(field, walls, progress) if walls else None

    with threadpool_limits(**ONE_THREAD):
        found = _located(field, reference, prove_by_tubes(field, reference, propose, prove))
        if not levels:
            return found
        return _with_levels(found, find_levels(field, reference, progress))


def check(
    certificate: Certificate,
    field: GuidingField,
    reference: ReferencePath | None = None,
    *,
    progress: Progress = no_progress,
) -> Certificate:
    """Proves a certificate anew from what it holds, without a search.

    Args:
        certificate: What is claimed.
        field: The field.
        reference: As of `certify`.
        progress: Told how far it is.

    Returns:
        What was proved; it is certified where it is as strong as what was claimed.

    Raises:
        ConfigurationError: The certificate is that of another field, or of nothing.
        RuntimeError: The process does not round to nearest.
    """
    if certificate.field_digest != field_digest(field):
        raise ConfigurationError("the certificate is that of another field")
    if not certificate.certified:
        raise ConfigurationError("the certificate certifies nothing")
    check_rounding()
    reference = field.path if reference is None else reference
    count = len(reference.pieces)

    def prove(walls: Sequence[Walls]) -> Basin | None:
        progress("tubes and walls", count, count)
        return prove_squares(certificate, field, walls, progress)

    known = known_tubes(certificate, field, progress)
    with threadpool_limits(**ONE_THREAD):
        found = prove_by_tubes(field, reference, known, prove)
        if certificate.levels is not None:
            progress("levels", 0, 1)
            proof = prove_levels(field, certificate.levels.conditions, reference)
            found = _with_levels(found, proof)
            progress("levels", 1, 1)
        if (claimed := certificate.vehicle) is not None:
            proposals = [None if piece is None else piece.proposal for piece in claimed.pieces]
            found = with_vehicle(
                found, field, proposals, claimed.law, claimed.scale, claimed.disturbance
            )
    if not found.is_as_strong_as(certificate):
        return found.refused("what is claimed is not what is proved")
    return found


def known_tubes(
    certificate: Certificate, field: BoundedField, progress: Progress = no_progress
) -> ProposeTube:
    """Returns what gives the tubes and the walls of a certificate, proved of a field."""
    count = len(certificate.tubes)

    def known(piece: int, _: FloatArray) -> FoundTube | None:
        progress("tubes and walls", piece, count)
        if piece >= min(len(certificate.tubes), len(certificate.walls)):
            return None
        tube, walls = certificate.tubes[piece], certificate.walls[piece]
        if tube is None or tube.rows.shape[1] != field.dim:
            return None
        proof = prove_tube(field, tube)
        if walls is None or not walls.fit(tube):
            return FoundTube(tube, proof)
        found = prove_walls(field, tube, walls)
        return FoundTube(tube, proof, walls if found.proved == len(walls) else None, found)

    return known


def prove_squares(
    certificate: Certificate,
    field: PlanarField,
    walls: Sequence[Walls],
    progress: Progress = no_progress,
    roughly: PlanarField | None = None,
) -> Basin | None:
    """Returns what is proved of the squares of a certificate, beside walls that are proved.

    With `roughly` as of `prove_basin`.
    """
    if certificate.cells is None or not walls:
        return None
    progress("cells", 0, 1)
    basin = prove_basin(field, Cells.of(certificate.cells), walls, certificate.fences, roughly)
    progress("cells", 1, 1)
    return basin


def with_vehicle(
    found: Certificate,
    field: GuidingField,
    proposals: Sequence[VehicleProposal | None],
    law: VehicleLaw,
    scale: float,
    disturbance: float,
) -> Certificate:
    """Proves what is proposed of the flight of a vehicle, between the walls of a certificate.

    Args:
        found: The certificate of the field as it is flown.
        field: That field.
        proposals: What is proposed of each piece; None: nothing.
        law: The vehicle.
        scale: Metres in a unit of the waypoints.
        disturbance: Of the acceleration that nobody knows of, m/s^2.
    """
    pieces: list[VehiclePiece | None] = []
    unit = field.cloud.unit_length * scale
    with threadpool_limits(**ONE_THREAD):
        for number, proposal in enumerate(proposals[: len(found.tubes)]):
            tube, walls = found.tubes[number], found.walls[number]
            if proposal is None or tube is None or walls is None:
                pieces.append(None)
                continue
            e_star = found.pieces[number].e_star
            known = (field, tube, walls, e_star, proposal)
            pieces.append(prove_piece(*known, law, unit, disturbance))
    boxes = found.boxes + sum(piece.patches for piece in pieces if piece is not None)
    result = VehicleResult(law, scale, disturbance, tuple(pieces))
    return replace(found, vehicle=result, boxes=boxes)


def _with_levels(found: Certificate, proof: LevelsProof) -> Certificate:
    reason = f"{found.reason}; {proof.reason}" if proof.reason else found.reason
    return replace(found, reason=reason, levels=proof.levels, boxes=found.boxes + proof.boxes)


def _located(field: GuidingField, reference: ReferencePath, found: Certificate) -> Certificate:
    """Returns a certificate with a zero of m on a piece without a tube, if there is one.

    Of closed pieces: at the end of an open one there is a zero as it should be.
    """
    pieces = [
        piece
        for piece, tube in zip(reference.pieces, found.tubes, strict=True)
        if tube is None and piece.closed
    ]
    if not pieces or field.dim != 2:
        return found
    stops = find_guiding_zeros(field).points
    distance = ReferencePath(tuple(pieces)).project(stops).distance
    if not len(stops) or distance.min() > field.sigma * field.cloud.unit_length:
        return found
    x, y = stops[np.argmin(distance)].tolist()
    reason = f"{found.reason}; m vanishes at ({x:.4g}, {y:.4g})"
    return replace(found, reason=reason, counterexample=(x, y))
