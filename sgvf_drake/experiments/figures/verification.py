"""The figure of a verification: where V falls, the tube from near, the flow, the bounds."""

from collections.abc import Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray
from sgvf_drake.fields import Field, GuidingField
from sgvf_drake.fields.vectors import component_along
from sgvf_drake.lyapunov import MIN_DECREASE, Verification, Violation
from sgvf_drake.lyapunov.conditions import NEARLY as BOUND_NEARLY

# The states of a point of the map: outside of the band and V falls, in the band, in the tube,
# and V does not fall.
OUTSIDE, FALLS, TUBE, RISES = "#eef1f3", "#c3dbec", plotting.GREEN, "#f2a27e"
LEVELS = "#8fa9bb"
# Of the map of the bounds: none fails, the first, the third, both.
BOUND_COLORS = (OUTSIDE, plotting.ORANGE, plotting.BLUE, plotting.RED)
BOUND_LABELS = (
    "all three hold",
    "printed bound fails",
    "bound with the true gradient missed by over 1 %",
    "both",
)
# A legend below its axes.
BELOW: dict[str, Any] = {
    "loc": "upper center",
    "bbox_to_anchor": (0.5, -0.13),
    "ncols": 2,
    "frameon": False,
}
# The window that shows the tube from near: half its side in tube half-widths, and in U where
# there is no tube; pixels and arrows along its side.
ZOOM_WIDTHS, ZOOM_UNITS = 5.0, 0.5
ZOOM_PIXELS, ZOOM_ARROWS = 161, 17
# Levels of V that are drawn on the map, and bins of the profile.
MAP_LEVELS = 10
PROFILE_BINS = 60
# Below this V the profile is that of the path itself, where V has nowhere to fall.
PROFILE_FLOOR = 1e-3


def verification_figure(field: GuidingField, found: Verification) -> Figure:
    """Returns maps of V_dot and the bounds, the tube from near, and the flow by level of V."""
    figure, axes = plotting.new_figure(2, 2, 12.5, 11.5)
    unit = "unit of the waypoints"
    plot_decrease(axes[0], found, field.cloud.unit_length)
    plotting.plot_waypoints(axes[0], field.cloud.points)
    plot_violations(axes[0], found.violations)
    title = "holds" if found.holds else "does NOT hold"
    plotting.plane_axes(axes[0], unit, f"where V falls along m (sampled): {title}")
    center, half = _window(field, found)
    plot_tube(axes[1], field, found, center, half)
    plotting.plot_waypoints(axes[1], field.cloud.points)
    place = "the weakest place of the tube" if found.holds else "the first violation"
    plotting.plane_axes(axes[1], unit, f"{place} from near, and m")
    axes[1].set(xlim=center[0] + half * np.array([-1, 1]))
    axes[1].set(ylim=center[1] + half * np.array([-1, 1]))
    plot_profile(axes[2], found)
    plot_bounds(axes[3], found)
    plotting.plane_axes(
        axes[3], unit, "where the bounds on the paper's V_dot and the true one hold"
    )
    axes[0].legend(handles=_handles(found), **BELOW)
    return figure


def plot_bounds(axes: Axes, found: Verification) -> Sequence[Artist]:
    """Draws where the printed bound fails, and where the one with the true gradient is missed.

    The bound with the squashed score always holds.
    """
    paper, _, gradient = found.bounds
    x, y = found.samples.axes
    state = found.samples.as_grid(~paper.holds + 2 * (gradient.excess > BOUND_NEARLY))
    axes.legend(
        handles=[
            Patch(color=color, label=label)
            for color, label in zip(BOUND_COLORS, BOUND_LABELS, strict=True)
        ],
        **BELOW,
    )
    colors = ListedColormap(BOUND_COLORS)
    return [axes.pcolormesh(x, y, state, cmap=colors, vmin=0, vmax=3)]


def plot_decrease(axes: Axes, found: Verification, unit_length: float) -> Sequence[Artist]:
    """Draws over the box where V falls and where not, level sets of V, and the band."""
    samples, function = found.samples, found.function
    x, y = samples.axes
    V = samples.as_grid(function(samples.x))
    V_dot = samples.as_grid(function.derivative(samples.x, samples.m))
    state = np.where(V_dot > -MIN_DECREASE / unit_length, 3, 0)
    if found.band is not None:
        state[(state == 0) & (found.band.c_out >= V)] = 1
        state[found.band.c_in >= V] = 2
    colors = ListedColormap([OUTSIDE, FALLS, TUBE, RISES])
    levels = np.geomspace(max(V.max() / 1e3, 0.1), V.max(), MAP_LEVELS)
    return [
        axes.pcolormesh(x, y, state, cmap=colors, vmin=0, vmax=3),
        axes.contour(x, y, V, levels, colors=LEVELS, linewidths=0.5),
    ]


def plot_tube(
    axes: Axes, field: Field, found: Verification, center: FloatArray, half: float
) -> Sequence[Artist]:
    """Draws a window: the sign of V_dot, K = {V <= c_in} with the sets around it, and m."""
    x, y, points = _grid(center, half, ZOOM_PIXELS)
    m = field(points)
    function = found.function
    V = function(points).reshape(len(y), len(x))
    rises = (function.derivative(points, m) >= 0).reshape(V.shape)
    artists: list[Artist] = [
        axes.pcolormesh(x, y, rises, cmap=ListedColormap([FALLS, RISES]), vmin=0, vmax=1)
    ]
    levels = np.geomspace(0.01, max(V.max(), 0.02), MAP_LEVELS)
    artists.append(axes.contour(x, y, V, levels, colors=LEVELS, linewidths=0.6))
    if found.band is not None:
        c_in = found.band.c_in
        artists.append(axes.contourf(x, y, V, [-1, c_in], colors=[TUBE], alpha=0.35))
        artists.append(axes.contour(x, y, V, [c_in], colors=[TUBE], linewidths=1.6))
    _, _, coarse = _grid(center, half, ZOOM_ARROWS)
    arrows = field(coarse)
    artists.append(
        axes.quiver(*coarse.T, *arrows.T, color="#4d5b66", width=0.003, scale=ZOOM_ARROWS)
    )
    return artists


def plot_violations(axes: Axes, violations: Sequence[Violation]) -> Sequence[Artist]:
    """Marks the places that speak against path following, those that count in red."""
    artists: list[Artist] = []
    for violation in violations:
        color = plotting.RED if violation.counts else plotting.GREY
        marker = {"zero": "X", "slow": "v"}.get(violation.kind, "o")
        artists += axes.plot(
            *violation.point, marker, color=color, markersize=7, markeredgecolor="white"
        )
    return artists


def plot_profile(axes: Axes, found: Verification) -> Sequence[Artist]:
    """Draws the outward normal speed of m on the level sets of V: largest and median."""
    samples, function = found.samples, found.function
    V, gradient = function(samples.x), function.gradient(samples.x)
    outward = component_along(gradient, samples.m)
    edges = np.geomspace(PROFILE_FLOOR, V.max(), PROFILE_BINS + 1)
    number = np.digitize(V, edges) - 1
    rows = [
        (
            np.sqrt(edges[k] * edges[k + 1]),
            outward[number == k].max(),
            np.median(outward[number == k]),
        )
        for k in range(PROFILE_BINS)
        if (number == k).any()
    ]
    level, largest, median = np.array(rows).T
    artists: list[Artist] = []
    if found.band is not None:
        band = found.band
        artists.append(
            axes.axvspan(band.c_in, band.c_out, color=FALLS, label="band on which V falls")
        )
    artists += axes.plot(level, median, color=plotting.BLUE, label="median")
    artists += axes.plot(level, largest, color=plotting.RED, label="largest")
    if found.margins is not None:
        margins = found.margins
        artists += axes.plot(
            margins.levels, -margins.e_star, "k.", markersize=4, label="$-e^*$ of a level set"
        )
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(
        xscale="log", xlabel="level of V", ylabel="outward normal speed of m on the level set"
    )
    axes.set_title("flow through the level sets")
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
    return artists


def _grid(
    center: FloatArray, half: float, count: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Returns the axes of a square window, and its points (count^2, 2), y by y."""
    x, y = (np.linspace(middle - half, middle + half, count) for middle in center)
    return x, y, np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _window(field: GuidingField, found: Verification) -> tuple[FloatArray, float]:
    """Returns the middle and half the side of the window: the worst place of the tube."""
    counting = [violation for violation in found.violations if violation.counts]
    if found.band is None or found.margins is None:
        place = counting[0].point if counting else field.cloud.points[0]
        return place, ZOOM_UNITS * field.cloud.unit_length
    place = counting[0].point if counting else found.margins.weakest[0]
    return place, ZOOM_WIDTHS * found.band.tube.half_width


def _handles(found: Verification) -> list[Artist]:
    """Returns the entries of the legend of both maps: what is in them."""
    handles: list[Artist] = []
    if found.band is not None:
        c_in, c_out = found.band.c_in, found.band.c_out
        handles += [
            Patch(color=TUBE, label=f"tube, V <= {c_in:.3g}"),
            Patch(color=FALLS, label=f"band, V <= {c_out:.3g}: V falls"),
        ]
    handles += [
        Patch(color=OUTSIDE, label="V falls, outside of a band"),
        Patch(color=RISES, label="V rises, or falls by less than 0.01 a U"),
        Line2D([], [], color=LEVELS, label="level sets of V"),
    ]
    for counts, color, label in (
        (True, plotting.RED, "violation"),
        (False, plotting.GREY, "the same or m = 0: no claim here"),
    ):
        if any(violation.counts is counts for violation in found.violations):
            handles.append(Line2D([], [], color=color, marker="X", linestyle="", label=label))
    return handles
