"""Lyapunov analysis of guiding fields, by sampling; NumPy and SciPy only.

Nothing here is a proof: what the samples show is called "sampled".
"""

from sgvf_drake.lyapunov.band import (
    MIN_DECREASE,
    SIGMA_RATIOS,
    Band,
    find_band,
    search_band,
)
from sgvf_drake.lyapunov.conditions import (
    Bound,
    check_assumptions,
    check_lemma,
    robustness_bounds,
)
from sgvf_drake.lyapunov.function import LyapunovFunction, find_modes
from sgvf_drake.lyapunov.margin import Margins, inward_margins, to_level_set
from sgvf_drake.lyapunov.samples import Samples, take_samples
from sgvf_drake.lyapunov.sublevel import SublevelSet, sublevel_set
from sgvf_drake.lyapunov.vanishing import NEAR_PATH, Vanishing, measure_vanishing
from sgvf_drake.lyapunov.verification import Verification, Violation, verify
from sgvf_drake.lyapunov.winding import winding_number
from sgvf_drake.lyapunov.zero_search import ZeroSearch, find_zeros
from sgvf_drake.lyapunov.zeros import (
    KINDS,
    PARTS,
    FieldZeros,
    KnownZero,
    KnownZeros,
    PartName,
    Singularities,
    Zero,
    find_guiding_zeros,
    find_singularities,
    kind_of,
)

__all__ = [
    "KINDS",
    "MIN_DECREASE",
    "NEAR_PATH",
    "PARTS",
    "SIGMA_RATIOS",
    "Band",
    "Bound",
    "FieldZeros",
    "KnownZero",
    "KnownZeros",
    "LyapunovFunction",
    "Margins",
    "PartName",
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
    "measure_vanishing",
    "robustness_bounds",
    "search_band",
    "sublevel_set",
    "take_samples",
    "to_level_set",
    "verify",
    "winding_number",
]
