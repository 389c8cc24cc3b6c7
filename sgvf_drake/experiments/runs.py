"""What the commands train, follow, fly and demo do, each into a folder of results."""

from collections.abc import Sequence
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

import pandas as pd

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.certified import CERTIFICATE_FIGURE, CertifiedField
from sgvf_drake.experiments.figures import runs as figures
from sgvf_drake.experiments.figures.certificate import certificate_figure
from sgvf_drake.experiments.flight import FlightSpec
from sgvf_drake.experiments.fly import fly
from sgvf_drake.experiments.follow import follow, follow_network
from sgvf_drake.experiments.reference import choose_reference
from sgvf_drake.experiments.results import (
    SUMMARY,
    origin,
    result_folder,
    save_figure,
    write_summary,
)
from sgvf_drake.experiments.route import fly_route, routes_summary
from sgvf_drake.experiments.scene import NO_VIEW, View
from sgvf_drake.experiments.tour import fly_tour
from sgvf_drake.experiments.velocity_error import flight_margin, margin_summary
from sgvf_drake.fields import (
    DirectedField,
    GuidingField,
    ScoreInducedField,
    load_field,
    load_guiding_field,
)
from sgvf_drake.learning.recipes import RECIPES
from sgvf_drake.paths import PathNetwork, ReferencePath, make_shape
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.progress import Progress, no_progress
from systems import FieldForSpeed, Quadrotor

FIELD_FILE = "field.safetensors"
TRAIN_FILES = (SUMMARY, FIELD_FILE, "losses.csv", "field.png")
FOLLOW_FILES = (SUMMARY, "trajectories.parquet", "follow.png")
ROUTE_KINDS = ("parquet", "png", "html")
TOUR_FILES = (SUMMARY, "tour.parquet", "tour.png", "tour.html")
# Of the demo: the paper's first flight scenario.
DEMO_SHAPE, DEMO_STARTS = "concentric-flight", 100
DEMO_FILES = (SUMMARY, "waypoints.csv", "train", "follow", "fly")

Folder = str | PathLike[str]


def open_field(path: Folder) -> GuidingField | DirectedField:
    """Loads a field from its file, or from the folder of its training.

    Raises:
        FieldFileError: If there is no field, or if it is damaged or foreign.
    """
    return load_field(_field_file(path))


def open_guiding_field(path: Folder) -> GuidingField:
    """Loads a field of the position alone; see `open_field`.

    Raises:
        FieldFileError: As `open_field`.
        ConfigurationError: If the field is a directed one.
    """
    return load_guiding_field(_field_file(path))


def _field_file(path: Folder) -> Path:
    path = Path(path)
    return path / FIELD_FILE if path.is_dir() else path


def run_train(
    source: PointCloud | PathNetwork,
    config: Any,
    out: Folder,
    *,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Trains a field as `learning.train` does; leaves it, the losses, a figure, the summary."""
    # Imported here: follow and fly do without torch.
    from sgvf_drake.learning import train

    with result_folder(out, TRAIN_FILES, overwrite=overwrite) as folder:
        result = train(source, config, progress)
        cloud = result.field.cloud
        result.field.save(folder / FIELD_FILE)
        result.history.to_csv(folder / "losses.csv", index=False)
        figure = figures.training_figure(result.field, result.history)
        save_figure(figure, folder / "field.png")
        summary = {
            "recipe": result.field.recipe,
            "seed": result.field.seed,
            "num_points": cloud.num_points,
            "dim": cloud.dim,
            "unit_length": cloud.unit_length,
            "shape": cloud.shape,
            "digest": cloud.digest,
            "origin": cloud.origin,
            "messages": [*cloud.messages, *result.network.messages, *_of_support(result)],
            "unsure": result.network.unsure,
            **_path_summary(result, config),
            "train_cpu_s": result.cpu_s,
            "train_wall_s": result.wall_s,
            "self_check_passed": result.self_check.passed,
            "self_check": result.self_check.to_json(),
            "restarts": result.restarts,
            "sigma": result.field.sigma,
            "gain": result.field.composition.gain,
            "settings": asdict(result.settings),
        }
        write_summary(folder, summary)
    return summary


def _of_support(result: Any) -> tuple[str, ...]:
    """What is to be said of what a directed field was learned from."""
    return result.support.messages if isinstance(result.field, DirectedField) else ()


def _path_summary(result: Any, config: Any) -> dict[str, Any]:
    """Returns what the training made of the waypoints, in their unit."""
    support, network = result.support, result.network
    unit = network.unit_length
    cleans = RECIPES[result.field.recipe].uses_paths
    directed = isinstance(result.field, DirectedField)
    return {
        "directed": directed,
        "pieces": _edges_by_piece(support, network) if directed else _lines(support, unit),
        "ends": result.field.ends,
        "open": config.open,
        "direction": config.direction,
        "start": config.start,
        "passes": config.passes,
        "anyway": config.anyway,
        "spacing": support.spacing * unit,
        "noise": network.scatter,
        "gap": support.gap * unit,
        "dropped": network.dropped if cleans else 0,
        "resampled": cleans and (directed or support.resampled),
    }


def _lines(support: Any, unit: float) -> list[dict[str, Any]]:
    """The lines that a field of the position alone was learned from."""
    return [
        {"points": count, "closed": line.closed, "length": line.length * unit}
        for line, count in zip(support.path.pieces, support.counts, strict=True)
    ]


def _edges_by_piece(support: Any, network: PathNetwork) -> list[dict[str, Any]]:
    """The pieces of the network that a directed field was learned from."""
    pieces = []
    for piece in range(network.num_pieces):
        own = [k for k, edge in enumerate(network.edges) if edge.piece == piece]
        pieces.append(
            {
                "points": sum(support.counts[k] for k in own),
                "closed": network.kind(piece) == "closed path",
                "length": sum(network.edges[k].length for k in own),
                "is": network.describe(piece),
            }
        )
    return pieces


def run_follow(
    field: GuidingField | DirectedField,
    reference: tuple[ReferencePath, str] | None,
    out: Folder,
    *,
    starts: int | None = None,
    duration: float | None = None,
    route: str | None = None,
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Follows a field as `follow` or `follow_network` does; leaves trajectories and a figure.

    Args:
        field: The field.
        reference: What a field of the position alone is measured against.
        out: The folder.
        starts: Agents; None: 400, or 100 of a directed field.
        duration: Seconds at unit speed; None: enough.
        route: Of a directed field: edges, as "1,2,-3"; None: straight on.
        seed: Of the headings with a directed field.
        overwrite: Whether results there are replaced.
        progress: Is told how far the simulation is.

    Raises:
        ConfigurationError: If an option does not fit the field.
    """
    followed: dict[str, Any] = {"duration": duration, "progress": progress}
    if starts is not None:
        followed["starts"] = starts
    if isinstance(field, DirectedField):
        if reference is not None:
            raise ConfigurationError(
                "a directed field is measured against its own network, not a reference"
            )
        kind, path = "network", None
        followed |= {"seed": seed}
        if route is not None:
            followed["route"] = Itinerary.parse(route, field.network)
    else:
        if route is not None:
            raise ConfigurationError("a route is for fields of paths that cross or branch")
        path, kind = reference or choose_reference(field)
    with result_folder(out, FOLLOW_FILES, overwrite=overwrite) as folder:
        if isinstance(field, DirectedField):
            result: Any = follow_network(field, **followed)
        else:
            assert path is not None
            result = follow(field, path, **followed)
        figures.trajectory_table(result).to_parquet(folder / "trajectories.parquet")
        save_figure(figures.follow_figure(field, result), folder / "follow.png")
        unit = {"unit_length": field.cloud.unit_length, "reference": kind, "route": route}
        summary = {**result.summary(), **unit, **origin(field)}
        write_summary(folder, summary)
    return summary


def run_fly(
    field: GuidingField,
    reference: tuple[ReferencePath, str] | None,
    out: Folder,
    spec: FlightSpec,
    *,
    view: View = NO_VIEW,
    certified: CertifiedField | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Flies a vehicle along every piece; leaves logs, a figure a piece, the summary.

    With a `view` with pages there is one for each piece.  With a certificate the velocity
    error is held against it, which adds a figure and a block of the summary.
    """
    path, kind = reference or choose_reference(field)
    pieces = range(1, 1 + len(path.lengths))
    names = [f"flight_{n}.{suffix}" for n in pieces for suffix in ("png", "parquet", "html")]
    files = (SUMMARY, CERTIFICATE_FIGURE, *names)
    with result_folder(out, files, overwrite=overwrite) as folder:
        result = fly(field, path, spec, progress=progress, scene=view.scene(folder, certified))
        flown = spec.craft.FlownField(field, spec.speed)
        for flight in result.flights:
            stem = folder / f"flight_{flight.piece + 1}"
            flight.log.to_parquet(stem.with_suffix(".parquet"))
            figure = figures.flight_figure(flown, field.cloud, flight, result)
            save_figure(figure, stem.with_suffix(".png"))
        summary = {**result.summary(), **_flight_origin(field, kind, spec)}
        if certified is not None:
            margins = [flight_margin(certified, one, spec.speed) for one in result.flights]
            figure = certificate_figure(certified.field, certified.certificate, margins)
            save_figure(figure, folder / CERTIFICATE_FIGURE)
            summary["certificate"] = margin_summary(margins)
        write_summary(folder, summary)
    return summary


def run_routes(
    field: DirectedField,
    routes: Sequence[Itinerary],
    out: Folder,
    spec: FlightSpec,
    *,
    view: View = NO_VIEW,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Flies along itineraries as `fly_route` does; leaves a log and a figure each, the summary.

    The files are named `route`, those of several `route_1` and so on.
    """
    count = max(len(routes), field.network.num_pieces)
    names = ["route", *(f"route_{n + 1}" for n in range(count))]
    files = (SUMMARY, *(f"{name}.{kind}" for name in names for kind in ROUTE_KINDS))
    stems = names[:1] if len(routes) == 1 else names[1 : 1 + len(routes)]
    with result_folder(out, files, overwrite=overwrite) as folder:
        scene = view.scene(folder)
        if scene is not None:
            scene.draw(field, spec.speed, spec.altitude)
        results = []
        for name, route in zip(stems, routes, strict=True):
            result = fly_route(field, route, spec, page=name, scene=scene, progress=progress)
            result.log.to_parquet(folder / f"{name}.parquet")
            save_figure(figures.route_figure(field, result), folder / f"{name}.png")
            results.append(result)
        summary = {**routes_summary(results), **_flight_origin(field, "network", spec)}
        write_summary(folder, summary)
    return summary


def run_tour(
    field: GuidingField | DirectedField,
    reference: tuple[ReferencePath, str] | None,
    out: Folder,
    tour: Sequence[int],
    spec: FlightSpec,
    *,
    view: View = NO_VIEW,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Flies a tour as `fly_tour` does; leaves the log, a figure, the summary."""
    path, kind = reference or choose_reference(field)
    with result_folder(out, TOUR_FILES, overwrite=overwrite) as folder:
        result = fly_tour(field, path, tour, spec, progress=progress, scene=view.scene(folder))
        result.log.to_parquet(folder / "tour.parquet")
        flown = FieldForSpeed(field, spec.speed)
        save_figure(figures.tour_figure(flown, field.cloud, result), folder / "tour.png")
        commanded = {"speed_command_m_s": spec.speed}
        summary = {**result.summary(), **commanded, **_flight_origin(field, kind, spec)}
        write_summary(folder, summary)
    return summary


def _flight_origin(
    field: ScoreInducedField, reference: str, spec: FlightSpec
) -> dict[str, Any]:
    """Returns what a flight was measured against and by, and where its field comes from."""
    sensors = spec.sensors and {**asdict(spec.sensors), "seed": spec.seed}
    disturbance = spec.disturbance and {
        **asdict(spec.disturbance),
        "disturbance_bandwidth": spec.gains.disturbance_bandwidth,
        "seed": spec.seed,
    }
    heading = spec.gains.heading if spec.heading is None else spec.heading
    return {
        "reference": reference,
        "sensors": sensors,
        "disturbance": disturbance,
        # Other vehicles look where they go.
        "heading": heading if isinstance(spec.craft, Quadrotor) else None,
        **origin(field),
    }


def run_demo(
    out: Folder, *, overwrite: bool = False, progress: Progress = no_progress
) -> dict[str, Any]:
    """Does the main job from end to end, in the paper's first flight scenario.

    Trains on the concentric rings, follows them from a grid and flies each of them; leaves a
    folder for each part, and the summaries of the parts by name.
    """
    from sgvf_drake.learning import TrainingConfig

    with result_folder(out, DEMO_FILES, overwrite=overwrite) as folder:
        cloud, _ = make_shape(DEMO_SHAPE)
        waypoints = pd.DataFrame(cloud.points, columns=["x", "y"])
        waypoints.to_csv(folder / "waypoints.csv", index=False)
        train = run_train(cloud, TrainingConfig(), folder / "train", progress=progress)
        field = open_guiding_field(folder / "train")
        follow = run_follow(
            field, None, folder / "follow", starts=DEMO_STARTS, progress=progress
        )
        flight = run_fly(field, None, folder / "fly", FlightSpec(), progress=progress)
        summary = {"train": train, "follow": follow, "fly": flight}
        write_summary(folder, summary)
    return summary
