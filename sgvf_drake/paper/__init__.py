"""The paper's experiments: scenarios, what runs them, and the page of what they found."""

from sgvf_drake.paper.reproduce import run_reproduce
from sgvf_drake.paper.scenario import (
    Scenario,
    load_scenario,
    override_names,
    run_scenario,
    scenario_names,
)

__all__ = [
    "Scenario",
    "load_scenario",
    "override_names",
    "run_reproduce",
    "run_scenario",
    "scenario_names",
]
