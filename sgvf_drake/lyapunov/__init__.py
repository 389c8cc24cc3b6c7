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
from sgvf_drake.lyapunov.learned_path import learned_path
from sgvf_drake.lyapunov.margin import Margins, inward_margins, to_level_set
from sgvf_drake.lyapunov.samples import Samples, take_samples
from sgvf_drake.lyapunov.singularities import (
    FieldZeros,
    Singularities,
    Zero,
    find_guiding_zeros,
    find_singularities,
    kind_of,
)
from sgvf_drake.lyapunov.sublevel import SublevelSet, sublevel_set
from sgvf_drake.lyapunov.vanishing import Vanishing, measure_vanishing
from sgvf_drake.lyapunov.verification import Verification, verify
from sgvf_drake.lyapunov.violations import Violation
from sgvf_drake.lyapunov.winding import winding_number
from sgvf_drake.lyapunov.zeros import ZeroSearch, find_zeros

__all__ = [
    "Assumptions",
    "Band",
    "Bound",
    "FieldZeros",
    "Lemma",
    "LyapunovFunction",
    "Margins",
    "Samples",
    "Singularities",
    "SublevelSet",
    "Vanishing",
    "Verification",
    "Violation",
    "Zero",
    "ZeroSearch",
    "check_assumptions",
    "check_lemma",
    "find_band",
    "find_guiding_zeros",
    "find_modes",
    "find_singularities",
    "find_zeros",
    "inward_margins",
    "kind_of",
    "learned_path",
    "measure_vanishing",
    "robustness_bounds",
    "search_band",
    "sublevel_set",
    "take_samples",
    "to_level_set",
    "verify",
    "winding_number",
]
