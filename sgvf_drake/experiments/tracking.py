"""How well the quadrotor tracks the field's velocity, against what its tube tolerates."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from pydrake.systems.framework import Diagram

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.feasibility import check_feasibility, lost_control_named
from sgvf_drake.experiments.flight_log import LOG_PERIOD, flight_log
from sgvf_drake.experiments.fly import flight_duration, flown_pieces, hover_start
from sgvf_drake.experiments.simulation import advance, read_log
from sgvf_drake.fields import Field, GuidingField
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.lyapunov.margin import Margins
from sgvf_drake.paths import Reference
from sgvf_drake.progress import Progress, no_progress
from systems import (
    FieldForSpeed,
    MakeFlightDiagram,
    MakeSimulator,
    QuadrotorParameters,
    SetHover,
    StopOnExit,
    SublevelExit,
)

# The tracking errors that are told, beside the largest.
QUANTILES = (0.5, 0.99)


@dataclass(frozen=True, eq=False)
class PieceTracking:
    """The velocity-tracking error of one flight.

    Attributes:
        piece: Number of the piece in the reference.
        log: As that of `fly`, without the cross-track error, and V, V_dot (1/s) and
            tracking_error (m/s), the |v_WB - speed m(p_WB)| of the field's dimensions.
        settled: Which samples are those from the first one inside {V <= c_in} on, (T,).
        exit: Where and when the vehicle left {V <= level}, which ended the flight; None: it
            did not.
    """

    piece: int
    log: pd.DataFrame
    settled: BoolArray
    exit: SublevelExit | None

    def summary(self, speed: float, level: float, margins: Margins) -> dict[str, Any]:
        """Returns the figures by plain names; None where the flight never settled.

        `smallest_covering_level` is the smallest level of the margins that tolerates the
        largest error; None: none does.
        """
        settled = self.log[self.settled]
        figures: dict[str, Any] = {
            "piece": self.piece,
            "settled_s": None,
            "tracking_error_max_m_s": None,
            "covered": None,
            "smallest_covering_level": None,
            "V_max_settled": None,
            "exit": None if self.exit is None else str(self.exit),
        }
        if settled.empty:
            return figures
        error = settled["tracking_error"]
        largest = float(error.max())
        covering = margins.levels[speed * margins.e_star > largest]
        for quantile in QUANTILES:
            name = f"tracking_error_{100 * quantile:.0f}_percent_m_s"
            figures[name] = float(error.quantile(quantile))
        return figures | {
            "settled_s": float(settled["time"].iloc[0]),
            "tracking_error_max_m_s": largest,
            "covered": largest < speed * margins.at(level),
            "smallest_covering_level": float(covering[0]) if len(covering) else None,
            "V_max_settled": float(settled["V"].max()),
        }


@dataclass(frozen=True, eq=False)
class TrackingResult:
    """The velocity-tracking errors of the flights along all pieces.

    Attributes:
        flights: One a piece.
        speed: Commanded speed, m/s.
        c_in: A flight has settled once it is inside {V <= c_in}.
        level: The flights are to stay in {V <= level}.
        margins: What the level sets tolerate, at unit speed.
    """

    flights: Sequence[PieceTracking]
    speed: float
    c_in: float
    level: float
    margins: Margins

    def summary(self) -> dict[str, Any]:
        """Returns the worst of the pieces, and each of them under `pieces`.

        `covered` tells whether the largest settled error of every flight stays below the
        tolerated one of the level that it is to stay in.
        """
        pieces = [
            flight.summary(self.speed, self.level, self.margins) for flight in self.flights
        ]
        errors = [piece["tracking_error_max_m_s"] for piece in pieces]
        return {
            "speed_command_m_s": self.speed,
            "c_in": self.c_in,
            "level": self.level,
            "tolerated_error_m_s": self.speed * self.margins.at(self.level),
            "tracking_error_max_m_s": None if None in errors else max(errors),
            "covered": all(piece["covered"] for piece in pieces),
            "stayed": all(flight.exit is None for flight in self.flights),
            "pieces": pieces,
        }


def flight_tracking(
    field: GuidingField,
    reference: Reference,
    speed: float,
    function: LyapunovFunction,
    margins: Margins,
    *,
    c_in: float,
    level: float,
    laps: float = 2.0,
    altitude: float = 1.0,
    parameters: QuadrotorParameters | None = None,
    progress: Progress = no_progress,
) -> TrackingResult:
    """Flies along every piece, and compares the velocity error with what V tolerates.

    With the error d = v_WB - speed m(p), V_dot = speed grad V . m + grad V . d, which is
    negative on a level set {V = c} while |d| < speed e*(c), where e*(c) is the smallest
    inward normal speed of m there; then {V <= c} is invariant.  At unit speed the tolerated
    error is e* itself.  The field m is the one that is flown, `systems.FieldForSpeed`, and
    so must be that of e*.

    What this does not cover: the take-off, in which the vehicle stands still and the error
    is the speed itself, so that the comparison begins where the flight is first inside
    {V <= c_in}; the vertical motion over a planar field; and what lies between the samples,
    of the flight and of e*.  It is a comparison of measured figures, not a proof.

    Args:
        field: The field, in metres; planar or spatial.
        reference: Holds the pieces that are flown, in metres.
        speed: Commanded speed, m/s.
        function: V, of the field's dimension, in metres.
        margins: e* of the flown field on levels of V.
        c_in: A flight has settled once it is inside {V <= c_in}.
        level: A flight is to stay in {V <= level} once it is inside, and ends if it does
            not; at least c_in, and one of the margins' range.
        laps: Lengths of a closed piece that time is given for, after the way in.
        altitude: Height of the flight where the field is planar, m.
        parameters: The vehicle; None: the paper's.
        progress: Told how far each simulation is.

    Raises:
        ConfigurationError: A value cannot be used, or the vehicle lost control.
        NonFiniteValueError: A value in the loop became NaN or infinite.
    """
    if not (np.isfinite(speed) and speed > 0):
        raise ConfigurationError(f"the speed must be a positive number, not {speed}")
    lowest, highest = margins.levels[0], margins.levels[-1]
    if not max(c_in, lowest) <= level <= highest:
        raise ConfigurationError(
            f"the level must be at least c_in = {c_in:g}, and one of those whose margin is "
            f"known, {lowest:g} to {highest:g}, not {level:g}"
        )
    pieces = flown_pieces(reference, field.cloud.unit_length)
    if not pieces:
        raise ConfigurationError(
            f"nothing to fly: the longest piece is only {reference.longest:g} m long"
        )
    parameters = parameters or QuadrotorParameters()
    diagram = MakeFlightDiagram(
        field,
        parameters,
        speed=speed,
        altitude=altitude,
        log_period=LOG_PERIOD,
        lyapunov=function,
        level=level,
    )
    feasibility = check_feasibility(field, reference, speed, parameters)
    flown, unit = FieldForSpeed(field, speed), field.cloud.unit_length
    flights = []
    for piece in pieces:
        start = hover_start(reference, piece, unit, altitude, field.ends)
        duration = flight_duration(reference, piece, unit, speed, laps)
        with lost_control_named(f"piece {piece + 1}", speed, feasibility):
            log, left = _simulate(diagram, start, duration, progress)
        log["tracking_error"] = _tracking_error(log, flown, speed)
        settled = np.logical_or.accumulate(log["V"].to_numpy() <= c_in)
        flights.append(PieceTracking(piece, log, settled, left))
    return TrackingResult(flights, speed, c_in, level, margins)


def _simulate(
    diagram: Diagram, start: FloatArray, duration: float, progress: Progress
) -> tuple[pd.DataFrame, SublevelExit | None]:
    """Flies from a hover until the end or an exit; returns the log with V, and the exit."""
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, start)
    watch = StopOnExit(simulator)
    advance(simulator, duration, LOG_PERIOD, "fly", progress)
    log = flight_log(diagram, context)
    for name in ("V", "V_dot"):
        log[name] = read_log(diagram, context, f"{name}_log")[1][:, 0]
    return log, watch.exit


def _tracking_error(log: pd.DataFrame, flown: Field, speed: float) -> FloatArray:
    """Returns |v_WB - speed m(p_WB)| in m/s, over the dimensions of the field, (T,)."""
    position = log[["x", "y", "z"][: flown.dim]].to_numpy()
    velocity = log[["vx", "vy", "vz"][: flown.dim]].to_numpy()
    return np.asarray(np.linalg.norm(velocity - speed * flown(position), axis=1))
