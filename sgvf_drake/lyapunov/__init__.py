"""Lyapunov analysis of guiding fields, by sampling; NumPy and SciPy only.

Nothing here is a proof: what the samples show is called "sampled".
"""

from sgvf_drake.lyapunov.band import Band, find_band, search_band
from sgvf_drake.lyapunov.bounds import Bound, robustness_bounds
from sgvf_drake.lyapunov.conditions import (
    Assumptions,
    Lemma,
    check_assumptions,
    check_lemma,
)
from sgvf_drake.lyapunov.function import LyapunovFunction, find_modes
from sgvf_drake.lyapunov.margin import Margins, inward_margins, to_level_set
from sgvf_drake.lyapunov.samples import Samples, take_samples
from sgvf_drake.lyapunov.sublevel import SublevelSet, sublevel_set

__all__ = [
    "Assumptions",
    "Band",
    "Bound",
    "Lemma",
    "LyapunovFunction",
    "Margins",
    "Samples",
    "SublevelSet",
    "check_assumptions",
    "check_lemma",
    "find_band",
    "find_modes",
    "inward_margins",
    "robustness_bounds",
    "search_band",
    "sublevel_set",
    "take_samples",
    "to_level_set",
]
