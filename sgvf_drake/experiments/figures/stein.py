"""The figure of Stein's identity."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator, NullFormatter
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.fields import FloatArray

# Of the scores, in their order.
COLORS = ("black", plotting.GREEN, plotting.BLUE, plotting.RED)
MARKERS = ("o", "^", "s", "D")


@dataclass(frozen=True, eq=False)
class ScoreSeries:
    """One score, in parts of the bound.

    Attributes:
        label: What it is called.
        curve: The residual over the number of draws: columns draws, residual.
        residuals: That of each test field, (K,).
    """

    label: str
    curve: pd.DataFrame
    residuals: FloatArray


def stein_figure(
    points: FloatArray,
    probes: Sequence[Mapping[str, Any]],
    signals: FloatArray,
    scores: Sequence[ScoreSeries],
) -> Figure:
    """Returns the test fields, the residual over the draws, and that of each test field.

    Args:
        points: The waypoints, (N, 2) in U.
        probes: Form, radius and centre of each test field, in U.
        signals: What the identity says with each test field, in parts of the bound, (K,).
        scores: At most four, the exact one first.
    """
    figure, axes = plotting.new_figure(1, 3, 14, 4.6)
    _draw_supports(axes[0], points, probes)
    _draw_convergence(axes[1], scores)
    _draw_residuals(axes[2], probes, signals, scores)
    handles, labels = axes[1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(handles))
    return figure


def _draw_supports(axes: Axes, points: FloatArray, probes: Sequence[Mapping[str, Any]]) -> None:
    plotting.plot_waypoints(axes, points)
    places = {(*probe["centre"], probe["radius"]) for probe in probes}
    for x, y, radius in places:
        axes.add_patch(Circle((x, y), radius, color=plotting.ORANGE, alpha=0.2, linewidth=0))
        axes.add_patch(Circle((x, y), radius, fill=False, color=plotting.ORANGE))
    reach = 1.05 * max(max(abs(x), abs(y)) + radius for x, y, radius in places)
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    plotting.plane_axes(axes, "U", "waypoints and supports of f")


def _draw_convergence(axes: Axes, scores: Sequence[ScoreSeries]) -> None:
    for score, color, marker in zip(scores, COLORS, MARKERS, strict=False):
        axes.plot(
            score.curve["draws"],
            100 * score.curve["residual"],
            marker=marker,
            markersize=4,
            color=color,
            label=score.label,
        )
    draws = scores[0].curve["draws"].to_numpy()
    root = 100 * scores[0].curve["residual"].iloc[0] * np.sqrt(draws[0] / draws)
    axes.plot(draws, root, color=plotting.GREY, linestyle="--", label=r"$\propto 1/\sqrt{n}$")
    axes.set(
        xlabel="draws n",
        ylabel="residual [% of bound]",
        xscale="log",
        yscale="log",
        title="residual over the draws",
    )
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter(NullFormatter())
    axes.grid(alpha=0.3)


def _draw_residuals(
    axes: Axes,
    probes: Sequence[Mapping[str, Any]],
    signals: FloatArray,
    scores: Sequence[ScoreSeries],
) -> None:
    rows = np.arange(len(probes))
    axes.barh(rows, 100 * signals, color="#d9d9d9", height=0.8)
    for score, color, marker in zip(scores, COLORS, MARKERS, strict=False):
        axes.plot(100 * score.residuals, rows, marker, markersize=5, color=color)
    axes.set_yticks(rows, [f"{probe['form']}, R = {probe['radius']:g}" for probe in probes])
    axes.invert_yaxis()
    axes.set(
        xlabel="residual [% of bound]",
        xscale="log",
        xlim=(0.03, None),
        title="grey: what the identity says",
    )
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(alpha=0.3, axis="x")
