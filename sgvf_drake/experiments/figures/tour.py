"""The figure of a flight along several pieces."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.experiments.tour import TourResult
from sgvf_drake.fields import Field
from sgvf_drake.paths import PointCloud
from systems import Mode

SHADE = "#f3d9b1"


def tour_figure(field: Field, cloud: PointCloud, result: TourResult) -> Figure:
    """Returns trajectory, error, velocity and propeller forces of a tour (paper, Fig. 3).

    `field` is the field as it was flown; see `systems.FieldForSpeed`.
    """
    figure, axes = plotting.new_figure(2, 2, 12, 8.5)
    log = result.log
    if field.dim == 2:
        plotting.plot_field(axes[0], field, cloud.box)
    plotting.plot_waypoints(axes[0], cloud.points)
    axes[0].plot(log["x"], log["y"], color=plotting.BLUE, linewidth=1.2)
    away = log[["x", "y"]].where(log["mode"] == Mode.TRANSFER)
    axes[0].plot(away["x"], away["y"], color=plotting.ORANGE, linewidth=2.2)
    axes[0].plot(log["x"].iloc[0], log["y"].iloc[0], "o", color=plotting.BLUE)
    order = ", ".join(str(leg["piece"] + 1) for leg in result.legs)
    plotting.plane_axes(axes[0], "m", f"one flight along the pieces {order}")
    handles = [
        Line2D([], [], color=plotting.BLUE),
        Line2D([], [], color=plotting.ORANGE, linewidth=2.2),
        Line2D([], [], color="black", ls=":"),
    ]
    # Beside the plane, which a flight may fill up to its corners.
    axes[0].legend(
        handles,
        ["quadrotor", "transfer", "waypoints"],
        loc="upper left",
        bbox_to_anchor=(1.0, 1.0),
        frameon=False,
    )
    errors = log["cross_track_error"].to_numpy()[:, None]
    plotting.plot_cross_track(axes[1], log["time"].to_numpy(), errors, "m")
    plotting.plot_velocity(axes[2], log)
    limit = result.parameters.max_propeller_force
    plotting.plot_propeller_forces(axes[3], log, limit, zoom=True)
    for timeline in axes[1:]:
        _shade_transfers(timeline, log)
    patch = Patch(color=SHADE, label="transfer")
    axes[1].legend(handles=[patch], loc="upper right")
    return figure


def _shade_transfers(axes: Axes, log: pd.DataFrame) -> None:
    flies = (log["mode"] == Mode.TRANSFER).to_numpy()
    axes.fill_between(
        log["time"],
        0,
        1,
        where=flies,
        color=SHADE,
        transform=axes.get_xaxis_transform(),
        zorder=0,
    )
