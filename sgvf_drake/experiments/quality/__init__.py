"""The quality of learning, measured: many clouds, followed from many starts, in one table.

A case is a cloud, a recipe and a seed.  It is trained, followed in Drake, and compared with
its true path and with the exact score.  Each case leaves a JSON file and a figure when it is
finished, so that a run that was interrupted goes on where it was.

    python -m sgvf_drake.experiments.quality --out build/bench-learning --suite full
"""

from sgvf_drake.experiments.quality.case import Case
from sgvf_drake.experiments.quality.report import print_summary
from sgvf_drake.experiments.quality.running import run_suite
from sgvf_drake.experiments.quality.suites import Suite, suite_cases

__all__ = [
    "Case",
    "Suite",
    "print_summary",
    "run_suite",
    "suite_cases",
]
