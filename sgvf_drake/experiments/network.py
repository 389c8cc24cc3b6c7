"""What the command paths does: the network of a cloud, without any training."""

from os import PathLike
import time
from typing import Any

from sgvf_drake.clouds import PointCloud
from sgvf_drake.experiments.figures.network import network_figure
from sgvf_drake.experiments.results import (
    SUMMARY,
    result_folder,
    save_figure,
    write_summary,
)
from sgvf_drake.paths import PathNetwork
from sgvf_drake.paths.finding import find_paths

NETWORK_FILE = "network.json"
PATHS_FILES = (SUMMARY, NETWORK_FILE, "network.png")


def run_paths(
    cloud: PointCloud,
    out: str | PathLike[str],
    *,
    overwrite: bool = False,
    **options: Any,
) -> dict[str, Any]:
    """Finds the network of a cloud; leaves it, a picture and the summary in a folder.

    Args:
        cloud: The waypoints.
        out: The folder.
        overwrite: Whether results there may be replaced.
        options: Those of `sgvf_drake.paths.find_paths`.

    Returns:
        The summary.
    """
    with result_folder(out, PATHS_FILES, overwrite=overwrite) as folder:
        begin = time.process_time()
        network = find_paths(cloud, **options)
        elapsed = time.process_time() - begin
        network.save(folder / NETWORK_FILE)
        save_figure(network_figure(cloud, network), folder / "network.png")
        summary = network_summary(cloud, network) | {"cpu_s": elapsed}
        write_summary(folder, summary)
    return summary


def network_summary(cloud: PointCloud, network: PathNetwork) -> dict[str, Any]:
    """Returns what was found, in the unit of the waypoints, without the polylines."""
    pieces = [
        {
            "kind": network.kind(piece),
            "length": sum(edge.length for edge in network.edges if edge.piece == piece),
            "edges": [k for k, edge in enumerate(network.edges) if edge.piece == piece],
            "nodes": [k for k, node in enumerate(network.nodes) if node.piece == piece],
        }
        for piece in range(network.num_pieces)
    ]
    found = network.to_json()
    for name in ("format", "version", "routes"):
        del found[name]
    for edge in found["edges"]:
        del edge["points"]
    return found | {
        "num_points": cloud.num_points,
        "dim": cloud.dim,
        "unit": "m" if cloud.origin is not None else "unit of the waypoints",
        "pieces": pieces,
        "junctions": network.count("junction"),
        "crossings": network.count("crossing"),
        "ends": network.count("end"),
        "cycles": network.cycles,
        "length": network.length,
        "messages": [*cloud.messages, *network.messages],
    }
