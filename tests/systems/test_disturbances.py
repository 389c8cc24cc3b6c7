"""Wind, drag, lag, a body other than believed: the plant, and the observer against them."""

import math

import numpy as np
from pydrake.common import RandomGenerator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import (
    ConstantVectorSource,
    FirstOrderTaylorApproximation,
    LogVectorOutput,
)
import pytest
from scipy.integrate import solve_ivp

from sgvf_drake.exceptions import ConfigurationError
from systems import (
    DEFAULT_GAINS,
    DISTURBANCE_BANDWIDTH,
    Disturbance,
    DisturbedQuadrotor,
    MakeFlightDiagram,
    MakeSimulator,
    Se3Controller,
    SensorParameters,
    SetHover,
    SetNoiseSeed,
    SetVehicleState,
)
from systems.quadrotor import ATTITUDE, VELOCITY

from .flying import ONE_RING, PARAMETERS, SPEED, STATE, CircleField, differences, order, rms

OBSERVING = DEFAULT_GAINS._replace(disturbance_bandwidth=DISTURBANCE_BANDWIDTH)
WIND = Disturbance(wind=(3.0, 0.0, 0.0))


class Disturbed:
    """A flight around the ring of 1 m, from a hover beside it."""

    def __init__(self, disturbance, gains=DEFAULT_GAINS, seed=0, **options):
        options.setdefault("speed", SPEED)
        self.diagram = MakeFlightDiagram(
            ONE_RING, PARAMETERS, disturbance=disturbance, gains=gains, **options
        )
        self.simulator = MakeSimulator(self.diagram)
        self.context = self.simulator.get_mutable_context()
        SetHover(self.diagram, self.context, (1.1, 0.0, 1.0))
        SetNoiseSeed(self.diagram, self.context, seed)

    def states(self, duration, since=0.0):
        self.simulator.AdvanceTo(duration)
        log = self.diagram.GetSubsystemByName("state_log").FindLog(self.context)
        return log.data()[:, log.sample_times() > since - 1e-9]


def off_ring(states):
    return np.hypot(states[0], states[1]) - 1.0


@pytest.mark.parametrize("lag", [0.0, 0.05])
def test_the_plant_moves_by_the_equations(lag):
    """Drag added to the derivatives of Drake's plant, by SciPy, against the linear system."""
    disturbance = Disturbance(
        wind=(2.0, -1.0, 0.5), drag=0.3, motor_lag=lag, mass_factor=1.3, thrust_factor=0.9
    )
    force = PARAMETERS.hover_force * np.array([1.2, 1.3, 1.25, 1.28])
    builder = DiagramBuilder()
    plant = builder.AddSystem(DisturbedQuadrotor(PARAMETERS, disturbance))
    source = builder.AddSystem(ConstantVectorSource(force))
    builder.Connect(source.get_output_port(), plant.get_input_port())
    log = LogVectorOutput(plant.GetOutputPort("state"), builder, 0.1)
    simulator = MakeSimulator(builder.Build(), step=1e-3)
    context = simulator.get_mutable_context()
    plant.SetVehicleState(context, STATE)
    simulator.AdvanceTo(0.5)

    body = disturbance.BodyOf(PARAMETERS)
    quadrotor = body.MakePlant()
    own = quadrotor.CreateDefaultContext()

    def rate(_, x):
        state, given = x[:12], x[12:]
        quadrotor.get_input_port().FixValue(own, given if lag else 0.9 * force)
        own.SetContinuousState(state)
        rates = quadrotor.EvalTimeDerivatives(own).CopyToVector()
        air = np.array(disturbance.wind) - state[VELOCITY]
        rates[VELOCITY] += disturbance.drag * air / body.mass
        return np.concatenate((rates, (0.9 * force - given) / lag if lag else np.zeros(4)))

    start = np.concatenate((STATE, np.full(4, body.hover_force)))
    times = log.FindLog(context).sample_times()
    expected = solve_ivp(rate, (0.0, 0.5), start, "DOP853", times, rtol=1e-11, atol=1e-12).y[
        :12
    ]
    np.testing.assert_allclose(log.FindLog(context).data(), expected, atol=1e-8)


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.full) for seed in (1, 2))]
)
def test_gusts_have_their_strength_and_fade_in_their_time(seed):
    """An Ornstein-Uhlenbeck process: deviation, and 1/e of correlation after its time."""
    wind, gust, fade = (1.0, -2.0, 0.5), 0.7, 0.2
    builder = DiagramBuilder()
    plant = builder.AddSystem(
        DisturbedQuadrotor(PARAMETERS, Disturbance(wind=wind, gust=gust, gust_time=fade))
    )
    builder.ExportInput(plant.get_input_port(), "propeller_force")
    log = LogVectorOutput(plant.GetOutputPort("wind"), builder, 0.01)
    diagram = builder.Build()
    simulator = MakeSimulator(diagram, step=0.01)
    context = simulator.get_mutable_context()
    diagram.get_input_port().FixValue(context, np.full(4, PARAMETERS.hover_force))
    diagram.SetRandomContext(context, RandomGenerator(seed))
    simulator.AdvanceTo(400.0)
    air = log.FindLog(context).data()[:, 100:] - np.array(wind)[:, None]
    lag = round(fade / 0.01)
    # 2,000 times its correlation time: 4 deviations of the estimates are a tenth.
    assert np.abs(air.mean(axis=1)).max() < 0.13 * gust
    np.testing.assert_allclose(air.std(axis=1), gust, rtol=0.1)
    correlations = [np.corrcoef(axis[lag:], axis[:-lag])[0, 1] for axis in air]
    np.testing.assert_allclose(correlations, math.exp(-1.0), atol=0.1)


def test_the_estimate_is_the_disturbance_at_rest():
    """At rest in wind the thrust leans against it: tan(pitch) = drag wind / weight."""
    states = Disturbed(WIND, OBSERVING, speed=0.0).states(10.0)
    lean = -math.atan(WIND.drag * WIND.wind[0] / PARAMETERS.weight)
    np.testing.assert_allclose(states[ATTITUDE, -1], [0.0, lean, 0.0], atol=1e-6)
    np.testing.assert_allclose(states[VELOCITY, -1], 0.0, atol=1e-6)
    carried = Disturbed(WIND, speed=0.0).states(10.0)
    assert carried[6, -1] > 0.1


@pytest.mark.parametrize("sensors", [None, SensorParameters(delay=0.03)])
def test_the_observer_removes_the_error_of_a_steady_wind(sensors):
    # A lap of 9 s, after it has come to the ring.
    options = {"sensors": sensors, "speed": 0.7}
    without = Disturbed(WIND, **options).states(13.0, 4.0)
    observed = Disturbed(WIND, OBSERVING, **options).states(13.0, 4.0)
    assert rms(off_ring(without)) > 0.05
    assert rms(off_ring(observed)) < 0.005


@pytest.mark.parametrize("name", ["mass_factor", "thrust_factor"])
@pytest.mark.parametrize("factor", [0.8, 1.2])
def test_the_altitude_returns_where_the_body_is_not_as_believed(name, factor):
    disturbance = Disturbance(drag=0.0, **{name: factor})
    without = Disturbed(disturbance).states(8.0, 7.0)
    observed = Disturbed(disturbance, OBSERVING).states(8.0, 7.0)
    assert np.abs(without[2] - 1.0).min() > 0.2
    assert np.abs(observed[2] - 1.0).max() < 1e-3
    assert rms(off_ring(observed)) < 0.006


def test_an_observer_changes_nothing_where_nothing_disturbs():
    still = Disturbance(drag=0.0)
    flights = [
        Disturbed(disturbance, gains).states(4.0)
        for disturbance, gains in (
            (None, DEFAULT_GAINS),
            (still, DEFAULT_GAINS),
            (None, OBSERVING),
        )
    ]
    np.testing.assert_allclose(flights[1], flights[0], atol=1e-12)
    np.testing.assert_allclose(flights[2][:3], flights[0][:3], atol=2e-3)


def test_a_start_in_flight_is_no_disturbance():
    """The observer has seen the velocity that is set: its forces are those without it."""
    forces = []
    for gains in (DEFAULT_GAINS, OBSERVING):
        flight = Disturbed(None, gains)
        SetVehicleState(flight.diagram, flight.context, STATE)
        loop = flight.diagram.GetSubsystemByName("guidance_loop")
        own = loop.GetMyContextFromRoot(flight.context)
        forces.append(loop.GetOutputPort("propeller_force").Eval(own).copy())
    np.testing.assert_array_equal(*forces)


def test_a_loop_that_observes_is_linearised():
    """The error of differences falls with the square of their step."""
    diagram = MakeFlightDiagram(
        CircleField(), gains=OBSERVING, sample_period=0.0, log_period=None, saturate=False
    )
    context = diagram.CreateDefaultContext()
    SetVehicleState(diagram, context, STATE)
    x = context.get_continuous_state_vector().CopyToVector()
    assert len(x) == 15

    def rate(x):
        context.SetContinuousState(x)
        return diagram.EvalTimeDerivatives(context).CopyToVector()

    A = FirstOrderTaylorApproximation(diagram, context).A()
    steps = 10.0 ** np.linspace(-2.0, -3.5, 4)
    errors = [np.abs(differences(rate, x, h) - A).max() / np.abs(A).max() for h in steps]
    assert order(steps, errors) == pytest.approx(2.0, abs=0.1)


def test_gusts_repeat_with_their_seed_and_not_with_another():
    gusty = Disturbance(gust=0.5)
    first, again, other = (Disturbed(gusty, seed=seed).states(1.0) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first[:2] - other[:2]).max() > 1e-4


def test_a_disturbance_that_cannot_be_is_named():
    for name in ("gust", "drag", "motor_lag"):
        with pytest.raises(ConfigurationError, match=name):
            Disturbance(**{name: -1.0})
    for name in ("gust_time", "mass_factor", "inertia_factor", "thrust_factor"):
        with pytest.raises(ConfigurationError, match=name):
            Disturbance(**{name: 0.0})
    for wind in ((1.0, 0.0), (math.nan, 0.0, 0.0)):
        with pytest.raises(ConfigurationError, match="wind"):
            Disturbance(wind=wind)


def test_a_controller_without_observer_refuses_its_bandwidth():
    controller = Se3Controller()
    with pytest.raises(ConfigurationError, match="without a disturbance_bandwidth"):
        controller.SetGains(controller.CreateDefaultContext(), OBSERVING)
