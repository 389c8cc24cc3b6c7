import math

import numpy as np
from pydrake.examples import QuadrotorPlant
import pytest

from sgvf_drake.exceptions import ConfigurationError
from systems import QuadrotorParameters


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
        ("inertia", (1e-3, 1e-3, 2.1e-3)),
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
