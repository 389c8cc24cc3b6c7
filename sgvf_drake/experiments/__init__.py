"""Experiments: what the commands run, each as a Drake simulation with its results.

Every `run_...` returns the summary that it leaves in the folder `out`, tells `progress` how far
it is, and replaces results there only where `overwrite` says so.  Its `reference` is one from
`choose_reference`; None: the best there is without a file.
"""

from sgvf_drake.experiments.certified import CertifiedField, as_flown
from sgvf_drake.experiments.certify import run_certify
from sgvf_drake.experiments.figures.network import network_figure
from sgvf_drake.experiments.figures.runs import tour_figure
from sgvf_drake.experiments.figures.singularities import log_density_figure, singularity_figure
from sgvf_drake.experiments.figures.tracking import tracking_figure
from sgvf_drake.experiments.figures.verification import theorem_figure, verification_figure
from sgvf_drake.experiments.flight import FlightSpec, check_feasibility, flight_log, simulate
from sgvf_drake.experiments.fly import FlightResult, fly
from sgvf_drake.experiments.follow import FollowResult, follow, follow_network
from sgvf_drake.experiments.importing import run_import
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

__all__ = [
    "CertifiedField",
    "FlightMargin",
    "FlightResult",
    "FlightScene",
    "FlightSpec",
    "FollowResult",
    "RouteResult",
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
    "log_density_figure",
    "network_figure",
    "open_field",
    "open_guiding_field",
    "run_certify",
    "run_demo",
    "run_fly",
    "run_follow",
    "run_import",
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
]
