"""The picture of a network: its nodes and edges with their numbers, and arrows along them."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
import matplotlib.patheffects as effects
import numpy as np

from sgvf_drake import plotting
from sgvf_drake.arrays import FloatArray
from sgvf_drake.clouds import PointCloud
from sgvf_drake.paths import PathNetwork
from sgvf_drake.paths.network import NodeKind

# Nodes by what they are; colours by Okabe and Ito.
MARKERS: dict[NodeKind, tuple[str, str]] = {
    "end": ("o", plotting.GREEN),
    "junction": ("s", plotting.ORANGE),
    "crossing": ("X", plotting.RED),
}
# More edges than this are not numbered: their numbers would cover them.
MOST_NUMBERS = 60


def network_figure(cloud: PointCloud, network: PathNetwork) -> Figure:
    """Draws a network in the plane, or in space seen from above and from the side."""
    views = [(0, 1)] if network.dim == 2 else [(0, 1), (0, 2)]
    figure, axes = plotting.new_figure(1, len(views), 7 * len(views), 6.4)
    for view, plane in zip(views, axes, strict=True):
        draw_network(plane, cloud.points, network, view)
        plane.set(xlabel="xyz"[view[0]], ylabel="xyz"[view[1]], aspect="equal")
    counts = {
        kind: f"{number} {kind}" + "s" * (number != 1)
        for kind in MARKERS
        if (number := network.count(kind))
    }
    title = ", ".join([_pieces(network), *counts.values()])
    figure.suptitle(title + (" (unsure)" if network.unsure else ""))
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    return figure


def _pieces(network: PathNetwork) -> str:
    kinds = [network.kind(piece) for piece in range(network.num_pieces)]
    names = {kind: kinds.count(kind) for kind in dict.fromkeys(kinds)}
    return ", ".join(f"{number} {kind}" + "s" * (number > 1) for kind, number in names.items())


def draw_network(
    axes: Axes, points: FloatArray, network: PathNetwork, view: tuple[int, ...] = (0, 1)
) -> None:
    """Draws waypoints, edges and nodes, and numbers these, in two of their coordinates."""
    axes.plot(*points[:, view].T, ".", color="0.7", markersize=3, zorder=0, label="waypoints")
    numbered = len(network.edges) <= MOST_NUMBERS
    for k, edge in enumerate(network.edges):
        line = edge.line.at(np.linspace(0, edge.length, 2 + 4 * len(edge.line.vertices)))
        axes.plot(*line[:, view].T, color=plotting.BLUE, linewidth=1.4, zorder=1)
        middle = edge.line.at(edge.length * np.array([0.5, 0.505]))[:, view]
        axes.annotate(
            "",
            tuple(middle[1]),
            tuple(middle[0]),
            arrowprops={"arrowstyle": "-|>", "color": plotting.BLUE, "mutation_scale": 14},
        )
        if numbered and len(network.edges) > 1:
            _number(axes, middle[0], str(k + 1), plotting.BLUE)
    for kind, (marker, color) in MARKERS.items():
        places = [node.place[list(view)] for node in network.nodes if node.kind == kind]
        if places:
            x, y = np.transpose(places)
            axes.plot(x, y, marker, color=color, markersize=6, zorder=2, ls="", label=kind)
    if numbered:
        for k, node in enumerate(network.nodes):
            _number(axes, node.place[list(view)], str(k + 1), "black")


def _number(axes: Axes, place: FloatArray, text: str, color: str) -> None:
    """Writes a number beside a place, on a white rim that keeps it readable."""
    axes.annotate(
        text,
        tuple(place),
        xytext=(4, 4),
        textcoords="offset points",
        color=color,
        fontsize=8,
        path_effects=[effects.withStroke(linewidth=2, foreground="white")],
    )
