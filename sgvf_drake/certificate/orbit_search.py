"""Proposes thin rings around a closed orbit: it is integrated, and widened as m lets it."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.boxes import BoxSizes
from sgvf_drake.certificate.orbits import Annulus
from sgvf_drake.fields import GuidingField

# Largest widths that are tried, in the unit of the squares; an orbit that attracts weakly or
# turns sharply needs a wide ring.
WIDTHS = (1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
# Sides of the polygon are no longer than this, in that unit, and turn no more, in rad.
LONGEST, SHARPEST = 0.5, 0.01
# Points on which a lap is looked at, and the step by which it is differentiated.
NUM_ANGLES, STEP = 8192, 1e-5
# Turns that are integrated, of which the last is looked at; each in no more than so many times
# the time of the piece at |m| = 1.
TURNS, LONGEST_LAP = 1.5, 3.0
TOLERANCE = 1e-7
# By which more than a turn is looked at, in rad, so that no angle is at an end.
OVERLAP = 0.1
DECIMALS = 10


@dataclass(frozen=True, eq=False)
class _Polar:
    """A field about a centre, along the angle: dr / dtheta.

    Attributes:
        field: m.
        center: (2,) normalised.
    """

    field: GuidingField
    center: FloatArray

    def points(self, angle: FloatArray, radius: FloatArray) -> FloatArray:
        """Returns the points (n, 2) of polar coordinates."""
        return self.center + radius[:, None] * _ray(angle)

    def parts(self, angle: FloatArray, radius: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns m outward and m counter-clockwise, (n,) each."""
        z = self.points(angle, radius)
        m, ray = self.field(self.field.cloud.denormalize(z)), _ray(angle)
        return (m * ray).sum(axis=1), ray[:, 0] * m[:, 1] - ray[:, 1] * m[:, 0]

    def slope(self, angle: FloatArray, radius: FloatArray) -> FloatArray:
        """Returns dr / dtheta along m, (n,)."""
        outward, around = self.parts(angle, radius)
        return radius * outward / around

    def crossing(self, angle: FloatArray, radius: FloatArray) -> FloatArray:
        """Returns what dr / dtheta differs by on a curve that m crosses at speed one, (n,)."""
        _, around = self.parts(angle, radius)
        oblique = self.slope(angle, radius) / radius
        return np.asarray(radius * np.sqrt(1 + oblique**2) / np.abs(around))


@dataclass(frozen=True, eq=False)
class _Lap:
    """A closed orbit around a centre.

    Attributes:
        angle: (n + 1,) from 0 to a turn.
        radius: (n + 1,) there.
        side: 1.0 where it is run counter-clockwise, -1.0 where clockwise.
    """

    angle: FloatArray
    radius: FloatArray
    side: float


def propose_annuli(field: GuidingField, points: FloatArray) -> Iterator[Annulus]:
    """Gives rings around the closed orbit near a piece of a path, the thinnest first.

    None where the piece is not star-shaped about the mean of its points, or where m does not
    settle on an orbit around it.

    Args:
        field: The field.
        points: (M, 2) on the piece, normalised.
    """
    polar, unit = _Polar(field, points.mean(axis=0)), BoxSizes.of(field).unit
    lap = _settled_lap(polar, points)
    if lap is None:
        return
    shape, orbit = _shape(polar, lap), polar.points(lap.angle, lap.radius)
    at = _corners(orbit, unit)
    vertices = orbit[at].round(DECIMALS)
    center = tuple(polar.center.round(DECIMALS).tolist())
    for width in WIDTHS:
        widths = (width * unit * shape[at]).round(DECIMALS)
        annulus = Annulus(center, tuple(map(tuple, vertices.tolist())), tuple(widths.tolist()))
        if annulus.is_ring:
            yield annulus


def _settled_lap(polar: _Polar, points: FloatArray) -> _Lap | None:
    """Returns the lap on which m settles; None: it does not turn around the centre."""
    states = _integrate(polar, points)
    if states is None:
        return None
    side = float(np.sign(states[2, -1]))
    turned = side * states[2]
    last = turned >= turned[-1] - 2 * np.pi - OVERLAP
    if (np.diff(turned[last]) <= 0).any():
        return None
    radius = np.linalg.norm(states[:2].T - polar.center, axis=1)
    angle = np.linspace(0, 2 * np.pi, NUM_ANGLES + 1)
    # The same angle on the last turn.
    at = turned[-1] - (turned[-1] - side * angle) % (2 * np.pi)
    return _Lap(angle, CubicSpline(turned[last], radius[last])(at), side)


def _integrate(polar: _Polar, points: FloatArray) -> FloatArray | None:
    """Returns points along m and the angle turned through, (3, n), from a piece on.

    None where m does not turn so often in the time that it should take.
    """
    field, center = polar.field, polar.center

    def rate(_: float, state: FloatArray) -> FloatArray:
        p, m = state[:2] - center, field(field.cloud.denormalize(state[None, :2]))[0]
        return np.array([*m, (p[0] * m[1] - p[1] * m[0]) / (p @ p)])

    def turned(_: float, state: FloatArray) -> float:
        return float(abs(state[2]) - TURNS * 2 * np.pi)

    turned.terminal = True  # type: ignore[attr-defined]
    length = np.linalg.norm(np.diff(points, axis=0, append=points[:1]), axis=1).sum()
    first = points[0] - center
    run = solve_ivp(
        rate,
        (0.0, LONGEST_LAP * TURNS * length),
        [*points[0], np.arctan2(first[1], first[0])],
        method="LSODA",
        events=turned,
        dense_output=True,
        rtol=TOLERANCE,
        atol=TOLERANCE,
    )
    if run.status != 1:
        return None
    return np.asarray(run.sol(np.linspace(0, run.t[-1], int(TURNS * NUM_ANGLES))))


def _shape(polar: _Polar, lap: _Lap) -> FloatArray:
    """Returns widths along a lap, the largest one, across whose ends m flows in alike.

    What is aside of the orbit by w changes by growth w along the angle; w' = growth w + flow
    has one solution that closes, and m flows in across it everywhere.
    """
    aside = (polar.slope(lap.angle, lap.radius + step) for step in (STEP, -STEP))
    order = slice(None, None, int(lap.side))
    growth = (lap.side * np.subtract(*aside) / (2 * STEP))[order]
    flow = polar.crossing(lap.angle, lap.radius)[order]
    step = 2 * np.pi / NUM_ANGLES
    widths = np.zeros_like(growth)
    # A lap forgets where it began, where the orbit attracts.
    for k in range(2 * NUM_ANGLES):
        factor = np.exp(step * growth[k % NUM_ANGLES])
        inflow = step * flow[k % NUM_ANGLES]
        widths[(k + 1) % NUM_ANGLES] = factor * widths[k % NUM_ANGLES] + inflow
    widths[-1] = widths[0]
    return np.asarray(widths[order] / widths.max())


def _corners(lap: FloatArray, unit: float) -> FloatArray:
    """Returns the indices of the corners of a polygon along a closed lap (n + 1, 2)."""
    step = np.diff(lap, axis=0)
    length = np.linalg.norm(step, axis=1)
    direction = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    turn = np.abs(np.diff(direction, append=direction[0] + 2 * np.pi))
    passed = np.concatenate([[0], np.cumsum(length / (LONGEST * unit) + turn / SHARPEST)])
    count = int(np.ceil(passed[-1]))
    at = np.searchsorted(passed, passed[-1] * np.arange(count) / count)
    return np.unique(np.minimum(at, len(length) - 1))


def _ray(angle: FloatArray) -> FloatArray:
    return np.column_stack([np.cos(angle), np.sin(angle)])
