"""Theorem 1 of the paper along trajectories: decrease, level sets, and the speed on the modes.

All lengths are in the field's unit.  The simulations run at unit speed, so that their times
are lengths along a field of length one, and rates are per unit of length.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from sgvf_drake.arrays import BoolArray, FloatArray
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.experiments.simulation import advance, read_log
from sgvf_drake.fields import AdjustableField, Field, GuidingField, TangentField
from sgvf_drake.lyapunov import LyapunovFunction, Verification, find_modes
from sgvf_drake.metrics import default_duration, grid_starts
from sgvf_drake.paths import ReferencePath
from sgvf_drake.progress import Progress, no_progress
from systems import MakeKinematicDiagram, MakeSimulator, SetPositions, StopOnExit, SublevelExit

# The step of the integrator, and of the samples, in noise levels of V; but no longer than the
# approach length of a field that has one.  On concentric circles V is then right within 2e-3
# along m, all on the steep way in, and within a thousandth of itself along v.
STEP_PER_SIGMA = 0.5
# Halvings of the interval in which a level set lies: down to rounding.
BISECTIONS = 60
# Fewer agents than this tell little of a basin.
FEW_STARTS = 8
# Level sets of the band on which x_dot = v starts.
NUM_LEVEL_SETS = 5


@dataclass(frozen=True, eq=False)
class LyapunovRun:
    """V along the trajectories of n agents.

    Attributes:
        times: (T,) s.
        positions: (T, n, d) in the field's unit.
        V: (T, n).
        V_dot: (T, n) grad V . x_dot, 1/s.
        exit: Where and when an agent left {V <= level}, which ended the run; None: none did.
    """

    times: FloatArray
    positions: FloatArray
    V: FloatArray
    V_dot: FloatArray
    exit: SublevelExit | None


def follow_lyapunov(
    field: Field,
    function: LyapunovFunction,
    starts: FloatArray,
    duration: float,
    level: float = math.inf,
    step: float | None = None,
    progress: Progress = no_progress,
) -> LyapunovRun:
    """Follows x_dot = m(x) in one Drake diagram, and V along it.

    Args:
        field: The field m.
        function: V, of the field's dimension.
        starts: (n, d) in the field's unit.
        duration: s.
        level: Of a sublevel set that should be invariant: the run ends when an agent that
            was inside is outside.
        step: Length of one step of the integrator where |m| = 1, and of one sample; None:
            `STEP_PER_SIGMA` noise levels of V, or the field's approach length if less.
        progress: Told how far the simulation is.

    Raises:
        ConfigurationError: The duration is not one sample long, or an argument cannot be
            used.
        NonFiniteValueError: The field is not finite somewhere on the way.
    """
    period = step
    if period is None:
        period = STEP_PER_SIGMA * function.sigma
        if isinstance(field, AdjustableField):
            period = min(period, field.approach_length)
    if not (np.isfinite(duration) and duration >= period):
        raise ConfigurationError(
            f"the duration must be a number of at least {period:.3g} s, not {duration}"
        )
    diagram = MakeKinematicDiagram(
        field, len(starts), 1.0, log_period=period, lyapunov=function, level=level
    )
    simulator = MakeSimulator(diagram, step=period)
    context = simulator.get_mutable_context()
    SetPositions(diagram, context, starts)
    watch = StopOnExit(simulator)
    advance(simulator, duration, period, "follow", progress)
    times, positions = read_log(diagram, context, "positions_log")
    return LyapunovRun(
        times,
        positions.reshape(-1, *starts.shape),
        read_log(diagram, context, "V_log")[1],
        read_log(diagram, context, "V_dot_log")[1],
        watch.exit,
    )


@dataclass(frozen=True, eq=False)
class DecreaseCheck:
    """Theorem 1 (i): V falls through a band of levels, and the agents stay below it.

    Attributes:
        run: The trajectories.
        band: (c_in, c_out).
        lap: Length of the last part of the run, over which V is averaged.
    """

    run: LyapunovRun
    band: tuple[float, float]
    lap: float

    @property
    def entry_times(self) -> FloatArray:
        """(n,) the time of the first sample with V <= c_in; infinity: there is none."""
        first = self.run.times[self._below.argmax(axis=0)]
        return np.where(self._below.any(axis=0), first, np.inf)

    @property
    def largest_after_entry(self) -> FloatArray:
        """(n,) the largest V from then on; NaN: the agent never entered."""
        entered = self.run.times[:, None] >= self.entry_times
        largest = np.where(entered, self.run.V, -np.inf).max(axis=0)
        return np.where(entered.any(axis=0), largest, np.nan)

    @property
    def _below(self) -> BoolArray:
        return np.less_equal(self.run.V, self.band[0])

    def summary(self) -> dict[str, Any]:
        """Returns the figures by plain names; None where there is nothing to tell of.

        `V_rise_max` is the largest V(t + step) - V(t) from a sample in the band, and
        `V_dot_max` the largest V_dot at one.
        """
        run, in_band = self.run, ~self._below
        entered = np.isfinite(self.entry_times)
        stayed = entered & (self.largest_after_entry <= self.band[0])
        last = run.times >= run.times[-1] - self.lap
        return {
            "starts": len(entered),
            "c_in": self.band[0],
            "c_out": self.band[1],
            # No sample is above c_out before an exit.
            "V_rise_max": _largest(np.diff(run.V, axis=0)[in_band[:-1]]),
            "V_dot_max": _largest(run.V_dot[in_band]),
            "entered_fraction": float(entered.mean()),
            "stayed_fraction": float(stayed.mean()),
            "entry_time_max": _largest(self.entry_times[entered]),
            "V_after_entry_max": _largest(self.largest_after_entry[entered]),
            "V_last_lap_mean": float(run.V[last].mean()),
            "exit": None if run.exit is None else str(run.exit),
        }


def check_decrease(
    field: Field,
    function: LyapunovFunction,
    band: tuple[float, float],
    starts: FloatArray,
    duration: float,
    lap: float,
    progress: Progress = no_progress,
) -> DecreaseCheck:
    """Follows x_dot = m(x) from starts inside {V <= c_out}, which should be invariant.

    After an agent has entered {V <= c_in}, V does not fall further but fluctuates: the path
    is no level set of V, whose minima are a handful of modes on it.

    Args:
        field: The field m.
        function: V.
        band: (c_in, c_out), the levels between which V should fall.
        starts: (n, d), inside {V <= c_out}.
        duration: Of the run, which ends early if an agent leaves {V <= c_out}.
        lap: Length of the path, or of its longest piece.
        progress: Told how far the simulation is.

    Raises:
        ConfigurationError: A start is outside, or an argument cannot be used.
    """
    c_in, c_out = band
    if not 0.0 < c_in < c_out:
        raise ConfigurationError(f"the band must be two rising positive levels, not {band}")
    outside = np.flatnonzero(function(starts) > c_out)
    if len(outside):
        raise ConfigurationError(
            f"{len(outside)} starts are outside of the band, V > {c_out:.4g}; the first is "
            f"start {outside[0]} at {starts[outside[0]].tolist()}"
        )
    run = follow_lyapunov(field, function, starts, duration, level=c_out, progress=progress)
    return DecreaseCheck(run, (c_in, c_out), lap)


@dataclass(frozen=True, eq=False)
class LevelSetCheck:
    """Theorem 1 (ii): V along x_dot = v alone, from starts on level sets.

    Attributes:
        levels: (L,) the levels.
        runs: One run a level, from k starts each.
    """

    levels: FloatArray
    runs: Sequence[LyapunovRun]

    @property
    def drift(self) -> FloatArray:
        """(L, k) the largest |V(t) - V(0)| along each trajectory."""
        return np.array([np.abs(run.V - run.V[0]).max(axis=0) for run in self.runs])

    @property
    def lengths(self) -> FloatArray:
        """(L, k) the length of each trajectory."""
        steps = [np.diff(run.positions, axis=0) for run in self.runs]
        return np.array([np.linalg.norm(step, axis=2).sum(axis=0) for step in steps])

    @property
    def rate(self) -> FloatArray:
        """(L, k) the mean |dV/ds| along each trajectory, per unit of its length s."""
        changes = [np.abs(np.diff(run.V, axis=0)).sum(axis=0) for run in self.runs]
        return np.array(changes) / self.lengths

    def summary(self) -> dict[str, Any]:
        """Returns lists with one entry a level; relative ones are over the level."""
        drift, rate = self.drift, self.rate
        return {
            "levels": self.levels.tolist(),
            "drift_max": drift.max(axis=1).tolist(),
            "drift_median": np.median(drift, axis=1).tolist(),
            "drift_relative_max": (drift.max(axis=1) / self.levels).tolist(),
            "rate_mean": rate.mean(axis=1).tolist(),
            "rate_relative_mean": (rate.mean(axis=1) / self.levels).tolist(),
            "length_min": self.lengths.min(axis=1).tolist(),
            "length_max": self.lengths.max(axis=1).tolist(),
        }


def check_level_sets(
    tangent: Field,
    function: LyapunovFunction,
    levels: Sequence[float],
    duration: float,
    starts_per_level: int = 16,
    seed: int = 0,
    progress: Progress = no_progress,
) -> LevelSetCheck:
    """Follows x_dot = v(x) alone from starts on level sets, along which V should not change.

    It is constant only where v is orthogonal to grad V, which a learned v is not quite, and
    grad V of an explicit density is not quite what v was trained to be orthogonal to.  The
    drift is that of the field: that of the integrator is smaller by orders of magnitude.

    Args:
        tangent: v as it is, whatever its length: `TangentField`.
        function: V.
        levels: The levels, above zero.
        duration: Of each run; the length of a lap where |v| = 1.
        starts_per_level: Number of starts on each level set.
        seed: Of the starts.
        progress: Told how far the simulations are.

    Raises:
        ConfigurationError: There is no waypoint inside a level set, or an argument cannot
            be used.
    """
    rng = np.random.default_rng(seed)
    runs = []
    for number, level in enumerate(levels):
        starts = level_set_points(function, level, starts_per_level, rng)
        runs.append(follow_lyapunov(tangent, function, starts, duration))
        progress("level sets", number + 1, len(levels))
    return LevelSetCheck(np.array(levels, dtype=np.float64), runs)


def level_set_points(
    function: LyapunovFunction, level: float, count: int, rng: np.random.Generator
) -> FloatArray:
    """Returns points (count, d) with V = level, in random directions from random waypoints.

    Raises:
        ConfigurationError: There is no waypoint with V below the level.
    """
    points = function.mixture.points
    points = points[function(points) < level]
    if len(points) == 0:
        raise ConfigurationError(f"no waypoint is inside of the level set V = {level:g}")
    origin = points[rng.integers(len(points), size=count)]
    direction = rng.standard_normal(origin.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)

    def is_outside(distance: FloatArray) -> BoolArray:
        return function(origin + distance[:, None] * direction) >= level

    inner, outer = np.zeros(count), np.full(count, function.sigma)
    while not (outside := is_outside(outer)).all():
        inner, outer = np.where(outside, inner, outer), np.where(outside, outer, 2 * outer)
    for _ in range(BISECTIONS):
        middle = (inner + outer) / 2
        outside = is_outside(middle)
        inner, outer = np.where(outside, inner, middle), np.where(outside, middle, outer)
    return origin + outer[:, None] * direction


@dataclass(frozen=True, eq=False)
class ModeCheck:
    """Theorem 1 (iii): on the modes of the density, where grad V = 0, the motion goes on.

    Attributes:
        modes: (k, d) the local maxima of the density.
        V: (k,) V there, zero at the global ones.
        speeds: (k,) |m| there.
    """

    modes: FloatArray
    V: FloatArray
    speeds: FloatArray

    def summary(self) -> dict[str, Any]:
        """Returns the figures by plain names."""
        return {
            "modes": len(self.speeds),
            "speed_min": float(self.speeds.min()),
            "speed_mean": float(self.speeds.mean()),
            "speed_max": float(self.speeds.max()),
            "speed_at_global_mode": float(self.speeds[self.V.argmin()]),
        }


def check_modes(field: Field, function: LyapunovFunction) -> ModeCheck:
    """Evaluates the speed |m| at the modes of the density of V."""
    modes = find_modes(function.mixture)
    return ModeCheck(modes, function(modes), np.linalg.norm(field(modes), axis=1))


Checks = tuple[DecreaseCheck, LevelSetCheck, ModeCheck]


def check_theorem(
    field: GuidingField,
    reference: ReferencePath,
    found: Verification,
    starts: int,
    progress: Progress = no_progress,
) -> Checks:
    """Follows the field through its band, and checks Theorem 1 (i) to (iii).

    Args:
        field: The field.
        reference: The path.
        found: Its verification, with a band.
        starts: Agents of the grid, of which those inside {V <= c_out} count; where these are
            fewer than `FEW_STARTS`, about so many of a finer grid inside.
        progress: Told how far it is.
    """
    assert found.band is not None
    function, c_in, c_out = found.function, found.band.c_in, found.band.c_out
    grid = grid_starts(field.cloud.box, starts, field.dim)
    inside = grid[function(grid) <= c_out]
    if len(inside) < FEW_STARTS:
        # So coarse a grid misses most of a thin basin, as in space.
        grid = found.samples.x[found.samples.on_grid]
        inside = grid[function(grid) <= c_out]
        inside = inside[:: max(1, len(inside) // starts)]
    # It may miss it still; the lowest waypoint lies in it.
    points = function.mixture.points
    first = inside if len(inside) else points[[np.argmin(function(points))]]
    longest = reference.longest
    duration = default_duration(reference, field.cloud.unit_length)
    decrease = check_decrease(
        field, function, (c_in, c_out), first, duration, longest, progress
    )
    levels = np.geomspace(c_in, c_out, NUM_LEVEL_SETS).tolist()
    level_sets = check_level_sets(
        TangentField(field), function, levels, longest, progress=progress
    )
    return decrease, level_sets, check_modes(field, function)


def _largest(values: FloatArray) -> float | None:
    return float(values.max()) if values.size else None
