"""The figures of the ablations: fields side by side, and measures with their intervals."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.quiver import Quiver
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray
from sgvf_drake.paper.intervals import interval

# Arrows along each side of a field.
ARROWS = 23
UNIT = "unit of the waypoints"
SOURCE, SINK, STOPPED = "^", "v", "o"
# How far apart groups and seeds are drawn beside a tick, in ticks.
GROUP_OFFSET, SEED_OFFSET = 0.3, 0.07
COLORS = (plotting.BLUE, plotting.ORANGE, plotting.GREEN, plotting.RED)


@dataclass(frozen=True, eq=False)
class FieldPanel:
    """A planar field to be drawn, and what keeps agents from following it.

    Attributes:
        title: Above the panel.
        points: (N, 2) waypoints.
        lengths: (N,) of the field there.
        x: (n, 2) where the arrows are; see `arrow_grid`.
        vectors: (n, 2) the field there.
        sources: (k, 2) where it parts on the path.
        sinks: (l, 2) where it meets.
        stopped: (m, 2) where agents are in the end that did not follow the path.
    """

    title: str
    points: FloatArray
    lengths: FloatArray
    x: FloatArray
    vectors: FloatArray
    sources: FloatArray
    sinks: FloatArray
    stopped: FloatArray


@dataclass(frozen=True)
class MeasurePanel:
    """A measure to be drawn over the variants.

    Attributes:
        measure: Its column.
        label: What it is, with the unit; above the panel.
        within: The range of its means.
        log: Whether the axis is logarithmic; the means are then geometric.
    """

    measure: str
    label: str
    within: tuple[float, float] = (0.0, np.inf)
    log: bool = False

    def mean(self, values: FloatArray) -> tuple[float, float, float]:
        """Returns the mean of the values of the seeds, with its interval."""
        if self.log:
            mean, low, high = np.exp(interval(np.log(values)))
            return float(mean), float(low), float(high)
        return interval(values, self.within)


def arrow_grid(box: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Returns where the arrows of a field over a box are drawn, (n, 2)."""
    axes = [np.linspace(box[0][k], box[1][k], ARROWS) for k in range(2)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def variants_figure(
    rows: Mapping[str, Sequence[FieldPanel]], symbol: str, span: tuple[float, float]
) -> Figure:
    """Returns fields side by side, a row for each name.

    Args:
        rows: The panels of each row.
        symbol: What is drawn, "v" or "m".
        span: The lengths that are told apart by colour; shorter and longer ones look like
            these.
    """
    columns = max(len(panels) for panels in rows.values())
    figure, axes = plotting.new_figure(
        len(rows), columns, 2.7 * columns + 0.8, 2.6 * len(rows) + 0.8
    )
    for row, (name, panels) in enumerate(rows.items()):
        for column, panel in enumerate(panels):
            panel_axes = axes[row * columns + column]
            arrows = plot_panel(panel_axes, panel, span)
            plotting.plane_axes(panel_axes, UNIT, panel.title if row == 0 else "")
            panel_axes.label_outer()
        axes[row * columns].set_ylabel(f"{name}\ny [{UNIT}]")
    figure.colorbar(arrows, ax=axes, label=f"$|{symbol}|$", extend="both", pad=0.01)
    figure.legend(handles=_marks(symbol), loc="outside lower center", ncols=4, frameon=False)
    return figure


def plot_panel(axes: Axes, panel: FieldPanel, span: tuple[float, float]) -> Quiver:
    """Draws arrows of one length and waypoints, coloured by that of the field, and marks."""
    colors, norm = _lengths(), LogNorm(*span)
    length = np.linalg.norm(panel.vectors, axis=1)
    unit = panel.vectors / np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    arrows = axes.quiver(
        *panel.x.T,
        *unit.T,
        length,
        cmap=colors,
        norm=norm,
        pivot="mid",
        scale=1.15 * ARROWS,
        width=0.006,
    )
    x, y = panel.points.T
    axes.scatter(x, y, s=14, c=panel.lengths, cmap=colors, norm=norm)
    axes.plot(*panel.stopped.T, STOPPED, color=plotting.RED, markersize=5)
    for points, mark in ((panel.sources, SOURCE), (panel.sinks, SINK)):
        axes.plot(*points.T, mark, color="white", markeredgecolor="black", markersize=8)
    return arrows


def _lengths() -> Colormap:
    # Without the palest colours, which do not show on white.
    return ListedColormap(colormaps["YlGnBu"](np.linspace(0.3, 1, 256)))


def _marks(symbol: str) -> list[Line2D]:
    def mark(marker: str, color: str, label: str) -> Line2D:
        return Line2D(
            [], [], ls="", marker=marker, color=color, markeredgecolor="black", label=label
        )

    return [
        Line2D([], [], ls="", marker="o", ms=4, color=plotting.BLUE, label="waypoint"),
        mark(SOURCE, "white", f"{symbol} parts on the path (source)"),
        mark(SINK, "white", f"{symbol} meets on the path (sink)"),
        Line2D([], [], ls="", marker="o", color=plotting.RED, label="end of a failed agent"),
    ]


def measures_figure(
    table: pd.DataFrame,
    panels: Sequence[MeasurePanel],
    group: str,
    names: Mapping[str, str],
    columns: int = 3,
) -> Figure:
    """Returns measures over the variants: every seed, and means with 95 % intervals.

    Args:
        table: One row a field, columns variant, the group and the measures.
        panels: The measures.
        group: The column that tells the colours apart.
        names: What each variant is called, in the order of the axis.
        columns: Panels in a row.
    """
    rows = -(-len(panels) // columns)
    figure, axes = plotting.new_figure(rows, columns, 3.8 * columns, 3.0 * rows + 0.6)
    groups = list(dict.fromkeys(table[group]))
    for panel, panel_axes in zip(panels, axes, strict=False):
        for number, name in enumerate(groups):
            offset = GROUP_OFFSET * (number - (len(groups) - 1) / 2)
            plot_measure(
                panel_axes,
                panel,
                [
                    table.loc[(table[group] == name) & (table["variant"] == variant)][
                        panel.measure
                    ].to_numpy(dtype=np.float64)
                    for variant in names
                ],
                offset,
                COLORS[number % len(COLORS)],
                str(name),
            )
        panel_axes.set_xticks(range(len(names)), list(names.values()), rotation=20, ha="right")
        panel_axes.set(title=panel.label, yscale="log" if panel.log else "linear")
        panel_axes.grid(axis="y", alpha=0.3)
    for spare in axes[len(panels) :]:
        spare.set_axis_off()
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(groups), frameon=False)
    return figure


def plot_measure(
    axes: Axes,
    panel: MeasurePanel,
    values: Sequence[FloatArray],
    offset: float,
    color: str,
    label: str,
) -> Sequence[Artist]:
    """Draws a measure: the values of the seeds faintly, their mean with its interval.

    Args:
        axes: Where.
        panel: The measure.
        values: Those of the seeds at each tick.
        offset: To the right of the ticks.
        color: Of all.
        label: In the legend.
    """
    means = np.array([panel.mean(here) for here in values])
    at = np.arange(len(values)) + offset
    bars = np.nan_to_num(np.abs(means[:, 1:].T - means[:, 0]))
    drawn = axes.errorbar(
        at, means[:, 0], bars, fmt="o", color=color, markersize=5, capsize=3, label=label
    )
    artists = list(drawn.get_children())
    for tick, here in zip(at, values, strict=True):
        spread = SEED_OFFSET * np.linspace(-1, 1, len(here)) if len(here) > 1 else [0.0]
        artists += axes.plot(tick + spread, here, ".", color=color, alpha=0.35, markersize=5)
    return artists
