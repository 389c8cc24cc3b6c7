"""The figures of the singularities of a field: where they are, and the density around them."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray, plane_grid
from sgvf_drake.fields import GuidingField, ScoreField, TangentField
from sgvf_drake.lyapunov import FieldZeros, Singularities, Zero

# Marker, face and edge of each kind of zero: up what repels, down what attracts.
MARKS = {
    "source": ("^", plotting.ORANGE, "black"),
    "sink": ("v", plotting.GREEN, "black"),
    "saddle": ("X", plotting.RED, "white"),
    "unstable focus": ("o", "white", plotting.BLUE),
    "stable focus": ("o", plotting.BLUE, "white"),
    "centre": ("s", plotting.GREY, "white"),
    "degenerate": ("P", "#CC79A7", "black"),
}
# The zeros of the score and of m, where both are drawn.
SCORE_MARK = ("o", "white", "black")
GUIDING_MARK = ("X", plotting.RED, "white")
# Of more zeros than this, markers are drawn smaller; their sizes, in square points.
FEW_ZEROS = 60
LARGE, SMALL = 64.0, 20.0
# How large a drawing in space is, so that the names of its axes are on the figure.
ZOOM = 0.78
# Points along each axis of the map and of the surface of the log-density.
MAP_SIZE, SURFACE_SIZE = 301, 161
# Both end at this percentile of the box, since the density falls for ever.
FLOOR_PERCENTILE = 25.0
# From where the surface is seen, in degrees, and its height over its sides: high and flat, so
# that the zeros between two ridges show.
ELEVATION, AZIMUTH = 62.0, -60.0
PROPORTIONS = (1.0, 1.0, 0.4)


def singularity_figure(field: GuidingField, found: Singularities) -> Figure:
    """Returns m, the score and the tangent as stream lines, each with its zeros."""
    figure, axes = plotting.new_figure(1, 3, 16.5, 6.2)
    fields = {
        "guiding field m": (field, found.guiding),
        "score S": (ScoreField(field), found.score),
        "tangent field v": (TangentField(field), found.tangent),
    }
    marks: dict[str, Artist] = {}
    for panel, (name, (part, zeros)) in zip(axes, fields.items(), strict=True):
        plotting.plot_field(panel, part, found.box)
        marks["waypoints"] = plotting.plot_waypoints(panel, field.cloud.points)[0]
        marks |= plot_zeros(panel, zeros)
        plotting.plane_axes(panel, plotting.UNIT, _title(name, zeros))
    _legend(figure, marks)
    return figure


def spatial_figure(field: GuidingField, found: Singularities) -> Figure:
    """Returns the zeros of m, of the score and of the tangent in space, with the waypoints."""
    figure = Figure(figsize=(16.5, 6.2), layout="constrained")
    names = ("guiding field m", "score S", "tangent field v")
    marks: dict[str, Artist] = {}
    for number, (name, zeros) in enumerate(
        zip(names, found.by_field.values(), strict=True), start=1
    ):
        panel = figure.add_subplot(1, 3, number, projection="3d")
        (marks["waypoints"],) = panel.plot(*field.cloud.points.T, ".", color="black", ms=2)
        marks |= plot_zeros(panel, zeros)
        plotting.plane_axes(panel, plotting.UNIT, _title(name, zeros))
        panel.set(zlabel=f"z [{plotting.UNIT}]")
        # Names of axes in space are no part of the layout.
        panel.set_box_aspect(None, zoom=ZOOM)
    _legend(figure, marks)
    return figure


def log_density_figure(field: GuidingField, found: Singularities) -> Figure:
    """Returns the log-density as a map and as a surface, with the zeros (paper, Fig. 5)."""
    figure = Figure(figsize=(14, 6.2), layout="constrained")
    marks = plot_density_map(figure.add_subplot(1, 2, 1), field, found)[-2:]
    plot_density_surface(figure.add_subplot(1, 2, 2, projection="3d"), field, found)
    score, guiding = (len(zeros.zeros) for zeros in (found.score, found.guiding))
    names = [f"zeros of S ({score})", f"zeros of m ({guiding})"]
    plotting.legend_below(figure, marks, names)
    return figure


def plot_zeros(axes: Axes, zeros: FieldZeros) -> dict[str, Artist]:
    """Draws zeros, each with the mark of its kind; returns the artists by the kinds."""
    names = [_name(zero) for zero in zeros.zeros]
    size = LARGE if len(names) <= FEW_ZEROS else SMALL
    return {
        name: _scatter(axes, zeros.points[[other == name for other in names]], mark, size)
        for name, mark in MARKS.items()
        if name in names
    }


def plot_density_map(axes: Axes, field: GuidingField, found: Singularities) -> Sequence[Artist]:
    """Draws the log-density from above, with the zeros of the score and of m."""
    (x, y), values, _ = _density(field, found, MAP_SIZE)
    image = axes.pcolormesh(x, y, values, cmap="viridis", shading="gouraud")
    axes.figure.colorbar(
        image, ax=axes, label="log p, 0 at its largest", extend="min", shrink=0.8
    )
    plotting.plane_axes(axes, plotting.UNIT, "log-density from above")
    return [image, *_mark_both(axes, found.score.points, found.guiding.points)]


def plot_density_surface(
    axes: Any, field: GuidingField, found: Singularities
) -> Sequence[Artist]:
    """Draws the log-density as a surface in 3-D axes, with the zeros of the score and of m."""
    (x, y), values, largest = _density(field, found, SURFACE_SIZE)
    # Marks are drawn last, or the surface would hide them in parts.
    axes.computed_zorder = False
    artists = [
        axes.plot_surface(
            *np.meshgrid(x, y),
            values,
            cmap="viridis",
            rcount=SURFACE_SIZE,
            ccount=SURFACE_SIZE,
            linewidth=0,
            antialiased=False,
        )
    ]
    raised = []
    for zeros in (found.score, found.guiding):
        height = field.mixture.log_density(zeros.points) - largest
        raised.append(np.column_stack([zeros.points, np.maximum(height, values.min())]))
    artists += _mark_both(axes, *raised)
    axes.view_init(ELEVATION, AZIMUTH)
    axes.set_box_aspect(PROPORTIONS, zoom=1.1)
    axes.set(
        xlabel=f"x [{plotting.UNIT}]",
        ylabel=f"y [{plotting.UNIT}]",
        title="log-density as a surface",
    )
    # The colour bar of the map tells the height better than an axis seen from above.
    axes.set_zticks([])
    return artists


def _density(
    field: GuidingField, found: Singularities, size: int
) -> tuple[tuple[FloatArray, FloatArray], FloatArray, float]:
    """Returns coordinates, log p less its largest value (size, size), and that value.

    The values are cut off at `FLOOR_PERCENTILE`.
    """
    x, y, grid = plane_grid(found.box, size)
    values = field.mixture.log_density(grid).reshape(size, size)
    largest = float(values.max())
    floor = np.percentile(values, FLOOR_PERCENTILE)
    return (x, y), np.maximum(values, floor) - largest, largest


def _mark_both(axes: Any, score: FloatArray, guiding: FloatArray) -> list[Artist]:
    """Marks the zeros of the score and of m, (k, 2), or (k, 3) on a surface."""
    size = 2 * LARGE if len(score) <= FEW_ZEROS else SMALL
    return [
        _scatter(axes, score, SCORE_MARK, size),
        # Small enough to leave a rim of the other, where both are.
        _scatter(axes, guiding, GUIDING_MARK, LARGE),
    ]


def _scatter(axes: Any, points: FloatArray, mark: tuple[str, str, str], size: float) -> Artist:
    """Draws points (k, 2) or (k, 3) with a marker, its face and its edge."""
    marker, face, edge = mark
    # What lies farther away on a surface is no less of a zero.
    flat = {"depthshade": False} if points.shape[1] == 3 else {}
    artist: Artist = axes.scatter(
        *points.T, s=size, marker=marker, color=face, edgecolor=edge, zorder=3, **flat
    )
    return artist


def _name(zero: Zero) -> str:
    if zero.kind != "focus":
        return zero.kind
    return "stable focus" if zero.stable else "unstable focus"


def _title(name: str, zeros: FieldZeros) -> str:
    count = "1 zero" if len(zeros.zeros) == 1 else f"{len(zeros.zeros)} zeros"
    return f"{name}: {count}, sum of indices {zeros.index_sum}"


def _legend(figure: Figure, marks: Mapping[str, Artist]) -> None:
    shown = [name for name in ("waypoints", *MARKS) if name in marks]
    plotting.legend_below(figure, [marks[name] for name in shown], shown, 8)
