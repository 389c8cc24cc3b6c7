"""Proposes walls: closed orbits of m turned, which m crosses at the angle of the turn.

The closed orbits of m turned by angles between 0 and pi / 2 to the left lie on the left of its
own, nested, and those of m turned to the right on its right (Duff, 1953: rotated fields).  m
crosses each from outside at its angle, everywhere.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.sparse import csc_array
from scipy.sparse.linalg import spsolve

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.field_model import ExactField
from sgvf_drake.certificate.trajectories import ROUGH, Orbit, closed_orbit
from sgvf_drake.certificate.walls import Walls
from sgvf_drake.paths import Piece, ReferencePath

# Turns of m in rad: what is between two walls is crossed at an angle between theirs.
ANGLES = (0.15, 0.4, 0.7, 1.0, 1.2)
# A wall turns from vertex to vertex by no more than this share of its angle.
SHARE = 0.5
# Places of a closed orbit at which the next one is looked for.
STARTS = 5
# Points of an orbit in each normalised unit of its length.
FINENESS = 200
# Over so many distances between two walls the spacing of their vertices evens out.  Each vertex
# of the outer one next to one of the inner would bring many together where that turns sharply
# away: cells between them would have hardly a width.
EVENNESS = 2.0


@dataclass(frozen=True, eq=False)
class Ladder:
    """Nested curves on both sides of a closed orbit, with points across from its own.

    Attributes:
        times: (n + 1,) of points of the orbit, from 0 to the end.
        rungs: (p, 2, n + 1, 2) points on each of p pairs of curves, left and right.
    """

    times: FloatArray
    rungs: FloatArray

    @classmethod
    def around(cls, field: ExactField, orbit: Orbit, times: FloatArray) -> "Ladder":
        """Returns the ladder of a closed orbit in the plane, with points at some times.

        It ends with the last angle whose closed orbits were both found.
        """
        points = orbit.at(times).T
        inner = [points, points]
        rungs: list[list[FloatArray]] = []
        for angle in ANGLES:
            outer = []
            for turn, before in zip((angle, -angle), inner, strict=True):
                found = _turned_orbit(field, before, orbit.duration, turn)
                if found is None:
                    return cls(times, _stacked(rungs, len(times)))
                outer.append(_across(before, found))
            rungs.append(outer)
            inner = outer
        return cls(times, _stacked(rungs, len(times)))

    @property
    def shares(self) -> FloatArray:
        """Which share (n,) of the way to the next vertex each step needs, on some wall."""
        shares = np.zeros(len(self.times) - 1)
        for angle, pair in zip(ANGLES, self.rungs, strict=False):
            for curve in pair:
                sides = np.diff(curve, axis=0)
                sides /= np.linalg.norm(sides, axis=1, keepdims=True)
                turn = np.linalg.norm(np.roll(sides, -1, axis=0) - sides, axis=1)
                shares = np.maximum(
                    shares, np.maximum(turn, np.roll(turn, 1)) / 2 / (SHARE * angle)
                )
        return shares

    def walls(self, times: FloatArray) -> Walls:
        """Returns the walls with vertices at some times, (K,)."""
        curves = make_interp_spline(self.times, self.rungs, k=1, axis=2)(times)
        return Walls.through(curves[:, 0], curves[:, 1])


def _turned_orbit(
    field: ExactField, points: FloatArray, duration: float, turn: float
) -> Orbit | None:
    """Returns the closed orbit of m turned by an angle, from points of a nearby one; or None.

    Where legs of a tip run side by side, it may not be seen where an orbit closes.
    """
    for start in points[:: len(points) // STARTS][:STARTS]:
        found = closed_orbit(field, start, duration, turn=turn, precision=ROUGH)
        if found is not None:
            return found
    return None


def _stacked(rungs: list[list[FloatArray]], count: int) -> FloatArray:
    return np.reshape(rungs, (len(rungs), 2, count, 2))


def _across(points: FloatArray, orbit: Orbit) -> FloatArray:
    """Returns points of a closed orbit across from those of a closed curve, (n + 1, 2).

    These are the nearest ones, moved along until their spacing is even.
    """
    count = int(np.ceil(FINENESS * orbit.duration))
    line = Piece(orbit.at(np.linspace(0, orbit.duration, count + 1)[:-1]).T, closed=True)
    foot = ReferencePath((line,)).project(points[:-1])
    step = np.linalg.norm(np.diff(points, axis=0), axis=1)
    arc = np.unwrap(foot.arc, period=line.length)
    even = arc[0] + line.length * (np.cumsum(step) - step) / step.sum()
    reach = EVENNESS * (foot.distance + np.roll(foot.distance, -1)) / 2
    moved = line.at((even + _smooth(arc - even, step, reach)) % line.length)
    return np.concatenate([moved, moved[:1]])


def _smooth(values: FloatArray, step: FloatArray, reach: FloatArray) -> FloatArray:
    """Returns the periodic f with f - (reach^2 f')' = values; steps lead to the next point."""
    n = len(values)
    stiffness, mass = reach**2 / step, (step + np.roll(step, 1)) / 2
    here, after = np.arange(n), (np.arange(n) + 1) % n
    diagonal = mass + stiffness + np.roll(stiffness, 1)
    matrix = csc_array(
        (
            np.concatenate([diagonal, -stiffness, -stiffness]),
            (np.concatenate([here, here, after]), np.concatenate([here, after, here])),
        ),
        shape=(n, n),
    )
    return np.asarray(spsolve(matrix, mass * values))
