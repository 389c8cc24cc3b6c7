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


def evaluate(system, inputs, gains=None, body=None):
    """The forces for all inputs in one vector (18,)."""
    context = system.CreateDefaultContext()
    if gains is not None:
        system.SetGains(context, gains)
    if body is not None:
        system.SetBody(context, body)
    for (name, _), value in zip(INPUTS, np.split(inputs, [12, 15]), strict=True):
        system.GetInputPort(name).FixValue(context, value)
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
    # Square roots of zero, as in hover, spoil the gradients first.
    output = evaluate(autodiff, InitializeAutoDiff(np.zeros(18))[:, 0])
    assert np.isfinite(ExtractGradient(output.reshape(-1, 1))).all()
    for inputs in make_inputs(50):
        forces = evaluate(autodiff, InitializeAutoDiff(inputs, np.zeros((18, 0)))[:, 0])
        np.testing.assert_allclose(
            evaluate(system, inputs), [force.value() for force in forces], rtol=1e-9, atol=1e-9
        )


def test_without_saturation_the_law_is_the_same_and_smooth_beyond_the_limits():
    smooth = Se3Controller(saturate=False)
    autodiff = smooth.ToAutoDiffXd()
    for inputs in random_inputs(20):
        forces = evaluate(CONTROLLER, inputs)
        np.testing.assert_allclose(evaluate(smooth, inputs), forces, rtol=1e-12)
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


def test_output_is_in_the_units_of_the_plant():
    inputs = random_inputs(1)[0]
    # Twice the force per unit of input, and the same torque per newton.
    doubled = QuadrotorParameters(force_constant=2.0, moment_constant=0.016)
    np.testing.assert_allclose(
        2.0 * evaluate(Se3Controller(doubled), inputs), evaluate(CONTROLLER, inputs)
    )


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


def test_thrust_and_torque_grow_with_the_body_that_is_believed():
    inputs, vehicle = random_inputs(1)[0], QuadrotorParameters()
    body = CONTROLLER.GetBody(CONTROLLER.CreateDefaultContext())
    assert body == (vehicle.mass, *vehicle.inertia)
    mixing, doubled = vehicle.MixingMatrix(), Body(*(2.0 * value for value in body))
    before, after = (mixing @ evaluate(CONTROLLER, inputs, None, b) for b in (body, doubled))
    np.testing.assert_allclose(after, 2.0 * before, rtol=1e-9)
    # One too heavy to lift is lifted as far as it goes.
    forces = evaluate(CONTROLLER, np.ones(18), None, body._replace(mass=50.0))
    assert np.all((forces >= 0.0) & (forces <= F_MAX))
    assert forces.mean() > 0.5 * F_MAX


@pytest.mark.parametrize("convert", [False, True])
def test_what_the_law_cannot_use_is_named(convert):
    for saturate, index, value, message in (
        (True, 4, math.nan, r"Se3Controller.*'state'.*t = 0 s"),
        (True, 13, math.nan, r"Se3Controller.*'velocity_command'.*t = 0 s"),
        (True, 17, math.inf, r"Se3Controller.*'acceleration_feedforward'.*t = 0 s"),
        # A velocity beyond all numbers, and a thrust vector of zero.
        (False, 6, 1e160, "the propeller force"),
        (False, 17, -QuadrotorParameters().gravity, "the propeller force"),
    ):
        system, inputs = Se3Controller(saturate=saturate), np.zeros(18)
        inputs[index] = value
        with pytest.raises(NonFiniteValueError, match=message):
            evaluate(system.ToAutoDiffXd() if convert else system, inputs)
    system = CONTROLLER.ToAutoDiffXd() if convert else CONTROLLER
    for index, entry, name in ((0, 1, "attitude_bandwidth"), (1, 0, "mass")):
        context = system.CreateDefaultContext()
        for port, size in INPUTS:
            system.GetInputPort(port).FixValue(context, np.zeros(size))
        context.get_mutable_numeric_parameter(index).SetAtIndex(entry, 0.0)
        with pytest.raises(ConfigurationError, match=f"{name} must be .* positive"):
            system.GetOutputPort("propeller_force").Eval(context)
