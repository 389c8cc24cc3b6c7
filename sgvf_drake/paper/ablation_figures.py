"""The figures of the ablations: fields side by side, and measures with their intervals."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray, plane_grid
from sgvf_drake.experiments.intervals import POSITIVE, interval
from sgvf_drake.fields import Field, GuidingField, TangentField, load_guiding_field
from sgvf_drake.paper.along_path import directions, sample_path
from sgvf_drake.paper.experiment import FOLDER
from sgvf_drake.paths import ReferencePath, shape_path

# In the file of a run: (n, 2) the last positions of its agents, (n,) whether each lapped.
ENDS, LAPPED = "ends", "followed"
# Arrows along each side of a field, and measures in a row.
ARROWS, COLUMNS = 23, 3
SOURCE, SINK, STOPPED = "^", "v", "o"
# How far apart groups and seeds are drawn beside a tick, in ticks.
GROUP_OFFSET, SEED_OFFSET = 0.3, 0.07
COLORS = (plotting.BLUE, plotting.ORANGE, plotting.GREEN, plotting.RED)
# Without the palest colours, which do not show on white.
LENGTHS = ListedColormap(colormaps["YlGnBu"](np.linspace(0.3, 1, 256)))
DRAWN: Mapping[str, Callable[[GuidingField], Field]] = {
    "v": TangentField,
    "m": lambda field: field,
}


def variants_figure(
    fields: pd.DataFrame,
    group: str,
    names: Mapping[str, str],
    symbol: str,
    span: tuple[float, float],
) -> Figure:
    """Returns fields side by side: a row for each group, a column for each variant.

    Args:
        fields: One row a field, of one seed: columns shape, variant, folder and the group.
        group: The column that tells the rows apart.
        names: What each variant is called.
        symbol: What is drawn, "v" or "m".
        span: The lengths that are told apart by colour; shorter and longer ones look like
            these.
    """
    groups, columns = list(fields.groupby(group, sort=False)), len(names)
    figure, axes = plotting.new_figure(
        len(groups), columns, 2.7 * columns + 0.8, 2.6 * len(groups) + 0.8
    )
    panels = iter(axes)
    for row, (name, own) in enumerate(groups):
        label = f"{symbol} by {name!s}" if group == "network" else str(name)
        for trained, panel in zip(own.to_dict("records"), panels, strict=False):
            stem, reference = trained[FOLDER] / trained["variant"], shape_path(trained["shape"])
            arrows = _draw_field(panel, stem, reference, DRAWN[symbol], span)
            plotting.plane_axes(
                panel, plotting.UNIT, names[trained["variant"]] if row == 0 else ""
            )
            panel.label_outer()
        axes[row * columns].set_ylabel(f"{label}\ny [{plotting.UNIT}]")
    figure.colorbar(arrows, ax=axes, label=f"$|{symbol}|$", extend="both", pad=0.01)
    turn = {"color": "white", "markeredgecolor": "black"}
    marks = [
        plotting.mark("waypoint", "o", plotting.BLUE, markersize=4),
        plotting.mark(f"{symbol} parts on the path (source)", SOURCE, **turn),
        plotting.mark(f"{symbol} meets on the path (sink)", SINK, **turn),
        plotting.mark("end of a failed agent", STOPPED, plotting.RED),
    ]
    plotting.legend_below(figure, marks)
    return figure


def _draw_field(
    axes: Axes,
    stem: Path,
    reference: ReferencePath,
    drawn: Callable[[GuidingField], Field],
    span: tuple[float, float],
) -> Quiver:
    """Draws a stored field, and what keeps agents from following it.

    Arrows of one length and waypoints are coloured by the length of what is drawn.
    """
    field = load_guiding_field(stem.with_suffix(".safetensors"))
    run = np.load(stem.with_suffix(".npz"))
    part, cloud = drawn(field), field.cloud
    _, _, x = plane_grid(cloud.box, ARROWS)
    vectors = part(x)
    length = np.linalg.norm(vectors, axis=1)
    unit = vectors / np.maximum(length, np.finfo(np.float64).tiny)[:, None]
    colors: dict[str, Any] = {"cmap": LENGTHS, "norm": LogNorm(*span)}
    arrows = axes.quiver(
        *x.T, *unit.T, length, **colors, pivot="mid", scale=1.15 * ARROWS, width=0.006
    )
    lengths = np.linalg.norm(part(cloud.points), axis=1)
    axes.scatter(cloud.points[:, 0], cloud.points[:, 1], s=14, c=lengths, **colors)
    axes.plot(*run[ENDS][~run[LAPPED]].T, STOPPED, color=plotting.RED, markersize=5)
    samples = sample_path(reference, cloud.unit_length)
    for piece in directions(samples, part(samples.points), cloud.unit_length):
        for points, mark in ((piece.sources, SOURCE), (piece.sinks, SINK)):
            axes.plot(*points.T, mark, color="white", markeredgecolor="black", markersize=8)
    return arrows


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
    within: tuple[float, float] = POSITIVE
    log: bool = False

    def mean(self, values: FloatArray) -> tuple[float, float, float]:
        """Returns the mean of the values of the seeds, with its interval."""
        if self.log:
            mean, low, high = np.exp(interval(np.log(values)))
            return float(mean), float(low), float(high)
        return interval(values, self.within)


def measures_figure(
    table: pd.DataFrame,
    panels: Sequence[MeasurePanel],
    group: str,
    names: Mapping[str, str],
) -> Figure:
    """Returns measures over the variants: every seed, and means with 95 % intervals.

    Args:
        table: One row a field, columns variant, the group and the measures.
        panels: The measures.
        group: The column that tells the colours apart.
        names: What each variant is called, in the order of the axis.
    """
    rows = -(-len(panels) // COLUMNS)
    figure, axes = plotting.new_figure(rows, COLUMNS, 3.8 * COLUMNS, 3.0 * rows + 0.6)
    groups = list(table.groupby(group, sort=False))
    for panel, own in zip(panels, axes, strict=False):
        for number, (name, fields) in enumerate(groups):
            values = fields.pivot(index="seed", columns="variant", values=panel.measure)
            by_variant = values[[*names]].to_numpy(dtype=np.float64)
            style: dict[str, Any] = {"color": COLORS[number % len(COLORS)], "markersize": 5}
            x = np.arange(len(names)) + GROUP_OFFSET * (number - (len(groups) - 1) / 2)
            means = [panel.mean(here) for here in by_variant.T]
            plotting.plot_intervals(own, x, means, fmt="o", label=str(name), **style)
            beside = np.linspace(-1, 1, len(values)) if len(values) > 1 else np.zeros(1)
            own.plot(SEED_OFFSET * beside[:, None] + x, by_variant, ".", alpha=0.35, **style)
        own.set_xticks(range(len(names)), list(names.values()), rotation=20, ha="right")
        # Without any value there is no logarithmic axis.
        log = panel.log and table[panel.measure].notna().any()
        own.set(title=panel.label, yscale="log" if log else "linear")
        own.grid(axis="y", alpha=0.3)
    for spare in axes[len(panels) :]:
        spare.set_axis_off()
    plotting.legend_below(figure, *axes[0].get_legend_handles_labels())
    return figure
