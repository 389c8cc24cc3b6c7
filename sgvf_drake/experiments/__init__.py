"""Experiments: what the commands run, each as a Drake simulation with its results.

Every `run_...` returns the summary that it leaves in the folder `out`, tells `progress` how far
it is, and replaces results there only where `overwrite` says so.  Its `reference` is one from
`choose_reference`; None: the best there is without a file.
"""

from sgvf_drake.experiments.certified import CertifiedField, as_flown
from sgvf_drake.experiments.certify import run_certify
from sgvf_drake.experiments.certify_network import run_certify_network
from sgvf_drake.experiments.distributions import (
    Distributions,
    DisturbanceDistributions,
    SensorDistributions,
    StartDistributions,
    load_distributions,
)
from sgvf_drake.experiments.figures.monte_carlo import monte_carlo_figure
from sgvf_drake.experiments.figures.network import network_figure
from sgvf_drake.experiments.figures.runs import tour_figure
from sgvf_drake.experiments.figures.singularities import log_density_figure, singularity_figure
from sgvf_drake.experiments.figures.tracking import tracking_figure
from sgvf_drake.experiments.figures.verification import theorem_figure, verification_figure
from sgvf_drake.experiments.flight import FlightSpec, check_feasibility, flight_log, simulate
from sgvf_drake.experiments.fly import FlightResult, fly
from sgvf_drake.experiments.follow import FollowResult, follow, follow_network
from sgvf_drake.experiments.importing import run_import
from sgvf_drake.experiments.monte_carlo import MonteCarlo, replay_flight, run_monte_carlo
from sgvf_drake.experiments.reference import choose_reference
from sgvf_drake.experiments.route import RouteResult, covering_routes, fly_route, to_point
from sgvf_drake.experiments.runs import (
    open_field,
    open_guiding_field,
    run_demo,
    run_fly,
    run_follow,
    run_routes,
    run_tour,
    run_train,
)
from sgvf_drake.experiments.scene import FlightScene, View
from sgvf_drake.experiments.singularities import run_singularities
from sgvf_drake.experiments.theorem import check_theorem
from sgvf_drake.experiments.tour import TourResult, fly_tour
from sgvf_drake.experiments.tube import tube_curves
from sgvf_drake.experiments.velocity_error import (
    FlightMargin,
    flight_margin,
    flight_tracking,
)
from sgvf_drake.experiments.verify import run_verify
from sgvf_drake.experiments.workers import workers_of

__all__ = [
    "CertifiedField",
    "Distributions",
    "DisturbanceDistributions",
    "FlightMargin",
    "FlightResult",
    "FlightScene",
    "FlightSpec",
    "FollowResult",
    "MonteCarlo",
    "RouteResult",
    "SensorDistributions",
    "StartDistributions",
    "TourResult",
    "View",
    "as_flown",
    "check_feasibility",
    "check_theorem",
    "choose_reference",
    "covering_routes",
    "flight_log",
    "flight_margin",
    "flight_tracking",
    "fly",
    "fly_route",
    "fly_tour",
    "follow",
    "follow_network",
    "load_distributions",
    "log_density_figure",
    "monte_carlo_figure",
    "network_figure",
    "open_field",
    "open_guiding_field",
    "replay_flight",
    "run_certify",
    "run_certify_network",
    "run_demo",
    "run_fly",
    "run_follow",
    "run_import",
    "run_monte_carlo",
    "run_routes",
    "run_singularities",
    "run_tour",
    "run_train",
    "run_verify",
    "simulate",
    "singularity_figure",
    "theorem_figure",
    "to_point",
    "tour_figure",
    "tracking_figure",
    "tube_curves",
    "verification_figure",
    "workers_of",
]
