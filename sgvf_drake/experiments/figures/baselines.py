"""Methods side by side: the same starts, cloud by cloud."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.arrays import BoolArray, FloatArray

# U; what is shown of the plane: the box of the starts, and a margin.
SHOWN = 6.0


@dataclass(frozen=True, eq=False)
class Panel:
    """Trajectories of one method on one cloud, in U.

    Attributes:
        points: (N, 2) the waypoints.
        positions: (T, n, 2) the agents.
        good: (n,) those that succeeded.
        title: What was found, in a few words.
    """

    points: FloatArray
    positions: FloatArray
    good: BoolArray
    title: str

    @classmethod
    def load(cls, file: Path, title: str) -> "Panel":
        """Reads the trajectories that a trial left."""
        with np.load(file) as data:
            return cls(data["points"], data["positions"], data["good"], title)


def baselines_figure(
    panels: Mapping[tuple[str, str], Panel],
    methods: Mapping[str, str],
    cases: Mapping[str, str],
) -> Figure:
    """Returns a grid of panels: methods from top to bottom, cases from left to right.

    Args:
        panels: By method and case; what is missing stays empty.
        methods: The labels of the rows.
        cases: The labels of the columns.
    """
    rows, columns = len(methods), len(cases)
    figure, axes = plotting.new_figure(rows, columns, 2.4 * columns, 2.5 * rows + 0.4)
    grid: Sequence[Sequence] = [axes[i * columns : (i + 1) * columns] for i in range(rows)]
    for row, (method, label) in zip(grid, methods.items(), strict=True):
        for axis, case in zip(row, cases, strict=True):
            panel = panels.get((method, case))
            if panel is not None:
                plotting.plot_trajectories(axis, panel.positions, panel.good)
                plotting.plot_waypoints(axis, panel.points)
                axis.set_title(panel.title, fontsize="medium")
            axis.set(xlim=(-SHOWN, SHOWN), ylim=(-SHOWN, SHOWN), aspect="equal")
            axis.label_outer()
        row[0].set_ylabel(f"{label}\ny [U]")
    for axis, case_label in zip(grid[0], cases.values(), strict=True):
        axis.set_title(f"{case_label}\n{axis.get_title()}", fontsize="medium")
    for axis in grid[-1]:
        axis.set_xlabel("x [U]")
    return figure
