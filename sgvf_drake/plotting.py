"""Pictures: every function draws given data into given axes and returns the artists.

Nothing here computes results; the data come from the experiments.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
import numpy as np
from numpy.typing import ArrayLike
import pandas as pd

from sgvf_drake.arrays import Box, FloatArray, plane_grid
from sgvf_drake.fields import Field

# Okabe and Ito's palette, told apart by colour-blind readers too.
BLUE, ORANGE, GREEN, RED = "#0072B2", "#E69F00", "#009E73", "#D55E00"
GREY = "#808080"
STREAM_RESOLUTION = 60
# Of stream lines, in matplotlib's unit.
STREAM_DENSITY = 1.6
MAX_TRAJECTORIES = 60
# More waypoints than this are drawn smaller, so that what follows them still shows.
FEW_WAYPOINTS = 400
# The smallest cross-track error that is drawn, relative to the largest.
ERROR_FLOOR = 1e-4
# Of lengths, where only the waypoints tell.
UNIT = "unit of the waypoints"
# File size and sharpness of every saved figure.
DPI = 150


def new_figure(
    rows: int, columns: int, width: float, height: float
) -> tuple[Figure, list[Axes]]:
    """Returns a figure outside pyplot's global state, and its axes row by row.

    Args:
        rows: Number of rows.
        columns: Number of columns.
        width: Width in inches.
        height: Height in inches.
    """
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    return figure, list(axes.flat)


def legend_below(
    figure: Figure,
    handles: Sequence[Artist],
    labels: Sequence[str] | None = None,
    columns: int | None = None,
) -> None:
    """Adds a legend below all axes of a figure.

    Args:
        figure: The figure.
        handles: What is named.
        labels: Its names; None: the labels of the handles.
        columns: Entries in a row; None: all of them.
    """
    names = [str(handle.get_label()) for handle in handles] if labels is None else labels
    columns = columns or len(handles)
    figure.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False)


def mark(label: str, marker: str = "", color: str = "black", **style: Any) -> Line2D:
    """Returns what stands in a legend for markers, or for lines where there is no marker."""
    line = "" if marker else "-"
    return Line2D([], [], ls=line, marker=marker, color=color, label=label, **style)


def plane_axes(
    axes: Axes, unit: str = "", title: str = "", names: tuple[str, str] = ("x", "y")
) -> None:
    """Labels the axes of a plane and makes its aspect equal."""
    x, y = (f"{name} [{unit}]" if unit else name for name in names)
    axes.set(xlabel=x, ylabel=y, title=title, aspect="equal")


def plot_field(axes: Axes, field: Field, box: Box) -> Sequence[Artist]:
    """Draws the stream lines of a planar field over a box."""
    x, y, points = plane_grid(box, STREAM_RESOLUTION)
    m = field(points).reshape(len(y), len(x), 2)
    style: dict[str, Any] = {"color": "#9fb0bb", "linewidth": 0.6, "arrowsize": 0.7}
    lines = axes.streamplot(x, y, m[..., 0], m[..., 1], density=STREAM_DENSITY, **style)
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    return [lines.lines]


def plot_waypoints(axes: Axes, points: FloatArray) -> Sequence[Artist]:
    """Draws waypoints (N, d), first two coordinates."""
    size = 2.5 if len(points) <= FEW_WAYPOINTS else 0.8
    return axes.plot(
        points[:, 0], points[:, 1], ".", color="black", markersize=size, label="waypoints"
    )


def plot_plane(axes: Axes, field: Field, box: Box, points: FloatArray, title: str) -> None:
    """Draws a planar field over a box with the waypoints (N, 2), in labelled axes."""
    plot_field(axes, field, box)
    plot_waypoints(axes, points)
    plane_axes(axes, UNIT, title)


def plot_trajectories(
    axes: Axes, positions: FloatArray, followed: Iterable[bool] | None = None
) -> Sequence[Artist]:
    """Draws trajectories (T, n, d), those that do not follow the path in another colour.

    Of many, an even selection is drawn, but every one that fails.
    """
    good = np.ones(positions.shape[1], bool) if followed is None else np.array(list(followed))
    shown = np.flatnonzero(good)
    if len(shown) > MAX_TRAJECTORIES:
        shown = shown[np.linspace(0, len(shown) - 1, MAX_TRAJECTORIES).astype(int)]
    artists: list[Artist] = []
    for agents, color, label in (
        (shown, BLUE, "agent"),
        (np.flatnonzero(~good), RED, "failed"),
    ):
        for number, agent in enumerate(agents):
            x, y = positions[:, agent, 0], positions[:, agent, 1]
            artists += axes.plot(
                x,
                y,
                color=color,
                linewidth=0.7,
                alpha=0.7,
                label=label if number == 0 else None,
            )
            artists += axes.plot(x[0], y[0], "o", color=color, markersize=2.5, alpha=0.7)
    return artists


def plot_cross_track(
    axes: Axes, times: FloatArray, errors: FloatArray, unit: str = "", time_unit: str = "s"
) -> Sequence[Artist]:
    """Draws cross-track errors (T, n) over time: one line, or the spread of many agents."""
    # A logarithmic axis shows the way in and the steady state; what crosses the path
    # exactly would run off it.
    largest = max(float(errors.max()), float(np.finfo(np.float64).eps))
    errors = np.maximum(errors, ERROR_FLOOR * largest)
    suffix = f" [{unit}]" if unit else ""
    axes.set(xlabel=f"time [{time_unit}]", ylabel=f"cross-track error{suffix}", yscale="log")
    axes.grid(alpha=0.3)
    if errors.shape[1] == 1:
        return axes.plot(times, errors[:, 0], color=BLUE, linewidth=0.8)
    artists: list[Artist] = []
    low, middle, high = np.quantile(errors, [0.05, 0.5, 0.95], axis=1)
    artists.append(
        axes.fill_between(
            times, low, high, color=BLUE, alpha=0.3, label="5 % to 95 % of agents"
        )
    )
    artists += axes.plot(times, middle, color=BLUE, label="median")
    artists += axes.plot(times, errors.max(axis=1), color=RED, linewidth=0.8, label="largest")
    axes.legend(loc="upper right")
    return artists


def plot_intervals(
    axes: Axes, x: ArrayLike, intervals: Sequence[Sequence[float]], **style: Any
) -> None:
    """Draws at each x a mean with its interval (mean, low, high); NaN: the mean alone."""
    mean, low, high = np.array(intervals, dtype=np.float64).T
    bars = np.nan_to_num(np.stack([mean - low, high - mean]))
    axes.errorbar(x, mean, bars, capsize=3, **style)


def plot_velocity(axes: Axes, log: pd.DataFrame) -> Sequence[Artist]:
    """Draws the planar velocity of a flight log, columns time, vx, vy (m/s)."""
    lines = axes.plot(log["time"], log["vx"], color=BLUE, label="$v_x$")
    lines += axes.plot(log["time"], log["vy"], color=ORANGE, label="$v_y$")
    speed = np.hypot(log["vx"], log["vy"])
    lines += axes.plot(log["time"], speed, color="black", linewidth=0.8, label="speed")
    axes.set(xlabel="time [s]", ylabel="velocity [m/s]")
    axes.legend(loc="lower right", bbox_to_anchor=(1, 1), ncols=3, frameon=False)
    axes.grid(alpha=0.3)
    return lines


def plot_propeller_forces(
    axes: Axes, log: pd.DataFrame, limit: float, *, zoom: bool = False
) -> Sequence[Artist]:
    """Draws the four propeller forces of a flight log (N) and their upper limit.

    With `zoom` the limit only stands in the label, and the forces fill the axes.
    """
    lines: list[Artist] = []
    for number, color in enumerate((BLUE, ORANGE, GREEN, RED), start=1):
        lines += axes.plot(
            log["time"],
            log[f"force_{number}"],
            color=color,
            linewidth=0.4 if zoom else 0.8,
            label=f"$f_{number}$",
        )
    axes.set(xlabel="time [s]", ylabel="propeller force [N]")
    if zoom:
        axes.set_ylabel(f"propeller force [N], limit {limit:.2f}")
    else:
        lines.append(axes.axhline(limit, color=GREY, linestyle="--", label="limit"))
        axes.set_ylim(0, 1.08 * limit)
    axes.legend(loc="upper right" if zoom else "center right", ncols=5)
    axes.grid(alpha=0.3)
    return lines


def plot_turn_rate(axes: Axes, log: pd.DataFrame, limit: float) -> Sequence[Artist]:
    """Draws the commanded turn rate of a flight log (rad/s) and its limit to either side."""
    lines = axes.plot(log["time"], log["turn_rate"], color=BLUE, linewidth=0.8)
    lines += [axes.axhline(side * limit, color=GREY, linestyle="--") for side in (-1, 1)]
    axes.set(xlabel="time [s]", ylabel="commanded turn rate [rad/s]")
    axes.grid(alpha=0.3)
    return lines


def plot_losses(axes: Axes, history: pd.DataFrame) -> Sequence[Artist]:
    """Draws every loss term of one stage of a training history."""
    terms = history.drop(columns=["stage", "iteration", "total"]).dropna(axis=1, how="all")
    lines: list[Artist] = []
    for term in terms:
        smooth = terms[term].rolling(10, min_periods=1).mean()
        lines += axes.plot(history["iteration"], smooth, linewidth=0.9, label=str(term))
    axes.set(xlabel="iteration", ylabel="loss", yscale="log", title=history["stage"].iloc[0])
    axes.legend()
    axes.grid(alpha=0.3)
    return lines
