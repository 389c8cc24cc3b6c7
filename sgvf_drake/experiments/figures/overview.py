"""The figure of score, tangent, losses and agents (paper, Fig. 2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.fields import FloatArray, GuidingField, ScoreField, TangentField

AGENT_COLORS = (plotting.BLUE, plotting.RED)


@dataclass(frozen=True, eq=False)
class OverviewRow:
    """What one recipe made of a cloud.

    Attributes:
        recipe: Its name.
        field: The field.
        history: The losses of its training.
        agents: (T, 2, 2) trajectories of two agents.
    """

    recipe: str
    field: GuidingField
    history: pd.DataFrame
    agents: FloatArray


def overview_figure(rows: Sequence[OverviewRow]) -> Figure:
    """Returns one row a recipe: score field, tangent field, losses, two agents."""
    figure, axes = plotting.new_figure(len(rows), 4, 13, 3.5 * len(rows))
    for number, row in enumerate(rows):
        score, tangent, losses, plane = axes[4 * number : 4 * number + 4]
        for each, part, title in (
            (score, ScoreField(row.field), "score S"),
            (tangent, TangentField(row.field), "tangent v"),
            (plane, row.field, "two agents in m = s + v"),
        ):
            plotting.plot_field(each, part, row.field.cloud.box)
            plotting.plot_waypoints(each, row.field.cloud.points)
            plotting.plane_axes(each, "unit of the waypoints", f"{row.recipe}: {title}")
        plotting.plot_losses(losses, row.history[row.history["stage"] == "tangent"])
        losses.set_title(f"{row.recipe}: losses of v")
        _draw_agents(plane, row.agents)
    return figure


def _draw_agents(axes: Axes, agents: FloatArray) -> None:
    for agent, color in zip(agents.transpose(1, 0, 2), cycle(AGENT_COLORS), strict=False):
        axes.plot(agent[:, 0], agent[:, 1], color=color, linewidth=1.5)
        # A start may lie on the border.
        axes.plot(*agent[0], "o", color=color, markersize=6, clip_on=False)
