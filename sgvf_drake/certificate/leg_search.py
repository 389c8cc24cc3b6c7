"""Proposes legs: an orbit at a constant intended direction, and a tube from disk to disk.

As around orbits that close or rest (`tube_search`), the widths of the tube solve
w' = |G| w + e.  But here they are known at its beginning, where the first section is a given
disk.  As m draws robots together, the tube ends narrower than it began, inside of the disk
of the next leg.

The direction of m changes at once where the intended one does, so that disks are askew to it.
A section {p + A s} may be: with A = E W + m c^T the points of the walls that it joins are moved
along m by the times c, and stay on the walls, to first order.  c is given at the disks, and
falls to zero from there.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from sgvf_drake.arrays import FloatArray, IntArray
from sgvf_drake.certificate.legs import Disk, Leg, ProvedLeg, lies_in
from sgvf_drake.certificate.trajectories import Orbit, open_orbit, passing_orbit
from sgvf_drake.certificate.tube import TICK, Tube
from sgvf_drake.certificate.tube_search import (
    Course,
    absolute_off_diagonal,
    complement,
    refined,
)
from sgvf_drake.fields import HeldField

# Half of a side of a disk, in noise levels: m draws robots together there at .2 of the speed.
# And of one at which a turn begins, where they may come apart again at first.
HALF_WIDTH, IN_TURNS = 0.1, 0.05
# The sides of a disk are whole multiples of a vector of ticks, by this: so there are sections
# in it, to the last bit, whose middles and sides are other multiples.
LATTICE = 1024
# How far from the middle of a disk an orbit may pass its plane, in noise levels.
NEAR = 2.0
# Inflows that are tried; the last ones where no tube was proved with this one or a larger.
THIN, INFLOWS = 0.03, (0.12, 0.06, 0.03, 0.02, 0.01)
# How far the bounds of the time may be from their middle, relative to it, for a wide tube to be
# taken.
SPREAD = 0.01
# What a robot takes longer until it rests than it would at full speed.
SLOWING = 1.0
# Sections stay askew for so many times as long as the disk is, and for so long besides.
STRETCH, SHORTEST = 4.0, 1e-3

MISSES = "a robot from the middle of its first disk does not come to the next one"
BESIDE = "what comes through its first disk does not end within the next one"
RESTLESS = "a robot from the middle of its disk does not come where rest is proved"
OPEN = "that robots stay in its tube could not be proved"


def disk_at(point: FloatArray, normal: FloatArray, half_width: float) -> Disk:
    """Returns a disk.

    Args:
        point: (d,) its middle, normalised.
        normal: (d,) of its plane, of any length.
        half_width: Half of its sides, normalised.
    """
    sides = half_width * complement(normal / np.linalg.norm(normal))
    lattice = np.rint(sides.T / (LATTICE * TICK)).astype(int)
    return disk_of(np.vstack([np.rint(point / TICK).astype(int), LATTICE * lattice]))


def disk_of(rows: IntArray) -> Disk:
    """Returns the disk of rows (d, d) of ticks."""
    return tuple(tuple(row) for row in rows.tolist())


def middle_of(disk: Disk) -> FloatArray:
    """Returns the middle (d,) of a disk, normalised."""
    return TICK * np.array(disk[0], float)


def normal_of(disk: Disk) -> FloatArray:
    """Returns the unit normal (d,) of a disk, on the side to which robots leave it."""
    sides = TICK * np.array(disk[1:], float)
    normal = np.linalg.svd(sides)[2][-1]
    return np.asarray(normal * np.sign(np.linalg.det([normal, *sides])))


@dataclass(frozen=True)
class Obstacle:
    """Why there is no proved leg.

    Attributes:
        reason: A sentence.
        place: (d,) where a robot ended that did not come into the next disk, or else the middle
            of the first one, in the unit of who tells it.
    """

    reason: str
    place: tuple[float, ...]


def find_leg(field: HeldField, start: Disk, end: Disk, near: float) -> ProvedLeg | Obstacle:
    """Returns a proved leg from one disk into another, or why there is none.

    Args:
        field: m at the constant intended direction of the leg.
        start: Where it begins.
        end: What it ends in.
        near: How far from the middle of that an orbit may pass its plane, normalised.
    """
    orbit, passes = passing_orbit(field, middle_of(start), middle_of(end), normal_of(end), near)
    if not passes:
        return Obstacle(MISSES, tuple(orbit.end.tolist()))
    return _found(LegCourse.between(field, orbit, start, end))


def find_end(field: HeldField, start: Disk, length: float) -> ProvedLeg | Obstacle:
    """Returns a proved leg from a disk to rest, or why there is none.

    Args:
        field: m at the constant intended direction of the leg.
        start: Where it begins.
        length: About the time that it takes.
    """
    orbit = open_orbit(field, middle_of(start), length + SLOWING)
    if orbit is None:
        return Obstacle(RESTLESS, tuple(middle_of(start).tolist()))
    return _found(LegCourse.between(field, orbit, start))


def _found(course: "LegCourse") -> ProvedLeg | Obstacle:
    """Returns the widest tube whose bounds of the time are close, or that with the closest."""
    found, reason = None, BESIDE
    for inflow in INFLOWS:
        if not course.fits(inflow):
            continue
        reason = OPEN
        tighter = refined(course.field, course, inflow)
        found = found if tighter is None else tighter
        if found is not None and (found.proof.spread <= SPREAD or inflow <= THIN):
            break
    if found is None:
        place = course.orbit.end if reason == BESIDE else course.points[0]
        return Obstacle(reason, tuple(place.tolist()))
    return ProvedLeg(Leg(tuple(course.held.g.tolist()), found.tube), found.proof)


@dataclass(frozen=True, eq=False)
class LegCourse(Course):
    """An orbit from a disk on, looked at in small steps.

    Attributes:
        start: The disk in which it begins; det [m, A] > 0.
        end: The disk in which it ends; None: it comes to rest.
    """

    start: Disk
    end: Disk | None

    @classmethod
    def between(
        cls, field: HeldField, orbit: Orbit, start: Disk, end: Disk | None = None
    ) -> "LegCourse":
        """Returns the course of an orbit between disks."""
        course = Course.along(field, orbit)
        m, sides = course.m[0], np.array(start[1:], float)
        if np.linalg.det([m, *sides]) < 0:
            # Robots leave it on the side on which they came.
            start = (start[0], tuple(-x for x in start[1]), *start[2:])
        return cls(**vars(course), start=start, end=end)

    @property
    def held(self) -> HeldField:
        """The field."""
        assert isinstance(self.field, HeldField)
        return self.field

    def sections(self, inflow: float) -> FloatArray:
        """Returns times of sections, from 0 to the end: three or more, of any tube."""
        times = super().sections(inflow)
        return times if len(times) > 2 else np.linspace(0, self.orbit.duration, 3)

    def fits(self, inflow: float) -> bool:
        """Whether the tube of an inflow ends in the last disk."""
        return self.end is None or lies_in(self._last(inflow), self.end)

    def tube(self, times: FloatArray, inflow: float) -> Tube:
        """Returns the tube of an inflow with sections at some times, from 0 to the end."""
        tube = super().tube(times, inflow)
        last = tube.sections[-1] if self.end is None else self._last(inflow)
        return Tube((self.start, *tube.sections[1:-1], last), False, self.orbit.rest)

    def _last(self, inflow: float) -> Disk:
        """Returns the nearest to the last section of those on the lattice of the last disk."""
        assert self.end is not None
        middle, *sides = (np.array(row) for row in self.end)
        vectors = np.array(sides) // LATTICE
        wanted = np.vstack([self.points[-1] / TICK - middle, self._axes(inflow)[-1].T / TICK])
        steps = np.linalg.lstsq(vectors.T.astype(float), wanted.T, rcond=None)[0]
        rows = np.rint(steps.T).astype(int) @ vectors
        rows[0] += middle
        return disk_of(rows)

    @cached_property
    def _first_axes(self) -> FloatArray:
        """The sides (d, d - 1) of the first disk."""
        return TICK * np.array(self.start[1:], float).T

    @cached_property
    def _directions(self) -> FloatArray:
        """What sides of unit length are seen as along m, in the frame, (d - 1, d - 1)."""
        seen = self.frame[0].T @ self._first_axes
        return np.asarray(seen / np.linalg.norm(seen, axis=0))

    def _widths_of(self, inflow: float) -> FloatArray:
        """Returns the half-widths along these for an inflow, (n + 1, d - 1)."""
        growth = np.linalg.solve(self._directions, self.growth @ self._directions)
        growth = absolute_off_diagonal(np.asarray(growth))
        widths = [np.linalg.norm(self.frame[0].T @ self._first_axes, axis=0)]
        identity = np.eye(growth.shape[1])
        for step, G in zip(np.diff(self.times), growth[1:], strict=True):
            widths.append(np.linalg.solve(identity - step * G, widths[-1] + step * inflow))
        return np.array(widths)

    def _axes(self, inflow: float) -> FloatArray:
        """Returns A for an inflow, (n + 1, d, d - 1)."""
        across = self.frame @ self._directions * self._widths_of(inflow)[:, None]
        askew = self._fading(self.times, self.m[0] @ self._first_axes / (self.m[0] @ self.m[0]))
        if self.end is not None:
            normal = normal_of(self.end)
            last = -(normal @ across[-1]) / (normal @ self.m[-1])
            askew += self._fading(self.times[-1] - self.times, last)
        return np.asarray(across + self.m[:, :, None] * askew[:, None])

    def _fading(self, times: FloatArray, askew: FloatArray) -> FloatArray:
        """Returns times by which sections are askew, (n + 1, d - 1), some times from a disk."""
        span = min(STRETCH * np.abs(askew).max() + SHORTEST, self.orbit.duration / 2)
        return np.maximum(1 - times / span, 0)[:, None] * askew
