"""The figures that the commands leave behind, each from one result."""

from sgvf_drake.experiments.figures.runs import (
    field_figure,
    flight_figure,
    follow_figure,
    tour_figure,
    training_figure,
    trajectory_table,
)
from sgvf_drake.experiments.figures.singularities import log_density_figure, singularity_figure
from sgvf_drake.experiments.figures.tracking import tracking_figure
from sgvf_drake.experiments.figures.verification import theorem_figure, verification_figure

__all__ = [
    "field_figure",
    "flight_figure",
    "follow_figure",
    "log_density_figure",
    "singularity_figure",
    "theorem_figure",
    "tour_figure",
    "tracking_figure",
    "training_figure",
    "trajectory_table",
    "verification_figure",
]
