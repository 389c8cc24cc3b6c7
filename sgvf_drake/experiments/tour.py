"""One flight along several pieces of a path, one after the other (paper, Fig. 3)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pandas as pd
from pydrake.systems.framework import Context

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.flight import (
    FORCE_COLUMNS,
    REST_S,
    START_OFFSET,
    TAKE_OFF_S,
    WAY_IN,
    FlightSpec,
    check_branches,
    check_feasibility,
    flown_pieces,
    route_start,
    simulate,
    velocities_of,
)
from sgvf_drake.experiments.scene import FlightScene
from sgvf_drake.fields import DirectedField, FloatArray, GuidingField
from sgvf_drake.metrics import REACH_DISTANCE, REST_WINDOW
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress
from systems import (
    Branch,
    BranchSupervisor,
    Feasibility,
    MakeBranches,
    Mode,
    QuadrotorParameters,
)
from systems.branch_supervisor import ACCELERATION_SHARE
from systems.supervision import Memory

# Time for a transfer: up to a lap until the place of departure, and so many times the way
# between the pieces.
TRANSFER_WAYS = 6.0
# And that many times all of it, since speed rises slowly: at the take-off and after turns.
SLACK = 2.0


@dataclass(frozen=True, eq=False)
class TourResult:
    """A flight along several pieces.

    Attributes:
        log: As that of `fly`, and the supervisor's mode and the piece that it follows or flies
            to.
        legs: The figures along each piece in turn, from the first reach on.
        transfers: The figures of each flight from one piece to the next.
        completed: Whether every leg was flown.
        feasibility: The demand of the path at the commanded speed.
        parameters: The vehicle.
        real_time_factor: Simulated over wall time.
        live: What was changed while it was flown; see `SimulatedFlight`.
    """

    log: pd.DataFrame
    legs: Sequence[Mapping[str, Any]]
    transfers: Sequence[Mapping[str, Any]]
    completed: bool
    feasibility: Feasibility
    parameters: QuadrotorParameters
    real_time_factor: float
    live: dict[str, Any] | None = None

    def summary(self) -> dict[str, Any]:
        """Returns the figures by the names of `summary.json`."""
        forces = self.log[list(FORCE_COLUMNS)].to_numpy()
        return {
            "completed": self.completed,
            "cross_track_rms_m": max(leg["cross_track_rms_m"] for leg in self.legs),
            "cross_track_max_m": max(leg["cross_track_max_m"] for leg in self.legs),
            **speed_figures(self.log[self.log["time"] > TAKE_OFF_S]),
            "motor_force_min_n": float(forces.min()),
            "motor_force_max_n": float(forces.max()),
            "motor_force_limit_n": self.parameters.max_propeller_force,
            "duration_s": float(self.log["time"].iloc[-1]),
            "real_time_factor": self.real_time_factor,
            "acceleration_demand_m_s2": self.feasibility.demand,
            "acceleration_limit_m_s2": self.feasibility.limit,
            "live": self.live,
            "legs": self.legs,
            "transfers": self.transfers,
        }


def fly_tour(
    field: GuidingField | DirectedField,
    reference: ReferencePath,
    tour: Sequence[int],
    spec: FlightSpec | None = None,
    *,
    progress: Progress = no_progress,
    scene: FlightScene | None = None,
    **options: Any,
) -> TourResult:
    """Flies from piece to piece without landing or stopping, from a hover beside the first.

    Args:
        field: The field, in metres; planar or spatial.
        reference: What the flight is measured against, in metres.
        tour: Numbers of pieces of the reference, or of the network of a directed field, in the
            order in which they are flown.
        spec: How they are flown; None: as `FlightSpec` has it, but for one lap.
        progress: Is told how far the simulation is.
        scene: Shows the flight; None: nothing does.
        **options: Fields of the spec in place of its own; see `fly`.

    Raises:
        ConfigurationError: If a value cannot be used, or if the vehicle lost control.
        NonFiniteValueError: If a value in the loop became NaN or infinite.
    """
    spec = replace(spec or FlightSpec(laps=1.0), **options)
    spec.check_supervised()
    pieces, branches = _branches_of(field, reference)
    stops = [_stop(pieces, piece) for piece in tour]
    if not stops:
        raise ConfigurationError("a tour needs at least one piece")
    # The last piece twice: the supervisor then tells when its leg is flown too.
    supervisor: Any = BranchSupervisor(
        field, branches, [*stops, stops[-1]], spec.laps, spec.parameters, box=field.cloud.box
    )

    flown, unit = [branches[stop] for stop in stops], field.cloud.unit_length
    rest = (START_OFFSET + REST_WINDOW) * unit / spec.speed + REST_S
    heading = None
    if isinstance(field, DirectedField):
        feasibility = check_branches(field, flown, spec.speed, spec.parameters)
        spec, heading = start_along(spec, flown[0])
    else:
        feasibility = check_feasibility(field, reference, spec.speed, spec.parameters)
    if spec.duration is None:
        spec = replace(spec, duration=time_limit(flown, spec, feasibility, unit))
    if scene is not None:
        scene.draw(field, spec.speed, spec.altitude)
    simulated = simulate(
        field,
        reference,
        spec,
        tour[0],
        supervisor=supervisor,
        heading=heading,
        feasibility=feasibility,
        is_over=partial(has_flown, supervisor, len(stops)),
        rest=0.0 if flown[-1].closed else rest,
        scene=scene,
        progress=progress,
    )
    log = simulated.log.rename(columns={"branch": "piece"})
    log["piece"] = np.array(pieces)[log["piece"]]
    legs, transfers = _legs_and_transfers(log, unit)
    return TourResult(
        log,
        legs,
        transfers,
        simulated.is_over,
        simulated.feasibility,
        spec.parameters,
        float(log["time"].iloc[-1]) / simulated.wall_s,
        simulated.live,
    )


def has_flown(supervisor: Any, stops: int, context: Context) -> bool:
    """Tells from the root Context whether a supervisor has come to a place of its tour."""
    own = supervisor.GetMyContextFromRoot(context)
    return Memory.FromVector(own.get_discrete_state(0).CopyToVector()).stop == stops


def start_along(spec: FlightSpec, branch: Branch) -> tuple[FlightSpec, FloatArray]:
    """Returns the spec with a start beside the itinerary of a branch, and the heading there."""
    assert branch.course is not None
    start, heading = route_start(branch.course.itinerary, spec.altitude)
    return replace(spec, start=spec.start or tuple(start.tolist())), heading


def _branches_of(
    field: GuidingField | DirectedField, reference: ReferencePath
) -> tuple[list[int], tuple[Branch, ...]]:
    """Returns the piece of the reference that each branch of the field is, and these."""
    unit = field.cloud.unit_length
    if isinstance(field, DirectedField):
        own = MakeBranches(field)
        numbers = [number for number, branch in enumerate(own) if branch.length >= unit]
        return numbers, tuple(own[number] for number in numbers)
    branches = [one for one in MakeBranches(field, field.path) if one.length >= unit]
    pieces = [
        int(np.bincount(reference.project(branch.points).piece).argmax()) for branch in branches
    ]
    if sorted(pieces) != flown_pieces(field, reference):
        raise ConfigurationError(
            f"the waypoints are in {len(pieces)} pieces, which are not those of the reference"
        )
    # In the order of the pieces, by which a slider numbers them.
    order = sorted(range(len(pieces)), key=lambda number: pieces[number])
    return [pieces[number] for number in order], tuple(branches[number] for number in order)


def _stop(pieces: Sequence[int], piece: int) -> int:
    if piece not in pieces:
        known = ", ".join(str(number + 1) for number in sorted(pieces))
        raise ConfigurationError(f"there is no piece {piece + 1} to fly (there are {known})")
    return pieces.index(piece)


def time_limit(
    branches: Sequence[Branch], spec: FlightSpec, feasibility: Feasibility, unit_length: float
) -> float:
    """Returns a time by which a tour is over, s."""
    way = WAY_IN * unit_length
    for branch in branches:
        way += (spec.laps if branch.closed else 1.0) * branch.length
    for here, there in pairwise(branches):
        apart = float(np.linalg.norm(here.points[:, None] - there.points[None], axis=2).max())
        way += here.length + TRANSFER_WAYS * apart
    # The supervisor lowers the speed until the path demands no more than it trusts.
    trusted = ACCELERATION_SHARE * feasibility.limit
    slowest = spec.speed * float(np.sqrt(trusted / max(trusted, feasibility.demand)))
    return TAKE_OFF_S + SLACK * way / slowest


def _legs_and_transfers(
    log: pd.DataFrame, unit_length: float
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Returns the figures of each part of a log with one mode and one piece."""
    legs, transfers = [], []
    part_number = (log[["mode", "piece"]].diff() != 0).any(axis=1).cumsum()
    for _, part in log.groupby(part_number):
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
            figures |= {
                "reached_s": float(measured["time"].iloc[0]) if reached.any() else None,
                "cross_track_rms_m": float(np.sqrt((errors**2).mean())),
                "cross_track_max_m": float(errors.max()),
            }
            legs.append(figures | _motion_figures(measured))
    return legs, transfers


def _motion_figures(part: pd.DataFrame) -> dict[str, float]:
    forces = part[list(FORCE_COLUMNS)].to_numpy()
    return {
        **speed_figures(part),
        "motor_force_min_n": float(forces.min()),
        "motor_force_max_n": float(forces.max()),
    }


def speed_figures(part: pd.DataFrame) -> dict[str, float]:
    """Returns the least and the greatest speed in a part of a log, m/s."""
    speed = np.linalg.norm(velocities_of(part), axis=1)
    return {"speed_min_m_s": float(speed.min()), "speed_max_m_s": float(speed.max())}
