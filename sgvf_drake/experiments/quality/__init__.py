"""The quality of learning, measured: many clouds, followed from many starts, in one table.

A case is a cloud, a recipe and a seed.  It is trained, followed in Drake, and compared with
its true path and with the exact score.  The workbench stores each case as it ends, so that a
run that was interrupted goes on where it was.

    python -m sgvf_drake.experiments.quality --out build/bench-learning --suite full
"""

from sgvf_drake.experiments.quality.cases import Case, Suite, suite_cases
from sgvf_drake.experiments.quality.running import print_summary, run_suite

__all__ = ["Case", "Suite", "print_summary", "run_suite", "suite_cases"]
