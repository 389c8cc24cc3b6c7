"""Fly a vehicle along every piece of a path, and measure how well."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.arrays import FloatArray
from sgvf_drake.experiments.flight import (
    TAKE_OFF_S,
    FlightSpec,
    SimulatedFlight,
    flown_pieces,
    positions_of,
    simulate,
    velocities_of,
)
from sgvf_drake.experiments.scene import FlightScene
from sgvf_drake.fields import GuidingField
from sgvf_drake.metrics import REACH_DISTANCE, FollowMetrics, follow_metrics
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress
from systems import Feasibility, Quadrotor

# An actuation this close to a limit, relative to the limit, is saturated.
SATURATION_MARGIN = 1e-6
# Figures of which the largest of all pieces is told.
WORST = (
    *("cross_track_rms_m", "cross_track_max_m", "altitude_rms_m", "motor_force_max_n"),
    *("saturated_fraction", "saturated_fraction_after_take_off"),
)


@dataclass(frozen=True, eq=False)
class PieceFlight:
    """One flight along one piece.

    Attributes:
        piece: Number of the piece in the reference.
        log: As `flight_log` returns it, and the cross-track error (m).
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
        spec: How they were flown.
    """

    flights: Sequence[PieceFlight]
    feasibility: Feasibility
    spec: FlightSpec

    def summary(self) -> dict[str, Any]:
        """Returns the worst of the pieces, and each of them under `pieces`.

        The laps are those of the closed pieces, null where there are none; `ended` tells
        whether the flights along all open pieces came to the end, and to rest there if the
        vehicle can, null where there are none.  Of a vehicle that only turns, what belongs to
        propellers and altitude is null, and there is the curvature in place of acceleration.
        """
        pieces = [flight.summary for flight in self.flights]
        laps = [piece["laps"] for piece in pieces if not piece["open"]]
        ended = [piece["ended"] for piece in pieces if piece["open"]]
        speeds = [piece["speed_mean_m_s"] for piece in pieces]
        worst = {name: [piece[name] for piece in pieces] for name in WORST}
        craft = self.spec.craft
        forces = craft.actuation_limits[1] if isinstance(craft, Quadrotor) else None
        return {
            "vehicle": self.spec.vehicle,
            **{name: None if None in all_ else max(all_) for name, all_ in worst.items()},
            "speed_mean_m_s": max(speeds, key=lambda speed: abs(speed - self.spec.speed)),
            "speed_command_m_s": self.spec.speed,
            "motor_force_limit_n": forces,
            "laps": min(laps, default=None),
            "ended": all(ended) if ended else None,
            "real_time_factor": min(piece["real_time_factor"] for piece in pieces),
            "acceleration_demand_m_s2": None,
            "acceleration_limit_m_s2": None,
            **self.feasibility.figures(),
            "pieces": pieces,
        }


def fly(
    field: GuidingField,
    reference: ReferencePath,
    spec: FlightSpec | None = None,
    *,
    progress: Progress = no_progress,
    scene: FlightScene | None = None,
    **options: Any,
) -> FlightResult:
    """Flies a vehicle along every piece, each from a start off the path.

    An open piece is flown once, from its start to the end at which the field comes to rest,
    and has time for that.  A vehicle that cannot rest is watched until it is there.

    Args:
        field: The field, in metres; planar or spatial.
        reference: What the flights are measured against, in metres.
        spec: How they are flown; None: as `FlightSpec` has it.
        progress: Is told how far each simulation is.
        scene: Shows the flights; None: nothing does.
        **options: Fields of the spec in place of its own, as in fly(field, path, speed=2.0).

    Raises:
        ConfigurationError: If a value cannot be used, if the field is neither planar nor
            spatial, if the reference is too short to be meant, if the vehicle cannot follow
            it, or if it lost control.
        NonFiniteValueError: If a value in the loop became NaN or infinite.
    """
    spec = replace(spec or FlightSpec(), **options)
    pieces = flown_pieces(field, reference)
    if scene is not None:
        scene.draw(field, spec.speed, spec.altitude)
    flights = []
    for piece in pieces:
        flown = simulate(field, reference, spec, piece, scene=scene, progress=progress)
        summary = _summary(flown, field, reference, piece, spec)
        summary["real_time_factor"] = summary["duration_s"] / flown.wall_s
        flights.append(PieceFlight(piece, flown.log, summary))
    return FlightResult(flights, flown.feasibility, spec)


def _summary(
    flown: SimulatedFlight,
    field: GuidingField,
    reference: ReferencePath,
    piece: int,
    spec: FlightSpec,
) -> dict[str, Any]:
    """Returns the figures of a flight along a piece by the names of `summary.json`."""
    log, craft, unit = flown.log, spec.craft, field.cloud.unit_length
    times = log["time"].to_numpy(dtype=np.float64)
    metrics = follow_metrics(
        times,
        positions_of(log, field.dim)[:, None, :],
        unit,
        field.cloud.box,
        reference,
        spec.speed,
        ends=field.ends,
    )
    errors, closed = metrics.summary(), bool(reference.closed[piece])
    measured = _measured(log, metrics, unit)
    if flown.is_over:
        measured = _way_to_end(log, reference.pieces[piece].vertices[[0, -1]], unit)
        error = measured["cross_track_error"].to_numpy()
        errors |= {"cross_track_rms": _rms(error), "cross_track_max": float(error.max())}
    actuation, (lowest, highest) = log[list(craft.actuation_columns)], craft.actuation_limits
    margin = SATURATION_MARGIN * highest
    saturated = ((actuation <= lowest + margin) | (actuation >= highest - margin)).any(axis=1)
    summary = {
        "piece": piece,
        "cross_track_rms_m": errors["cross_track_rms"],
        "cross_track_max_m": errors["cross_track_max"],
        "speed_mean_m_s": float(np.linalg.norm(velocities_of(measured), axis=1).mean()),
        "speed_command_m_s": spec.speed,
        "altitude_rms_m": None,
        "motor_force_max_n": None,
        "saturated_fraction": float(saturated.mean()),
        "saturated_fraction_after_take_off": float(saturated[times > TAKE_OFF_S].mean()),
        "duration_s": float(times[-1]),
        "start_m": positions_of(log, 3)[0].tolist(),
        "open": not closed,
        "laps": abs(float(metrics.laps[0])) if closed else None,
        "ended": None if closed else flown.is_over or _came_to_rest(metrics, piece),
        "live": flown.live,
    }
    if isinstance(craft, Quadrotor):
        above = measured["z"].to_numpy() - spec.altitude
        summary["altitude_rms_m"] = _rms(above) if field.dim == 2 else np.nan
        summary["motor_force_max_n"] = float(actuation.to_numpy().max())
    return summary


def _came_to_rest(metrics: FollowMetrics, piece: int) -> bool:
    return bool(metrics.ended[0] and metrics.piece[0] == piece)


def _measured(log: pd.DataFrame, metrics: FollowMetrics, unit_length: float) -> pd.DataFrame:
    """Returns the rows over which the errors are measured, the last one if there are none.

    They are the last lap, or on the way to an end those from the first reach on.
    """
    samples = max(int(metrics.samples[0]), 1)
    if not metrics.ended[0]:
        return log.tail(samples)
    return _since_reach(log, unit_length).head(samples)


def _way_to_end(log: pd.DataFrame, ends: FloatArray, unit_length: float) -> pd.DataFrame:
    """Returns the rows from the first reach on to the place nearest to the end just passed."""
    places = positions_of(log, ends.shape[1])
    passed = ends[np.argmin(np.linalg.norm(ends - places[-1], axis=1))]
    arrival = int(np.argmin(np.linalg.norm(places - passed, axis=1)))
    return _since_reach(log.head(arrival + 1), unit_length)


def _since_reach(log: pd.DataFrame, unit_length: float) -> pd.DataFrame:
    reached = log["cross_track_error"].to_numpy() <= REACH_DISTANCE * unit_length
    return log.iloc[int(np.argmax(reached)) :]


def _rms(values: FloatArray) -> float:
    """Returns the root mean square."""
    return float(np.sqrt((values**2).mean()))
