"""Proposes levels of V: samples find a band, and the proof cuts it where V does not fall."""

from dataclasses import replace

from sgvf_drake.certificate.levels import Conditions, LevelsProof, prove_levels
from sgvf_drake.certificate.mixture_model import lowest_of, mixture_of
from sgvf_drake.fields import GuidingField
from sgvf_drake.lyapunov import (
    LyapunovFunction,
    find_guiding_zeros,
    search_band,
    take_samples,
)
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress

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


def find_levels(
    field: GuidingField, reference: ReferencePath, progress: Progress
) -> LevelsProof:
    """Finds a band of levels on which V is proved to fall, or tells what is in the way.

    Args:
        field: The field, of closed paths in the plane.
        reference: The path.
        progress: Told how far it is.
    """
    samples = take_samples(field, grid_size=GRID_SIZE)
    stops = find_guiding_zeros(field).points
    band = search_band(field, samples, reference, RATIOS, stops=stops, progress=progress)
    if band is None:
        return LevelsProof(None, "V falls on no band of levels, by samples")
    sigma = band.function.sigma / field.cloud.unit_length
    mixture = mixture_of(field, sigma)
    conditions = Conditions(
        sigma, lowest_of(mixture), band.c_in, band.c_out, ALPHA, DELTA, SHARE
    )
    function, boxes = LyapunovFunction(mixture), 0
    for number in range(ATTEMPTS):
        found = prove_levels(field, conditions, reference)
        boxes += found.boxes
        progress("levels", number + 1, ATTEMPTS)
        if found.obstacle is None:
            break
        narrowed = _narrowed(conditions, float(function(found.obstacle[None])[0]))
        if narrowed is None:
            break
        conditions = narrowed
    progress("levels", ATTEMPTS, ATTEMPTS)
    return replace(found, boxes=boxes)


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
