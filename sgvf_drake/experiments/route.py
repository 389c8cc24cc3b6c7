"""Flights along itineraries on a network, and how well their edges and turns are flown."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
import math
from typing import Any

import numpy as np
import pandas as pd

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.flight import (
    FORCE_COLUMNS,
    LOG_PERIOD,
    REST_S,
    TAKE_OFF_S,
    FlightSpec,
    check_branches,
    positions_of,
    simulate,
)
from sgvf_drake.experiments.scene import FlightScene
from sgvf_drake.experiments.tour import has_flown, speed_figures, start_along, time_limit
from sgvf_drake.fields import DirectedField
from sgvf_drake.metrics import REACH_DISTANCE, SETTLE_DISTANCE
from sgvf_drake.network_metrics import WAY_OFF
from sgvf_drake.passages import errors_in_use, passages, runs_along, turn_fraction
from sgvf_drake.paths import PathNetwork
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.planning import covering, shortest
from sgvf_drake.paths.sections import END, sections
from sgvf_drake.progress import Progress, no_progress
from systems import BranchAlong, BranchSupervisor, Feasibility, Mode
from systems.branches import STOPPING_TIME

# Errors within this many sigma of a node that is turned at are those of the turn.
NEAR_TURN = 2.0
# So many sigma from an end a vehicle may turn round: its speed is not judged there.
NEAR_END = END + 2.0
# Of the first edge of a loop, what is flown once more.
BEYOND = 0.6
# Figures of which the largest of all routes is told, and those of which the smallest is.
LARGEST = ("cross_track_rms_m", "cross_track_max_m", "turn_error_max_m", "motor_force_max_n")
SMALLEST = ("route_completed", "turn_fraction", "speed_min_m_s", "real_time_factor")


@dataclass(frozen=True, eq=False)
class RouteResult:
    """A flight along an itinerary.

    Attributes:
        itinerary: The itinerary, in metres.
        log: As that of a tour, with the edge in use, the arc length on the itinerary, and the
            distance from the edges in use as the error.
        figures: By the names of `summary.json`; errors count from one U after the first reach.
        feasibility: The demand of the itinerary at the commanded speed.
        spec: How it was flown.
    """

    itinerary: Itinerary
    log: pd.DataFrame
    figures: dict[str, Any]
    feasibility: Feasibility
    spec: FlightSpec

    def summary(self) -> dict[str, Any]:
        """Returns the figures by the names of `summary.json`."""
        return {
            "route": list(self.itinerary.edges),
            "route_closed": self.itinerary.closed,
            "route_length_m": self.itinerary.length,
            **self.figures,
            "speed_command_m_s": self.spec.speed,
            "motor_force_limit_n": self.spec.parameters.max_propeller_force,
            "acceleration_demand_m_s2": self.feasibility.demand,
            "acceleration_limit_m_s2": self.feasibility.limit,
        }


def routes_summary(results: Sequence[RouteResult]) -> dict[str, Any]:
    """Returns the worst of several routes, and each of them under `routes`; of one its own."""
    routes = [result.summary() for result in results]
    if len(routes) == 1:
        return routes[0]
    worst: dict[str, Any] = {}
    for names, choose in ((LARGEST, max), (SMALLEST, min)):
        for name in names:
            known = [route[name] for route in routes if route[name] is not None]
            worst[name] = choose(known) if known else None
    return {**worst, "speed_command_m_s": results[0].spec.speed, "routes": routes}


def to_point(network: PathNetwork, target: Sequence[float], spec: FlightSpec) -> Itinerary:
    """Returns the shortest itinerary from the start of a flight to a point.

    Args:
        network: In metres.
        target: The point (d,), in metres.
        spec: The flight; without a start it starts where the itinerary over all of the
            target's piece does.

    Raises:
        ConfigurationError: If the point cannot be used or reached.
    """
    if spec.start is not None:
        return shortest(network, spec.start[: network.dim], target)
    x = np.asarray(target, dtype=np.float64)
    piece = 0
    if x.shape == (network.dim,) and np.isfinite(x).all():
        piece = network.routes[int(network.path.project(x[None]).piece[0])].piece
    start = covering(network, piece).line.at(np.zeros(1))[0]
    return shortest(network, start, target)


def covering_routes(network: PathNetwork) -> list[Itinerary]:
    """Returns the itinerary over every edge of each piece; not of strays, below one U."""
    whole = [covering(network, piece) for piece in range(network.num_pieces)]
    return [route for route in whole if route.length >= network.unit_length]


def fly_route(
    field: DirectedField,
    itinerary: Itinerary,
    spec: FlightSpec | None = None,
    *,
    page: str = "route",
    progress: Progress = no_progress,
    scene: FlightScene | None = None,
    **options: Any,
) -> RouteResult:
    """Flies along an itinerary, from a hover beside its start.

    An open one is flown to its end, where the vehicle comes to rest.

    Args:
        field: The field, in metres; planar or spatial.
        itinerary: On the network of the field.
        spec: How it is flown; None: as `FlightSpec` has it, but for one lap.
        page: The name of the page of a scene.
        progress: Is told how far the simulation is.
        scene: Shows the flight; None: nothing does.
        **options: Fields of the spec in place of its own; see `fly`.

    Raises:
        ConfigurationError: If a value cannot be used, or if the vehicle lost control.
        NonFiniteValueError: If a value in the loop became NaN or infinite.
    """
    spec = replace(spec or FlightSpec(laps=1.0), **options)
    spec.check_supervised()
    if field.dim not in (2, 3):
        raise ConfigurationError(
            f"a vehicle needs a field of dimension 2 or 3, not {field.dim}"
        )
    branch = BranchAlong(field, itinerary)
    # Twice: the supervisor then tells when it is flown.
    supervisor: Any = BranchSupervisor(
        field, (branch,), (0, 0), spec.laps, spec.parameters, box=field.cloud.box
    )
    feasibility = check_branches(field, (branch,), spec.speed, spec.parameters)
    spec, heading = start_along(spec, branch)
    if spec.duration is None:
        limit = time_limit((branch,), spec, feasibility, field.cloud.unit_length)
        spec = replace(spec, duration=limit)
    # A loop is flown on beyond the middle of its first edge, where the last turn shows.
    lengths = np.diff(np.append(itinerary.starts, itinerary.length))
    rest = BEYOND * float(lengths[0]) / spec.speed if itinerary.closed else REST_S
    simulated = simulate(
        field,
        field.network.path,
        spec,
        field.network.edges[abs(itinerary.edges[0]) - 1].piece,
        supervisor=supervisor,
        heading=heading,
        feasibility=feasibility,
        page=page,
        is_over=partial(has_flown, supervisor, 1),
        rest=rest,
        scene=scene,
        progress=progress,
    )
    log = simulated.log.drop(columns="branch")
    figures = _figures(log, field, itinerary, spec)
    figures["route_completed"] &= simulated.is_over
    figures["real_time_factor"] = figures["duration_s"] / simulated.wall_s
    figures["live"] = simulated.live
    return RouteResult(itinerary, log, figures, feasibility, spec)


def _figures(
    log: pd.DataFrame, field: DirectedField, itinerary: Itinerary, spec: FlightSpec
) -> dict[str, Any]:
    """Returns the figures of a flight, and puts the error from the edges in use in its log."""
    network, sigma = field.network, field.memory_length
    positions = positions_of(log, field.dim)
    passed = passages(positions[:, None], network)
    log["cross_track_error"] = errors_in_use(positions, passed[0], network)
    turned, ends = _turned(itinerary, sigma)
    error, unit = log["cross_track_error"].to_numpy(), network.unit_length
    came = np.maximum.accumulate(error <= REACH_DISTANCE * unit)
    way_off = min(math.ceil(WAY_OFF * unit / spec.speed / LOG_PERIOD), len(came))
    came[way_off:] = came[: len(came) - way_off]
    came[:way_off] = False
    flies = came & (log["mode"] == Mode.FOLLOW).to_numpy()
    in_turn = _near(positions, turned, NEAR_TURN * sigma)
    moving = flies & (log["time"] > TAKE_OFF_S).to_numpy()
    moving &= ~_near(positions, ends, NEAR_END * sigma)
    if not itinerary.closed:
        stopping = max(STOPPING_TIME * spec.speed / 2, NEAR_END * sigma)
        moving &= (log["arc"] < itinerary.length - stopping).to_numpy()
    altitude = log["z"].to_numpy()[moving] - spec.altitude
    forces = log[list(FORCE_COLUMNS)].to_numpy()
    return {
        "route_completed": runs_along(passed[0], itinerary)
        and bool((error[came] <= SETTLE_DISTANCE * unit).all()),
        "turn_fraction": turn_fraction(passed, itinerary),
        "turned_nodes": len(turned),
        **{f"cross_track_{name}_m": x for name, x in _size(error[flies & ~in_turn]).items()},
        "turn_error_max_m": _size(error[flies & in_turn])["max"],
        **(speed_figures(log[moving]) if moving.any() else {"speed_min_m_s": 0.0}),
        "speed_judged": "after the take-off, away from ends",
        "altitude_rms_m": _size(altitude)["rms"] if field.dim == 2 else None,
        "motor_force_min_n": float(forces.min()),
        "motor_force_max_n": float(forces.max()),
        "duration_s": float(log["time"].iloc[-1]),
        "start_m": positions_of(log, 3)[0].tolist(),
    }


def _size(values: FloatArray) -> dict[str, float | None]:
    if not len(values):
        return {"rms": None, "max": None}
    return {"rms": float(np.sqrt((values**2).mean())), "max": float(np.abs(values).max())}


def _turned(itinerary: Itinerary, sigma: float) -> tuple[FloatArray, FloatArray]:
    """The places (n, d) of the nodes where an itinerary turns, and of ends where it does."""
    network = itinerary.network
    numbers = {s.node for s in sections(itinerary, sigma) if s.turns and s.node is not None}
    nodes = [network.nodes[number] for number in sorted(numbers)]
    empty = np.empty((0, network.dim))
    places = np.array([node.place for node in nodes]) if nodes else empty
    ends = [node.place for node in nodes if node.degree == 1]
    return places, np.array(ends) if ends else empty


def _near(positions: FloatArray, places: FloatArray, reach: float) -> BoolArray:
    """Which positions (T, d) are within a reach of one of some places (n, d)."""
    distance = np.linalg.norm(positions[:, None] - places, axis=2)
    return np.asarray(distance.min(axis=1, initial=np.inf) <= reach)
