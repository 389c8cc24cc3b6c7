import math

import numpy as np
import pytest
from systems.transfer import Motion, PlanTransfer

from sgvf_drake.exceptions import ConfigurationError
from systems.branches import (
    BRAKING_SHARE,
    Branch,
    CheckBranches,
    CheckedBox,
    CheckTour,
    DepartureDelay,
    MakeBranches,
    SpeedLimits,
)

SPEED, MAX_ACCELERATION = 0.45, 15.0
ANGLES = np.linspace(0.0, 2 * np.pi, 80, endpoint=False)
UNIT = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])


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


def ring(radius=1.0, center=(0.0, 0.0)):
    return Branch(center + radius * UNIT, 2 * np.pi * radius, True)


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_branches_run_with_the_field(sense):
    cloud = np.random.default_rng(0).permutation(np.concatenate([UNIT, 2.0 * UNIT]))
    branches = MakeBranches(Rotations((0.0, 0.0), sense=sense), cloud)
    assert [branch.closed for branch in branches] == [True, True]
    np.testing.assert_allclose(
        [branch.length for branch in branches], [4 * np.pi, 2 * np.pi], rtol=1e-3
    )
    for branch, radius in zip(branches, (2.0, 1.0), strict=True):
        np.testing.assert_allclose(np.linalg.norm(branch.points, axis=1), radius)
        turned = np.unwrap(np.arctan2(*branch.points.T[::-1]))
        assert (sense * np.diff(turned) > 0.0).all()


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_open_branch_starts_where_the_field_starts(sense):
    arc = UNIT[:50]
    (branch,) = MakeBranches(Rotations((0.0, 0.0), sense=sense), arc[::-1].copy())
    assert not branch.closed
    np.testing.assert_allclose(branch.points[0], arc[0] if sense > 0 else arc[-1])


def test_stray_waypoints_are_no_branch():
    cloud = np.concatenate([UNIT, [[9.0, 9.0]]])
    assert len(MakeBranches(Rotations((0.0, 0.0)), cloud)) == 1


def test_nearest_waypoint():
    index, distance = ring().Nearest(3.0 * UNIT[17])
    assert index == 17
    assert distance == pytest.approx(2.0)


def test_entries_move_with_the_field():
    entries = ring(2.0).Entries(Rotations((0.0, 0.0)), SPEED)
    np.testing.assert_allclose(np.linalg.norm(entries.velocity, axis=1), SPEED)
    np.testing.assert_allclose(entries.acceleration, -(SPEED**2) / 2.0 * UNIT, atol=1e-12)


def test_open_branch_is_entered_near_its_start_unless_anywhere():
    branch, field = Branch(UNIT[:50], 3.9, False), Rotations((0.0, 0.0))
    np.testing.assert_array_equal(branch.Entries(field, SPEED).position, UNIT[:5])
    assert len(branch.Entries(field, SPEED, anywhere=True).position) == 50


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
    entries = there.Entries(field, SPEED)

    def cost(position):
        start = here.Entries(field, SPEED)
        index, _ = here.Nearest(position)
        motion = Motion(*(values[index] for values in start))
        return PlanTransfer(motion, entries, SPEED, MAX_ACCELERATION).cost

    delays = []
    for angle in np.linspace(0.0, 2 * np.pi, 6, endpoint=False):
        position = centers[0] + np.array([math.cos(angle), math.sin(angle)])
        delay = DepartureDelay(field, here, there, position, SPEED, MAX_ACCELERATION)
        turned = angle + SPEED * delay
        departure = centers[0] + np.array([math.cos(turned), math.sin(turned)])
        # A few entries only are tried in the forecast: a tenth is left to it.
        assert delay + cost(departure) <= 1.1 * cost(position)
        assert 0.0 <= delay < 2 * np.pi / SPEED
        delays.append(delay)
    assert max(delays) > 3.0


def test_departure_between_concentric_rings_needs_no_waiting():
    field = Rotations((0.0, 0.0))
    for position in UNIT[::13]:
        assert DepartureDelay(field, ring(), ring(2.0), position, SPEED, 15.0) < 0.5


@pytest.mark.parametrize(
    ("branch", "message"),
    [
        (Branch(np.zeros((3, 3)), 1.0, True), r"branch 0 must have points \(n, 2\)"),
        (Branch(np.zeros((0, 2)), 1.0, True), "branch 0 must have points"),
        (Branch(np.full((3, 2), math.nan), 1.0, True), "branch 0 has a point"),
        (Branch(np.zeros((3, 2)), 0.0, True), "length of branch 0 must be positive, got 0.0"),
        (Branch(np.full((3, 2), 2.0), 1.0, True), "branch 0 is not inside the box"),
    ],
)
def test_branches_that_cannot_be_flown_are_refused(branch, message):
    with pytest.raises(ConfigurationError, match=message):
        CheckBranches([branch], 2, (np.full(2, -1.0), np.full(2, 1.0)))


def test_no_branches_are_refused():
    with pytest.raises(ConfigurationError, match="at least one branch"):
        CheckBranches([], 2, None)


@pytest.mark.parametrize("box", [([0.0], [1.0]), ([0.0, 1.0], [1.0, 1.0]), ([1, 1], [0, 2])])
def test_bad_box_is_refused(box):
    with pytest.raises(ConfigurationError, match="box must be"):
        CheckedBox(box, 2)


@pytest.mark.parametrize("tour", [(), (0, 2), (-1,), (0.5,)])
def test_bad_tour_is_refused(tour):
    with pytest.raises(ConfigurationError, match="tour must hold numbers of the 2 branches"):
        CheckTour(tour, 2)


def test_a_loop_at_whose_end_the_field_rests_is_open():
    field = Rotations((0.0, 0.0))
    (loop,) = MakeBranches(field, UNIT)
    field.ends = loop.points[-1:]
    (branch,) = MakeBranches(field, UNIT)
    assert loop.closed
    assert not branch.closed
    assert branch.length == pytest.approx(2 * np.pi, rel=0.03)
    # In the direction of travel, to the end.
    np.testing.assert_allclose(branch.points[-1], field.ends[0])


def test_a_pair_of_stray_waypoints_is_no_branch():
    points = np.concatenate([UNIT, [[3.0, 3.0], [3.01, 3.0]]])
    (branch,) = MakeBranches(Rotations((0.0, 0.0)), points)
    assert len(branch.points) == len(UNIT)
