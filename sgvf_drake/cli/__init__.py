"""The command line: ``sgvf train | follow | fly | verify | ... | run | reproduce``.

Commands parse, call the experiments, and print a table; the work is elsewhere.  The heavy
imports (Drake, torch, matplotlib) happen inside the commands, so that ``sgvf --help`` and
a mistyped option answer at once.
"""

# The help lists the commands in this order.
from sgvf_drake.cli import training  # isort: skip
from sgvf_drake.cli import flying  # isort: skip
from sgvf_drake.cli import checking  # isort: skip
from sgvf_drake.cli import running  # isort: skip
from sgvf_drake.cli import reproducing  # isort: skip
from sgvf_drake.cli.application import app, main

__all__ = [
    "app",
    "checking",
    "flying",
    "main",
    "reproducing",
    "running",
    "training",
]
