"""The vehicle that holds its speed and turns: its motion in closed form, and in wind."""

import numpy as np
from pydrake.autodiffutils import ExtractGradient, InitializeAutoDiff
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import (
    Disturbance,
    MakeSimulator,
    PlanarVehicle,
    PlanarVehicleInWind,
    PlanarVehicleParameters,
)

from .flying import differences

START = np.array([0.3, -0.2, 1.5, 0.7])


def moved(parameters, turn_rate, duration, wind=None):
    """The state after a constant command, integrated finely."""
    builder = DiagramBuilder()
    vehicle = builder.AddSystem(PlanarVehicle(parameters))
    for name, value in (("turn_rate", [turn_rate]), ("wind", wind)):
        if value is not None:
            source = builder.AddSystem(ConstantVectorSource(np.array(value)))
            builder.Connect(source.get_output_port(), vehicle.GetInputPort(name))
    diagram = builder.Build()
    simulator = MakeSimulator(diagram)
    context = vehicle.GetMyContextFromRoot(simulator.get_context())
    vehicle.SetVehicleState(simulator.get_mutable_context(), START)
    simulator.AdvanceTo(duration)
    return vehicle.GetOutputPort("state").Eval(context)


def test_it_drifts_with_the_wind_along_its_heading():
    wind = [0.4, -1.0, 9.0]
    state = moved(PlanarVehicleParameters(2.0, 1.0), 0.0, 3.0, wind)
    velocity = 2.0 * np.array([np.cos(0.7), np.sin(0.7)]) + wind[:2]
    np.testing.assert_allclose(state[:2], START[:2] + 3.0 * velocity, atol=1e-12)
    np.testing.assert_allclose(state[2:], [1.5, 0.7, *velocity, 0.0], atol=1e-12)


@pytest.mark.parametrize("asked", [0.5, 1.6, 40.0])
def test_it_turns_on_a_circle_of_its_radius_and_no_tighter(asked):
    parameters = PlanarVehicleParameters(2.0, 1.6)
    turn_rate = min(asked, 1.6)
    centre = START[:2] + 2.0 / turn_rate * np.array([-np.sin(0.7), np.cos(0.7)])
    for duration in (0.4, 2.0 * np.pi / turn_rate):
        state = moved(parameters, asked, duration)
        away = np.linalg.norm(state[:2] - centre)
        assert away == pytest.approx(2.0 / turn_rate, rel=1e-7)
        assert state[3] == pytest.approx(0.7 + turn_rate * duration)
    np.testing.assert_allclose(state[:2], START[:2], atol=1e-6)
    assert parameters.turn_radius == 1.25


def test_a_lag_delays_the_turn():
    """The heading after a step is w (t - T (1 - exp(-t / T)))."""
    state = moved(PlanarVehicleParameters(2.0, 0.5, 0.3), 3.0, 0.8)
    expected = 0.5 * (0.8 - 0.3 * (1.0 - np.exp(-0.8 / 0.3)))
    assert state[3] - 0.7 == pytest.approx(expected, rel=1e-6)


def test_derivatives_agree_with_differences():
    vehicle = PlanarVehicle(PlanarVehicleParameters(2.0, 1.6, 0.3))

    def rates(x, system):
        context = system.CreateDefaultContext()
        context.SetContinuousState(x[:5])
        system.GetInputPort("turn_rate").FixValue(context, x[5:6])
        system.GetInputPort("wind").FixValue(context, x[6:])
        rate = system.EvalTimeDerivatives(context).CopyToVector()
        return np.concatenate((rate, system.GetOutputPort("state").Eval(context)))

    x = np.array([*START, 0.4, 0.9, 0.2, -0.3, 0.1])
    exact = ExtractGradient(rates(InitializeAutoDiff(x).ravel(), vehicle.ToAutoDiffXd()))
    numeric = differences(lambda values: rates(values, vehicle), x)
    np.testing.assert_allclose(exact, numeric, atol=1e-8)


def test_moving_air_is_that_of_the_disturbance():
    air = Disturbance(wind=(1.0, 2.0, 0.0))
    vehicle = PlanarVehicleInWind(PlanarVehicleParameters(5.0, 1.0), air)
    context = vehicle.CreateDefaultContext()
    vehicle.GetInputPort("turn_rate").FixValue(context, [0.0])
    vehicle.SetVehicleState(context, START)
    simulator = Simulator(vehicle, context)
    simulator.AdvanceTo(2.0)
    moved_by = vehicle.GetOutputPort("state").Eval(context)[:2] - START[:2]
    ahead = 5.0 * np.array([np.cos(0.7), np.sin(0.7)])
    np.testing.assert_allclose(moved_by, 2.0 * (ahead + air.wind[:2]), atol=1e-9)
    np.testing.assert_array_equal(vehicle.GetOutputPort("wind").Eval(context), air.wind)


@pytest.mark.parametrize(
    ("values", "name"),
    [
        ((0.0, 1.0), "airspeed"),
        ((1.0, -1.0), "max_turn_rate"),
        ((1.0, np.nan), "max_turn_rate"),
        ((1.0, 1.0, -0.1), "turn_lag"),
    ],
)
def test_impossible_parameters_are_refused(values, name):
    with pytest.raises(ConfigurationError, match=name):
        PlanarVehicleParameters(*values)


@pytest.mark.parametrize("name", ["turn_rate", "wind"])
def test_what_is_not_finite_is_told_with_its_port(name):
    vehicle = PlanarVehicle(PlanarVehicleParameters(1.0, 1.0))
    context = vehicle.CreateDefaultContext()
    for port in ("turn_rate", "wind"):
        size = vehicle.GetInputPort(port).size()
        vehicle.GetInputPort(port).FixValue(
            context, np.full(size, np.nan if port == name else 0)
        )
    with pytest.raises(NonFiniteValueError, match=name):
        vehicle.EvalTimeDerivatives(context)
