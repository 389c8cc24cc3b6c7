import numpy as np
import pytest
from scipy.interpolate import BPoly
from systems.transfer import SPEED_RANGE, TURN_RATE, Motion, PlanStop, PlanTransfer

from systems import transfer

SPEED, MAX_ACCELERATION = 0.45, 10.0


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
def test_motion_agrees_with_scipy(dim):
    rng = np.random.default_rng(dim)
    start, end = random_motion(rng, dim), random_motion(rng, dim, 1)
    plan = PlanTransfer(start, end, SPEED, MAX_ACCELERATION)
    expected = by_scipy(start, single(end, 0), plan.duration)
    for t in np.linspace(0.0, plan.duration, 7):
        for order, values in enumerate(plan.Eval(t)):
            np.testing.assert_allclose(
                values, expected.derivative(order)(t) if order else expected(t), atol=1e-11
            )


def test_ends_are_met():
    rng = np.random.default_rng(5)
    start, entries = random_motion(rng, 3), random_motion(rng, 3, 4)
    plan = PlanTransfer(start, entries, SPEED, MAX_ACCELERATION)
    for values, expected in zip(plan.Eval(0.0), start, strict=True):
        np.testing.assert_allclose(values, expected, atol=1e-12)
    reached = [
        i
        for i in range(4)
        if all(
            np.allclose(a, b, atol=1e-11)
            for a, b in zip(plan.Eval(plan.duration), single(entries, i), strict=True)
        )
    ]
    assert len(reached) == 1


def test_motion_stays_at_its_ends_outside_of_its_time():
    plan = PlanStop(random_motion(np.random.default_rng(0), 2), MAX_ACCELERATION)
    for before, at in zip(plan.Eval(-1.0), plan.Eval(0.0), strict=True):
        np.testing.assert_array_equal(before, at)
    for after, at in zip(plan.Eval(plan.duration + 9.0), plan.Eval(plan.duration), strict=True):
        np.testing.assert_array_equal(after, at)


@pytest.mark.parametrize(("radius", "other"), [(1.0, 2.0), (2.0, 1.0)])
@pytest.mark.parametrize("angle", np.linspace(0.0, 5.5, 4))
def test_a_vehicle_neither_stops_nor_rushes_between_rings(radius, other, angle):
    start = single(on_ring(radius, np.array([angle])), 0)
    entries = on_ring(other, np.linspace(0.0, 2 * np.pi, 60, endpoint=False))
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


def test_a_start_from_rest_is_possible():
    start = Motion(np.array([3.0, 1.0]), np.zeros(2), np.zeros(2))
    entries = on_ring(1.0, np.linspace(0.0, 2 * np.pi, 60, endpoint=False))
    plan = PlanTransfer(start, entries, SPEED, MAX_ACCELERATION)
    speeds = np.linalg.norm(sampled(plan)[1], axis=1)
    assert plan.violation == 0.0
    assert speeds[len(speeds) // 2 :].min() > (SPEED_RANGE[0] - 0.01) * SPEED


def test_choice_is_that_of_an_exhaustive_search():
    start = single(on_ring(1.0, np.array([0.3])), 0)
    entries = on_ring(2.0, np.linspace(0.0, 2 * np.pi, 12, endpoint=False))
    plan = PlanTransfer(start, entries, SPEED, MAX_ACCELERATION)
    shares, best = transfer._SAMPLES, np.inf
    for i in range(12):
        distance = np.linalg.norm(entries.position[i] - start.position)
        for detour in transfer._DETOURS:
            T = max(detour * distance / SPEED, transfer.SHORTEST_TRANSFER)
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


def test_plan_scales_with_the_unit_of_length():
    rng = np.random.default_rng(2)
    start, entries = random_motion(rng, 2), random_motion(rng, 2, 5)
    plan = PlanTransfer(start, entries, SPEED, MAX_ACCELERATION)
    scaled = PlanTransfer(
        Motion(*(100.0 * v for v in start)),
        Motion(*(100.0 * v for v in entries)),
        100.0 * SPEED,
        100.0 * MAX_ACCELERATION,
    )
    assert scaled.duration == pytest.approx(plan.duration)
    np.testing.assert_allclose(scaled.control_points, 100.0 * plan.control_points)


def test_plan_turns_with_the_world():
    rng = np.random.default_rng(3)
    start, entries = random_motion(rng, 3), random_motion(rng, 3, 5)
    R = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    plan = PlanTransfer(start, entries, SPEED, MAX_ACCELERATION)
    turned = PlanTransfer(
        Motion(*(v @ R.T for v in start)),
        Motion(*(v @ R.T for v in entries)),
        SPEED,
        MAX_ACCELERATION,
    )
    np.testing.assert_allclose(turned.control_points, plan.control_points @ R.T, atol=1e-9)


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


def test_a_stop_begins_with_the_acceleration_that_there_is():
    start = random_motion(np.random.default_rng(4), 3)
    plan = PlanStop(start, MAX_ACCELERATION)
    for values, expected in zip(plan.Eval(0.0), start, strict=True):
        np.testing.assert_allclose(values, expected, atol=1e-12)
    assert np.abs(plan.Eval(plan.duration).velocity).max() < 1e-12


def test_a_stop_from_rest_stays():
    p = np.array([1.0, 2.0])
    plan = PlanStop(Motion(p, np.zeros(2), np.zeros(2)), MAX_ACCELERATION)
    np.testing.assert_array_equal(plan.control_points, np.tile(p, (6, 1)))
