from dataclasses import replace
import math

import numpy as np
from pydrake.examples import QuadrotorPlant
import pytest
from rotorpy.vehicles.crazyflie_params import quad_params
from scipy.optimize import minimize

from sgvf_drake.exceptions import ConfigurationError, InertiaWarning
from systems import QuadrotorParameters
from systems.quadrotor import NearestInertia


def test_default_vehicle_is_that_of_the_paper():
    parameters = QuadrotorParameters()
    assert parameters.mass == 0.46
    assert 2.0 * parameters.arm_length == pytest.approx(0.149)
    assert parameters.max_propeller_force == pytest.approx(4.625, abs=1e-3)
    assert 4.0 * parameters.hover_force == pytest.approx(0.46 * 9.81)


def test_greatest_horizontal_acceleration_uses_all_the_thrust():
    parameters = QuadrotorParameters()
    specific_thrust = 4.0 * parameters.max_propeller_force / parameters.mass
    assert math.hypot(
        parameters.max_horizontal_acceleration, parameters.gravity
    ) == pytest.approx(specific_thrust)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("mass", 0.0),
        ("mass", math.nan),
        ("arm_length", -0.1),
        ("thrust_to_weight", 1.0),
        ("thrust_to_weight", math.inf),
        ("inertia", (1e-3, 1e-3)),
        ("inertia", (1e-3, 1e-3, 0.0)),
        ("force_constant", 0.0),
        ("moment_constant", math.nan),
        ("gravity", -9.81),
    ],
)
def test_bad_parameter_is_named(name, value):
    with pytest.raises(ConfigurationError, match=name):
        QuadrotorParameters(**{name: value})


def test_parameters_survive_the_way_through_a_plant():
    # A flat plate has a possible inertia.
    parameters = QuadrotorParameters(
        force_constant=2.0, thrust_to_weight=3.0, inertia=(1e-3, 1e-3, 2e-3)
    )
    assert QuadrotorParameters.FromPlant(parameters.MakePlant(), 3.0) == parameters


def test_plant_with_products_of_inertia_is_refused():
    inertia = np.diag([2e-3, 2e-3, 3e-3])
    inertia[0, 1] = inertia[1, 0] = 1e-4
    with pytest.raises(ConfigurationError, match="inertia"):
        QuadrotorParameters.FromPlant(QuadrotorPlant(0.5, 0.1, inertia, 1.0, 0.01))


def test_plant_has_its_own_gravity():
    with pytest.raises(ConfigurationError, match="gravity"):
        QuadrotorParameters(gravity=1.62).MakePlant()


@pytest.mark.parametrize("force_constant", [1.0, 2.5])
def test_mixing_matrix_agrees_with_the_plant(force_constant):
    parameters = QuadrotorParameters(force_constant=force_constant)
    plant = parameters.MakePlant()
    context = plant.CreateDefaultContext()
    force = np.array([1.0, 1.3, 0.7, 1.6])
    plant.get_input_port().FixValue(context, force / force_constant)
    # Level and at rest, the rates of the roll-pitch-yaw rates are those of the body.
    rates = plant.EvalTimeDerivatives(context).CopyToVector()[6:]
    thrust, *torque = parameters.MixingMatrix() @ force
    expected = [0.0, 0.0, thrust / parameters.mass - parameters.gravity]
    np.testing.assert_allclose(rates[:3], expected, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(rates[3:], np.array(torque) / parameters.inertia, rtol=1e-12)


def nearest(inertia):
    """The nearest inertia of a rigid body, by SciPy."""
    constraints = [
        {"type": "ineq", "fun": lambda x, sign=sign: sign @ x}
        for sign in np.ones((3, 3)) - 2.0 * np.eye(3)
    ]
    result = minimize(
        lambda x: np.sum((x - inertia) ** 2),
        inertia,
        jac=lambda x: 2.0 * (x - inertia),
        method="SLSQP",
        constraints=constraints,
        options={"ftol": 1e-14},
    )
    assert result.success
    return result.x


@pytest.mark.parametrize("seed", range(20))
def test_nearest_inertia_is_that_of_an_optimizer(seed):
    inertia = tuple(np.random.default_rng(seed).uniform(0.01, 1.0, 3).tolist())
    np.testing.assert_allclose(NearestInertia(inertia), nearest(np.array(inertia)), atol=1e-6)
    # What is possible stays.
    assert NearestInertia(NearestInertia(inertia)) == NearestInertia(inertia)


def test_an_impossible_inertia_that_is_published_is_warned_of():
    # RotorPy's Crazyflie.
    published = tuple(quad_params[name] for name in ("Ixx", "Iyy", "Izz"))
    with pytest.warns(
        InertiaWarning, match=r"by 3e-07.*\(1.44e-05, 1.44e-05, 2.88e-05\)"
    ) as warned:
        parameters = QuadrotorParameters(mass=quad_params["mass"], inertia=published)
    assert len(warned) == 1
    np.testing.assert_allclose(parameters.inertia, (1.44e-5, 1.44e-5, 2.88e-5), rtol=1e-9)
    # It is used from here on, without another warning.
    assert replace(parameters, mass=0.03).inertia == parameters.inertia
    np.testing.assert_array_equal(np.diag(parameters.MakePlant().inertia()), parameters.inertia)
