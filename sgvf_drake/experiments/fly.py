"""Fly Drake's quadrotor along every piece of a path, and measure how well."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.feasibility import (
    Feasibility,
    check_feasibility,
    lost_control_named,
)
from sgvf_drake.experiments.flight_log import FORCE_COLUMNS, LOG_PERIOD, simulate
from sgvf_drake.experiments.scene import FlightScene
from sgvf_drake.fields import FloatArray, GuidingField
from sgvf_drake.metrics import REACH_DISTANCE, REST_WINDOW, FollowMetrics, follow_metrics
from sgvf_drake.paths import Reference, ReferencePath, TreeReference
from sgvf_drake.progress import Progress, no_progress
from systems import MakeFlightDiagram, QuadrotorParameters, SensorParameters

# The vehicle hovers this many U beside the path at the start.
START_OFFSET = 0.5
# Time is added for a way in of this many U, and on an open piece for coming to rest.
WAY_IN = 4.0
REST_S = 3.0
# Waypoints are noisy; the direction of an end is that of this many U of the piece.
END_SECTION = 1.0
# Time for the take-off, after which saturation is judged.
TAKE_OFF_S = 1.0
# A propeller this close to a limit, relative to the limit, is saturated.
SATURATION_MARGIN = 1e-6


@dataclass(frozen=True, eq=False)
class PieceFlight:
    """One flight along one piece.

    Attributes:
        piece: Number of the piece in the reference.
        log: One row a sample of 10 ms: time (s), the state (x ... yaw_rate, SI), the
            velocity command, the propeller forces (N) and the cross-track error (m).
        summary: The figures of this flight by the names of `summary.json`.
    """

    piece: int
    log: pd.DataFrame
    summary: dict[str, Any]


@dataclass(frozen=True, eq=False)
class FlightResult:
    """The flights along all pieces of a path.

    Attributes:
        flights: One a piece.
        feasibility: The demand of the path at the commanded speed.
        parameters: The vehicle.
    """

    flights: Sequence[PieceFlight]
    feasibility: Feasibility
    parameters: QuadrotorParameters

    def summary(self) -> dict[str, Any]:
        """Returns the worst of the pieces, and each of them under `pieces`.

        The laps are those of the closed pieces, null where there are none; `ended` tells
        whether the flights along all open pieces came to rest at the end, null where there
        are none.
        """
        pieces = [flight.summary for flight in self.flights]
        laps = [piece["laps"] for piece in pieces if not piece["open"]]
        ended = [piece["ended"] for piece in pieces if piece["open"]]

        def worst(key: str, pick: Any) -> float | None:
            values = [piece[key] for piece in pieces]
            return None if None in values else pick(values)

        speeds = [piece["speed_mean_m_s"] for piece in pieces]
        commanded = pieces[0]["speed_command_m_s"]
        return {
            "cross_track_rms_m": worst("cross_track_rms_m", max),
            "cross_track_max_m": worst("cross_track_max_m", max),
            "speed_mean_m_s": max(speeds, key=lambda speed: abs(speed - commanded)),
            "speed_command_m_s": commanded,
            "altitude_rms_m": worst("altitude_rms_m", max),
            "motor_force_max_n": worst("motor_force_max_n", max),
            "motor_force_limit_n": self.parameters.max_propeller_force,
            "saturated_fraction": worst("saturated_fraction", max),
            "saturated_fraction_after_take_off": worst(
                "saturated_fraction_after_take_off", max
            ),
            "laps": min(laps, default=None),
            "ended": all(ended) if ended else None,
            "real_time_factor": worst("real_time_factor", min),
            "acceleration_demand_m_s2": self.feasibility.demand,
            "acceleration_limit_m_s2": self.feasibility.limit,
            "pieces": pieces,
        }


def fly(
    field: GuidingField,
    reference: Reference,
    speed: float = 0.45,
    laps: float = 2.0,
    altitude: float = 1.0,
    parameters: QuadrotorParameters | None = None,
    progress: Progress = no_progress,
    scene: FlightScene | None = None,
    sensors: SensorParameters | None = None,
    seed: int = 0,
) -> FlightResult:
    """Flies the quadrotor along every piece, each from an off-path hover.

    An open piece is flown once, from its start to the end at which the field comes to rest,
    and has time for that.

    Args:
        field: The field, in metres; planar or spatial.
        reference: What the flights are measured against, in metres.
        speed: Commanded speed, m/s.
        laps: Lengths of a closed piece that time is given for, after the way in; at least
            1, since the last lap is what is measured.
        altitude: Height of the flight where the field is planar, m.
        parameters: The vehicle; None: the paper's.
        progress: Told how far each simulation is.
        scene: Shows the flights; None: nothing does.
        sensors: Noise, delay and rates of the measurements; None: they are ideal.
        seed: Of their noise.

    Raises:
        ConfigurationError: A value cannot be used, the field is neither planar nor
            spatial, the reference is too short to be meant, or the vehicle lost control.
        NonFiniteValueError: A value in the loop became NaN or infinite.
    """
    parameters = parameters or QuadrotorParameters()
    check_flight(speed, laps, altitude)
    diagram = MakeFlightDiagram(
        field,
        parameters,
        speed=speed,
        altitude=altitude,
        log_period=LOG_PERIOD,
        sensors=sensors,
        meshcat=None if scene is None else scene.meshcat,
    )
    if scene is not None:
        scene.draw(field, speed, altitude)
    pieces = flown_pieces(reference, field.cloud.unit_length)
    if not pieces:
        raise ConfigurationError(
            f"nothing to fly: the reference is only {reference.longest:g} m long, "
            f"the waypoints span {2 * field.cloud.half_extent:g} m"
        )
    feasibility = check_feasibility(field, reference, speed, parameters)
    flights = []
    for piece in pieces:
        unit = field.cloud.unit_length
        start = hover_start(reference, piece, unit, altitude, field.ends)
        duration = flight_duration(reference, piece, unit, speed, laps)
        with lost_control_named(f"piece {piece + 1}", speed, feasibility):
            log, wall_s = simulate(
                diagram, start, duration, progress, scene, f"flight_{piece + 1}", seed
            )
        errors = reference.project(log[["x", "y", "z"][: field.dim]].to_numpy()).distance
        log["cross_track_error"] = errors
        metrics = _metrics(log, field, reference, speed)
        summary = {
            **_figures(log, metrics, field, speed, altitude, parameters),
            **_completion(metrics, piece, bool(reference.closed[piece])),
            "real_time_factor": duration / wall_s,
        }
        flights.append(PieceFlight(piece, log, {"piece": piece, **summary}))
    return FlightResult(flights, feasibility, parameters)


def check_flight(speed: float, laps: float, altitude: float) -> None:
    """Raises ConfigurationError unless a flight can be asked for with these values."""
    if not (np.isfinite(speed) and speed > 0):
        raise ConfigurationError(f"the speed must be a positive number, not {speed}")
    if not (np.isfinite(laps) and laps >= 1):
        raise ConfigurationError(f"the number of laps must be at least 1, not {laps}")
    if not (np.isfinite(altitude) and altitude > 0):
        raise ConfigurationError(f"the altitude must be a positive number, not {altitude}")


def flown_pieces(reference: Reference, unit_length: float) -> list[int]:
    """Returns the pieces long enough to fly: all but stray points, shorter than one U."""
    return [int(piece) for piece in np.flatnonzero(reference.lengths >= unit_length)]


def flight_duration(
    reference: Reference, piece: int, unit_length: float, speed: float, laps: float
) -> float:
    """Returns the time for a flight along a piece: `laps` of it, or to its end and to rest."""
    length = float(reference.lengths[piece])
    if reference.closed[piece]:
        return TAKE_OFF_S + (laps * length + WAY_IN * unit_length) / speed
    return TAKE_OFF_S + (length + (WAY_IN + REST_WINDOW) * unit_length) / speed + REST_S


def hover_start(
    reference: Reference,
    piece: int,
    unit_length: float,
    altitude: float,
    ends: FloatArray | None = None,
) -> FloatArray:
    """Returns a position (3,) beside a piece, from which all of it can be flown.

    On a closed piece it is beside the first point, away from the middle.  On an open one it
    is before the start, in line with the first part of the piece.

    Args:
        reference: Holds the piece.
        piece: Its number.
        unit_length: U.
        altitude: The third coordinate for a planar piece.
        ends: (E, d) where the field comes to rest: an open piece starts at its other end.
            None, or E = 0: it starts at the first point.
    """
    if isinstance(reference, TreeReference):
        points = reference.points[reference.pieces[piece].order]
    else:
        assert isinstance(reference, ReferencePath)
        points = reference.pieces[piece].vertices
    if reference.closed[piece]:
        middle = points.mean(axis=0)
    else:
        if ends is not None and len(ends) and _runs_backward(points, ends):
            points = points[::-1]
        middle = _first_section(points, END_SECTION * unit_length).mean(axis=0)
    outward = points[0] - middle
    outward /= max(float(np.linalg.norm(outward)), 1e-12)
    start = points[0] + START_OFFSET * unit_length * outward
    return start if len(start) == 3 else np.append(start, altitude)


def _runs_backward(points: FloatArray, ends: FloatArray) -> bool:
    """Whether the field rests at the first of the points in order, not at the last."""
    first, last = (np.linalg.norm(ends - point, axis=1).min() for point in points[[0, -1]])
    return bool(first < last)


def _first_section(points: FloatArray, length: float) -> FloatArray:
    """Returns the points until one is farther than a length from the first; at least two."""
    far = np.linalg.norm(points - points[0], axis=1) > length
    count = int(np.argmax(far)) if far.any() else len(points)
    return points[: max(count, 2)]


def _metrics(
    log: pd.DataFrame, field: GuidingField, reference: Reference, speed: float
) -> FollowMetrics:
    cloud = field.cloud
    return follow_metrics(
        log["time"].to_numpy(dtype=np.float64),
        log[["x", "y", "z"][: field.dim]].to_numpy()[:, None, :],
        cloud.unit_length,
        cloud.box,
        reference,
        speed,
        ends=field.ends,
    )


def _measured(log: pd.DataFrame, metrics: FollowMetrics, unit_length: float) -> pd.DataFrame:
    """Returns the rows over which the errors are measured, the last one if there are none.

    They are the last lap, or on the way to an end those from the first reach on.
    """
    samples = max(int(metrics.samples[0]), 1)
    if not metrics.ended[0]:
        return log.tail(samples)
    reached = log["cross_track_error"].to_numpy() <= REACH_DISTANCE * unit_length
    return log.iloc[int(np.argmax(reached)) :].head(samples)


def _completion(metrics: FollowMetrics, piece: int, closed: bool) -> dict[str, Any]:
    """Returns how much of a piece was flown: laps of a closed one, the end of an open one."""
    ended = bool(metrics.ended[0]) and int(metrics.piece[0]) == piece
    return {
        "open": not closed,
        "laps": abs(float(metrics.laps[0])) if closed else None,
        "ended": None if closed else ended,
    }


def _figures(
    log: pd.DataFrame,
    metrics: FollowMetrics,
    field: GuidingField,
    speed: float,
    altitude: float,
    parameters: QuadrotorParameters,
) -> dict[str, Any]:
    errors = metrics.summary()
    measured = _measured(log, metrics, field.cloud.unit_length)
    times = log["time"].to_numpy(dtype=np.float64)
    forces = log[list(FORCE_COLUMNS)].to_numpy()
    limit = parameters.max_propeller_force
    margin = SATURATION_MARGIN * limit
    saturated = np.any((forces <= margin) | (forces >= limit - margin), axis=1)
    altitude_error = measured["z"] - altitude if field.dim == 2 else pd.Series([np.nan])
    return {
        "cross_track_rms_m": errors["cross_track_rms"],
        "cross_track_max_m": errors["cross_track_max"],
        "speed_mean_m_s": float(np.linalg.norm(measured[["vx", "vy", "vz"]], axis=1).mean()),
        "speed_command_m_s": speed,
        "altitude_rms_m": float(np.sqrt((altitude_error**2).mean())),
        "motor_force_max_n": float(forces.max()),
        "saturated_fraction": float(saturated.mean()),
        "saturated_fraction_after_take_off": float(saturated[times > TAKE_OFF_S].mean()),
        "duration_s": float(times[-1]),
        "start_m": log[["x", "y", "z"]].iloc[0].tolist(),
    }
