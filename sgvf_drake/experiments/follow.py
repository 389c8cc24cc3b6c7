"""Follow a field with many kinematic agents, and measure how well."""

from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.simulation import simulate_agents
from sgvf_drake.fields import DirectedField, Field, FloatArray, ParametricField
from sgvf_drake.metrics import (
    DURATION_LAPS,
    DURATION_UNITS,
    FollowMetrics,
    default_duration,
    follow_metrics,
    grid_starts,
)
from sgvf_drake.network_metrics import NetworkMetrics, network_metrics
from sgvf_drake.paths import ReferencePath
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.navigator import Navigator
from sgvf_drake.progress import Progress, no_progress

# The integrator's step in U at a speed of one U a second, at most and in noise levels: the
# field turns within about half a noise level.
STEP = 0.05
STEP_PER_SIGMA = 0.5
LOG_PERIOD = 0.05
# Where an agent is on its route is looked at after this many noise levels of way.
NAVIGATION_PER_SIGMA = 0.25
# Robots slow down within this many noise levels of an end.
AT_REST = 10.0
# Points of the reference at which the speed on the path is read.
SPEED_SAMPLES = 2_000


class PathField(Field, Protocol):
    """A field that knows the waypoints it was made from, as a `GuidingField` does."""

    @property
    def cloud(self) -> PointCloud:
        """The waypoints."""

    @property
    def sigma(self) -> float:
        """The scale of the field across its path, U: it turns within about half of it."""

    @property
    def ends(self) -> FloatArray:
        """Where robots come to rest, (E, d) in the unit of the waypoints; E may be zero."""


Metrics = TypeVar("Metrics", FollowMetrics, NetworkMetrics)


@dataclass(frozen=True, eq=False)
class FollowResult(Generic[Metrics]):
    """Trajectories of n agents and what they say of the field.

    Attributes:
        times: (T,) seconds at unit speed, that is, length travelled on the path.
        positions: (T, n, d) in the unit of the field; in space, without the parameter that
            the state of a parametric field has besides.
        errors: (T, n) cross-track errors in the unit of the field.
        metrics: Reach, lap, end, stall, leave and cross-track error; of a directed field also
            what was done at crossings and turns.
        speed_on_path: Smallest and largest |m| on the reference.
        wall_s: Time of the simulation, building and measuring excluded.
    """

    times: FloatArray
    positions: FloatArray
    errors: FloatArray
    metrics: Metrics
    speed_on_path: tuple[float, float]
    wall_s: float

    def summary(self) -> dict[str, Any]:
        """Returns the figures by the names of `summary.json`."""
        return {
            "starts": self.positions.shape[1],
            **self.metrics.summary(),
            "speed_on_path_min": self.speed_on_path[0],
            "speed_on_path_max": self.speed_on_path[1],
            "duration": float(self.times[-1]),
            "wall_s": self.wall_s,
        }


def follow(
    field: PathField,
    reference: ReferencePath,
    starts: int = 400,
    duration: float | None = None,
    progress: Progress = no_progress,
) -> FollowResult[FollowMetrics]:
    """Follows a field from a grid of starts over its box, in one Drake diagram.

    With a parametric field, each agent starts at the parameter of the nearest point of its
    curve.

    Args:
        field: The field.
        reference: What the trajectories are measured against, in the field's unit.
        starts: Number of agents.
        duration: Seconds at unit speed; None: 1.5 longest pieces + 15 U.
        progress: Is told how far the simulation is.

    Raises:
        ConfigurationError: If the duration is not one sample long, or no start is asked for.
        NonFiniteValueError: If the field is not finite somewhere on the way.
    """
    unit = field.cloud.unit_length
    if duration is None:
        duration = default_duration(reference, unit)
    _check_duration(duration, unit)
    dim = field.cloud.dim
    grid = _states(field, grid_starts(field.cloud.box, starts, dim))
    ways, states, wall_s = simulate_agents(
        field,
        grid,
        unit,
        way=duration / unit,
        step=min(STEP, STEP_PER_SIGMA * field.sigma),
        log_period=LOG_PERIOD,
        progress=progress,
    )
    times = ways * unit
    positions = states[..., :dim]
    errors = reference.project(positions.reshape(-1, dim)).distance
    return FollowResult(
        times=times,
        positions=positions,
        errors=errors.reshape(positions.shape[:2]),
        metrics=follow_metrics(
            times, positions, unit, field.cloud.box, reference, ends=field.ends
        ),
        speed_on_path=_speed_on_path(field, reference),
        wall_s=wall_s,
    )


def _check_duration(duration: float, unit: float) -> None:
    sample = LOG_PERIOD * unit
    if not (np.isfinite(duration) and duration >= sample):
        raise ConfigurationError(
            f"the duration must be a number of at least {sample:.3g} s, not {duration}"
        )


def follow_network(
    field: DirectedField,
    starts: int = 100,
    duration: float | None = None,
    progress: Progress = no_progress,
    *,
    route: Itinerary | None = None,
    seed: int = 0,
) -> FollowResult[NetworkMetrics]:
    """Follows a directed field from a grid of starts, with headings by chance.

    Args:
        field: The field.
        starts: Number of agents.
        duration: Seconds at unit speed; None: 1.5 longest pieces, or routes, + 15 U.
        progress: Is told how far the simulation is.
        route: Where the agents are to go, from the place of it that they come to; None: they
            go on as they are heading.
        seed: The seed of the headings.

    Raises:
        ConfigurationError: If the duration is not one sample long, or no start is asked for.
    """
    unit, network, dim = field.cloud.unit_length, field.network, field.dim
    if duration is None:
        longest = network.length if route is None else route.length
        duration = DURATION_LAPS * longest + DURATION_UNITS * unit
    _check_duration(duration, unit)
    places = grid_starts(field.cloud.box, starts, dim)
    headings = np.random.default_rng(seed).normal(size=places.shape)
    headings /= np.linalg.norm(headings, axis=1, keepdims=True)
    period = NAVIGATION_PER_SIGMA * field.sigma
    navigator = None
    if route is not None:
        navigator = Navigator(route, field.memory_length, step=period * unit)
    ways, states, wall_s = simulate_agents(
        field.with_memory(),
        np.concatenate([places, headings], axis=1),
        unit,
        way=duration / unit,
        step=min(STEP, STEP_PER_SIGMA * field.sigma),
        log_period=LOG_PERIOD,
        progress=progress,
        navigator=navigator,
        navigation_period=period,
    )
    times, positions = ways * unit, states[..., :dim]
    metrics = network_metrics(times, positions, network, field.cloud.box, field.ends, route)
    return FollowResult(
        times=times,
        positions=positions,
        errors=metrics.errors,
        metrics=metrics,
        speed_on_path=_speed_on_edges(field),
        wall_s=wall_s,
    )


def _speed_on_edges(field: DirectedField) -> tuple[float, float]:
    """The smallest and the largest |m| along the edges, away from where robots rest."""
    share = SPEED_SAMPLES // len(field.network.edges)
    speeds = []
    for edge in field.network.edges:
        points = edge.line.sample(max(share, 3))
        chords = np.gradient(points, axis=0)
        g = chords / np.linalg.norm(chords, axis=1, keepdims=True)
        away = np.linalg.norm(points[:, None] - field.ends, axis=2).min(axis=1, initial=np.inf)
        moving = away > AT_REST * field.memory_length
        speeds.append(np.linalg.norm(field(points, g), axis=1)[moving])
    all_speeds = np.concatenate(speeds)
    return float(all_speeds.min()), float(all_speeds.max())


def _states(field: PathField, positions: FloatArray) -> FloatArray:
    """Returns the states of agents at positions (n, d)."""
    return field.lift(positions) if isinstance(field, ParametricField) else positions


def _speed_on_path(field: PathField, reference: ReferencePath) -> tuple[float, float]:
    share = SPEED_SAMPLES // len(reference.pieces)
    points = np.concatenate([piece.sample(share) for piece in reference.pieces])
    m = field(_states(field, points))[:, : points.shape[1]]
    speeds = np.linalg.norm(m, axis=1)
    return float(speeds.min()), float(speeds.max())
