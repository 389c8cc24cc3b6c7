"""The figure of a certificate: tubes and walls, what these tolerate, and flights."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.arrays import Box, plane_grid
from sgvf_drake.certificate import Certificate, Levels
from sgvf_drake.certificate.tube import corners
from sgvf_drake.experiments.figures.tracking import FLIGHT_COLORS, color_of
from sgvf_drake.experiments.figures.verification import BELOW, FALLS, LEVELS, TUBE
from sgvf_drake.experiments.velocity_error import FlightMargin
from sgvf_drake.fields import GaussianMixture, GuidingField
from sgvf_drake.lyapunov import LyapunovFunction

# Pixels along each side of the map, and level sets of V in the band.
PIXELS, NUM_LEVELS = 401, 7
# Small enough that a thin tube shows between them, in points.
WAYPOINT_SIZE = 1.5
# Half-side of the window that shows the walls from near, in half-widths of the outermost.
ZOOM_WIDTHS = 2.5
WALL_COLOR = "#4b6a80"

_SETS = [
    Patch(color=FALLS, label="between walls: robots come to the tube"),
    Line2D([], [], color=TUBE, label="the tube: robots follow the path"),
]
_EXCLUDED = plotting.mark("robots may stay here: middle of the set", "x", plotting.RED)
_FENCE = Line2D([], [], color=plotting.RED, linewidth=0.8, label="fence: no robot comes in")
_LEVELS = Line2D([], [], color=LEVELS, linestyle="--", label="level sets of V")


def certificate_figure(
    field: GuidingField, found: Certificate, flights: Sequence[FlightMargin] = ()
) -> Figure:
    """Returns a map of tubes and walls with the field, and what the walls tolerate.

    Where tubes alone are proved, it shows these.  With flights, they are drawn on the map,
    their velocity errors since they came between walls beside e*, and the place where the first
    of them did stands between, from near.

    Args:
        field: In the unit of its waypoints.
        found: What is proved of it.
        flights: In the field, one a piece.
    """
    if any(found.tubes) and not any(found.walls):
        return _tubes_figure(field, found)
    columns = 3 if flights else 2
    figure, axes = plotting.new_figure(1, columns, 6.2 * columns, 6.4)
    _plot_map(axes[0], field, found, field.cloud.box, flights)
    axes[0].set_title(_title(found))
    if flights:
        _plot_map(axes[1], field, found, _entry_window(found, flights[0]), flights)
        axes[1].set_title("where the first flight comes between the walls")
    _plot_margin(axes[-1], field, found, flights)
    return figure


def _title(found: Certificate) -> str:
    if not found.certified or found.area_fraction is None:
        return "certified" if found.certified else "NOT certified"
    return f"certified: robots come from {found.area_fraction:.1%} of the box"


def _tubes_figure(field: GuidingField, found: Certificate) -> Figure:
    """Returns the tubes around the pieces of a path, in the plane or in space."""
    figure = Figure(figsize=(7.0, 7.0), layout="constrained")
    axes = figure.add_subplot(projection="3d" if field.dim == 3 else None)
    points = field.cloud.points
    axes.plot(*points.T, ".", color="black", markersize=3, label="waypoints")
    _plot_tubes(axes, field, found)
    plotting.plane_axes(axes, plotting.UNIT, _title(found))
    if field.dim == 3:
        axes.set(zlabel=f"z [{plotting.UNIT}]")
    axes.legend()
    return figure


def _plot_tubes(axes: Axes, field: GuidingField, found: Certificate) -> None:
    label: str | None = "borders of the tubes"
    for tube in filter(None, found.tubes):
        for line in np.moveaxis(corners(tube.rows), 1, 0):
            x = field.cloud.denormalize(line)
            axes.plot(*x.T, color=TUBE, linewidth=0.8, label=label)
            label = None


def _plot_map(
    axes: Axes,
    field: GuidingField,
    found: Certificate,
    box: Box,
    flights: Sequence[FlightMargin],
) -> None:
    handles = list(_SETS)
    plotting.plot_field(axes, field, box)
    _plot_walls(axes, field, found)
    _plot_tubes(axes, field, found)
    if found.levels is not None:
        _plot_levels(axes, field, found.levels, box)
        handles.append(_LEVELS)
    for dots in plotting.plot_waypoints(axes, field.cloud.points):
        dots.set(markersize=WAYPOINT_SIZE)
    for flight in flights:
        x, y = flight.positions.T
        axes.plot(x, y, color=color_of(flight), linewidth=1.2)
        axes.plot(x[0], y[0], "o", color=color_of(flight), markersize=5)
    if found.excluded:
        x, y = np.transpose([one.center for one in found.excluded])
        axes.plot(x, y, "x", color=plotting.RED, markersize=7)
        handles.append(_EXCLUDED)
    if found.fences:
        for fence in found.fences:
            x = field.cloud.denormalize(fence.vertices)
            axes.fill(*x.T, fill=False, edgecolor=plotting.RED, linewidth=0.8)
        handles.append(_FENCE)
    if found.counterexample is not None:
        axes.plot(*found.counterexample, "X", color=plotting.RED, markersize=9)
    plotting.plane_axes(axes, plotting.UNIT)
    axes.set(xlim=(box[0][0], box[1][0]), ylim=(box[0][1], box[1][1]))
    if any(found.walls):
        axes.legend(handles=handles, **(BELOW | {"ncols": 1}))


def _plot_walls(axes: Axes, field: GuidingField, found: Certificate) -> None:
    for walls in filter(None, found.walls):
        left, right = (field.cloud.denormalize(walls.polygons(side)) for side in (1, -1))
        # The one backwards, so that it is the hole of the other.
        between = Path.make_compound_path(
            Path(left[-1], closed=False), Path(right[-1][::-1], closed=False)
        )
        axes.add_patch(PathPatch(between, facecolor=FALLS, edgecolor="none", alpha=0.7))
        for wall in (*left, *right):
            axes.fill(*wall.T, fill=False, edgecolor=WALL_COLOR, linewidth=0.5)


def _plot_levels(axes: Axes, field: GuidingField, levels: Levels, box: Box) -> None:
    function = LyapunovFunction(GaussianMixture(field.mixture.points, levels.sigma))
    x, y, points = plane_grid(box, PIXELS)
    shown = np.geomspace(levels.conditions.c_in, levels.conditions.c_out, NUM_LEVELS)
    V = function(points).reshape(PIXELS, PIXELS)
    axes.contour(x, y, V, shown, colors=[LEVELS], linewidths=0.6, linestyles="--")


def _entry_window(found: Certificate, flight: FlightMargin) -> Box:
    """Returns the corners of a square about where a flight settles, or ends."""
    row = int(np.argmax(flight.settled)) if flight.settled.any() else -1
    middle = flight.positions[row]
    half = ZOOM_WIDTHS * max(max(piece.wall_half_widths, default=0) for piece in found.pieces)
    return middle - half, middle + half


def _plot_margin(
    axes: Axes, field: GuidingField, found: Certificate, flights: Sequence[FlightMargin]
) -> None:
    """Draws e* of the pairs of walls over their half-widths, and the errors of flights."""
    unit = field.cloud.unit_length
    axes.set(xlabel="largest distance of the walls from the orbit, in U")
    axes.set(ylabel="disturbance, part of the speed")
    axes.set_title("disturbance that walls tolerate, at least")
    axes.grid(alpha=0.3)
    if not any(found.walls):
        axes.text(0.5, 0.5, "nothing is proved", ha="center", transform=axes.transAxes)
        return
    for number, piece in enumerate(found.pieces):
        axes.plot(
            np.array(piece.wall_half_widths) / unit,
            piece.e_star,
            "o-",
            color=FLIGHT_COLORS[number % len(FLIGHT_COLORS)],
            label=f"tolerated, e* of piece {number + 1}",
        )
    for flight in flights:
        widths = [pair.half_width / flight.certified.scale / unit for pair in flight.walls]
        axes.plot(
            widths,
            [pair.error_max for pair in flight.walls],
            "x--",
            color=color_of(flight),
            label=f"error of flight {flight.piece + 1}, largest since it was between them",
        )
    axes.set(xlim=(0, None), ylim=(0, None))
    axes.legend(**(BELOW | {"ncols": 1}))
