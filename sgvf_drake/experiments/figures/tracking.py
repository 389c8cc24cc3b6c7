"""The figure of the velocity error in flight over time and over V."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.experiments.flight import TAKE_OFF_S
from sgvf_drake.experiments.velocity_error import TrackingResult, VelocityErrors

FLIGHT_COLORS = (plotting.RED, plotting.BLUE, plotting.ORANGE)
# Below these V and errors are not told apart: as parts of c_in, and of the speed.
LOWEST_V, LOWEST_ERROR = 1e-2, 1e-3


def tracking_figure(result: TrackingResult) -> Figure:
    """Returns the velocity error over time, and over V beside what each level tolerates."""
    figure, axes = plotting.new_figure(1, 2, 12, 4.8)
    _draw_over_time(axes[0], result)
    levels, e_star = result.margins.levels, np.maximum(result.margins.e_star, 0.0)
    axes[1].plot(levels, e_star, color="black", linewidth=1.5, label="tolerated, e*")
    axes[1].fill_between(levels, e_star, color="black", alpha=0.1)
    _draw_over_V(axes[1], result)
    for level, text in ((result.c_in, "$c_{in}$"), (result.level, "level")):
        axes[1].axvline(level, color=plotting.GREY, linewidth=0.9)
        axes[1].annotate(text, (level, 0.02), xycoords=("data", "axes fraction"))
    axes[1].set(title="in the shade V falls, whatever the direction of the error")
    axes[1].legend(loc="upper left")
    return figure


def _draw_over_V(axes: Axes, result: TrackingResult) -> None:  # noqa: N802
    """Draws the errors over V; the take-off, the way to the tube and the rest differ."""
    lowest = LOWEST_V * result.c_in
    for flight in result.flights:
        V = np.maximum(flight.log["V"], lowest)
        error = np.maximum(flight.log["error"], LOWEST_ERROR)
        taking_off = ~flight.settled & (flight.log["time"] < TAKE_OFF_S)
        name, color = f"flight {flight.piece + 1}", color_of(flight)
        for part, style, label in (
            (taking_off, ":", f"{name}, take-off"),
            (~taking_off & ~flight.settled, "--", f"{name}, to the tube"),
            (flight.settled, "-", f"{name}, since then"),
        ):
            axes.plot(V[part], error[part], style, color=color, linewidth=1, label=label)
    axes.set(
        xscale="log",
        yscale="log",
        xlim=(lowest, 1.5 * result.margins.levels[-1]),
        ylim=(LOWEST_ERROR, 1.5),
        xlabel="V",
        ylabel="velocity error and what is tolerated, parts of the speed",
    )
    axes.grid(alpha=0.3)


def color_of(flight: VelocityErrors) -> str:
    """Returns the colour of the lines of a flight."""
    return FLIGHT_COLORS[flight.piece % len(FLIGHT_COLORS)]


def _draw_over_time(axes: Axes, result: TrackingResult) -> None:
    for flight in result.flights:
        log, color, label = flight.log, color_of(flight), f"flight {flight.piece + 1}"
        error = np.maximum(log["error"], LOWEST_ERROR)
        axes.plot(log["time"], error, color=color, linewidth=0.9, label=label)
        for time in log["time"][flight.settled][:1]:
            axes.axvline(time, color=color, linestyle=":", linewidth=0.9)
    axes.axhline(
        result.tolerated / result.speed,
        color="black",
        linestyle="--",
        label=f"tolerated at V = {result.level:.3g}",
    )
    axes.set(
        xlabel="time [s]",
        ylabel="velocity error, part of the speed",
        yscale="log",
        ylim=(LOWEST_ERROR, 1.5),
        title=f"flight at {result.speed:g} m/s; settled from the dotted lines on",
    )
    axes.legend(loc="upper right")
    axes.grid(alpha=0.3)
