"""The figure of what the order of waypoints decides (paper, Fig. 1)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sgvf_drake import plotting
from sgvf_drake.arrays import BoolArray
from sgvf_drake.fields import FloatArray

CURVE_COLORS = (plotting.BLUE, plotting.ORANGE)
# U; the box of every cloud.
HALF_SIZE = 5.0


@dataclass(frozen=True, eq=False)
class Agents:
    """Trajectories in one field.

    Attributes:
        label: What the field is called.
        points: The waypoints, (N, 2) in U.
        positions: (T, n, 2) in U.
        good: (n,) who succeeds.
    """

    label: str
    points: FloatArray
    positions: FloatArray
    good: BoolArray


@dataclass(frozen=True, eq=False)
class IndexingColumn:
    """One way of giving waypoints.

    Attributes:
        label: What it is called.
        points: Few waypoints in their order, (N, 2) in U.
        curves: Points (n, 2) of the curves through them, in U, by name.
        agents: What follows the fields, one a row.
    """

    label: str
    points: FloatArray
    curves: Mapping[str, FloatArray]
    agents: Sequence[Agents]


def indexing_figure(columns: Sequence[IndexingColumn]) -> Figure:
    """Returns a column a case: the curves through few waypoints, then agents in fields."""
    rows = 1 + len(columns[0].agents)
    figure, axes = plotting.new_figure(rows, len(columns), 4 * len(columns), 4 * rows)
    for number, column in enumerate(columns):
        _draw_curves(axes[number], column)
        for row, agents in enumerate(column.agents, start=1):
            _draw_agents(axes[row * len(columns) + number], agents)
    axes[0].legend(loc="upper left", fontsize="small")
    return figure


def _draw_curves(axes: Axes, column: IndexingColumn) -> None:
    for (name, x), color in zip(column.curves.items(), CURVE_COLORS, strict=True):
        axes.plot(x[:, 0], x[:, 1], color=color, linewidth=1.0, label=name)
    axes.plot(column.points[:, 0], column.points[:, 1], "o", color="black", markersize=3.5)
    _frame(axes, f"{column.label}, {len(column.points)} waypoints")


def _draw_agents(axes: Axes, agents: Agents) -> None:
    plotting.plot_trajectories(axes, agents.positions, agents.good)
    plotting.plot_waypoints(axes, agents.points)
    _frame(axes, f"{agents.label}: {agents.good.sum()} of {len(agents.good)} agents")


def _frame(axes: Axes, title: str) -> None:
    plotting.plane_axes(axes, "U", title)
    axes.set(xlim=(-HALF_SIZE, HALF_SIZE), ylim=(-HALF_SIZE, HALF_SIZE))
