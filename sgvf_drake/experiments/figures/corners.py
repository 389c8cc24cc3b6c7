"""The figures of corners: agents around polygons, fields at a corner, and angles."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.paper.intervals import SHARE, interval
from sgvf_drake.fields import GuidingField

UNIT = "unit of the waypoints"
# Half the side of the window about a corner, U, and its pixels.
WINDOW, PIXELS = 0.6, 161
# The colours of |m|, and between which values.
NORM_COLORS, NORMS = "viridis", (0.0, 1.0)
# Colour, marker and shift along the axis of angles, so that intervals do not cover each other.
STYLES = {
    "shallow": (plotting.RED, "o", -1.2),
    "deep": (plotting.BLUE, "s", 0.0),
    "robust": (plotting.GREEN, "^", 1.2),
}


@dataclass(frozen=True, eq=False)
class CornerView:
    """A field of a polygon and its agents, as they are drawn.

    Attributes:
        title: What it is.
        field: The field.
        positions: (T, n, 2) trajectories.
        lapped: (n,) who completes a lap.
        stalled: (n,) who stalls.
        zeros: (k, 2) the zeros of m.
        stable: (k,) which of them attract.
        corner: (2,) the corner that is shown from near.
    """

    title: str
    field: GuidingField
    positions: FloatArray
    lapped: BoolArray
    stalled: BoolArray
    zeros: FloatArray
    stable: BoolArray
    corner: FloatArray


def corners_figure(views: Sequence[CornerView]) -> Figure:
    """Returns the trajectories of each view, and where agents stall (paper, Fig. 6)."""
    figure, axes = plotting.new_figure(2, 2, 10.5, 10.8)
    for panel, view in zip(axes, views, strict=True):
        plotting.plot_field(panel, view.field, view.field.cloud.box)
        plotting.plot_trajectories(panel, view.positions, view.lapped)
        plotting.plot_waypoints(panel, view.field.cloud.points)
        final = view.positions[-1, view.stalled]
        panel.plot(*final.T, "X", color="black", markersize=9, markeredgecolor="white")
        title = f"{view.title}: {view.lapped.mean():.0%} lap, {view.stalled.mean():.0%} stall"
        plotting.plane_axes(panel, UNIT, title)
    handles = [
        Line2D([], [], color=plotting.BLUE, label="agent that laps"),
        Line2D([], [], color=plotting.RED, label="agent that does not"),
        Line2D([], [], color="black", marker="X", linestyle="", label="where agents stall"),
        Line2D([], [], color="black", marker=".", linestyle="", label="waypoints"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False)
    return figure


def near_figure(views: Sequence[CornerView]) -> Figure:
    """Returns each field about its corner."""
    figure, axes = plotting.new_figure(2, 2, 10.5, 10.2)
    for panel, view in zip(axes, views, strict=True):
        plot_corner(panel, view)
    scale = ScalarMappable(Normalize(*NORMS), NORM_COLORS)
    figure.colorbar(scale, ax=axes, label="|m|", shrink=0.6, extend="max")
    handles = [
        Line2D([], [], color="white", marker="v", mec="black", ls="", label="zero, attracts"),
        Line2D([], [], color="white", marker="o", mec="black", ls="", label="zero, other"),
        Line2D([], [], color="black", marker=".", ls="", label="waypoints"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def plot_corner(axes: Axes, view: CornerView) -> list[Artist]:
    """Draws |m|, stream lines, waypoints and zeros about the corner of a view."""
    unit, corner = view.field.cloud.unit_length, view.corner
    half = WINDOW * unit
    x, y = (np.linspace(middle - half, middle + half, PIXELS) for middle in corner)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    m = view.field(grid.reshape(-1, 2)).reshape(grid.shape)
    norm = np.linalg.norm(m, axis=2)
    artists: list[Artist] = [
        axes.pcolormesh(
            x, y, norm, cmap=NORM_COLORS, vmin=NORMS[0], vmax=NORMS[1], shading="gouraud"
        )
    ]
    axes.streamplot(x, y, m[..., 0], m[..., 1], color="white", density=1.1, linewidth=0.7)
    artists += axes.plot(*view.field.cloud.points.T, ".", color="black", markersize=5)
    for chosen, marker in ((view.stable, "v"), (~view.stable, "o")):
        artists += axes.plot(
            *view.zeros[chosen].T, marker, color="white", markeredgecolor="black", markersize=11
        )
    plotting.plane_axes(axes, UNIT, view.title)
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    return artists


def angles_figure(
    table: pd.DataFrame,
    profiles: Mapping[str, Sequence[FloatArray]],
    traps: Mapping[str, FloatArray],
) -> Figure:
    """Returns stalls and traps over the angle, the speed past a corner, and where traps sit.

    Args:
        table: One row a field: angle, network, stalled, trapped.
        profiles: |m| along the sides of a polygon, (corners, samples) for each field, in the
            direction of travel, by network.
        traps: Where those of each network sit, (k, 2); see `plot_traps`.
    """
    figure, axes = plotting.new_figure(2, 2, 11.5, 9.5)
    for panel, name, label in (
        (axes[0], "stalled", "agents that stall, %"),
        (axes[1], "trapped", "corners with a trap, %"),
    ):
        plot_over_angle(panel, table, name)
        panel.set(ylabel=label, ylim=(-5, 105))
    plot_profiles(axes[2], profiles)
    plot_traps(axes[3], traps)
    for panel in axes:
        panel.grid(alpha=0.3)
        panel.legend(loc="best")
    return figure


def plot_over_angle(axes: Axes, table: pd.DataFrame, name: str) -> None:
    """Draws the mean share of each network over the angle of the corners, in per cent."""
    for network, (color, marker, shift) in STYLES.items():
        groups = table[table["network"] == network].groupby("angle")[name]
        angles = np.array([angle for angle, _ in groups], dtype=np.float64)
        mean, low, high = 100 * np.array([interval(values, SHARE) for _, values in groups]).T
        spread = np.nan_to_num(np.stack([mean - low, high - mean]))
        axes.errorbar(
            angles + shift, mean, spread, color=color, marker=marker, capsize=3, label=network
        )
    axes.set(xlabel="angle of the corners [degrees]", xticks=sorted(set(table["angle"])))


def plot_profiles(axes: Axes, profiles: Mapping[str, Sequence[FloatArray]]) -> list[Artist]:
    """Draws the median |m| past a corner, with the range from 10 % to 90 % of them."""
    artists: list[Artist] = []
    for network, speeds in profiles.items():
        # From the middle of one side over the corner to the middle of the next.
        past = np.concatenate([np.roll(speed, speed.shape[1] // 2) for speed in speeds])
        part = (np.arange(past.shape[1]) + 0.5) / past.shape[1] - 0.5
        low, median, high = np.quantile(past, [0.1, 0.5, 0.9], axis=0)
        color = STYLES[network][0]
        axes.fill_between(part, low, high, color=color, alpha=0.15)
        artists += axes.plot(part, median, color=color, label=network)
    axes.set(
        xlabel="past the corner of the square [sides]", ylabel="|m| on the path", ylim=(0, 1.25)
    )
    return artists


def plot_traps(axes: Axes, traps: Mapping[str, FloatArray]) -> list[Artist]:
    """Draws where traps of each network sit, (k, 2): past the corner along the way, outside."""
    artists: list[Artist] = []
    for network, places in traps.items():
        color, marker, _ = STYLES[network]
        label = f"{network}: {len(places)}"
        artists.append(
            axes.scatter(
                places[:, 0], places[:, 1], s=26, color=color, marker=marker, label=label
            )
        )
    axes.axvline(0, color="black", linewidth=0.8)
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(
        xlabel="past the corner along the way [U], negative before it",
        ylabel="outside of the polygon [U]",
    )
    return artists
