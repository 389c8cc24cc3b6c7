"""Fly Drake's quadrotor along every piece of a path, and measure how well."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.experiments.flight import (
    FORCE_COLUMNS,
    TAKE_OFF_S,
    Feasibility,
    FlightSpec,
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

# A propeller this close to a limit, relative to the limit, is saturated.
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
        whether the flights along all open pieces came to rest at the end, null where there
        are none.
        """
        pieces = [flight.summary for flight in self.flights]
        laps = [piece["laps"] for piece in pieces if not piece["open"]]
        ended = [piece["ended"] for piece in pieces if piece["open"]]
        speeds = [piece["speed_mean_m_s"] for piece in pieces]
        worst = {name: [piece[name] for piece in pieces] for name in WORST}
        return {
            **{name: None if None in all_ else max(all_) for name, all_ in worst.items()},
            "speed_mean_m_s": max(speeds, key=lambda speed: abs(speed - self.spec.speed)),
            "speed_command_m_s": self.spec.speed,
            "motor_force_limit_n": self.spec.parameters.max_propeller_force,
            "laps": min(laps, default=None),
            "ended": all(ended) if ended else None,
            "real_time_factor": min(piece["real_time_factor"] for piece in pieces),
            "acceleration_demand_m_s2": self.feasibility.demand,
            "acceleration_limit_m_s2": self.feasibility.limit,
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
    """Flies the quadrotor along every piece, each from an off-path hover.

    An open piece is flown once, from its start to the end at which the field comes to rest,
    and has time for that.

    Args:
        field: The field, in metres; planar or spatial.
        reference: What the flights are measured against, in metres.
        spec: How they are flown; None: as `FlightSpec` has it.
        progress: Is told how far each simulation is.
        scene: Shows the flights; None: nothing does.
        **options: Fields of the spec in place of its own, as in fly(field, path, speed=2.0).

    Raises:
        ConfigurationError: If a value cannot be used, if the field is neither planar nor
            spatial, if the reference is too short to be meant, or if the vehicle lost control.
        NonFiniteValueError: If a value in the loop became NaN or infinite.
    """
    spec = replace(spec or FlightSpec(), **options)
    pieces = flown_pieces(field, reference)
    if scene is not None:
        scene.draw(field, spec.speed, spec.altitude)
    flights = []
    for piece in pieces:
        flown = simulate(field, reference, spec, piece, scene=scene, progress=progress)
        summary = _summary(flown.log, field, reference, piece, spec)
        summary["real_time_factor"] = summary["duration_s"] / flown.wall_s
        flights.append(PieceFlight(piece, flown.log, summary))
    return FlightResult(flights, flown.feasibility, spec)


def _summary(
    log: pd.DataFrame,
    field: GuidingField,
    reference: ReferencePath,
    piece: int,
    spec: FlightSpec,
) -> dict[str, Any]:
    """Returns the figures of a flight along a piece by the names of `summary.json`."""
    times = log["time"].to_numpy(dtype=np.float64)
    metrics = follow_metrics(
        times,
        positions_of(log, field.dim)[:, None, :],
        field.cloud.unit_length,
        field.cloud.box,
        reference,
        spec.speed,
        ends=field.ends,
    )
    errors, closed = metrics.summary(), bool(reference.closed[piece])
    measured = _measured(log, metrics, field.cloud.unit_length)
    altitude_error = measured["z"] - spec.altitude if field.dim == 2 else np.array([np.nan])
    forces, limit = log[list(FORCE_COLUMNS)].to_numpy(), spec.parameters.max_propeller_force
    margin = SATURATION_MARGIN * limit
    saturated = np.any((forces <= margin) | (forces >= limit - margin), axis=1)
    return {
        "piece": piece,
        "cross_track_rms_m": errors["cross_track_rms"],
        "cross_track_max_m": errors["cross_track_max"],
        "speed_mean_m_s": float(np.linalg.norm(velocities_of(measured), axis=1).mean()),
        "speed_command_m_s": spec.speed,
        "altitude_rms_m": float(np.sqrt((altitude_error**2).mean())),
        "motor_force_max_n": float(forces.max()),
        "saturated_fraction": float(saturated.mean()),
        "saturated_fraction_after_take_off": float(saturated[times > TAKE_OFF_S].mean()),
        "duration_s": float(times[-1]),
        "start_m": positions_of(log, 3)[0].tolist(),
        "open": not closed,
        "laps": abs(float(metrics.laps[0])) if closed else None,
        "ended": None if closed else bool(metrics.ended[0] and metrics.piece[0] == piece),
    }


def _measured(log: pd.DataFrame, metrics: FollowMetrics, unit_length: float) -> pd.DataFrame:
    """Returns the rows over which the errors are measured, the last one if there are none.

    They are the last lap, or on the way to an end those from the first reach on.
    """
    samples = max(int(metrics.samples[0]), 1)
    if not metrics.ended[0]:
        return log.tail(samples)
    reached = log["cross_track_error"].to_numpy() <= REACH_DISTANCE * unit_length
    return log.iloc[int(np.argmax(reached)) :].head(samples)
