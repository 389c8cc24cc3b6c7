"""The figure of a Monte Carlo experiment: where flights started, and how well they went."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.paths import ReferencePath

MM = 1e3
# Points along each piece of the path.
SAMPLES = 400


def monte_carlo_figure(flights: pd.DataFrame, path: ReferencePath) -> Figure:
    """Returns the starts by what became of them, and the distribution of the error.

    Args:
        flights: One row a flight, as `run_monte_carlo` leaves it.
        path: The path, in metres.
    """
    figure, axes = plotting.new_figure(1, 2, 11, 4.8)
    for piece in path.pieces:
        line = piece.sample(SAMPLES)
        line = np.vstack((line, line[:1])) if piece.closed else line
        axes[0].plot(line[:, 0], line[:, 1], color="black", linewidth=0.8)
    for success, color, marker in ((True, plotting.BLUE, "o"), (False, plotting.RED, "x")):
        own = flights[flights["success"] == success]
        label = f"{len(own)} {'succeeded' if success else 'failed'}"
        places = own["start_x"], own["start_y"]
        axes[0].scatter(*places, s=14, marker=marker, color=color, label=label)
    plotting.plane_axes(axes[0], "m", "starts")
    axes[0].legend(loc="upper right")
    _plot_errors(axes[1], flights[flights["success"]])
    return figure


def _plot_errors(axes: Axes, flights: pd.DataFrame) -> None:
    for name, label, color in (
        ("cross_track_rms_m", "RMS", plotting.BLUE),
        ("cross_track_max_m", "largest", plotting.ORANGE),
    ):
        errors = MM * flights[name].to_numpy(dtype=np.float64)
        if len(errors):
            axes.ecdf(errors, label=label, color=color)
    axes.set(
        xlabel="cross-track error since the path was reached, mm",
        ylabel="part of the successful flights",
        title="error",
    )
    if len(flights):
        axes.legend(loc="lower right")
    axes.grid(alpha=0.3)
