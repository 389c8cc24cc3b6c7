"""The command that finds the paths of a cloud, without training: paths."""

from pathlib import Path
from typing import Annotated, Any

import typer

from sgvf_drake.cli.application import app, errors
from sgvf_drake.cli.options import Columns, Out, Overwrite, columns_of, directions_of, point_of
from sgvf_drake.cli.tables import print_folder, print_messages, print_table
from sgvf_drake.exceptions import ConfigurationError, PointCloudError


@app.command()
def paths(
    points: Annotated[Path, typer.Argument(metavar="FILE", help="Waypoints in any order.")],
    out: Out,
    columns: Columns = None,
    is_open: Annotated[
        bool | None,
        typer.Option(
            "--open/--closed",
            help="All pieces that are one path have ends, or are closed  \\[default: as they "
            "look].",
        ),
    ] = None,
    passes: Annotated[
        bool, typer.Option("--passes", help="All waypoints are passes of one path.")
    ] = False,
    direction: Annotated[
        str | None,
        typer.Option(help="Direction of travel, as of `sgvf train`: ccw, cw, reverse."),
    ] = None,
    start: Annotated[
        str | None, typer.Option(metavar="X,Y", help="A point near which open paths start.")
    ] = None,
    sigma: Annotated[
        float | None, typer.Option(help="Scale in U at which to look  \\[default: they vote].")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Find the paths in a cloud: pieces, junctions, crossings, ends; nothing is trained."""
    from sgvf_drake.clouds import PointCloud

    if sigma is not None and not 0 < sigma < float("inf"):
        raise ConfigurationError(f"--sigma must be a positive length in U, not {sigma}")
    cloud = PointCloud.read(points, columns_of(columns, points, "FILE"))
    print_messages(cloud.messages)
    from sgvf_drake.experiments.network import run_paths

    options: dict[str, Any] = {
        "closed": None if is_open is None else not is_open,
        "passes": passes,
        "direction": directions_of(direction),
        "start": point_of(start),
        "sigma": sigma,
    }
    try:
        summary = run_paths(cloud, out, overwrite=overwrite, **options)
    except PointCloudError as error:
        raise PointCloudError(f"{points}: {error}") from error
    print_messages(summary["messages"][len(cloud.messages) :])
    _print_network(summary)
    print_folder(out)


def _print_network(summary: dict[str, Any]) -> None:
    lengths = (f"{name} {summary[name]:.4g}" for name in ("length", "scatter", "spacing"))
    counts = (
        f"{summary[name]} {name}" for name in ("junctions", "crossings", "ends", "cycles")
    )
    rows = {
        "waypoints": f"{summary['num_points']} in {summary['dim']}-D",
        "pieces": str(len(summary["pieces"])),
        "nodes, edges": f"{len(summary['nodes'])}, {len(summary['edges'])}",
        "of them": ", ".join(counts),
        "lengths": ", ".join(lengths),
        "scale": f"{summary['sigma']:.4g}, {summary['sigma'] / summary['unit_length']:.3g} U",
        "time": f"{summary['cpu_s']:.2f} s CPU",
    }
    print_table("Paths", rows)
    if summary["unsure"]:
        errors.print(f"unsure: {summary['unsure']}", style="bold red", soft_wrap=True)
