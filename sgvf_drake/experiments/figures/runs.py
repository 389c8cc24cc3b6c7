"""The figures of training, following, flying and tours."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
import numpy as np
import pandas as pd

from sgvf_drake import plotting
from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments.figures.network import draw_network
from sgvf_drake.experiments.fly import FlightResult, PieceFlight
from sgvf_drake.experiments.follow import FollowResult
from sgvf_drake.experiments.route import RouteResult
from sgvf_drake.experiments.tour import TourResult
from sgvf_drake.fields import DirectedField, Field, GuidingField
from systems import Mode, Quadrotor, Vehicle

# Behind the times of a transfer.
SHADE = "#f3d9b1"
# In the title of a route.
MOST_EDGES = 12


def field_figure(
    field: GuidingField | DirectedField, columns: int = 1
) -> tuple[Figure, list[Axes]]:
    """Returns a figure that shows a planar field with its waypoints, and its further axes.

    Of a directed field, which differs with the intended direction, it shows the network.
    """
    figure, axes = plotting.new_figure(1, columns, 5.2 * columns, 4.6)
    if field.dim == 2:
        _plot_behind(axes[0], field, field.cloud)
        plotting.plot_waypoints(axes[0], field.cloud.points)
        directed = isinstance(field, DirectedField)
        title = "network of paths" if directed else "guiding field"
        plotting.plane_axes(axes[0], plotting.UNIT, title)
        axes = axes[1:]
    return figure, axes


def _plot_behind(axes: Axes, field: Field, cloud: PointCloud) -> None:
    """Draws what agents move over: the field, or the network of a directed one."""
    if isinstance(field, DirectedField):
        draw_network(axes, cloud.points, field.network)
    else:
        plotting.plot_field(axes, field, cloud.box)


def training_figure(field: GuidingField | DirectedField, history: pd.DataFrame) -> Figure:
    """Returns the field with its waypoints beside the losses (paper, Fig. 2)."""
    stages = [losses for _, losses in history.groupby("stage", sort=False)]
    figure, axes = field_figure(field, len(stages) + (field.dim == 2))
    for stage_axes, losses in zip(axes, stages, strict=True):
        plotting.plot_losses(stage_axes, losses)
    return figure


def follow_figure(field: GuidingField | DirectedField, result: FollowResult) -> Figure:
    """Returns trajectories over the field, and the cross-track error over time."""
    figure, axes = plotting.new_figure(1, 2, 11, 5.2)
    if field.dim == 2:
        _plot_behind(axes[0], field, field.cloud)
    followed = result.metrics.followed
    plotting.plot_trajectories(axes[0], result.positions, followed)
    plotting.plot_waypoints(axes[0], field.cloud.points)
    title = f"{followed.sum()} of {len(followed)} starts {result.metrics.aim}"
    plotting.plane_axes(axes[0], plotting.UNIT, title)
    plotting.plot_cross_track(
        axes[1], result.times, result.errors, plotting.UNIT, "s at unit speed"
    )
    return figure


def flight_figure(
    field: Field, cloud: PointCloud, flight: PieceFlight, result: FlightResult
) -> Figure:
    """Returns one flight: trajectory, error, velocity and actuation (paper, Fig. 3).

    `field` is the field as it was flown; see `systems.FieldForSpeed`.
    """
    craft = result.spec.craft
    figure, axes = _flight_panels(field, cloud, flight.log, craft, zoom=False)
    start = "a hover" if craft.can_rest else "a start"
    plotting.plane_axes(axes[0], "m", f"flight from {start} beside the path")
    _plane_legend(axes[0], transfers=False)
    return figure


def tour_figure(field: Field, cloud: PointCloud, result: TourResult) -> Figure:
    """Returns the same of a tour, with its transfers in another colour (paper, Fig. 3)."""
    log = result.log
    figure, axes = _flight_panels(field, cloud, log, Quadrotor(result.parameters), zoom=True)
    flies = log["mode"] == Mode.TRANSFER
    away = log[["x", "y"]].where(flies)
    axes[0].plot(away["x"], away["y"], color=plotting.ORANGE, linewidth=2.2)
    order = ", ".join(str(leg["piece"] + 1) for leg in result.legs)
    plotting.plane_axes(axes[0], "m", f"one flight along the pieces {order}")
    _plane_legend(axes[0], transfers=True)
    for timeline in axes[1:]:
        across = timeline.get_xaxis_transform()
        timeline.fill_between(
            log["time"], 0, 1, where=flies, color=SHADE, transform=across, zorder=0
        )
    axes[1].legend(handles=[Patch(color=SHADE, label="transfer")], loc="upper right")
    return figure


def route_figure(field: DirectedField, result: RouteResult) -> Figure:
    """Returns the same of a flight along an itinerary, over the network."""
    craft = result.spec.craft
    figure, axes = _flight_panels(field, field.cloud, result.log, craft, zoom=True)
    edges = ", ".join(str(number) for number in result.itinerary.edges[:MOST_EDGES])
    more = ", ..." if len(result.itinerary.edges) > MOST_EDGES else ""
    plotting.plane_axes(axes[0], "m", f"route {edges}{more}")
    _plane_legend(axes[0], transfers=False)
    return figure


def _flight_panels(
    field: Field, cloud: PointCloud, log: pd.DataFrame, craft: Vehicle, zoom: bool
) -> tuple[Figure, list[Axes]]:
    """Returns a figure of the plane, the error, the velocity and the actuation of a flight."""
    figure, axes = plotting.new_figure(2, 2, 12, 8.5)
    if field.dim == 2:
        _plot_behind(axes[0], field, cloud)
    plotting.plot_waypoints(axes[0], cloud.points)
    plotting.plot_trajectories(axes[0], log[["x", "y"]].to_numpy()[:, None, :])
    errors = log["cross_track_error"].to_numpy()[:, None]
    plotting.plot_cross_track(axes[1], log["time"].to_numpy(), errors, "m")
    plotting.plot_velocity(axes[2], log)
    limit = craft.actuation_limits[1]
    if isinstance(craft, Quadrotor):
        plotting.plot_propeller_forces(axes[3], log, limit, zoom=zoom)
    else:
        plotting.plot_turn_rate(axes[3], log, limit)
    return figure, axes


def _plane_legend(axes: Axes, transfers: bool) -> None:
    """Names the lines of a flight, beside the plane, which a flight may fill."""
    lines = [
        Line2D([], [], color=plotting.BLUE, label="quadrotor"),
        Line2D([], [], color=plotting.ORANGE, linewidth=2.2, label="transfer"),
        Line2D([], [], color="black", ls=":", label="waypoints"),
    ]
    shown = lines if transfers else lines[::2]
    axes.legend(handles=shown, loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)


def trajectory_table(result: FollowResult) -> pd.DataFrame:
    """Returns the trajectories as one row an agent and time: agent, time, x, y[, z ...]."""
    steps, agents, dim = result.positions.shape
    names = ["x", "y", "z"][:dim] if dim <= 3 else [f"x{k}" for k in range(dim)]
    table = pd.DataFrame(result.positions.reshape(-1, dim), columns=names)
    table.insert(0, "time", np.repeat(result.times, agents))
    table.insert(0, "agent", np.tile(np.arange(agents), steps))
    table["cross_track_error"] = result.errors.ravel()
    return table
