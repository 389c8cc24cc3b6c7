"""The figures of training, following and flying."""

from matplotlib.figure import Figure
from matplotlib.lines import Line2D
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.experiments.fly import FlightResult, PieceFlight
from sgvf_drake.experiments.follow import FollowResult
from sgvf_drake.fields import Field, GuidingField
from sgvf_drake.metrics import FollowMetrics
from sgvf_drake.paths import PointCloud


def training_figure(field: GuidingField, history: pd.DataFrame) -> Figure:
    """Returns the field with its waypoints beside the losses (paper, Fig. 2)."""
    stages = list(history.groupby("stage", sort=False))
    planar = field.dim == 2
    columns = len(stages) + planar
    figure, axes = plotting.new_figure(1, columns, 5 * columns, 4.6)
    if planar:
        plotting.plot_field(axes[0], field, field.cloud.box)
        plotting.plot_waypoints(axes[0], field.cloud.points)
        plotting.plane_axes(axes[0], "unit of the waypoints", "guiding field")
    for stage_axes, (_, losses) in zip(axes[planar:], stages, strict=True):
        plotting.plot_losses(stage_axes, losses)
    return figure


def follow_figure(field: GuidingField, result: FollowResult) -> Figure:
    """Returns trajectories over the field, and the cross-track error over time."""
    figure, axes = plotting.new_figure(1, 2, 11, 5.2)
    if field.dim == 2:
        plotting.plot_field(axes[0], field, field.cloud.box)
    followed = result.metrics.lapped | result.metrics.ended
    plotting.plot_trajectories(axes[0], result.positions, followed)
    plotting.plot_waypoints(axes[0], field.cloud.points)
    title = f"{followed.sum()} of {len(followed)} starts {_aim(result.metrics)}"
    plotting.plane_axes(axes[0], "unit of the waypoints", title)
    plotting.plot_cross_track(
        axes[1], result.times, result.errors, "unit of the waypoints", "s at unit speed"
    )
    return figure


def _aim(metrics: FollowMetrics) -> str:
    """Returns what the agents are to do on the pieces on which they are in the end."""
    if metrics.open.all():
        return "come to rest at the end"
    return "complete a lap" + (" or come to rest at the end" if metrics.open.any() else "")


def flight_figure(
    field: Field, cloud: PointCloud, flight: PieceFlight, result: FlightResult
) -> Figure:
    """Returns one flight: trajectory, error, velocity and propeller forces (paper, Fig. 3).

    `field` is the field as it was flown; see `systems.FieldForSpeed`.
    """
    figure, axes = plotting.new_figure(2, 2, 12, 8.5)
    log = flight.log
    if field.dim == 2:
        plotting.plot_field(axes[0], field, cloud.box)
    plotting.plot_waypoints(axes[0], cloud.points)
    positions = log[["x", "y"]].to_numpy()[:, None, :]
    plotting.plot_trajectories(axes[0], positions)
    plotting.plane_axes(axes[0], "m", "flight from a hover beside the path")
    handles = [Line2D([], [], color=plotting.BLUE), Line2D([], [], color="black", ls=":")]
    axes[0].legend(handles, ["quadrotor", "waypoints"], loc="upper right")
    errors = log["cross_track_error"].to_numpy()[:, None]
    plotting.plot_cross_track(axes[1], log["time"].to_numpy(), errors, "m")
    plotting.plot_velocity(axes[2], log)
    plotting.plot_propeller_forces(axes[3], log, result.parameters.max_propeller_force)
    return figure


def trajectory_table(result: FollowResult) -> pd.DataFrame:
    """Returns the trajectories as one row an agent and time: agent, time, x, y[, z ...]."""
    steps, agents, dim = result.positions.shape
    names = ["x", "y", "z"][:dim] if dim <= 3 else [f"x{k}" for k in range(dim)]
    table = pd.DataFrame(result.positions.reshape(-1, dim), columns=names)
    table.insert(0, "time", np.repeat(result.times, agents))
    table.insert(0, "agent", np.tile(np.arange(agents), steps))
    table["cross_track_error"] = result.errors.ravel()
    return table
