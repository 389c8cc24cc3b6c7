"""The figure of the velocity-tracking error in flight."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.experiments.tracking import TrackingResult

PIECE_COLORS = (plotting.BLUE, plotting.GREEN)
# Errors and V cross zero; they are drawn over so many decades below the largest.
DECADES = 4


def tracking_figure(result: TrackingResult) -> Figure:
    """Returns the velocity error over time, and over V beside what each level tolerates."""
    figure, axes = plotting.new_figure(1, 2, 12, 4.8)
    _draw_over_time(axes[0], result)
    _draw_over_V(axes[1], result)
    return figure


def _draw_over_time(axes: Axes, result: TrackingResult) -> None:
    for flight in result.flights:
        color = PIECE_COLORS[flight.piece % len(PIECE_COLORS)]
        log, label = flight.log, f"piece {flight.piece + 1}"
        axes.plot(log["time"], log["tracking_error"], color=color, linewidth=0.9, label=label)
        for time in log["time"][flight.settled][:1]:
            axes.axvline(time, color=color, linestyle=":", linewidth=0.9)
    tolerated = result.speed * result.margins.at(result.level)
    axes.axhline(
        tolerated,
        color=plotting.RED,
        linestyle="--",
        label=f"tolerated at V = {result.level:.3g}",
    )
    highest = 2 * max(result.speed, tolerated)
    axes.set(
        xlabel="time [s]",
        ylabel="velocity error [m/s]",
        yscale="log",
        ylim=(highest / 10**DECADES, highest),
        title=f"flight at {result.speed:g} m/s; settled from the dotted lines on",
    )
    axes.legend(loc="upper right")
    axes.grid(alpha=0.3)


def _draw_over_V(axes: Axes, result: TrackingResult) -> None:  # noqa: N802
    levels, e_star = result.margins.levels, result.margins.e_star
    tolerated = np.maximum(result.speed * e_star, 0.0)
    axes.plot(levels, tolerated, color=plotting.RED, linestyle="--", label="tolerated")
    axes.fill_between(levels, tolerated, color=plotting.RED, alpha=0.1)
    for flight in result.flights:
        color = PIECE_COLORS[flight.piece % len(PIECE_COLORS)]
        for part, style, state in (
            (~flight.settled, ":", "on its way in"),
            (flight.settled, "-", "settled"),
        ):
            log, label = flight.log[part], f"piece {flight.piece + 1}, {state}"
            axes.plot(
                log["V"], log["tracking_error"], style, color=color, linewidth=0.9, label=label
            )
    for level, text in ((result.c_in, "$c_{in}$"), (result.level, "level")):
        axes.axvline(level, color=plotting.GREY, linewidth=0.9)
        axes.annotate(text, (level, 0.02), xycoords=("data", "axes fraction"))
    highest = 2 * max(result.speed, float(tolerated.max()))
    axes.set(
        xlabel="V",
        ylabel="velocity error [m/s]",
        xscale="log",
        yscale="log",
        xlim=(levels[-1] / 10**DECADES, 2 * levels[-1]),
        ylim=(highest / 10**DECADES, highest),
        title="in the shade V falls, whatever the direction of the error",
    )
    axes.legend(loc="upper left")
    axes.grid(alpha=0.3)
