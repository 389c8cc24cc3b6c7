"""From a field to its certificate: samples propose the levels, bounds over squares prove."""

from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.boxes import Boxes, BoxSizes
from sgvf_drake.certificate.by_tubes import ProposeTube, ProvedTube, prove_by_tubes
from sgvf_drake.certificate.certificate import Certificate
from sgvf_drake.certificate.conditions import Conditions
from sgvf_drake.certificate.field_model import model_field
from sgvf_drake.certificate.kernels import check_rounding
from sgvf_drake.certificate.mixture_model import lowest_of, mixture_of
from sgvf_drake.certificate.path_following import failed, prove
from sgvf_drake.certificate.tube import prove_tube
from sgvf_drake.certificate.tube_search import find_tube
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields import GuidingField, check_position_alone
from sgvf_drake.fields.storage import field_digest
from sgvf_drake.lyapunov import (
    LyapunovFunction,
    find_guiding_zeros,
    search_band,
    take_samples,
)
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress

# The matrices are small: more threads cost more than they bring, many times over where other
# processes run.
ONE_THREAD: dict[str, Any] = {"limits": 1, "user_api": "blas"}
# What is to be proved: V falls by more than this in every normalised unit of length, and m is
# at least so fast in the tube; and how sharp the bounds are to be.
ALPHA, DELTA, SHARE = 0.01, 0.05, 0.5
# Points along each axis at which a band is looked for; what they miss the proof finds.
GRID_SIZE = 151
# Noise levels of V that are tried, in those of the field.
RATIOS = (0.7, 1.0, 1.4)
# A level at which V does not fall is left out of the band with this margin, so many times.
LEVEL_MARGIN, LEVEL_FLOOR = 0.03, 0.005
ATTEMPTS = 12
# A band on which V changes by less is none.
MIN_BAND = 0.1


def certify(
    field: GuidingField,
    reference: ReferencePath | None = None,
    *,
    progress: Progress = no_progress,
) -> Certificate:
    """Proves that robots follow a field along its path, or says what is in the way.

    Of closed paths in the plane, from where; of open ones, and in space, what enters a tube.

    Args:
        field: The field.
        reference: The path, for its pieces and the width of the tube; None: `field.path`.
        progress: Told how far it is.

    Raises:
        ConfigurationError: The field is of a kind that nothing bounds.
        RuntimeError: The process does not round to nearest.
    """
    check_position_alone(field)
    check_rounding()
    # What nothing bounds is told before the search.
    middle = Boxes(np.zeros((1, field.dim)), np.array([BoxSizes.of(field).cover]))
    model_field(field, middle.patches)
    reference = field.path if reference is None else reference
    with threadpool_limits(**ONE_THREAD):
        if field.dim == 2 and not len(field.ends):
            return _search(field, reference, progress)
        return prove_by_tubes(field, reference, _proposed(field, reference))


def _proposed(field: GuidingField, reference: ReferencePath) -> ProposeTube:
    def propose(number: int, points: FloatArray) -> ProvedTube | None:
        found = find_tube(field, points, closed=reference.pieces[number].closed)
        return None if found is None else (found.tube, found.proof)

    return propose


def _search(field: GuidingField, reference: ReferencePath, progress: Progress) -> Certificate:
    samples = take_samples(field, grid_size=GRID_SIZE)
    stops = find_guiding_zeros(field).points
    band = search_band(field, samples, reference, RATIOS, stops=stops, progress=progress)
    if band is None:
        return _without_band(field, reference, stops)
    sigma = band.function.sigma / field.cloud.unit_length
    lowest = lowest_of(mixture_of(field, sigma))
    proposed = Conditions(sigma, lowest, band.c_in, band.c_out, ALPHA, DELTA, SHARE)
    return _prove_narrowing(field, proposed, reference, progress)


def check(
    certificate: Certificate, field: GuidingField, reference: ReferencePath | None = None
) -> Certificate:
    """Proves a certificate anew, without the search.

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

    def known(piece: int, _: FloatArray) -> ProvedTube | None:
        tube = certificate.tubes[piece] if piece < len(certificate.tubes) else None
        if tube is None or tube.rows.shape[1] != field.dim:
            return None
        return tube, prove_tube(field, tube)

    with threadpool_limits(**ONE_THREAD):
        if certificate.conditions is None:
            found = prove_by_tubes(field, reference, known)
        else:
            found = prove(field, certificate.conditions, reference, known).certificate
    if not found.is_as_strong_as(certificate):
        return found.refused("what is claimed is not what is proved")
    return found


def _prove_narrowing(
    field: GuidingField, conditions: Conditions, reference: ReferencePath, progress: Progress
) -> Certificate:
    """Proves conditions on the band that is left where V was found not to fall."""
    function = LyapunovFunction(mixture_of(field, conditions.sigma))
    boxes = 0

    for number in range(ATTEMPTS):
        attempt = prove(field, conditions, reference, _proposed(field, reference))
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


def _without_band(
    field: GuidingField, reference: ReferencePath, stops: FloatArray
) -> Certificate:
    """Returns what samples say where they show no band: a zero of m on the path, if any."""
    reason = "V falls on no band of levels with a tube about each piece, by samples"
    if not len(stops):
        return failed(field, None, reason)
    x, y = stops[np.argmin(reference.project(stops).distance)].tolist()
    reason += f"; m vanishes at ({x:.4g}, {y:.4g})"
    return failed(field, None, reason, counterexample=(x, y))
