"""The figure of a certificate: the set, the tube, what the levels tolerate, and flights."""

from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np
from scipy import ndimage

from sgvf_drake import plotting
from sgvf_drake.arrays import Box, FloatArray, plane_grid
from sgvf_drake.certificate import Certificate, Part
from sgvf_drake.certificate.tube import corners
from sgvf_drake.experiments.figures.tracking import LOWEST_V, color_of, draw_errors
from sgvf_drake.experiments.figures.verification import BELOW, FALLS, LEVELS, TUBE
from sgvf_drake.experiments.velocity_error import FlightMargin
from sgvf_drake.fields import GaussianMixture, GuidingField
from sgvf_drake.lyapunov import LyapunovFunction

# Pixels along each side of the map, and level sets of V in the band.
PIXELS, NUM_LEVELS = 401, 7
# Small enough that a thin tube shows between them, in points.
WAYPOINT_SIZE = 1.5
# Half-side of the window that shows the tube from near, in half-widths of the tube.
ZOOM_WIDTHS = 4.0
PART_ALPHA = 0.4

_SETS = [
    Patch(color=FALLS, label="every robot from here enters the tube"),
    Patch(color=FALLS, alpha=PART_ALPHA, label="and from here, on higher levels"),
    Patch(color=TUBE, label="the tube, with a closed orbit around each hole"),
    Line2D([], [], color=LEVELS, label="level sets of V"),
]


def certificate_figure(
    field: GuidingField, found: Certificate, flights: Sequence[FlightMargin] = ()
) -> Figure:
    """Returns a map of the certified set with the field, and e* over the levels.

    Where tubes alone are proved, it shows these.  With flights, they are drawn on the map,
    their velocity errors over V beside e*, and the place where the first of them enters the
    tube stands between, from near.

    Args:
        field: In the unit of its waypoints.
        found: What is proved of it.
        flights: In the field, one a piece.
    """
    if found.conditions is None and found.tubes:
        return _tubes_figure(field, found)
    columns = 3 if flights and found.sigma is not None else 2
    figure, axes = plotting.new_figure(1, columns, 6.2 * columns, 6.4)
    _plot_map(axes[0], field, found, field.cloud.box, flights)
    axes[0].set_title("certified" if found.certified else "NOT certified")
    if columns == 3:
        _plot_map(axes[1], field, found, _entry_window(found, flights), flights)
        axes[1].set_title("where the first flight enters the tube")
    _plot_margin(axes[-1], found, flights)
    return figure


def _tubes_figure(field: GuidingField, found: Certificate) -> Figure:
    """Returns the tubes around the pieces of a path, in the plane or in space."""
    figure = Figure(figsize=(7.0, 7.0), layout="constrained")
    axes = figure.add_subplot(projection="3d" if field.dim == 3 else None)
    points = field.cloud.points
    axes.plot(*points.T, ".", color="black", markersize=3, label="waypoints")
    for number, tube in enumerate(found.tubes):
        if tube is None:
            continue
        label = None if number else "walls of the tubes"
        for k, wall in enumerate(np.moveaxis(corners(tube.rows), 1, 0)):
            axes.plot(
                *field.cloud.denormalize(wall).T,
                color=TUBE,
                linewidth=0.8,
                label=None if k else label,
            )
    title = "certified" if found.certified else "NOT certified"
    plotting.plane_axes(axes, plotting.UNIT, title)
    if field.dim == 3:
        axes.set(zlabel=f"z [{plotting.UNIT}]")
    axes.legend()
    return figure


def _plot_map(
    axes: Axes,
    field: GuidingField,
    found: Certificate,
    box: Box,
    flights: Sequence[FlightMargin],
) -> None:
    plotting.plot_field(axes, field, box)
    if found.sigma is not None:
        _plot_sets(axes, field, found, box)
        axes.legend(handles=_SETS, **(BELOW | {"ncols": 1}))
    for dots in plotting.plot_waypoints(axes, field.cloud.points):
        dots.set(markersize=WAYPOINT_SIZE)
    for flight in flights:
        x, y = flight.positions.T
        axes.plot(x, y, color=color_of(flight), linewidth=1.2)
        axes.plot(x[0], y[0], "o", color=color_of(flight), markersize=5)
    if found.counterexample is not None:
        axes.plot(*found.counterexample, "X", color=plotting.RED, markersize=9)
    plotting.plane_axes(axes, plotting.UNIT)
    axes.set(xlim=(box[0][0], box[1][0]), ylim=(box[0][1], box[1][1]))


def _plot_sets(axes: Axes, field: GuidingField, found: Certificate, box: Box) -> None:
    assert found.conditions is not None
    assert found.sigma is not None
    c_in, c_out = found.conditions.c_in, found.conditions.c_out
    function = LyapunovFunction(GaussianMixture(field.mixture.points, found.sigma))
    x, y, points = plane_grid(box, PIXELS)
    V = function(points).reshape(PIXELS, PIXELS)
    axes.contourf(x, y, V, [c_in, c_out], colors=[FALLS], alpha=0.7)
    axes.contourf(x, y, V, [-1, c_in], colors=[TUBE], alpha=0.8)
    # On the map a tube may be thinner than a pixel.
    axes.contour(x, y, V, [c_in], colors=[TUBE], linewidths=1.0)
    levels = np.geomspace(c_in, c_out, NUM_LEVELS)
    axes.contour(x, y, V, levels, colors=[LEVELS], linewidths=0.6)
    for part in found.parts:
        _plot_part(axes, part, (x, y, V), c_out)


def _plot_part(
    axes: Axes, part: Part, raster: tuple[FloatArray, FloatArray, FloatArray], c_out: float
) -> None:
    """Draws the component of {c_out <= V <= level} that is proved, if its point is in sight."""
    x, y, V = raster
    labels, _ = ndimage.label((c_out <= V) & (part.level >= V))
    row, column = (
        int(np.abs(a - b).argmin()) for a, b in ((y, part.point[1]), (x, part.point[0]))
    )
    if labels[row, column]:
        inside = np.where(labels == labels[row, column], V, np.nan)
        axes.contourf(x, y, inside, [c_out, part.level], colors=[FALLS], alpha=PART_ALPHA)


def _entry_window(found: Certificate, flights: Sequence[FlightMargin]) -> Box:
    """Returns the corners of a square about where the first flight settles, or ends."""
    assert found.tube_half_width is not None
    first = flights[0]
    row = int(np.argmax(first.settled)) if first.settled.any() else -1
    middle = first.positions[row]
    half = ZOOM_WIDTHS * found.tube_half_width
    return middle - half, middle + half


def _plot_margin(axes: Axes, found: Certificate, flights: Sequence[FlightMargin]) -> None:
    axes.set(xlabel="level of V", ylabel="disturbance, part of the speed")
    axes.set_title("disturbance that a level set tolerates, at least")
    axes.grid(alpha=0.3)
    if not found.e_star:
        axes.text(0.5, 0.5, "nothing is proved", ha="center", transform=axes.transAxes)
        return
    levels, e_star = np.array(found.levels), np.array(found.e_star)
    axes.stairs(e_star, levels, color="black", linewidth=1.5, label="tolerated, e*")
    axes.set(xscale="log", ylim=(0, None))
    if flights:
        _plot_errors(axes, levels, e_star, flights)


def _plot_errors(
    axes: Axes, levels: FloatArray, e_star: FloatArray, flights: Sequence[FlightMargin]
) -> None:
    """Draws the errors of flights over V beside what is tolerated."""
    c_in, lowest = levels[0], LOWEST_V * levels[0]
    axes.stairs(e_star, levels, fill=True, color="black", alpha=0.1)
    axes.fill_between([lowest, c_in], e_star[0], color=TUBE, alpha=0.2)
    axes.hlines(
        e_star[0], lowest, c_in, color="black", linestyle="--", label="e* of the tube's border"
    )
    draw_errors(axes, flights, c_in, levels[-1])
    levels_of_flights = [flight.covering_level for flight in flights]
    covering = [level for level in levels_of_flights if level is not None]
    if len(covering) == len(flights):
        axes.axvline(
            max(covering),
            color="black",
            linestyle=":",
            linewidth=1,
            label="the first level that tolerates all errors in the tube",
        )
    axes.set(xlabel="V (in the green part inside the tube)", title="velocity error against e*")
    axes.legend(**BELOW)
