"""Orbits of m by integration: those that close, come to rest, or lead from place to place."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.field_model import ExactField
from sgvf_drake.certificate.rest_ball import RestBall, prove_rest
from sgvf_drake.fields import ComposedField
from sgvf_drake.fields.compiled import CompiledField

Precision = tuple[str, float]
# SciPy's method, and its relative and absolute tolerance: where nothing else is told, and where
# an orbit need not be more than sketched, at half the cost.
PRECISE, ROUGH = ("DOP853", 1e-7), ("RK45", 1e-6)
# The longest step, in time at |m| = 1, by which no passage of a plane within `NEAR` is missed.
LONGEST_STEP = 0.15
# A return to within this is looked at, in U, and one to within so many tolerances ends the
# search.
NEAR, CLOSED = 0.2, 10
# What an orbit is given to settle, in lengths of its piece; so many laps, none longer than so
# many lengths.
SETTLING, LAPS, LONGEST_LAP = 0.2, 6, 3.0
# What is added to the time of the way between two places.
SLOWEST = 1.0
# An orbit rests where |m| is so small.  Radii of balls of rest that are tried, in U, and how
# deep in one an orbit is followed.
STILL, RADII, WELL_INSIDE = 1e-4, (0.05, 0.035, 0.025, 0.0175), 0.6
# Steps in which it is looked for the time at which an orbit is there.
STEP = 1 / 64

Solution = Callable[[FloatArray], FloatArray]
Rate = Callable[[float, FloatArray], FloatArray]
Event = Callable[[float, FloatArray], float]


@dataclass(frozen=True, eq=False)
class Orbit:
    """A solution of z' = m(z), in normalised units.

    Attributes:
        at: From times (n,) to points (d, n).
        duration: The time of a lap, or until it is where it leads to: well inside of its ball
            of rest, if it has one.
        closed: Whether it is periodic.
        rest: Where it comes to rest; None: it does not.
    """

    at: Solution
    duration: float
    closed: bool
    rest: RestBall | None = None

    @property
    def end(self) -> FloatArray:
        """The point (d,) at which it is after its duration."""
        return self.at(np.array([self.duration]))[:, 0]


def closed_orbit(
    field: ExactField,
    start: FloatArray,
    length: float,
    *,
    turn: float = 0.0,
    precision: Precision = PRECISE,
) -> Orbit | None:
    """Returns the closed orbit on which m settles; None if it does not settle on one.

    Args:
        field: m.
        start: (d,) where to start, normalised.
        length: About the time of a lap.
        turn: The angle by which m is turned counter-clockwise first, in the plane, rad.
        precision: How precisely.
    """
    rate = rate_of(field, turn)
    place = _run(rate, start, SETTLING * length, precision=precision).y[:, -1]
    for _ in range(LAPS):
        back = _return_to(place, rate(0.0, place))
        run = _run(rate, place, LONGEST_LAP * length, back, precision=precision)
        gap, place = place - run.y[:, -1], run.y[:, -1]
        if run.status != 1 or gap @ gap > NEAR**2 / 4:
            return None
        if np.abs(gap).max() < CLOSED * precision[1]:
            return Orbit(_closed_up(run.sol, run.t[-1], gap), float(run.t[-1]), closed=True)
    return None


def open_orbit(field: ExactField, start: FloatArray, length: float) -> Orbit | None:
    """Returns the orbit from a place to a ball in which all is proved to come to rest, or None.

    Args:
        field: m.
        start: (d,) where to start, normalised.
        length: About the time that it takes.
    """
    rate = rate_of(field)
    run = _run(rate, start, LONGEST_LAP * length, _stop(rate))
    if run.status != 1:
        return None
    end = run.y[:, -1]
    times = np.arange(0.0, run.t[-1], STEP)
    away = np.linalg.norm(run.sol(times).T - end, axis=1)
    for ball in (RestBall(tuple(end.tolist()), radius) for radius in RADII):
        if prove_rest(field, ball).proved:
            outside = times[away > WELL_INSIDE * ball.radius]
            return Orbit(run.sol, float(outside.max(initial=0.0)) + STEP, False, ball)
    return None


def passing_orbit(
    field: ExactField, start: FloatArray, place: FloatArray, normal: FloatArray, near: float
) -> tuple[Orbit, bool]:
    """Returns the orbit from a place until it passes a plane near another, and whether it does.

    Args:
        field: The field.
        start: (d,) where to start, normalised.
        place: (d,) a point of the plane.
        normal: (d,) that of the plane, which it passes in this direction.
        near: How far from the place it passes the plane, at most.
    """
    longest = LONGEST_LAP * float(np.linalg.norm(place - start)) + SLOWEST
    run = _run(rate_of(field), start, longest, _pass(place, normal, near), near / 2)
    return Orbit(run.sol, float(run.t[-1]), closed=False), run.status == 1


def rate_of(field: ExactField, turn: float = 0.0) -> Rate:
    """Returns z' by time and z, for m turned by an angle, rad; in the plane, unless it is 0."""
    if turn:
        return _turned(rate_of(field), turn)
    center, unit = field.cloud.center, field.cloud.unit_length
    if isinstance(field, ComposedField):
        compiled, no_slopes = CompiledField(field), np.empty((0, field.dim))
        return lambda _, z: compiled.evaluate(center + unit * z, no_slopes)
    motion, g, d = field.field.with_memory().compiled(), field.g, field.dim
    return lambda _, z: motion.evaluate(np.concatenate([center + unit * z, g]))[:d]


def _turned(rate: Rate, angle: float) -> Rate:
    c, s = np.cos(angle), np.sin(angle)
    rotation = np.array([[c, -s], [s, c]])
    return lambda t, z: rotation @ rate(t, z)


def _return_to(place: FloatArray, normal: FloatArray) -> Event:
    """Returns the event that an orbit from a place passes it once more, in that direction."""

    def passed(t: float, z: FloatArray) -> float:
        off = z - place
        if t < LONGEST_STEP:
            return 1.0
        return float(off @ normal) if off @ off < NEAR**2 else -1.0

    passed.terminal, passed.direction = True, 1.0  # type: ignore[attr-defined]
    return passed


def _pass(place: FloatArray, normal: FloatArray, near: float) -> Event:
    """Returns the event that an orbit passes a plane near a place, along its normal."""

    def passed(_: float, z: FloatArray) -> float:
        off = z - place
        return float(off @ normal) if off @ off < near**2 else -1.0

    passed.terminal, passed.direction = True, 1.0  # type: ignore[attr-defined]
    return passed


def _stop(rate: Rate) -> Event:
    """Returns the event that m nearly vanishes."""

    def stopped(t: float, z: FloatArray) -> float:
        return float(np.linalg.norm(rate(t, z)) - STILL)

    stopped.terminal = True  # type: ignore[attr-defined]
    return stopped


def _closed_up(solution: Solution, duration: float, gap: FloatArray) -> Solution:
    """Returns a solution whose gap between end and start is spread over its duration."""
    return lambda t: solution(t) + gap[:, None] * t / duration


def _run(
    rate: Rate,
    start: FloatArray,
    duration: float,
    event: Event | None = None,
    max_step: float = LONGEST_STEP,
    precision: Precision = PRECISE,
) -> Any:
    """Returns what `solve_ivp` finds: with an event, as a function of time too."""
    method, tolerance = precision
    return solve_ivp(
        rate,
        (0.0, duration),
        start,
        method=method,
        events=event,
        dense_output=event is not None,
        max_step=min(max_step, LONGEST_STEP),
        rtol=tolerance,
        atol=tolerance,
    )
