"""The figures of a verification: where V falls on samples, and Theorem 1 along trajectories."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray, box_grid, plane_grid
from sgvf_drake.clouds.point_cloud import BOX_FACTOR
from sgvf_drake.experiments.theorem import DecreaseCheck, LevelSetCheck, ModeCheck
from sgvf_drake.fields import GuidingField
from sgvf_drake.fields.vectors import component_along
from sgvf_drake.lyapunov import (
    MIN_DECREASE,
    Samples,
    Verification,
    Violation,
    robustness_bounds,
)
from sgvf_drake.lyapunov.conditions import NEARLY as BOUND_NEARLY

# The states of a point of the map: outside of the band and V falls, in the band, in the tube,
# and V does not fall.
OUTSIDE, FALLS, TUBE, RISES = "#eef1f3", "#c3dbec", plotting.GREEN, "#f2a27e"
LEVELS = "#8fa9bb"
# Of the map of the bounds: none fails, the first, the third, both.
BOUNDS = {
    "all three hold": OUTSIDE,
    "printed bound fails": plotting.ORANGE,
    "bound with the true gradient missed by over 1 %": plotting.BLUE,
    "both": plotting.RED,
}
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
# Of a section in space: points along its sides, and waypoints that tell which way is across.
MAP_SIZE, NEAREST = 151, 8
# How large a view of space is, so that the names of its axes are on the figure.
ZOOM = 0.85
# Levels of V that are drawn on the map, and bins of the profile.
MAP_LEVELS = 10
PROFILE_BINS = 60
# Below this V the profile is that of the path itself, where V has nowhere to fall.
PROFILE_FLOOR = 1e-3
# Trajectories of V that are drawn: an even selection of many.
MAX_LINES = 150
# The way in is drawn up to this many times the last entry.
SHOWN_ENTRIES = 2.5
# V goes through zero on the modes; it is drawn down to this part of the band's lower end.
SHOWN_BELOW = 0.02
LEVEL_COLORS = (plotting.BLUE, plotting.ORANGE, plotting.GREEN, plotting.RED)


@dataclass(frozen=True, eq=False)
class Section:
    """A plane in which a figure is drawn, cut out of space; of the plane, it is all of it.

    Attributes:
        origin: (d,) where its coordinates are zero.
        directions: (2, d) its axes, of length one and orthogonal.
        names: The names of the two.
    """

    origin: FloatArray
    directions: FloatArray
    names: tuple[str, str]

    def points(self, flat: FloatArray) -> FloatArray:
        """Returns the points with given coordinates, (n, 2) -> (n, d)."""
        return self.origin + flat @ self.directions

    def coordinates(self, x: FloatArray) -> FloatArray:
        """Returns the coordinates of the nearest points of the section, (n, d) -> (n, 2)."""
        return (x - self.origin) @ self.directions.T

    def samples(self, field: GuidingField, found: Verification) -> Samples:
        """Returns a field on a grid over the section, as far around the cloud as its box is."""
        if field.dim == 2:
            return found.samples
        corner = np.full(2, BOX_FACTOR * np.abs(self.coordinates(field.cloud.points)).max())
        axes, grid = box_grid((-corner, corner), MAP_SIZE)
        x = self.points(grid)
        return Samples(axes, x, *field.components(x))


def _sections(field: GuidingField) -> Sequence[Section]:
    """Returns the plane, or in space two sections along the principal axes of the cloud."""
    if field.dim == 2:
        return [Section(np.zeros(2), np.eye(2), ("x", "y"))]
    middle, axes = _principal(field.cloud.points)
    names = ("long axis of the cloud", "middle axis", "short axis")
    return [Section(middle, axes[[i, j]], (names[i], names[j])) for i, j in ((0, 1), (0, 2))]


def _section_across(field: GuidingField, point: FloatArray) -> Section:
    """Returns the plane, or in space the section through a point across the path near to it."""
    if field.dim == 2:
        return _sections(field)[0]
    points = field.mixture.points
    near = np.argsort(np.linalg.norm(points - point, axis=1))[:NEAREST]
    axes = _principal(points[near])[1]
    return Section(point, axes[1:], ("one way across the path", "the other way across"))


def _principal(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Returns the middle of points (n, d), and their principal axes (d, d), longest first."""
    middle = points.mean(axis=0)
    return middle, np.linalg.svd(points - middle, full_matrices=False)[2]


def verification_figure(field: GuidingField, found: Verification) -> Figure:
    """Returns maps of V_dot and the bounds, the tube from near, and the flow by level of V.

    In space there are two maps, of sections along the axes of the cloud, beside a view of it.
    """
    sections = _sections(field)
    extra = len(sections) - 1
    figure, axes = plotting.new_figure(2, 2 + extra, 12.5 + 6.5 * extra, 11.5)
    *maps, near, profile, bounds = axes[extra:]
    title = "holds" if found.holds else "does NOT hold"
    if extra:
        axes[0].remove()
        view = figure.add_subplot(2, 2 + extra, 1, projection="3d")
        _draw_view(view, field, found)
        plotting.plane_axes(view, plotting.UNIT, f"where V does not fall (sampled): {title}")
        view.set(zlabel=f"z [{plotting.UNIT}]")
        # Names of axes in space are no part of the layout.
        view.set_box_aspect(None, zoom=ZOOM)
    samples = [section.samples(field, found) for section in sections]
    for panel, section, on_section in zip(maps, sections, samples, strict=True):
        _draw_decrease(panel, field, found, section, on_section)
        text = f"where V falls along m (sampled): {title}"
        plotting.plane_axes(panel, plotting.UNIT, text, section.names)
    names = _draw_tube(near, field, found)
    place = "the weakest place of the tube" if found.holds else "the first violation"
    plotting.plane_axes(near, plotting.UNIT, f"{place} from near, and m", names)
    _draw_profile(profile, found)
    _draw_bounds(bounds, found, samples[0])
    title = "where the bounds on the paper's V_dot and the true one hold"
    plotting.plane_axes(bounds, plotting.UNIT, title, sections[0].names)
    maps[0].legend(handles=_handles(found), **BELOW)
    return figure


def _draw_view(axes: Any, field: GuidingField, found: Verification) -> None:
    """Draws the waypoints in space, where V does not fall on the grid, and what is found."""
    samples = found.samples
    x, m = samples.x[samples.on_grid], samples.m[samples.on_grid]
    V, V_dot = found.function(x), found.function.derivative(x, m)
    rises = V_dot > -MIN_DECREASE / field.cloud.unit_length
    if found.band is not None:
        rises &= found.band.c_in < V
    axes.plot(*x[rises].T, "s", color=RISES, markersize=3)
    axes.plot(*field.cloud.points.T, ".", color="black", markersize=2)
    _mark(axes, found.violations)


def _mark(axes: Axes, violations: Sequence[Violation], section: Section | None = None) -> None:
    """Marks violations where they are, or on a section."""
    for violation in violations:
        color = plotting.RED if violation.counts else plotting.GREY
        marker = {"zero": "X", "slow": "v"}.get(violation.kind, "o")
        at = violation.point if section is None else section.coordinates(violation.point)
        (mark,) = axes.plot(*at[:, None], marker, color=color)
        mark.set(markersize=7, markeredgecolor="white")


def _draw_decrease(
    axes: Axes, field: GuidingField, found: Verification, section: Section, samples: Samples
) -> None:
    """Draws over the box where V falls and where not, the band, and what speaks against it."""
    function = found.function
    x, y = samples.axes
    V = samples.as_grid(function(samples.x))
    V_dot = samples.as_grid(function.derivative(samples.x, samples.m))
    state = np.where(V_dot > -MIN_DECREASE / field.cloud.unit_length, 3, 0)
    if found.band is not None:
        state[(state == 0) & (found.band.c_out >= V)] = 1
        state[found.band.c_in >= V] = 2
    colors = ListedColormap([OUTSIDE, FALLS, TUBE, RISES])
    axes.pcolormesh(x, y, state, cmap=colors, vmin=0, vmax=3)
    levels = np.geomspace(max(V.max() / 1e3, 0.1), V.max(), MAP_LEVELS)
    axes.contour(x, y, V, levels, colors=LEVELS, linewidths=0.5)
    plotting.plot_waypoints(axes, section.coordinates(field.cloud.points))
    _mark(axes, found.violations, section)


def _draw_tube(axes: Axes, field: GuidingField, found: Verification) -> tuple[str, str]:
    """Draws the worst place of the tube: the sign of V_dot, {V <= c_in}, level sets, and m.

    Returns the names of the axes.
    """
    counting = [violation.point for violation in found.violations if violation.counts]
    if found.band is None or found.margins is None:
        center = counting[0] if counting else field.cloud.points[0]
        half = ZOOM_UNITS * field.cloud.unit_length
    else:
        center = counting[0] if counting else found.margins.weakest[0]
        half = ZOOM_WIDTHS * found.band.tube.half_width
    section = _section_across(field, center)
    middle = section.coordinates(center)
    window = (middle - half, middle + half)
    x, y, flat = plane_grid(window, ZOOM_PIXELS)
    points = section.points(flat)
    V = found.function(points).reshape(len(y), len(x))
    rises = (found.function.along(field, points) >= 0).reshape(V.shape)
    axes.pcolormesh(x, y, rises, cmap=ListedColormap([FALLS, RISES]), vmin=0, vmax=1)
    levels = np.geomspace(0.01, max(V.max(), 0.02), MAP_LEVELS)
    axes.contour(x, y, V, levels, colors=LEVELS, linewidths=0.6)
    if found.band is not None:
        axes.contourf(x, y, V, [-1, found.band.c_in], colors=[TUBE], alpha=0.35)
        axes.contour(x, y, V, [found.band.c_in], colors=[TUBE], linewidths=1.6)
    _, _, coarse = plane_grid(window, ZOOM_ARROWS)
    arrows = field(section.points(coarse)) @ section.directions.T
    axes.quiver(*coarse.T, *arrows.T, color="#4d5b66", width=0.003, scale=ZOOM_ARROWS)
    waypoints = section.coordinates(field.cloud.points)
    off = np.linalg.norm(section.points(waypoints) - field.cloud.points, axis=1)
    plotting.plot_waypoints(axes, waypoints[off <= half])
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]))
    return section.names


def _draw_profile(axes: Axes, found: Verification) -> None:
    """Draws the outward normal speed of m on the level sets of V: largest and median."""
    V, gradient = found.function.value_and_gradient(found.samples.x)
    outward = component_along(gradient, found.samples.m)
    edges = np.geomspace(PROFILE_FLOOR, V.max(), PROFILE_BINS + 1)
    number = np.digitize(V, edges) - 1
    bins = np.intersect1d(number, np.arange(PROFILE_BINS))
    level = np.sqrt(edges[bins] * edges[bins + 1])
    if found.band is not None:
        band = (found.band.c_in, found.band.c_out)
        axes.axvspan(*band, color=FALLS, label="band on which V falls")
    median, largest = np.array(
        [(np.median(outward[number == k]), outward[number == k].max()) for k in bins]
    ).T
    axes.plot(level, median, color=plotting.BLUE, label="median")
    axes.plot(level, largest, color=plotting.RED, label="largest")
    if found.margins is not None:
        levels, e_star = found.margins.levels, found.margins.e_star
        axes.plot(levels, -e_star, "k.", markersize=4, label="$-e^*$ of a level set")
    axes.axhline(0, color="black", linewidth=0.8)
    axes.set(
        xscale="log",
        xlabel="level of V",
        ylabel="outward normal speed of m on the level set",
        title="flow through the level sets",
    )
    axes.grid(alpha=0.3)
    axes.legend(loc="best")


def _draw_bounds(axes: Axes, found: Verification, samples: Samples) -> None:
    """Draws where the printed bound fails, and where the one with the true gradient is missed.

    The bound with the squashed score always holds.
    """
    own = samples is found.samples
    paper, _, gradient = found.bounds if own else robustness_bounds(found.function, samples)
    state = samples.as_grid(~paper.holds + 2 * (gradient.excess > BOUND_NEARLY))
    colors = ListedColormap(list(BOUNDS.values()))
    axes.pcolormesh(*samples.axes, state, cmap=colors, vmin=0, vmax=3)
    handles = [Patch(color=color, label=label) for label, color in BOUNDS.items()]
    axes.legend(handles=handles, **BELOW)


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


def theorem_figure(
    decrease: DecreaseCheck, level_sets: LevelSetCheck, modes: ModeCheck
) -> Figure:
    """Returns one panel for each part of Theorem 1.

    They show V along x_dot = m, with the band through which it should fall; V along
    x_dot = v alone, with the levels that it should keep; and |m| on the modes.
    """
    figure, axes = plotting.new_figure(1, 3, 15, 4.8)
    _draw_falling(axes[0], decrease)
    _draw_level_sets(axes[1], level_sets)
    _draw_modes(axes[2], modes)
    for panel in axes:
        panel.grid(alpha=0.3)
    return figure


def _draw_falling(axes: Axes, check: DecreaseCheck) -> None:
    run, (c_in, c_out) = check.run, check.band
    entered = np.isfinite(check.entry_times)
    label = f"band, {c_in:.3g} to {c_out:.3g}"
    axes.axhspan(c_in, c_out, color=plotting.ORANGE, alpha=0.2, label=label)
    for chosen, color, label in (
        (entered, plotting.BLUE, "agent"),
        (~entered, plotting.RED, "did not get below it"),
    ):
        agents = np.flatnonzero(chosen)
        if len(agents) > MAX_LINES:
            agents = agents[np.linspace(0, len(agents) - 1, MAX_LINES).astype(int)]
        lines = axes.plot(run.times, run.V[:, agents], color=color, linewidth=0.6, alpha=0.5)
        for line in lines[:1]:
            line.set_label(label)
    if run.exit is not None:
        (marker,) = axes.plot(run.exit.time, run.exit.V, "X", color=plotting.RED, clip_on=False)
        marker.set(markersize=9, label="left it, which ends the run")
    end = run.times[-1]
    if entered.all():
        end = min(end, SHOWN_ENTRIES * max(check.entry_times.max(), run.times[1]))
    axes.set(
        xlabel="time at unit speed",
        ylabel="V",
        yscale="log",
        xlim=(0, end),
        ylim=(SHOWN_BELOW * c_in, 2 * c_out),
        title=f"(i) along m: {entered.sum()} of {len(entered)} fall through the band",
    )
    axes.legend(loc="upper right")


def _draw_level_sets(axes: Axes, check: LevelSetCheck) -> None:
    drifts = check.drift.max(axis=1) / check.levels
    for number, (level, run) in enumerate(zip(check.levels, check.runs, strict=True)):
        color, drift = LEVEL_COLORS[number % len(LEVEL_COLORS)], drifts[number]
        axes.axhline(level, color=color, linestyle="--", linewidth=1.2)
        axes.plot(run.times, run.V, color=color, linewidth=0.6, alpha=0.6)
        text = f"{drift:.0%}" if drift < 10 else f"{drift:.0f}-fold"
        axes.annotate(text, (1.01, level), xycoords=("axes fraction", "data"), color=color)
    axes.set(
        xlabel="time",
        ylabel="V",
        yscale="log",
        xlim=(0, check.runs[0].times[-1]),
        title="(ii) along v alone: levels to keep, and largest drift",
    )


def _draw_modes(axes: Axes, check: ModeCheck) -> None:
    order = np.argsort(check.speeds)
    share = 100 * (np.arange(len(order)) + 0.5) / len(order)
    speeds, at = check.speeds[order], np.flatnonzero(order == check.V.argmin())[:1]
    axes.axhline(1.0, color=plotting.GREY, linestyle="--", label="unit length")
    axes.plot(share, speeds, ".", color=plotting.BLUE, label="mode")
    (star,) = axes.plot(share[at], speeds[at], "*", color=plotting.RED, label="global mode")
    star.set(markersize=12)
    axes.set(
        xlabel="share of the modes [%]",
        ylabel="|m|",
        ylim=(0, 1.1 * max(1.0, check.speeds.max())),
        title=f"(iii) speed on the {len(order)} modes",
    )
    axes.legend(loc="lower right")
