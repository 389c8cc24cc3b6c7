"""Experiments: what the commands run, each as a Drake simulation with its results."""

from sgvf_drake.experiments.demo import run_demo
from sgvf_drake.experiments.fly import FlightResult, check_feasibility, fly
from sgvf_drake.experiments.follow import FollowResult, follow
from sgvf_drake.experiments.reference import choose_reference, scale_reference
from sgvf_drake.experiments.runs import open_field, run_fly, run_follow, run_train

__all__ = [
    "FlightResult",
    "FollowResult",
    "check_feasibility",
    "choose_reference",
    "fly",
    "follow",
    "open_field",
    "run_demo",
    "run_fly",
    "run_follow",
    "run_train",
    "scale_reference",
]
