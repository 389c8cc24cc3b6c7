import math

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import DEFAULT_GAINS, Body, QuadrotorParameters, Se3Controller

from .flying import differences

F_MAX = QuadrotorParameters().max_propeller_force
INPUTS = (("state", 12), ("velocity_command", 3), ("acceleration_feedforward", 3))
CONTROLLER = Se3Controller()


def evaluate(system, inputs, gains=None):
    """The forces for all inputs in one vector (18,)."""
    context = system.CreateDefaultContext()
    if gains is not None:
        system.SetGains(context, gains)
    start = 0
    for name, size in INPUTS:
        system.GetInputPort(name).FixValue(context, inputs[start : start + size])
        start += size
    return system.GetOutputPort("propeller_force").Eval(context)


def random_inputs(count, seed=0):
    """Inputs within the vehicle's limits, where the law is smooth."""
    rng = np.random.default_rng(seed)
    return np.concatenate(
        (
            rng.uniform(-2.0, 2.0, (count, 3)),
            rng.uniform(-0.15, 0.15, (count, 3)),
            rng.uniform(-0.4, 0.4, (count, 6)),
            rng.uniform(-0.4, 0.4, (count, 6)),
        ),
        axis=1,
    )


def test_gradients_agree_with_differences():
    autodiff = CONTROLLER.ToAutoDiffXd()
    for inputs in random_inputs(6):
        forces = evaluate(CONTROLLER, inputs)
        assert np.all((forces > 0.01) & (forces < F_MAX - 0.01)), "not smooth at a limit"
        expected = differences(lambda x: evaluate(CONTROLLER, x), inputs)
        output = evaluate(autodiff, InitializeAutoDiff(inputs)[:, 0])
        np.testing.assert_allclose(
            ExtractGradient(output.reshape(-1, 1)),
            expected,
            atol=1e-5 * np.abs(expected).max(),
        )


def test_gradients_are_finite_in_hover():
    # Square roots of zero are what spoils them.
    output = evaluate(CONTROLLER.ToAutoDiffXd(), InitializeAutoDiff(np.zeros(18))[:, 0])
    assert np.all(np.isfinite(ExtractGradient(output.reshape(-1, 1))))


finite = st.floats(-1e3, 1e3)


@settings(max_examples=200)
@given(st.lists(finite, min_size=18, max_size=18))
def test_forces_stay_within_what_a_motor_gives(inputs):
    forces = evaluate(CONTROLLER, np.array(inputs))
    assert np.all((forces >= 0.0) & (forces <= F_MAX))


@given(
    st.integers(0, 2**32 - 1),
    st.floats(-3.0, 3.0),
    st.tuples(*[st.floats(-100.0, 100.0)] * 3),
)
def test_turning_and_moving_the_world_changes_nothing(seed, turn, shift):
    inputs = random_inputs(1, seed)[0]
    c, s = math.cos(turn), math.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    moved = inputs.copy()
    moved[:3] = R @ inputs[:3] + shift
    moved[5] += turn
    for start in (6, 12, 15):
        moved[start : start + 3] = R @ inputs[start : start + 3]
    gains = DEFAULT_GAINS._replace(heading=0.2)
    turned = gains._replace(heading=0.2 + turn)
    np.testing.assert_allclose(
        evaluate(CONTROLLER, moved, turned), evaluate(CONTROLLER, inputs, gains), atol=1e-11
    )


def wild_inputs(count, seed=0):
    """Inputs far beyond what the vehicle can do, where everything is limited."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.0, 1.0, (count, 18)) * np.repeat([9, 1.2, 9, 9, 30], [3, 3, 3, 3, 6])


@pytest.mark.parametrize("saturate", [True, False])
@pytest.mark.parametrize("make_inputs", [random_inputs, wild_inputs])
def test_compiled_law_is_the_law(make_inputs, saturate):
    # Floats run compiled, AutoDiffXd in the interpreter: two translations of one source.
    system = Se3Controller(saturate=saturate)
    autodiff = system.ToAutoDiffXd()
    for inputs in make_inputs(50):
        forces = evaluate(autodiff, InitializeAutoDiff(inputs, np.zeros((18, 0)))[:, 0])
        np.testing.assert_allclose(
            evaluate(system, inputs), [force.value() for force in forces], rtol=1e-9, atol=1e-9
        )


def test_without_saturation_the_law_is_the_same_within_the_limits():
    smooth = Se3Controller(saturate=False)
    for inputs in random_inputs(20):
        np.testing.assert_allclose(
            evaluate(smooth, inputs), evaluate(CONTROLLER, inputs), rtol=1e-12
        )


def test_without_saturation_the_law_is_smooth_beyond_the_limits():
    smooth = Se3Controller(saturate=False)
    autodiff = smooth.ToAutoDiffXd()
    beyond = [
        inputs
        for inputs in wild_inputs(10)
        if np.ptp(np.clip(evaluate(smooth, inputs), 0.0, F_MAX) - evaluate(smooth, inputs)) > 0
    ]
    assert len(beyond) >= 5
    for inputs in beyond:
        gradient = ExtractGradient(
            evaluate(autodiff, InitializeAutoDiff(inputs)[:, 0]).reshape(-1, 1)
        )
        coarse, fine = (
            np.abs(differences(lambda x: evaluate(smooth, x), inputs, h) - gradient).max()
            for h in (2e-3, 1e-3)
        )
        # Central differences of a smooth function: a half of the step, a quarter of the error.
        assert fine < 0.3 * coarse


def test_thrust_and_torque_grow_with_the_body_that_is_believed():
    context, inputs = CONTROLLER.CreateDefaultContext(), random_inputs(1)[0]
    body = CONTROLLER.GetBody(context)
    assert body == (QuadrotorParameters().mass, *QuadrotorParameters().inertia)
    start = 0
    for name, size in INPUTS:
        CONTROLLER.GetInputPort(name).FixValue(context, inputs[start : start + size])
        start += size
    mixing = QuadrotorParameters().MixingMatrix()
    before = mixing @ CONTROLLER.GetOutputPort("propeller_force").Eval(context)
    doubled = Body(*(2.0 * value for value in body))
    CONTROLLER.SetBody(context, doubled)
    after = mixing @ CONTROLLER.GetOutputPort("propeller_force").Eval(context)
    np.testing.assert_allclose(after, 2.0 * before, rtol=1e-9)
    assert CONTROLLER.GetBody(context.Clone()) == doubled


def test_gain_or_body_of_zero_in_the_context_is_named():
    for index, entry, name in (
        (CONTROLLER.gains_index, 1, "attitude_bandwidth"),
        (CONTROLLER.body_index, 0, "mass"),
    ):
        for system in (CONTROLLER, CONTROLLER.ToAutoDiffXd()):
            context = system.CreateDefaultContext()
            for port, size in INPUTS:
                system.GetInputPort(port).FixValue(context, np.zeros(size))
            context.get_mutable_numeric_parameter(index).SetAtIndex(entry, 0.0)
            with pytest.raises(ConfigurationError, match=f"{name} must be .* positive"):
                system.GetOutputPort("propeller_force").Eval(context)


def test_a_body_too_heavy_to_lift_is_lifted_as_far_as_it_goes():
    context = CONTROLLER.CreateDefaultContext()
    for port, size in INPUTS:
        CONTROLLER.GetInputPort(port).FixValue(context, np.ones(size))
    CONTROLLER.SetBody(context, CONTROLLER.GetBody(context)._replace(mass=50.0))
    forces = CONTROLLER.GetOutputPort("propeller_force").Eval(context)
    assert np.all((forces >= 0.0) & (forces <= F_MAX))
    assert forces.mean() > 0.5 * F_MAX


def test_output_is_in_the_units_of_the_plant():
    inputs = random_inputs(1)[0]
    # Twice the force per unit of input, and the same torque per newton.
    doubled = QuadrotorParameters(force_constant=2.0, moment_constant=0.016)
    np.testing.assert_allclose(
        2.0 * evaluate(Se3Controller(doubled), inputs), evaluate(CONTROLLER, inputs)
    )


@pytest.mark.parametrize(
    ("index", "port"),
    [(4, "state"), (13, "velocity_command"), (17, "acceleration_feedforward")],
)
def test_input_that_is_not_finite_is_named(index, port):
    inputs = np.zeros(18)
    inputs[index] = math.nan
    for system in (CONTROLLER, CONTROLLER.ToAutoDiffXd()):
        with pytest.raises(NonFiniteValueError, match=f"Se3Controller.*'{port}'.*t = 0 s"):
            evaluate(system, inputs)


def test_velocity_beyond_all_numbers_is_no_force():
    inputs = np.zeros(18)
    inputs[6] = 1e160
    with pytest.raises(NonFiniteValueError, match="the propeller force"):
        evaluate(Se3Controller(saturate=False), inputs)


def test_thrust_vector_of_zero_is_named():
    inputs = np.zeros(18)
    inputs[17] = -QuadrotorParameters().gravity
    for system in (Se3Controller(saturate=False), Se3Controller(saturate=False).ToAutoDiffXd()):
        with pytest.raises(NonFiniteValueError, match="the propeller force"):
            evaluate(system, inputs)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("velocity_gain", 0.0),
        ("attitude_bandwidth", math.nan),
        ("damping_ratio", -1.0),
        ("heading", math.inf),
        ("mass", 0.0),
        ("I_yy", math.nan),
    ],
)
def test_bad_gain_or_body_is_named(name, value):
    context = CONTROLLER.CreateDefaultContext()
    if name in DEFAULT_GAINS._fields:
        gains = DEFAULT_GAINS._replace(**{name: value})
        with pytest.raises(ConfigurationError, match=name):
            Se3Controller(gains=gains)
        with pytest.raises(ConfigurationError, match=name):
            CONTROLLER.SetGains(context, gains)
        return
    with pytest.raises(ConfigurationError, match=name):
        CONTROLLER.SetBody(context, CONTROLLER.GetBody(context)._replace(**{name: value}))
