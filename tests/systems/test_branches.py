"""The pieces of a path as branches, and the motions that are planned from one to another."""

import math

import numpy as np
import pytest
from scipy.interpolate import BPoly, CubicHermiteSpline

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.paths import Piece, ReferencePath
from systems import branches
from systems.branches import (
    BRAKING_SHARE,
    SPEED_RANGE,
    TURN_RATE,
    Branch,
    CheckBranches,
    CheckedBox,
    CheckTour,
    DepartureDelay,
    MakeBranches,
    Motion,
    PlanStop,
    PlanTransfer,
    SpeedLimits,
)

from .flying import ANGLES, UNIT, ring

SPEED, MAX_ACCELERATION = 0.45, 15.0
"""A waypoint and a pair of them that are no branch."""


class Rotations:
    """Turns at unit speed about the nearest of some centers, counter-clockwise or not."""

    dim = 2

    def __init__(self, *centers, sense=1.0):
        self._centers, self._sense = np.array(centers), sense

    def __call__(self, x):
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x):
        offsets = x[:, None] - self._centers
        nearest = np.linalg.norm(offsets, axis=2).argmin(axis=1)
        dx, dy = offsets[np.arange(len(x)), nearest].T
        r = np.hypot(dx, dy)
        m = self._sense * np.column_stack([-dy, dx]) / r[:, None]
        J = np.array([[dx * dy, -dx * dx], [dy * dy, -dx * dy]]) / r**3
        return m, self._sense * np.moveaxis(J, 2, 0)


class Bend:
    """Leads along x, and turns at a place as sharply as a Gaussian says."""

    dim = 2

    def value_and_jacobian(self, x):
        m = np.tile([1.0, 0.0], (len(x), 1))
        J = np.zeros((len(x), 2, 2))
        J[:, 1, 0] = 5.0 * np.exp(-(((x[:, 0] - 5.0) / 0.2) ** 2))
        return m, J


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_branches_run_with_the_field(sense):
    rings = ReferencePath((Piece(2.0 * UNIT, True), Piece(UNIT, True)))
    pieces = MakeBranches(Rotations((0.0, 0.0), sense=sense), rings)
    assert [branch.closed for branch in pieces] == [True, True]
    np.testing.assert_allclose(
        [branch.length for branch in pieces], [4 * np.pi, 2 * np.pi], rtol=2e-3
    )
    for branch, radius in zip(pieces, (2.0, 1.0), strict=True):
        np.testing.assert_allclose(np.linalg.norm(branch.points, axis=1), radius, rtol=2e-3)
        turned = np.unwrap(np.arctan2(*branch.points.T[::-1]))
        assert (sense * np.diff(turned) > 0.0).all()


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_open_branch_starts_where_the_field_starts(sense):
    arc = UNIT[:50]
    path = ReferencePath((Piece(arc[::-1], False),))
    (branch,) = MakeBranches(Rotations((0.0, 0.0), sense=sense), path)
    assert not branch.closed
    np.testing.assert_allclose(branch.points[0], arc[0] if sense > 0 else arc[-1])


def test_entries_move_with_the_field():
    field = Rotations((0.0, 0.0))
    entries = ring(2.0).MotionAt(field, SPEED)
    np.testing.assert_allclose(np.linalg.norm(entries.velocity, axis=1), SPEED)
    np.testing.assert_allclose(entries.acceleration, -(SPEED**2) / 2.0 * UNIT, atol=1e-12)
    # An open branch is entered near its start, unless anywhere.
    branch = Branch(UNIT[:50], 3.9, False)
    np.testing.assert_array_equal(branch.Entrances(), range(5))
    np.testing.assert_array_equal(branch.Entrances(anywhere=True), range(50))
    index, distance = ring().Nearest(3.0 * UNIT[17])
    assert (index, distance) == (17, pytest.approx(2.0))


@pytest.mark.parametrize("radius", [0.5, 2.0])
def test_speed_limit_on_a_circle(radius):
    branch, field = ring(radius), Rotations((0.0, 0.0))
    fastest = math.sqrt(MAX_ACCELERATION * radius)
    for speed in (0.9 * fastest, 3.0 * fastest):
        np.testing.assert_allclose(
            SpeedLimits(field, branch, speed, MAX_ACCELERATION), min(speed, fastest)
        )


@pytest.mark.parametrize("closed", [True, False])
def test_speed_falls_ahead_of_a_turn_as_a_vehicle_can_brake(closed):
    x = np.linspace(0.0, 10.0, 201)
    # The turn of a loop may lie behind its first waypoint.
    x = np.roll(x, -90) if closed else x
    branch = Branch(np.column_stack([x, np.zeros_like(x)]), 10.0, closed)
    limits = SpeedLimits(Bend(), branch, 20.0, MAX_ACCELERATION)
    at_turn = math.sqrt(MAX_ACCELERATION / 5.0)
    assert limits.min() == pytest.approx(at_turn, rel=1e-3)
    order = np.argsort(x)
    before = order[x[order] < 4.0]
    # v^2 = v_turn^2 + 2 b s, but for the length of the turn itself.
    expected = np.sqrt(at_turn**2 + 2 * BRAKING_SHARE * MAX_ACCELERATION * (5.0 - x[before]))
    np.testing.assert_allclose(limits[before], expected, rtol=0.1)
    steps = np.diff(limits[order][:100] ** 2)
    assert steps.min() > -2 * BRAKING_SHARE * MAX_ACCELERATION * 0.05 - 1e-9
    if not closed:
        assert limits[-1] == 20.0


def test_departure_waits_for_a_better_place():
    centers = (-1.5, 0.0), (1.5, 0.0)
    field = Rotations(*centers)
    here, there = ring(1.0, centers[0]), ring(1.0, centers[1])
    entries = there.MotionAt(field, SPEED)

    def cost(position):
        start = here.MotionAt(field, SPEED)
        index, _ = here.Nearest(position)
        motion = Motion(*(values[index] for values in start))
        return PlanTransfer(motion, entries, SPEED, MAX_ACCELERATION).cost

    delays = []
    for angle in np.linspace(0.0, 2 * np.pi, 6, endpoint=False):
        position = centers[0] + np.array([math.cos(angle), math.sin(angle)])
        waypoint, _ = here.Nearest(position)
        delay = DepartureDelay(field, here, there, waypoint, SPEED, MAX_ACCELERATION)
        turned = angle + SPEED * delay
        departure = centers[0] + np.array([math.cos(turned), math.sin(turned)])
        # A few entries only are tried in the forecast: a tenth is left to it.
        assert delay + cost(departure) <= 1.1 * cost(position)
        assert 0.0 <= delay < 2 * np.pi / SPEED
        delays.append(delay)
    assert max(delays) > 3.0


def test_departure_between_concentric_rings_needs_no_waiting():
    field = Rotations((0.0, 0.0))
    for waypoint in range(0, len(UNIT), 13):
        assert DepartureDelay(field, ring(), ring(2.0), waypoint, SPEED, 15.0) < 0.5


@pytest.mark.parametrize(
    ("branch", "message"),
    [
        (Branch(np.zeros((3, 3)), 1.0, True), r"branch 0 must have points \(n, 2\)"),
        (Branch(np.zeros((0, 2)), 1.0, True), "branch 0 must have points"),
        (Branch(np.full((3, 2), math.nan), 1.0, True), "branch 0 has a point"),
        (Branch(np.zeros((3, 2)), 0.0, True), "branch 0 must have a positive length, got 0.0"),
        (Branch(np.full((3, 2), 2.0), 1.0, True), "branch 0 is not inside the box"),
    ],
)
def test_branches_that_cannot_be_flown_are_refused(branch, message):
    with pytest.raises(ConfigurationError, match=message):
        CheckBranches([branch], 2, (np.full(2, -1.0), np.full(2, 1.0)))


def test_bad_boxes_and_tours_are_refused():
    for box in (([0.0], [1.0]), ([0.0, 1.0], [1.0, 1.0]), ([1, 1], [0, 2])):
        with pytest.raises(ConfigurationError, match="box must be"):
            CheckedBox(box, 2)
    for tour in ((), (0, 2), (-1,), (0.5,)):
        with pytest.raises(ConfigurationError, match="tour must hold numbers of the 2"):
            CheckTour(tour, 2)


# Motions.


def random_motion(rng, dim, count=None):
    shape = (dim,) if count is None else (count, dim)
    return Motion(*(scale * rng.standard_normal(shape) for scale in (1.0, 0.5, 0.3)))


def on_ring(radius, angles, center=(0.0, 0.0)):
    """The motion around a ring, counter-clockwise at the commanded speed."""
    outward = np.column_stack([np.cos(angles), np.sin(angles)])
    along = np.column_stack([-np.sin(angles), np.cos(angles)])
    return Motion(center + radius * outward, SPEED * along, -(SPEED**2) / radius * outward)


def single(motions, i):
    return Motion(*(values[i] for values in motions))


def sampled(plan, count=400):
    """Position, velocity and acceleration, (count, d) each, over the whole duration."""
    motions = [plan.Eval(t) for t in np.linspace(0.0, plan.duration, count)]
    return [np.array(values) for values in zip(*motions, strict=True)]


def by_scipy(start, end, duration):
    pairs = [np.stack(pair) for pair in zip(start, end, strict=True)]
    return BPoly.from_derivatives([0.0, duration], np.stack(pairs, axis=1))


@pytest.mark.parametrize("dim", [2, 3])
def test_motion_agrees_with_scipy_and_meets_one_of_the_entries(dim):
    rng = np.random.default_rng(dim)
    start, entries = random_motion(rng, dim), random_motion(rng, dim, 4)
    plan = PlanTransfer(start, entries, SPEED, MAX_ACCELERATION)
    reached = np.linalg.norm(entries.position - plan.control_points[-1], axis=1).argmin()
    expected = by_scipy(start, single(entries, reached), plan.duration)
    for t in np.linspace(0.0, plan.duration, 7):
        for order, values in enumerate(plan.Eval(t)):
            np.testing.assert_allclose(
                values, expected.derivative(order)(t) if order else expected(t), atol=1e-11
            )


def test_plan_turns_and_scales_with_the_world():
    rng = np.random.default_rng(3)
    start, entries = random_motion(rng, 3), random_motion(rng, 3, 5)
    R = 100.0 * np.linalg.qr(rng.standard_normal((3, 3)))[0]
    plan = PlanTransfer(start, entries, SPEED, MAX_ACCELERATION)
    turned = PlanTransfer(
        Motion(*(v @ R.T for v in start)),
        Motion(*(v @ R.T for v in entries)),
        100.0 * SPEED,
        100.0 * MAX_ACCELERATION,
    )
    assert turned.duration == pytest.approx(plan.duration)
    np.testing.assert_allclose(turned.control_points, plan.control_points @ R.T, atol=1e-7)


def test_a_start_from_rest_is_possible():
    start = Motion(np.array([3.0, 1.0]), np.zeros(2), np.zeros(2))
    plan = PlanTransfer(start, on_ring(1.0, ANGLES), SPEED, MAX_ACCELERATION)
    speeds = np.linalg.norm(sampled(plan)[1], axis=1)
    assert plan.violation == 0.0
    assert speeds[len(speeds) // 2 :].min() > (SPEED_RANGE[0] - 0.01) * SPEED
    # And a stop from rest stays.
    stop = PlanStop(start, MAX_ACCELERATION)
    np.testing.assert_array_equal(stop.control_points, np.tile(start.position, (6, 1)))


def test_motion_stays_at_its_ends_outside_of_its_time():
    start = random_motion(np.random.default_rng(0), 2)
    plan = PlanStop(start, MAX_ACCELERATION)
    for values, expected in zip(plan.Eval(0.0), start, strict=True):
        np.testing.assert_allclose(values, expected, atol=1e-12)
    for before, at in zip(plan.Eval(-1.0), plan.Eval(0.0), strict=True):
        np.testing.assert_array_equal(before, at)
    for after, at in zip(plan.Eval(plan.duration + 9.0), plan.Eval(plan.duration), strict=True):
        np.testing.assert_array_equal(after, at)


@pytest.mark.parametrize(("radius", "other"), [(1.0, 2.0), (2.0, 1.0)])
@pytest.mark.parametrize("angle", [0.0, 3.7])
def test_a_vehicle_neither_stops_nor_rushes_between_rings(radius, other, angle):
    start = single(on_ring(radius, np.array([angle])), 0)
    entries = on_ring(other, ANGLES)
    plan = PlanTransfer(start, entries, SPEED, MAX_ACCELERATION)
    position, velocity, acceleration = sampled(plan)
    speeds = np.linalg.norm(velocity, axis=1)
    assert plan.violation == 0.0
    # Between the samples of the planner the speed may be a little outside.
    assert speeds.min() > (SPEED_RANGE[0] - 0.01) * SPEED
    assert speeds.max() < (SPEED_RANGE[1] + 0.01) * SPEED
    assert np.linalg.norm(acceleration, axis=1).max() < 1.5 * SPEED * TURN_RATE
    # No loop: it goes around the center as the rings do, and less than half of them.
    turned = np.unwrap(np.arctan2(position[:, 1], position[:, 0]))
    assert np.diff(turned).min() > -1e-3
    assert turned[-1] - turned[0] < np.pi


def test_choice_is_that_of_an_exhaustive_search():
    start = single(on_ring(1.0, np.array([0.3])), 0)
    entries = on_ring(2.0, np.linspace(0.0, 2 * np.pi, 12, endpoint=False))
    plan = PlanTransfer(start, entries, SPEED, MAX_ACCELERATION)
    shares, best = branches._SAMPLES, np.inf
    for i in range(12):
        distance = np.linalg.norm(entries.position[i] - start.position)
        for detour in branches._DETOURS:
            T = max(detour * distance / SPEED, branches.SHORTEST_TRANSFER)
            curve = by_scipy(start, single(entries, i), T)
            speeds = np.linalg.norm(curve.derivative()(shares * T), axis=1) / SPEED
            accelerations = np.linalg.norm(curve.derivative(2)(shares * T), axis=1)
            if SPEED_RANGE[0] <= speeds.min() and speeds.max() <= SPEED_RANGE[1]:
                effort = np.mean((accelerations / (TURN_RATE * SPEED)) ** 2)
                best = min(best, T * (1.0 + effort))
    assert plan.cost == pytest.approx(best, rel=1e-9)


def test_least_violation_where_no_motion_keeps_the_limits():
    start = single(on_ring(1.0, np.array([0.3])), 0)
    entries = on_ring(2.0, np.linspace(0.0, 2 * np.pi, 12, endpoint=False))
    # The rings themselves demand 0.2 and 0.1 m/s^2.
    plan = PlanTransfer(start, entries, SPEED, 0.05)
    acceleration = np.linalg.norm(sampled(plan)[2], axis=1).max()
    # 0.2 m/s^2 at the start is the least that there is.
    assert plan.violation >= acceleration / 0.05 - 1.0 - 0.05
    assert plan.violation >= 0.2025 / 0.05 - 1.0 - 1e-9
    assert np.isfinite(plan.control_points).all()


@pytest.mark.parametrize("speed", [0.45, 8.0])
def test_a_stop_is_straight_steady_and_gentle(speed):
    v = speed * np.array([0.6, 0.8])
    plan = PlanStop(Motion(np.array([1.0, -2.0]), v, np.zeros(2)), 5.0)
    position, velocity, acceleration = sampled(plan)
    along = velocity @ v / speed
    assert np.diff(along).max() <= 1e-12
    np.testing.assert_allclose(velocity, np.outer(along, v / speed), atol=1e-12)
    np.testing.assert_allclose(velocity[-1], 0.0, atol=1e-12)
    np.testing.assert_allclose(acceleration[-1], 0.0, atol=1e-11)
    peak = 1.5 * speed / plan.duration
    assert np.linalg.norm(acceleration, axis=1).max() == pytest.approx(peak, rel=1e-4)
    assert peak <= 5.0 + 1e-12
    np.testing.assert_allclose(position[-1] - position[0], v * plan.duration / 2.0)


def test_a_stop_takes_up_the_acceleration():
    start = random_motion(np.random.default_rng(3), 2)
    plan = PlanStop(start, MAX_ACCELERATION)
    # The smoothest one: its velocity is the cubic between both ends.
    velocity = CubicHermiteSpline(
        [0.0, plan.duration],
        [start.velocity, np.zeros(2)],
        [start.acceleration, np.zeros(2)],
    )
    for time in plan.duration * np.linspace(0.0, 1.0, 9):
        np.testing.assert_allclose(plan.Eval(time).velocity, velocity(time), atol=1e-12)
