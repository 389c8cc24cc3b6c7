"""Proposes tubes: an orbit is integrated, and given sections as wide as m lets them be.

Along an orbit, with a frame E normal to it that turns no more than it must, displacements obey
y' = G y to first order, with G = E^T J E.  So a box |y_j| <= w_j whose half-widths solve
w' = |G| w + e, with the absolute values of G off its diagonal, is entered on every side at the
speed e: with one number e, the inflow, the tube is as wide everywhere as m holds it together.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.linalg import expm, logm, null_space
from scipy.sparse import bsr_array
from scipy.sparse.linalg import spsolve

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.field_model import ExactField
from sgvf_drake.certificate.trajectories import Orbit, closed_orbit, open_orbit
from sgvf_drake.certificate.tube import Tube, TubeProof, prove_tube
from sgvf_drake.certificate.wall_search import Ladder
from sgvf_drake.certificate.walls import Walls, WallsProof, prove_walls

# The time and the turn, in rad, between points at which the field is looked at along an orbit,
# and the time at first.
FINE, FINE_TURN, FIRST = 1 / 32, 1 / 64, 1 / 64
# A wall turns from section to section by no more than this share of the angle at which m
# crosses it; and sections are no farther apart than this.
SHARE, LONGEST = 1.0, 0.25
# Inflows that are tried.  A wider tube has fewer cells, and looser bounds of the time.
INFLOWS = (0.08, 0.04, 0.02, 0.01)
# Of an orbit to which m attracts, the half-width for an inflow of one is no more than this, in
# U: distances shrink by a tenth of |m| / U and faster.
WIDEST = 10.0
# How far the bounds of the time may be from their middle, relative to it, for the first tube to
# be taken.
SPREAD = 0.02


@dataclass(frozen=True, eq=False)
class Course:
    """An orbit, looked at in small steps.

    Attributes:
        field: m.
        orbit: The orbit.
        times: (n + 1,) from 0 to the end.
        points: (n + 1, d) there.
        m: (n + 1, d) the velocities.
        frame: (n + 1, d, d - 1) E, normal to m; of a closed orbit it closes.
        growth: (n + 1, d - 1, d - 1) G.
    """

    field: ExactField
    orbit: Orbit
    times: FloatArray
    points: FloatArray
    m: FloatArray
    frame: FloatArray
    growth: FloatArray

    @classmethod
    def along(cls, field: ExactField, orbit: Orbit) -> "Course":
        """Returns the course of an orbit."""
        times = _looked_at(field, orbit)
        z = orbit.at(times).T
        m, J = field.value_and_jacobian(field.cloud.denormalize(z))
        frame, spin = _frame(_direction(m), orbit.closed)
        rate = spin / orbit.duration
        growth = frame.swapaxes(1, 2) @ (J * field.cloud.unit_length) @ frame - rate
        return cls(field, orbit, times, z, m, frame, growth)

    @property
    def holds_together(self) -> bool:
        """Whether there are widths: they are above zero where m attracts to the orbit."""
        return bool((self._widths > 0).all() and self._widths.max() < WIDEST)

    @cached_property
    def _widths(self) -> FloatArray:
        """The half-widths for an inflow of one, (n + 1, d - 1).

        The last widths are the first: an open orbit, too, begins as wide as it ends.
        """
        n, r = len(self.growth) - 1, self.growth.shape[1]
        step = np.diff(self.times)
        blocks = np.eye(r) - step[:, None, None] * absolute_off_diagonal(self.growth[1:])
        each = np.arange(n)
        before = bsr_array(
            (np.broadcast_to(np.eye(r), blocks.shape), (each - 1) % n, range(n + 1))
        )
        now = bsr_array((blocks, each, range(n + 1)))
        w = spsolve((now - before).tocsc(), np.repeat(step, r)).reshape(n, r)
        return np.concatenate([w[-1:], w])

    def _axes(self, inflow: float) -> FloatArray:
        """Returns A for an inflow, (n + 1, d, d - 1)."""
        return inflow * self.frame * self._widths[:, None]

    @cached_property
    def ladder(self) -> Ladder | None:
        """Curves for walls; None: the orbit is not a closed one in the plane."""
        if not self.orbit.closed or self.points.shape[1] != 2:
            return None
        return Ladder.around(self.field, self.orbit, self.times)

    def sections(self, inflow: float) -> FloatArray:
        """Returns times of sections, from 0 to the end.

        They are so close that the walls turn by less than the angle at which m crosses them,
        and no farther apart than is told.
        """
        axes = self._axes(inflow)
        signs = np.array(list(product((-1.0, 1.0), repeat=axes.shape[2])))
        edges = self.points[:, None] + signs @ axes.swapaxes(1, 2)
        sides = np.diff(edges, axis=0)
        length = np.linalg.norm(sides, axis=2)
        sides /= length[..., None]
        turn = np.linalg.norm(np.diff(sides, axis=0, append=sides[-1:]), axis=2)
        speed = np.linalg.norm(self.m[1:], axis=1)
        share = turn.max(axis=1) * speed / (SHARE * inflow) + length.max(axis=1) / LONGEST
        if self.ladder is not None:
            share = np.maximum(share, self.ladder.shares)
        return _spread(self.times, share)

    def tube(self, times: FloatArray, inflow: float) -> Tube:
        """Returns the tube of an inflow with sections at some times, from 0 to the end."""
        if self.orbit.closed:
            times = times[:-1]
        axes = make_interp_spline(self.times, self._axes(inflow), k=1)(times)
        return Tube.around(
            self.orbit.at(times).T, axes, closed=self.orbit.closed, rest=self.orbit.rest
        )


def absolute_off_diagonal(growth: FloatArray) -> FloatArray:
    """Returns matrices (n, r, r) with the absolute values of what is off their diagonals."""
    return np.where(np.eye(growth.shape[1], dtype=bool), growth, np.abs(growth))


def _looked_at(field: ExactField, orbit: Orbit) -> FloatArray:
    """Returns times along an orbit, close together where it turns."""
    times = np.linspace(0, orbit.duration, int(np.ceil(orbit.duration / FIRST)) + 1)
    tangent = _direction(field(field.cloud.denormalize(orbit.at(times).T)))
    turn = np.linalg.norm(np.diff(tangent, axis=0), axis=1)
    return _spread(times, np.diff(times) / FINE + turn / FINE_TURN)


def _spread(times: FloatArray, shares: FloatArray) -> FloatArray:
    """Returns times between which the shares (n,) of the steps of others add up to one."""
    passed = np.concatenate([[0], np.cumsum(shares)])
    return np.interp(np.linspace(0, passed[-1], int(np.ceil(passed[-1])) + 1), passed, times)


def _direction(m: FloatArray) -> FloatArray:
    return np.asarray(m / np.linalg.norm(m, axis=1, keepdims=True))


def _frame(tangent: FloatArray, closed: bool) -> tuple[FloatArray, FloatArray]:
    """Returns frames normal to unit tangents (n, d), and how they spin to close, (d-1, d-1).

    Each is the one before, turned as the tangent turns (Bishop).  Where that does not close,
    the rest of the turn is spread evenly over all.
    """
    c = (tangent[1:] * tangent[:-1]).sum(axis=1)[:, None, None]
    K = tangent[1:, :, None] * tangent[:-1, None, :]
    K = K - K.swapaxes(1, 2)
    turns = np.eye(tangent.shape[1]) + K + K @ K / (1 + c)
    frames = [complement(tangent[0])]
    for turn in turns:
        frames.append(turn @ frames[-1])
    frame = np.array(frames)
    spin = np.zeros((frame.shape[2],) * 2)
    if closed:
        spin = np.real(logm(frame[-1].T @ frame[0]))
        frame = frame @ expm(np.linspace(0, 1, len(frame))[:, None, None] * spin)
    return frame, spin


def complement(tangent: FloatArray) -> FloatArray:
    """Returns a frame (d, d - 1) with det [tangent, frame] = 1."""
    frame = null_space(tangent[None])
    frame[:, 0] *= np.linalg.det(np.column_stack([tangent, frame]))
    return frame


@dataclass(frozen=True, eq=False)
class FoundTube:
    """A tube that was proved, and walls around it.

    Attributes:
        tube: The tube.
        proof: What is proved of it.
        walls: Walls around it; None: none are proved.
        walls_proof: What is proved of these.
    """

    tube: Tube
    proof: TubeProof
    walls: Walls | None = None
    walls_proof: WallsProof | None = None

    @property
    def patches(self) -> int:
        """How many patches the field was bounded over, for this one alone."""
        return self.proof.patches + (self.walls_proof.patches if self.walls_proof else 0)


def find_tube(field: ExactField, points: FloatArray, *, closed: bool) -> FoundTube | None:
    """Returns a proved tube around the orbit of a piece of a path; None: none was found.

    Args:
        field: m.
        points: (M, d) along the piece in the direction of travel, normalised.
        closed: Whether the piece is closed.
    """
    length = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    orbit = (closed_orbit if closed else open_orbit)(field, points[0], length)
    if orbit is None:
        return None
    course = Course.along(field, orbit)
    if not course.holds_together:
        return None
    found = None
    for inflow in INFLOWS:
        tighter = refined(field, course, inflow)
        found = found if tighter is None else tighter
        if found is not None and found.proof.spread <= SPREAD:
            break
    return None if found is None else _with_walls(course, found)


def _with_walls(course: Course, found: "Refined") -> FoundTube:
    """Returns a tube with the walls around it that are proved."""
    if course.ladder is None or not len(course.ladder.rungs):
        return FoundTube(found.tube, found.proof)
    walls = course.ladder.walls(found.times[:-1])
    proof = prove_walls(course.field, found.tube, walls)
    if not proof.proved:
        return FoundTube(found.tube, found.proof, walls_proof=proof)
    return FoundTube(found.tube, found.proof, walls[: proof.proved], proof)


@dataclass(frozen=True, eq=False)
class Refined:
    """A tube that was proved, with sections at some times, from 0 to the end."""

    tube: Tube
    proof: TubeProof
    times: FloatArray


def refined(field: ExactField, course: Course, inflow: float) -> Refined | None:
    """Returns a proved tube of an inflow, with more sections where that helps; or None."""
    times, weak = course.sections(inflow), np.inf
    while True:
        tube = course.tube(times, inflow)
        proof = prove_tube(field, tube)
        if proof.proved:
            return Refined(tube, proof, times)
        if not 0 < proof.weak.sum() < weak:
            return None
        weak = proof.weak.sum()
        middles = ((times[:-1] + times[1:]) / 2)[proof.weak]
        times = np.sort(np.concatenate([times, middles]))
