"""The command line: ``sgvf paths | train | fly | montecarlo | verify | ... | run | reproduce``.

Commands parse, call the experiments, and print a table; the work is elsewhere.  The heavy
imports (Drake, torch, matplotlib) happen inside the commands, so that ``sgvf --help`` and
a mistyped option answer at once.
"""

from importlib import import_module

from sgvf_drake.cli.application import app, main

__all__ = ["app", "main"]

# A module registers its commands when it is imported; the help lists them in this order.
for _name in (
    *("finding", "training", "flying", "monte_carlo", "checking"),
    *("exporting", "running", "reproducing"),
):
    import_module(f"{__name__}.{_name}")
