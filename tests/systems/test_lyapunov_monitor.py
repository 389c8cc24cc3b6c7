"""The monitor against the function, finite differences, and trajectories."""

import math

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
from systems import (
    AddLyapunovMonitor,
    LyapunovMonitor,
    MakeFlightDiagram,
    MakeKinematicDiagram,
    MakeSimulator,
    SetHover,
    SetPositions,
)

from .flying import differences

PORTS = ("V", "V_dot", "margin")


class CountingFunction(LyapunovFunction):
    """A function that counts its calls and must never see objects."""

    values = gradients = 0

    def __call__(self, x):
        assert x.dtype == np.float64
        self.values += 1
        return super().__call__(x)

    def gradient(self, x):
        assert x.dtype == np.float64
        self.gradients += 1
        return super().gradient(x)

    def gradient_and_hessian(self, x):
        assert x.dtype == np.float64
        return super().gradient_and_hessian(x)


def make_function(dim=2):
    """V of a mixture without any symmetry."""
    points = np.random.default_rng(7).uniform(-1.0, 1.0, (12, dim))
    return CountingFunction(GaussianMixture(points, 0.4))


@pytest.fixture
def function():
    return make_function()


def evaluate(monitor, state, velocity, level=None):
    """The outputs by their names."""
    context = monitor.CreateDefaultContext()
    monitor.GetInputPort("state").FixValue(context, state)
    monitor.GetInputPort("velocity").FixValue(context, velocity)
    if level is not None:
        monitor.SetLevel(context, level)
    return {name: monitor.GetOutputPort(name).Eval(context) for name in PORTS}


def random_motion(agents, state_size, dim, seed=0):
    rng = np.random.default_rng(seed)
    return rng.uniform(-1.5, 1.5, (agents, state_size)), rng.normal(size=(agents, dim))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("agents", [1, 2])
def test_outputs_agree_with_the_function(dim, agents):
    V, h, extra = make_function(dim), 1e-6, 10 * (agents - 1)
    states, velocities = random_motion(agents, dim + extra, dim)
    x = states[:, :dim]
    outputs = evaluate(
        LyapunovMonitor(V, agents, 3.0, dim + extra), states.ravel(), velocities.ravel()
    )
    np.testing.assert_array_equal(outputs["V"], V(x))
    np.testing.assert_array_equal(outputs["margin"], 3.0 - V(x))
    # V a little later and earlier, along the velocity.
    rate = (V(x + h * velocities) - V(x - h * velocities)) / (2.0 * h)
    np.testing.assert_allclose(outputs["V_dot"], rate, rtol=1e-7, atol=1e-8)


def test_level_costs_no_evaluation_and_the_value_no_gradient(function):
    monitor = LyapunovMonitor(function, 2)
    context = monitor.CreateDefaultContext()
    monitor.GetInputPort("state").FixValue(context, [0.3, 0.4, -1.0, 1.0])
    V, margin = monitor.GetOutputPort("V").Eval(context), monitor.GetOutputPort("margin")
    np.testing.assert_array_equal(margin.Eval(context), math.inf)
    for level in (5.0, -math.inf):
        monitor.SetLevel(context, level)
        np.testing.assert_array_equal(margin.Eval(context), level - V)
    assert (function.values, function.gradients) == (1, 0)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("agents", [1, 3])
def test_gradients_agree_with_differences(dim, agents):
    V, state_size = make_function(dim), 5
    monitor = LyapunovMonitor(V, agents, 3.0, state_size)
    autodiff = monitor.ToAutoDiffXd()
    states, velocities = random_motion(agents, state_size, dim, seed=1)
    z = np.concatenate((states.ravel(), velocities.ravel()))
    size = states.size
    at = InitializeAutoDiff(z).ravel()
    outputs = evaluate(autodiff, at[:size], at[size:])
    floats = evaluate(monitor, z[:size], z[size:])
    for name in PORTS:
        column = outputs[name].reshape(-1, 1)
        expected = differences(
            lambda z, name=name: evaluate(monitor, z[:size], z[size:])[name], z
        )
        np.testing.assert_allclose(ExtractValue(column).ravel(), floats[name], rtol=1e-13)
        np.testing.assert_allclose(ExtractGradient(column), expected, rtol=1e-6, atol=1e-7)


def test_one_of_the_inputs_may_be_a_constant(function):
    autodiff = LyapunovMonitor(function).ToAutoDiffXd()
    (x,), (v,) = random_motion(1, 2, 2)
    gradient, H = (part[0] for part in function.gradient_and_hessian(x[None]))
    for state, velocity, expected in (
        (InitializeAutoDiff(x), v, H @ v),
        (x, InitializeAutoDiff(v), gradient),
    ):
        V_dot = evaluate(autodiff, state, velocity)["V_dot"]
        np.testing.assert_allclose(ExtractGradient(V_dot.reshape(-1, 1))[0], expected)
    assert evaluate(autodiff, x, v)["V_dot"][0].value() == pytest.approx(gradient @ v)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_not_finite_is_named_with_the_agent(function, value):
    monitor = LyapunovMonitor(function, 3)
    monitor.set_name("watch")
    for system in (monitor, monitor.ToAutoDiffXd()):
        for port, output, name in (
            ("state", "V", "the position of agent 1"),
            ("state", "V_dot", "the position of agent 1"),
            ("state", "margin", "the position of agent 1"),
            ("velocity", "V_dot", "the velocity of agent 1"),
        ):
            context = system.CreateDefaultContext()
            values = {"state": np.zeros(6), "velocity": np.zeros(6)}
            values[port][3] = value
            for key, vector in values.items():
                system.GetInputPort(key).FixValue(context, vector)
            with pytest.raises(NonFiniteValueError, match=rf"watch: {name} .* t = 0 s"):
                system.GetOutputPort(output).Eval(context)


def test_function_that_is_not_finite_is_named():
    class Broken:
        dim = 2

        def __call__(self, x):
            return np.where(x[:, 0] > 0.0, np.nan, 0.0)

        def gradient(self, x):
            return np.full(x.shape, np.nan)

    monitor = LyapunovMonitor(Broken(), 2)
    context = monitor.CreateDefaultContext()
    monitor.GetInputPort("state").FixValue(context, [-1.0, 0.0, 1.0, 0.0])
    monitor.GetInputPort("velocity").FixValue(context, np.ones(4))
    with pytest.raises(NonFiniteValueError, match="V of agent 1"):
        monitor.GetOutputPort("V").Eval(context)
    with pytest.raises(NonFiniteValueError, match="V_dot of agent 0"):
        monitor.GetOutputPort("V_dot").Eval(context)


# In diagrams.


def logged(diagram, context, name):
    log = diagram.GetSubsystemByName(name).FindLog(context)
    return log.sample_times().copy(), log.data().T.copy()


def follow(field, starts, duration=1.5, **options):
    diagram = MakeKinematicDiagram(field, len(starts), log_period=0.02, **options)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetPositions(diagram, context, starts)
    simulator.AdvanceTo(duration)
    return diagram, context


def test_V_is_logged_along_kinematic_trajectories(circle_field, ring_function):  # noqa: N802
    starts = np.random.default_rng(3).uniform(-1.5, 1.5, (4, 2))
    diagram, context = follow(circle_field, starts, lyapunov=ring_function, speed=0.5)
    times, positions = logged(diagram, context, "positions_log")
    x = positions.reshape(-1, 2)
    expected = ring_function(x).reshape(-1, 4)
    V_times, V = logged(diagram, context, "V_log")
    np.testing.assert_array_equal(V_times, times)
    np.testing.assert_array_equal(V, expected)
    # The rate at speed 0.5, and its integral.
    _, V_dot = logged(diagram, context, "V_dot_log")
    along = 0.5 * (ring_function.gradient(x) * circle_field(x)).sum(axis=1)
    np.testing.assert_allclose(V_dot, along.reshape(-1, 4), rtol=1e-12)
    change = np.cumsum((V_dot[1:] + V_dot[:-1]) / 2 * np.diff(times)[:, None], axis=0)
    # The trapezoidal rule is good to a thousandth of what V falls by.
    np.testing.assert_allclose(change, V[1:] - V[0], atol=1e-3 * V.max())


def fly(field, duration=0.5, **options):
    diagram = MakeFlightDiagram(field, speed=0.45, **options)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, (1.3, 0.0, 1.0))
    simulator.AdvanceTo(duration)
    return diagram, context


def test_V_is_logged_in_flight_without_changing_it(circle_field, ring_function):  # noqa: N802
    plain, context = fly(circle_field)
    assert not any(
        plain.HasSubsystemNamed(name) for name in ("lyapunov", "V_log", "state_parts")
    )
    watched, other = fly(circle_field, lyapunov=ring_function)
    times, state = logged(watched, other, "state_log")
    np.testing.assert_array_equal(state, logged(plain, context, "state_log")[1])
    V_times, V = logged(watched, other, "V_log")
    np.testing.assert_array_equal(V_times, times)
    np.testing.assert_array_equal(V[:, 0], ring_function(state[:, :2]))
    _, V_dot = logged(watched, other, "V_dot_log")
    np.testing.assert_allclose(
        V_dot[:, 0], ring_function.derivative(state[:, :2], state[:, 6:8]), rtol=1e-12
    )


def test_a_spatial_function_watches_the_altitude(spatial_circle_field):
    points = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]])
    V = LyapunovFunction(GaussianMixture(points, 0.5))
    diagram, context = fly(spatial_circle_field, 0.5, lyapunov=V)
    _, state = logged(diagram, context, "state_log")
    np.testing.assert_array_equal(logged(diagram, context, "V_log")[1][:, 0], V(state[:, :3]))


def test_bad_arguments_are_refused(function, circle_field):
    for arguments, message in (
        ({"num_agents": 0}, "num_agents must be at least 1, got 0"),
        ({"level": math.nan}, "level must be a number"),
        ({"state_size": 1}, "at least the dimension 2, got 1"),
    ):
        with pytest.raises(ConfigurationError, match=message):
            LyapunovMonitor(function, **arguments)
    monitor = LyapunovMonitor(function)
    with pytest.raises(ConfigurationError, match="level must be a number"):
        monitor.SetLevel(monitor.CreateDefaultContext(), math.nan)
    with pytest.raises(ConfigurationError, match="dimension 2 or 3, got 4"):
        MakeFlightDiagram(circle_field, lyapunov=make_function(4))
    with pytest.raises(ConfigurationError, match="2 agents in 3 dimensions"):
        MakeKinematicDiagram(circle_field, 2, lyapunov=make_function(3))
    # Ports that do not fit.
    builder = DiagramBuilder()
    state, rates = (
        builder.AddSystem(ConstantVectorSource(np.zeros(size))).get_output_port()
        for size in (4, 3)
    )
    for agents in (0, 2, 3):
        with pytest.raises(ConfigurationError, match=f"{agents} agents in 2 dimensions"):
            AddLyapunovMonitor(builder, function, state, rates, num_agents=agents)
