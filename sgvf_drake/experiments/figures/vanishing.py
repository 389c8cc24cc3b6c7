"""The figures of score vanishing: its zeros, the density, and a field without singularity."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.figure import Figure
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray
from sgvf_drake.experiments.figures.singularities import (
    MARKS,
    UNIT,
    plot_density_map,
    plot_density_surface,
    plot_zeros,
)
from sgvf_drake.fields import GuidingField, ParametricField, ScoreField
from sgvf_drake.lyapunov import find_singularities

# Points of a helix.
HELIX = 400
# From where the helices are seen, in degrees.
ELEVATION, AZIMUTH = 22.0, -58.0
# The colours of the pieces.
PIECES = (plotting.BLUE, plotting.RED, plotting.GREEN)
# The sign of an index, its colour, its marker, and what it is.
INDICES = (
    (1, plotting.BLUE, "o", "index 1: source, sink or focus"),
    (-1, plotting.RED, "x", "index -1: saddle"),
)


def vanishing_figure(
    field: GuidingField, curves: Sequence[ParametricField], flows: Sequence[FloatArray]
) -> Figure:
    """Returns the score with its zeros, the log-density twice, and the field beyond (Fig. 5).

    Args:
        field: The learned field.
        curves: The fields in one more dimension, one for each piece.
        flows: (T, n, 3) states of agents that follow each of them.
    """
    found = find_singularities(field)
    figure = Figure(figsize=(12.5, 11.5), layout="constrained")
    score = figure.add_subplot(2, 2, 1)
    plotting.plot_field(score, ScoreField(field), found.box)
    marks: dict[str, Artist] = {
        "waypoints": plotting.plot_waypoints(score, field.cloud.points)[0]
    }
    marks |= plot_zeros(score, found.score)
    plotting.plane_axes(score, UNIT, f"(a) learned score, {len(found.score.zeros)} zeros")
    above = figure.add_subplot(2, 2, 2)
    both = plot_density_map(above, field, found)[-2:]
    above.set_title("(b) log-density from above")
    surface = figure.add_subplot(2, 2, 3, projection="3d")
    plot_density_surface(surface, field, found)
    surface.set_title("(c) log-density as a surface")
    beyond = figure.add_subplot(2, 2, 4, projection="3d")
    plot_helices(beyond, curves, flows)
    names = [name for name in ("waypoints", *MARKS) if name in marks]
    figure.legend(
        [*(marks[name] for name in names), *both],
        [*names, "zeros of S in (b), (c)", "zeros of m in (b), (c)"],
        loc="outside lower center",
        ncols=4,
        frameon=False,
    )
    return figure


def plot_helices(
    axes: Any, curves: Sequence[ParametricField], flows: Sequence[FloatArray]
) -> Sequence[Artist]:
    """Draws curves over their parameter w, and agents that follow them, in 3-D axes."""
    artists: list[Artist] = []
    # Curves are drawn last, since agents are on them most of the time.
    axes.computed_zorder = False
    for number, (field, states) in enumerate(zip(curves, flows, strict=True)):
        color = PIECES[number % len(PIECES)]
        for agent in np.moveaxis(states, 1, 0):
            artists += axes.plot(*agent.T, color=plotting.GREY, linewidth=0.9)
            artists += axes.plot(*agent[:1].T, "o", color=color, markersize=4)
        unit = field.cloud.unit_length
        w = np.linspace(0, states[..., 2].max() / unit, HELIX)
        points = field.cloud.denormalize(field.curve.derivatives(w, 0)[0])
        label = f"piece {number + 1}, and starts"
        artists += axes.plot(
            *points.T, w * unit, color=color, linewidth=2.2, label=label, zorder=3
        )
    axes.view_init(ELEVATION, AZIMUTH)
    axes.set(
        xlabel=f"x [{UNIT}]",
        ylabel=f"y [{UNIT}]",
        zlabel="parameter w",
        title="(d) the path in one more dimension, and agents",
    )
    axes.legend(loc="upper left", frameon=False)
    return artists


def shapes_figure(fields: Mapping[str, GuidingField]) -> Figure:
    """Returns the log-density of each field with the zeros of its score and of m."""
    columns = min(2, len(fields))
    rows = -(-len(fields) // columns)
    figure, axes = plotting.new_figure(rows, columns, 6.3 * columns, 5.2 * rows + 0.5)
    for panel in axes[len(fields) :]:
        panel.set_axis_off()
    marks: Sequence[Artist] = []
    for panel, (name, field) in zip(axes, fields.items(), strict=False):
        found = find_singularities(field)
        marks = plot_density_map(panel, field, found)[-2:]
        count = f"{len(found.score.zeros)} zeros of S, {len(found.guiding.zeros)} of m"
        panel.set_title(f"{name}: {count}")
    figure.legend(
        marks, ["zeros of S", "zeros of m"], loc="outside lower center", ncols=2, frameon=False
    )
    return figure


def places_figure(zeros: Sequence[Mapping[str, Any]]) -> Figure:
    """Returns at which densities zeros of the score are, and |m| there.

    Args:
        zeros: density_percentile, on_path, path_distance (U), guiding_norm and index of each.
    """
    figure, axes = plotting.new_figure(1, 2, 12, 5)
    percentile = np.array([zero["density_percentile"] for zero in zeros])
    on_path = np.array([zero["on_path"] for zero in zeros], bool)
    for chosen, color, label in (
        (np.ones_like(on_path), "black", "all zeros"),
        (on_path, plotting.BLUE, "on the path"),
        (~on_path, plotting.RED, "off the path"),
    ):
        if chosen.any():
            axes[0].ecdf(
                100 * percentile[chosen], color=color, label=f"{label} ({chosen.sum()})"
            )
    axes[0].plot([0, 100], [0, 1], "--", color=plotting.GREY, label="places drawn evenly")
    axes[0].set(
        xlabel="percentile of the density in the box, %",
        ylabel="share of the zeros up to it",
        title="at which densities the score vanishes",
    )
    distance = np.array([zero["path_distance"] for zero in zeros])
    norm = np.array([zero["guiding_norm"] for zero in zeros])
    index = np.array([zero["index"] for zero in zeros])
    for sign, color, marker, label in INDICES:
        own = index == sign
        axes[1].scatter(distance[own], norm[own], s=22, color=color, marker=marker, label=label)
    axes[1].set(
        xlabel="distance from the path [U]",
        ylabel="|m|",
        title="|m| where the score vanishes",
        ylim=(-0.05, 1.1),
    )
    for panel in axes:
        panel.grid(alpha=0.3)
        panel.legend(loc="best")
    return figure
