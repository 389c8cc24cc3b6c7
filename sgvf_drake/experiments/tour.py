"""One flight along several pieces of a path, one after the other (paper, Fig. 3)."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import pairwise
import time
from typing import Any

import numpy as np
import pandas as pd
from pydrake.systems.analysis import Simulator

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.feasibility import (
    Feasibility,
    check_feasibility,
    lost_control_named,
)
from sgvf_drake.experiments.flight_log import FORCE_COLUMNS, LOG_PERIOD, flight_log
from sgvf_drake.experiments.fly import (
    REST_S,
    START_OFFSET,
    TAKE_OFF_S,
    WAY_IN,
    check_flight,
    flown_pieces,
    hover_start,
)
from sgvf_drake.experiments.scene import FlightScene
from sgvf_drake.experiments.simulation import read_log
from sgvf_drake.fields import GuidingField
from sgvf_drake.metrics import REACH_DISTANCE, REST_WINDOW
from sgvf_drake.paths import Reference
from sgvf_drake.progress import Progress, no_progress
from systems import (
    Branch,
    BranchSupervisor,
    MakeBranches,
    MakeFlightDiagram,
    MakeSimulator,
    Mode,
    QuadrotorParameters,
    SensorParameters,
    SetHover,
    SetNoiseSeed,
)
from systems.branch_supervisor import ACCELERATION_SHARE
from systems.supervision import Memory

# The flight is looked at so often, to see whether the tour is done, s.
CHUNK = 0.1
# Time for a transfer: up to a lap until the place of departure, and so many times the way
# between the pieces.
TRANSFER_WAYS = 6.0
# And that many times all of it, since speed rises slowly: at the take-off and after turns.
SLACK = 2.0


@dataclass(frozen=True, eq=False)
class TourResult:
    """A flight along several pieces.

    Attributes:
        log: One row a sample of 10 ms: as that of `fly`, and the supervisor's mode and the
            piece that it follows or flies to.
        legs: The figures along each piece in turn, from the first reach on.
        transfers: The figures of each flight from one piece to the next.
        completed: Whether every leg was flown.
        feasibility: The demand of the path at the commanded speed.
        parameters: The vehicle.
        real_time_factor: Simulated over wall time.
    """

    log: pd.DataFrame
    legs: Sequence[Mapping[str, Any]]
    transfers: Sequence[Mapping[str, Any]]
    completed: bool
    feasibility: Feasibility
    parameters: QuadrotorParameters
    real_time_factor: float

    def summary(self) -> dict[str, Any]:
        """Returns the figures by the names of `summary.json`."""
        under_way = self.log[self.log["time"] > TAKE_OFF_S]
        forces = self.log[list(FORCE_COLUMNS)].to_numpy()
        return {
            "completed": self.completed,
            "cross_track_rms_m": max(leg["cross_track_rms_m"] for leg in self.legs),
            "cross_track_max_m": max(leg["cross_track_max_m"] for leg in self.legs),
            "speed_min_m_s": float(_speed(under_way).min()),
            "speed_max_m_s": float(_speed(under_way).max()),
            "motor_force_min_n": float(forces.min()),
            "motor_force_max_n": float(forces.max()),
            "motor_force_limit_n": self.parameters.max_propeller_force,
            "duration_s": float(self.log["time"].iloc[-1]),
            "real_time_factor": self.real_time_factor,
            "acceleration_demand_m_s2": self.feasibility.demand,
            "acceleration_limit_m_s2": self.feasibility.limit,
            "legs": self.legs,
            "transfers": self.transfers,
        }


def fly_tour(
    field: GuidingField,
    reference: Reference,
    tour: Sequence[int],
    speed: float = 0.45,
    laps: float = 1.0,
    altitude: float = 1.0,
    parameters: QuadrotorParameters | None = None,
    sensors: SensorParameters | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
    scene: FlightScene | None = None,
) -> TourResult:
    """Flies from piece to piece without landing or stopping, from a hover beside the first.

    Args:
        field: The field, in metres; planar or spatial.
        reference: What the flight is measured against, in metres.
        tour: Numbers of pieces of the reference, in the order in which they are flown.
        speed: Commanded speed, m/s.
        laps: Of every closed piece, at least 1.
        altitude: Height of the flight where the field is planar, m.
        parameters: The vehicle; None: the paper's.
        sensors: Noise, delay and rates of the measurements; None: they are ideal.
        seed: Of their noise.
        progress: Told how far the simulation is.
        scene: Shows the flight; None: nothing does.

    Raises:
        ConfigurationError: A value cannot be used, or the vehicle lost control.
        NonFiniteValueError: A value in the loop became NaN or infinite.
    """
    parameters = parameters or QuadrotorParameters()
    check_flight(speed, laps, altitude)
    pieces, branches = _branches_of(field, reference)
    stops = [_stop(pieces, piece) for piece in tour]
    if not stops:
        raise ConfigurationError("a tour needs at least one piece")
    # The last piece twice: the supervisor then tells when its leg is flown too.
    supervisor: Any = BranchSupervisor(
        field, branches, [*stops, stops[-1]], laps, parameters, box=field.cloud.box
    )
    diagram: Any = MakeFlightDiagram(
        field,
        parameters,
        speed=speed,
        altitude=altitude,
        log_period=LOG_PERIOD,
        sensors=sensors,
        supervisor=supervisor,
        meshcat=None if scene is None else scene.meshcat,
    )
    if scene is not None:
        scene.draw(field, speed, altitude)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    unit = field.cloud.unit_length
    start = hover_start(reference, tour[0], unit, altitude, field.ends)
    SetHover(diagram, context, start)
    SetNoiseSeed(diagram, context, seed)
    feasibility = check_feasibility(field, reference, speed, parameters)
    flown = [branches[stop] for stop in stops]
    limit = _time_limit(flown, laps, _slowest(speed, feasibility), unit)
    rest = 0.0 if flown[-1].closed else (START_OFFSET + REST_WINDOW) * unit / speed + REST_S
    shown = nullcontext() if scene is None else scene.show(simulator, "tour")
    with lost_control_named("the tour", speed, feasibility), shown:
        begin = time.perf_counter()
        completed = _advance(simulator, len(stops), rest, limit, progress)
        wall_s = time.perf_counter() - begin
    log = _tour_log(diagram, context, field, reference, pieces)
    legs, transfers = _legs_and_transfers(log, unit)
    return TourResult(
        log,
        legs,
        transfers,
        completed,
        feasibility,
        parameters,
        float(log["time"].iloc[-1]) / wall_s,
    )


def _branches_of(
    field: GuidingField, reference: Reference
) -> tuple[list[int], tuple[Branch, ...]]:
    """Returns the piece of the reference that each branch of the waypoints is, and these."""
    branches = MakeBranches(field, field.cloud.points)
    pieces = [
        int(np.bincount(reference.project(branch.points).piece).argmax()) for branch in branches
    ]
    if len(set(pieces)) < len(pieces) or set(pieces) != set(
        flown_pieces(reference, field.cloud.unit_length)
    ):
        raise ConfigurationError(
            f"the waypoints are in {len(pieces)} pieces, which are not those of the reference"
        )
    return pieces, branches


def _stop(pieces: Sequence[int], piece: int) -> int:
    if piece not in pieces:
        known = ", ".join(str(number + 1) for number in sorted(pieces))
        raise ConfigurationError(f"there is no piece {piece + 1} to fly (there are {known})")
    return pieces.index(piece)


def _slowest(speed: float, feasibility: Feasibility) -> float:
    """Returns the least speed to which the supervisor lowers one, m/s."""
    trusted = ACCELERATION_SHARE * feasibility.limit
    return speed * float(np.sqrt(trusted / max(trusted, feasibility.demand)))


def _time_limit(
    branches: Sequence[Branch], laps: float, speed: float, unit_length: float
) -> float:
    """Returns a time by which a tour is over, s."""
    way = WAY_IN * unit_length
    for branch in branches:
        way += (laps if branch.closed else 1.0) * branch.length
    for here, there in pairwise(branches):
        apart = float(np.linalg.norm(here.points[:, None] - there.points[None], axis=2).max())
        way += here.length + TRANSFER_WAYS * apart
    return TAKE_OFF_S + SLACK * way / speed


def _advance(
    simulator: Simulator, num_legs: int, rest: float, limit: float, progress: Progress
) -> bool:
    """Advances until all legs of a tour are flown; returns whether they were.

    Args:
        simulator: Of the flight.
        num_legs: Of the tour, before the supervisor's last stop.
        rest: Time after them, in which to come to the end of an open piece, s.
        limit: The time after which legs are no longer waited for, s.
        progress: Told how far it is.
    """
    diagram: Any = simulator.get_system()
    supervisor = diagram.GetSubsystemByName("supervisor")
    own = supervisor.GetMyContextFromRoot(simulator.get_context())
    for chunk in range(1, int(np.ceil(limit / CHUNK)) + 1):
        simulator.AdvanceTo(chunk * CHUNK)
        progress("fly", chunk * CHUNK, limit)
        memory = Memory.FromVector(own.get_discrete_state(0).CopyToVector())
        if memory.stop == num_legs:
            simulator.AdvanceTo(chunk * CHUNK + rest)
            return True
    return False


def _tour_log(
    diagram: Any,
    context: Any,
    field: GuidingField,
    reference: Reference,
    pieces: Sequence[int],
) -> pd.DataFrame:
    log = flight_log(diagram, context)
    log["mode"] = read_log(diagram, context, "mode_log")[1][:, 0].astype(int)
    branch = read_log(diagram, context, "branch_log")[1][:, 0].astype(int)
    log["piece"] = np.array(pieces)[branch]
    positions = log[["x", "y", "z"][: field.dim]].to_numpy()
    log["cross_track_error"] = reference.project(positions).distance
    return log


def _legs_and_transfers(
    log: pd.DataFrame, unit_length: float
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    legs, transfers = [], []
    for part in _parts(log):
        figures: dict[str, Any] = {
            "piece": int(part["piece"].iloc[0]),
            "begin_s": float(part["time"].iloc[0]),
            "end_s": float(part["time"].iloc[-1]),
        }
        if part["mode"].iloc[0] == Mode.TRANSFER:
            transfers.append(figures | _motion_figures(part))
        elif part["mode"].iloc[0] == Mode.FOLLOW:
            reached = part["cross_track_error"].to_numpy() <= REACH_DISTANCE * unit_length
            measured = part.iloc[int(np.argmax(reached)) :] if reached.any() else part
            errors = measured["cross_track_error"]
            legs.append(
                figures
                | {
                    "reached_s": float(measured["time"].iloc[0]) if reached.any() else None,
                    "cross_track_rms_m": float(np.sqrt((errors**2).mean())),
                    "cross_track_max_m": float(errors.max()),
                }
                | _motion_figures(measured)
            )
    return legs, transfers


def _parts(log: pd.DataFrame) -> Iterator[pd.DataFrame]:
    """Yields the parts of a log with one mode and one piece."""
    keys = log[["mode", "piece"]].to_numpy()
    borders = np.flatnonzero((np.diff(keys, axis=0) != 0).any(axis=1)) + 1
    for begin, end in pairwise([0, *borders, len(log)]):
        yield log.iloc[begin:end]


def _motion_figures(part: pd.DataFrame) -> dict[str, float]:
    forces = part[list(FORCE_COLUMNS)].to_numpy()
    return {
        "speed_min_m_s": float(_speed(part).min()),
        "speed_max_m_s": float(_speed(part).max()),
        "motor_force_min_n": float(forces.min()),
        "motor_force_max_n": float(forces.max()),
    }


def _speed(part: pd.DataFrame) -> np.ndarray:
    return np.linalg.norm(part[["vx", "vy", "vz"]].to_numpy(), axis=1)
