"""Follow a field with many kinematic agents, and measure how well."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sgvf_drake.clouds import PointCloud
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.simulation import simulate_agents
from sgvf_drake.fields import Field, FloatArray, ParametricField
from sgvf_drake.metrics import FollowMetrics, default_duration, follow_metrics, grid_starts
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress

# The integrator's step in U at a speed of one U a second, at most and in noise levels: the
# field turns within about half a noise level.
STEP = 0.05
STEP_PER_SIGMA = 0.5
LOG_PERIOD = 0.05
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


@dataclass(frozen=True, eq=False)
class FollowResult:
    """Trajectories of n agents and what they say of the field.

    Attributes:
        times: (T,) seconds at unit speed, that is, length travelled on the path.
        positions: (T, n, d) in the unit of the field; in space, without the parameter that
            the state of a parametric field has besides.
        errors: (T, n) cross-track errors in the unit of the field.
        metrics: Reach, lap, end, stall, leave and cross-track error.
        speed_on_path: Smallest and largest |m| on the reference.
        wall_s: Time of the simulation, building and measuring excluded.
    """

    times: FloatArray
    positions: FloatArray
    errors: FloatArray
    metrics: FollowMetrics
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
) -> FollowResult:
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
    sample = LOG_PERIOD * unit
    if not (np.isfinite(duration) and duration >= sample):
        raise ConfigurationError(
            f"the duration must be a number of at least {sample:.3g} s, not {duration}"
        )
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


def _states(field: PathField, positions: FloatArray) -> FloatArray:
    """Returns the states of agents at positions (n, d)."""
    return field.lift(positions) if isinstance(field, ParametricField) else positions


def _speed_on_path(field: PathField, reference: ReferencePath) -> tuple[float, float]:
    share = SPEED_SAMPLES // len(reference.pieces)
    points = np.concatenate([piece.sample(share) for piece in reference.pieces])
    m = field(_states(field, points))[:, : points.shape[1]]
    speeds = np.linalg.norm(m, axis=1)
    return float(speeds.min()), float(speeds.max())
