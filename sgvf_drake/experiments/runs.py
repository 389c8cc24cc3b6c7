"""The commands' work: train, follow, fly and tour, each into a folder of results."""

from collections.abc import Sequence
from dataclasses import asdict
from os import PathLike
from pathlib import Path
from typing import Any

from sgvf_drake.experiments import figures
from sgvf_drake.experiments.certified import CERTIFICATE_FIGURE, CertifiedField
from sgvf_drake.experiments.figures.certificate import certificate_figure
from sgvf_drake.experiments.fly import fly
from sgvf_drake.experiments.follow import follow
from sgvf_drake.experiments.margin import flight_margin, margin_summary
from sgvf_drake.experiments.reference import choose_reference
from sgvf_drake.experiments.results import (
    SUMMARY,
    origin,
    result_folder,
    save_figure,
    write_summary,
)
from sgvf_drake.experiments.scene import NO_VIEW, View
from sgvf_drake.experiments.tour import fly_tour
from sgvf_drake.fields import GuidingField, load_field
from sgvf_drake.paths import PointCloud, Reference
from sgvf_drake.progress import Progress, no_progress
from systems import FieldForSpeed, SensorParameters

FIELD_FILE = "field.safetensors"
TRAIN_FILES = (SUMMARY, FIELD_FILE, "losses.csv", "field.png")
FOLLOW_FILES = (SUMMARY, "trajectories.parquet", "follow.png")
TOUR_FILES = (SUMMARY, "tour.parquet", "tour.png", "tour.html")

Folder = str | PathLike[str]


def open_field(path: Folder) -> GuidingField:
    """Loads a field from its file, or from the folder of its training.

    Raises:
        FieldFileError: There is no field, or it is damaged or foreign.
    """
    path = Path(path)
    return load_field(path / FIELD_FILE if path.is_dir() else path)


def run_train(
    cloud: PointCloud,
    config: Any,
    out: Folder,
    *,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Trains a field; leaves the field, the losses, a figure and the summary.

    Args:
        cloud: The waypoints.
        config: A `TrainingConfig`.
        out: The folder of the results.
        overwrite: Whether results there may be replaced.
        progress: Told how far the training is.

    Returns:
        The summary.
    """
    # Imported here: follow and fly do without torch.
    from sgvf_drake.learning import train

    with result_folder(out, TRAIN_FILES, overwrite=overwrite) as folder:
        result = train(cloud, config, progress)
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


def _path_summary(result: Any, config: Any) -> dict[str, Any]:
    """Returns what the training made of the waypoints, in their unit."""
    support, unit = result.support, result.field.cloud.unit_length
    # The paper's recipe learns from the waypoints as they are.
    cleans = result.field.recipe != "paper"
    return {
        "pieces": [
            {
                "points": len(piece.indices),
                "closed": piece.closed,
                "length": piece.length * unit,
            }
            for piece in support.pieces
        ],
        "ends": result.field.ends,
        "open": config.open,
        "direction": config.direction,
        "start": config.start,
        "spacing": support.scales.spacing * unit,
        "noise": support.scales.noise * unit,
        "gap": support.scales.gap * unit,
        "dropped": support.dropped if cleans else 0,
        "resampled": support.resampled and cleans,
    }


def run_follow(
    field: GuidingField,
    reference: tuple[Reference, str] | None,
    out: Folder,
    *,
    starts: int = 400,
    duration: float | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Follows a field from a grid of starts; leaves trajectories, a figure, the summary.

    Args:
        field: The field.
        reference: From `choose_reference`; None: the best there is without a file.
        out: The folder of the results.
        starts: Number of starts.
        duration: Seconds at unit speed; None: 1.5 longest pieces + 15 U.
        overwrite: Whether results there may be replaced.
        progress: Told how far the simulation is.

    Returns:
        The summary.
    """
    path, kind = reference or choose_reference(field)
    with result_folder(out, FOLLOW_FILES, overwrite=overwrite) as folder:
        result = follow(field, path, starts, duration, progress)
        figures.trajectory_table(result).to_parquet(folder / "trajectories.parquet")
        save_figure(figures.follow_figure(field, result), folder / "follow.png")
        unit = {"unit_length": field.cloud.unit_length, "reference": kind}
        summary = {**result.summary(), **unit, **origin(field)}
        write_summary(folder, summary)
    return summary


def run_fly(
    field: GuidingField,
    reference: tuple[Reference, str] | None,
    out: Folder,
    *,
    speed: float = 0.45,
    laps: float = 2.0,
    altitude: float = 1.0,
    sensors: SensorParameters | None = None,
    seed: int = 0,
    view: View = NO_VIEW,
    certified: CertifiedField | None = None,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Flies the quadrotor along every piece; leaves logs, a figure a piece, the summary.

    Args:
        field: The field, in metres.
        reference: From `choose_reference`; None: the best there is without a file.
        out: The folder of the results.
        speed: Commanded speed, m/s.
        laps: Lengths of each closed piece, at least 1.
        altitude: Height of the flight where the field is planar, m.
        sensors: Noise, delay and rates of the measurements; None: they are ideal.
        seed: Of their noise.
        view: How the flights are watched; with pages, there is one for each piece.
        certified: What the velocity error is held against; adds a figure, and a block of the
            summary.  None: nothing is proved of the field.
        overwrite: Whether results there may be replaced.
        progress: Told how far each simulation is.

    Returns:
        The summary.
    """
    path, kind = reference or choose_reference(field)
    pieces = range(1, 1 + len(path.lengths))
    names = [f"flight_{n}.{suffix}" for n in pieces for suffix in ("png", "parquet", "html")]
    with result_folder(
        out, (SUMMARY, CERTIFICATE_FIGURE, *names), overwrite=overwrite
    ) as folder:
        result = fly(
            field,
            path,
            speed,
            laps,
            altitude,
            progress=progress,
            scene=view.scene(folder),
            sensors=sensors,
            seed=seed,
        )
        flown = FieldForSpeed(field, speed)
        for flight in result.flights:
            stem = folder / f"flight_{flight.piece + 1}"
            flight.log.to_parquet(stem.with_suffix(".parquet"))
            figure = figures.flight_figure(flown, field.cloud, flight, result)
            save_figure(figure, stem.with_suffix(".png"))
        summary = {
            **result.summary(),
            "reference": kind,
            "sensors": _sensor_summary(sensors, seed),
            **origin(field),
        }
        if certified is not None:
            margins = [flight_margin(certified, flight, speed) for flight in result.flights]
            figure = certificate_figure(certified.field, certified.certificate, margins)
            save_figure(figure, folder / CERTIFICATE_FIGURE)
            summary["certificate"] = margin_summary(margins)
        write_summary(folder, summary)
    return summary


def run_tour(
    field: GuidingField,
    reference: tuple[Reference, str] | None,
    out: Folder,
    tour: Sequence[int],
    *,
    speed: float = 0.45,
    laps: float = 1.0,
    altitude: float = 1.0,
    sensors: SensorParameters | None = None,
    seed: int = 0,
    view: View = NO_VIEW,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Any]:
    """Flies along several pieces in one flight; leaves the log, a figure, the summary.

    Args:
        field: The field, in metres.
        reference: From `choose_reference`; None: the best there is without a file.
        out: The folder of the results.
        tour: Numbers of the pieces, from 0, in the order in which they are flown.
        speed: Commanded speed, m/s.
        laps: Of each closed piece, at least 1.
        altitude: Height of the flight where the field is planar, m.
        sensors: Noise, delay and rates of the measurements; None: they are ideal.
        seed: Of their noise.
        view: How the flight is watched.
        overwrite: Whether results there may be replaced.
        progress: Told how far the simulation is.

    Returns:
        The summary.
    """
    path, kind = reference or choose_reference(field)
    with result_folder(out, TOUR_FILES, overwrite=overwrite) as folder:
        result = fly_tour(
            field,
            path,
            tour,
            speed,
            laps,
            altitude,
            sensors=sensors,
            seed=seed,
            progress=progress,
            scene=view.scene(folder),
        )
        result.log.to_parquet(folder / "tour.parquet")
        figure = figures.tour_figure(FieldForSpeed(field, speed), field.cloud, result)
        save_figure(figure, folder / "tour.png")
        summary = {
            **result.summary(),
            "speed_command_m_s": speed,
            "reference": kind,
            "sensors": _sensor_summary(sensors, seed),
            **origin(field),
        }
        write_summary(folder, summary)
    return summary


def _sensor_summary(sensors: SensorParameters | None, seed: int) -> dict[str, Any] | None:
    return None if sensors is None else {**asdict(sensors), "seed": seed}
