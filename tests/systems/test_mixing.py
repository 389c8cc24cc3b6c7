from hypothesis import example, given
from hypothesis import strategies as st
import numpy as np
import pytest

from systems import QuadrotorParameters
from systems.mixing import CalcPropellerForces

PARAMETERS = QuadrotorParameters()
F_MAX = PARAMETERS.max_propeller_force
MOST_ROLL = PARAMETERS.arm_length * F_MAX


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


def test_yaw_torque_alone_gives_way():
    demand = np.array([5.0, 0.05, -0.04, 10.0])
    forces, given_ = mix(demand[0], demand[1:])
    np.testing.assert_allclose(given_[:3], demand[:3], rtol=1e-12)
    assert 0.0 < given_[3] < demand[3]
    # Nothing is left over: one propeller is at its limit.
    assert min(forces.min(), F_MAX - forces.max()) == pytest.approx(0.0, abs=1e-12)


def test_thrust_gives_way_to_roll_torque():
    _, given_ = mix(4.0 * F_MAX, (0.5 * MOST_ROLL, 0.0, 0.0))
    assert given_[1] == pytest.approx(0.5 * MOST_ROLL)
    assert given_[0] == pytest.approx(3.0 * F_MAX)


def test_too_much_roll_and_pitch_keep_their_direction():
    _, given_ = mix(5.0, (4.0 * MOST_ROLL, -2.0 * MOST_ROLL, 0.0))
    np.testing.assert_allclose(given_[1:3], [MOST_ROLL, -0.5 * MOST_ROLL], rtol=1e-12)
