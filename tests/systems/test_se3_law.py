"""The law and its mixing against matrices written from Lee et al. 2010, RotorPy and Drake."""

import math

from hypothesis import example, given
from hypothesis import strategies as st
import numpy as np
from pydrake.math import RollPitchYaw
import pytest
from rotorpy.controllers.quadrotor_control import SE3Control

from systems import DEFAULT_GAINS, Gains, QuadrotorParameters
from systems.se3_law import (
    LIFT_SHARE,
    MAX_DESIRED_ANGULAR_ACCELERATION,
    MAX_DESIRED_RATE,
    MAX_HEADING_ERROR,
    MAX_TILT,
    MIN_LIFT,
    SLOW_SPEED,
    THRUST_SHARE,
    Body,
    CalcAttitude,
    CalcAttitudeError,
    CalcDesiredAttitude,
    CalcPropellerForces,
    CalcPropellerInput,
    CalcThrustAndTorque,
    LimitThrust,
)

from .rotorpy_vehicle import rotorpy_parameters

PARAMETERS = QuadrotorParameters()
MAX_THRUST = 4 * PARAMETERS.max_propeller_force
F_MAX = PARAMETERS.max_propeller_force
MOST_ROLL = PARAMETERS.arm_length * F_MAX
E3 = np.array([0.0, 0.0, 1.0])


def columns(R):
    """The law's own form of a rotation matrix."""
    return tuple(tuple(column) for column in np.asarray(R).T.tolist())


def hat(w):
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def vee(S):
    return np.array([S[2, 1], S[0, 2], S[1, 0]])


def random_case(seed):
    """A state, a velocity command and a feed-forward well within all limits."""
    rng = np.random.default_rng(seed)
    state = np.concatenate(
        (
            rng.uniform(-2.0, 2.0, 3),
            rng.uniform(-0.6, 0.6, 3),
            rng.uniform(-1.5, 1.5, 3),
            rng.uniform(-2.0, 2.0, 3),
        )
    )
    turn = rng.uniform(-MAX_HEADING_ERROR, MAX_HEADING_ERROR)
    gains = Gains(3.0, 12.0, 0.7, state[5] + turn)
    return state, state[6:9] + rng.uniform(-0.5, 0.5, 3), rng.uniform(-2.0, 2.0, 3), gains


def law(
    state, velocity_command, acceleration, gains=DEFAULT_GAINS, disturbance=(0.0, 0.0, 0.0)
):
    thrust, torque = CalcThrustAndTorque(
        state.tolist(),
        velocity_command.tolist(),
        acceleration.tolist(),
        (),
        list(disturbance),
        gains,
        Body(PARAMETERS.mass, *PARAMETERS.inertia),
        PARAMETERS.gravity,
        MAX_THRUST,
        True,
    )
    return thrust, np.array(torque)


def desired_rotation(F, heading):
    b3 = F / np.linalg.norm(F)
    b2 = np.cross(b3, [math.cos(heading), math.sin(heading), 0.0])
    b2 /= np.linalg.norm(b2)
    return np.column_stack((np.cross(b2, b3), b2, b3))


def lee(state, velocity_command, acceleration, gains, disturbance):
    """Lee et al. 2010, with matrices and numerical rates of R_d."""
    m, g, J = PARAMETERS.mass, PARAMETERS.gravity, np.diag(PARAMETERS.inertia)
    v = state[6:9]
    R = RollPitchYaw(state[3:6]).ToRotationMatrix().matrix()
    w = RollPitchYaw(state[3:6]).CalcAngularVelocityInChildFromRpyDt(state[9:12])
    wanted = acceleration + gains.velocity_gain * (velocity_command - v) - disturbance
    F = m * (wanted + g * E3)
    turn = np.cross(v, acceleration) / (v @ v + SLOW_SPEED**2)

    def attitude(t):
        # The feed-forward turns with the path; Taylor's series of the rotation suffices.
        first = np.cross(turn, acceleration)
        moved = t * first + 0.5 * t**2 * np.cross(turn, first)
        return desired_rotation(F + m * moved, gains.heading)

    def w_d(t, h=1e-4):
        # vee of the skew part, because rounding leaves a symmetric one.
        S = attitude(t).T @ (attitude(t + h) - attitude(t - h)) / (2.0 * h)
        return vee(0.5 * (S - S.T))

    w_d_dot = (w_d(1e-3) - w_d(-1e-3)) / 2e-3
    Q = attitude(0.0).T @ R
    e_R = 0.5 * vee(Q - Q.T)
    e_w = w - Q.T @ w_d(0.0)
    k_R, k_w = gains.attitude_bandwidth**2, 2 * gains.damping_ratio * gains.attitude_bandwidth
    M = J @ (-k_R * e_R - k_w * e_w) + np.cross(w, J @ w)
    M -= J @ (hat(w) @ Q.T @ w_d(0.0) - Q.T @ w_d_dot)
    return F @ R @ E3, M


@pytest.mark.parametrize("seed", range(10))
def test_law_agrees_with_lee_et_al(seed):
    case = random_case(seed)
    # Half of the cases are disturbed.
    disturbance = (seed % 2) * np.random.default_rng(seed).uniform(-1.0, 1.0, 3)
    thrust, torque = law(*case, disturbance)
    expected_thrust, expected_torque = lee(*case, disturbance)
    assert thrust == pytest.approx(expected_thrust, rel=1e-12)
    # The numerical rates of R_d are good to about 1e-6.
    np.testing.assert_allclose(
        torque, expected_torque, atol=2e-5 * np.linalg.norm(expected_torque)
    )


@pytest.mark.parametrize("seed", range(5))
def test_law_agrees_with_rotorpy(seed):
    state, velocity_command, _, gains = random_case(seed)
    reference = SE3Control(rotorpy_parameters(gains, PARAMETERS))
    reference.kd_pos = np.full(3, gains.velocity_gain)
    rpy = RollPitchYaw(state[3:6])
    q = rpy.ToQuaternion()
    measured = {
        "x": state[:3],
        "v": state[6:9],
        "q": np.array([q.x(), q.y(), q.z(), q.w()]),
        "w": rpy.CalcAngularVelocityInChildFromRpyDt(state[9:12]),
    }
    wanted = {
        "x": state[:3],
        "x_dot": velocity_command,
        "x_ddot": np.zeros(3),
        "yaw": gains.heading,
        "yaw_dot": 0.0,
    }
    # Without feed-forward the desired attitude is at rest, as RotorPy always takes it.
    expected = reference.update(0.0, measured, wanted)
    thrust, torque = law(state, velocity_command, np.zeros(3), gains)
    assert thrust == pytest.approx(expected["cmd_thrust"], rel=1e-9)
    np.testing.assert_allclose(torque, expected["cmd_moment"], rtol=1e-9, atol=1e-12)


angles = st.floats(-3.0, 3.0)
pitches = st.floats(-1.4, 1.4)
rates = st.floats(-10.0, 10.0)


@given(st.tuples(angles, pitches, angles), st.tuples(rates, rates, rates))
def test_attitude_agrees_with_drake(rpy, rpy_rates):
    R_WB, w_WB_B = CalcAttitude(rpy, rpy_rates)
    expected = RollPitchYaw(np.array(rpy))
    np.testing.assert_allclose(
        np.array(R_WB).T, expected.ToRotationMatrix().matrix(), atol=1e-14
    )
    w = expected.CalcAngularVelocityInChildFromRpyDt(np.array(rpy_rates))
    np.testing.assert_allclose(w_WB_B, w, atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_attitude_error_points_from_desired_to_actual(axis):
    # B is D turned by +0.01 rad about one axis: the error is +0.01 there, so that the
    # torque -k e_R turns back.
    rpy = np.zeros(3)
    rpy[axis] = 0.01
    R_WD = RollPitchYaw(0.3, -0.2, 1.0).ToRotationMatrix()
    R_WB = R_WD @ RollPitchYaw(rpy).ToRotationMatrix()
    error = CalcAttitudeError(columns(R_WD.matrix()), columns(R_WB.matrix()))
    np.testing.assert_allclose(error, rpy, atol=1e-6)


@given(
    st.tuples(*[st.floats(-100.0, 100.0)] * 3),
    st.sampled_from([1.05, 1.5, 4.1]),
)
def test_limited_thrust_can_be_pointed_and_given(F, thrust_to_weight):
    parameters = QuadrotorParameters(thrust_to_weight=thrust_to_weight)
    x, y, z = limited = np.array(
        LimitThrust(parameters.weight, 4 * parameters.max_propeller_force, F)
    )
    spare = (thrust_to_weight - 1.0) * parameters.weight
    assert math.hypot(x, y) <= math.tan(MAX_TILT) * z * (1.0 + 1e-12)
    assert np.linalg.norm(limited) <= (parameters.weight + THRUST_SHARE * spare) * (1 + 1e-12)
    assert (
        MIN_LIFT * parameters.weight
        <= z
        <= (parameters.weight + LIFT_SHARE * spare) * (1 + 1e-12)
    )
    # Sideways the direction is kept.
    assert x * F[1] - y * F[0] == pytest.approx(0.0, abs=1e-9)


def test_hover_needs_the_weight_and_no_torque():
    thrust, torque = law(np.zeros(12), np.zeros(3), np.zeros(3))
    assert thrust == pytest.approx(PARAMETERS.weight)
    np.testing.assert_array_equal(torque, 0.0)
    # Within the limits a thrust is not changed.
    assert LimitThrust(PARAMETERS.weight, MAX_THRUST, (3.0, -2.0, 5.0)) == (3.0, -2.0, 5.0)


def test_desired_rates_are_the_derivatives_of_the_desired_attitude():
    # A thrust vector that turns fast and changes its length.
    F, F_dot, F_ddot = np.array([[1.5, -1.0, 4.0], [3.0, 2.0, -5.0], [-4.0, 6.0, 5.0]])

    def attitude(t):
        moved = (F + t * F_dot + 0.5 * t**2 * F_ddot, F_dot + t * F_ddot, F_ddot)
        R, w, alpha = CalcDesiredAttitude(*map(tuple, moved), 0.7, False)
        return np.array(R).T, np.array(w), np.array(alpha)

    h = 1e-5
    (before, w_before, _), (R, w, alpha), (after, w_after, _) = map(attitude, (-h, 0.0, h))
    np.testing.assert_allclose((after - before) / (2 * h), hat(w) @ R, atol=1e-8)
    # The part along D's z axis is left out, and said so.
    w_dot = (w_after - w_before) / (2 * h)
    np.testing.assert_allclose(np.cross(R[:, 2], alpha), np.cross(R[:, 2], w_dot), atol=1e-8)


def test_desired_rates_are_limited():
    F, fast, faster = (0.0, 0.0, 4.5), (900.0, 0.0, 0.0), (0.0, 9e5, 0.0)
    _, w, alpha = CalcDesiredAttitude(F, fast, faster, 0.0)
    assert np.linalg.norm(w) == pytest.approx(MAX_DESIRED_RATE)
    assert np.linalg.norm(alpha) == pytest.approx(MAX_DESIRED_ANGULAR_ACCELERATION)


# The mixing.


def mix(thrust, torque):
    forces = np.array(CalcPropellerForces(PARAMETERS.rotors, thrust, tuple(torque), True))
    return forces, PARAMETERS.MixingMatrix() @ forces


def test_what_the_motors_can_give_is_given_exactly():
    demand = np.array([5.0, 0.02, -0.03, 0.01])
    forces, given_ = mix(demand[0], demand[1:])
    assert np.all((forces > 0.0) & (forces < F_MAX))
    np.testing.assert_allclose(given_, demand, rtol=1e-12)


@given(
    thrust=st.floats(-50.0, 100.0),
    torque=st.tuples(*[st.floats(-5.0, 5.0)] * 3),
)
@example(thrust=0.0, torque=(0.0, 0.0, 1.0))
@example(thrust=4 * F_MAX, torque=(MOST_ROLL, -MOST_ROLL, 0.0))
def test_forces_stay_within_what_a_motor_gives(thrust, torque):
    forces, _ = mix(thrust, torque)
    assert np.all((forces >= 0.0) & (forces <= F_MAX))


@given(
    thrust=st.floats(-10.0, 4 * F_MAX + 10.0),
    roll=st.floats(-0.99, 0.99),
    pitch=st.floats(-0.99, 0.99),
    yaw=st.floats(-1.0, 1.0),
)
def test_roll_and_pitch_torque_are_kept_whatever_else_is_asked(thrust, roll, pitch, yaw):
    _, given_ = mix(thrust, (roll * MOST_ROLL, pitch * MOST_ROLL, yaw))
    expected = [roll * MOST_ROLL, pitch * MOST_ROLL]
    np.testing.assert_allclose(given_[1:3], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(
    ("demand", "expected"),
    [
        # Thrust gives way to roll torque.
        ((4.0 * F_MAX, 0.5 * MOST_ROLL, 0.0, 0.0), (3.0 * F_MAX, 0.5 * MOST_ROLL, 0.0, 0.0)),
        # Too much roll and pitch keep their direction.
        (
            (2.0 * F_MAX, 4.0 * MOST_ROLL, -2.0 * MOST_ROLL, 0.0),
            (2.0 * F_MAX, MOST_ROLL, -0.5 * MOST_ROLL, 0.0),
        ),
    ],
)
def test_what_cannot_be_given_gives_way(demand, expected):
    np.testing.assert_allclose(mix(demand[0], demand[1:])[1], expected, rtol=1e-12, atol=1e-12)


def test_yaw_torque_alone_gives_way():
    demand = np.array([5.0, 0.05, -0.04, 10.0])
    forces, given_ = mix(demand[0], demand[1:])
    np.testing.assert_allclose(given_[:3], demand[:3], rtol=1e-12)
    assert 0.0 < given_[3] < demand[3]
    # Nothing is left over: one propeller is at its limit.
    assert min(forces.min(), F_MAX - forces.max()) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_limits_do_not_hide_a_torque_that_overflows(axis):
    """A body rate of which the law demands infinite torque about one axis, at hover."""
    state, nothing = [0.0] * 12, [0.0] * 3
    state[9 + axis] = 1e308
    forces = CalcPropellerInput(
        *(state, nothing, nothing, (), nothing),
        *(DEFAULT_GAINS, Body(PARAMETERS.mass, *PARAMETERS.inertia)),
        *(PARAMETERS.rotors, PARAMETERS.gravity, True),
    )
    assert np.isnan(forces).all()
