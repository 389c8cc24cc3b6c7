import math

import numpy as np
from pydrake.systems.analysis import Simulator
import pytest

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.navigator import Navigator
from systems import (
    KinematicGuidance,
    MakeKinematicDiagram,
    MakeSimulator,
    RouteNavigator,
    SetPositions,
)
from tests.networks import straight_network


def follow(field, starts, duration=2.0, **options):
    diagram = MakeKinematicDiagram(field, len(starts), **options)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetPositions(diagram, context, starts)
    simulator.AdvanceTo(duration)
    return diagram.GetOutputPort("positions").Eval(context).reshape(np.shape(starts))


@pytest.fixture
def starts():
    return np.random.default_rng(3).uniform(-1.5, 1.5, (5, 2))


def test_agents_do_as_each_would_alone(circle_field, starts):
    together = follow(circle_field, starts)
    alone = [follow(circle_field, start[None])[0] for start in starts]
    np.testing.assert_allclose(together, alone, atol=1e-9)


def test_agent_reaches_the_circle_and_goes_round_at_its_speed(circle_field):
    # One lap in pi seconds at 2 units per second.
    x, y = follow(circle_field, np.array([[1.0, 0.0]]), duration=math.pi, speed=2.0)[0]
    assert math.hypot(x - 1.0, y) < 1e-6
    x, y = follow(circle_field, np.array([[0.2, 0.1]]), duration=6.0, speed=2.0)[0]
    assert math.hypot(x, y) == pytest.approx(1.0, abs=1e-6)


def test_agents_in_three_dimensions(spatial_circle_field):
    ends = follow(spatial_circle_field, np.array([[1.3, 0.0, 0.4], [0.0, 0.5, 1.5]]), 6.0)
    np.testing.assert_allclose(ends[:, 2], 1.0, atol=1e-6)
    np.testing.assert_allclose(np.hypot(ends[:, 0], ends[:, 1]), 1.0, atol=1e-6)


def test_one_call_of_the_field_serves_all_agents(circle_field, starts):
    system = KinematicGuidance(circle_field, num_agents=len(starts))
    context = system.CreateDefaultContext()
    system.get_input_port().FixValue(context, starts.ravel())
    calls = circle_field.calls
    system.get_output_port().Eval(context)
    assert circle_field.calls == calls + 1


def test_log_holds_the_positions(circle_field):
    diagram = MakeKinematicDiagram(circle_field, 1, log_period=0.5)
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetPositions(diagram, context, [1.0, 0.0])
    simulator.AdvanceTo(1.0)
    log = diagram.GetSubsystemByName("positions_log").FindLog(context)
    np.testing.assert_allclose(log.sample_times(), [0.0, 0.5, 1.0])
    np.testing.assert_allclose(log.data()[:, 2], [math.cos(1.0), math.sin(1.0)], atol=1e-6)


class Cliff:
    """A field to the right that ends, in NaN, at x = 1."""

    dim = 2

    def __call__(self, x):
        return np.where(x[..., :1] < 1.0, np.array([1.0, 0.0]), np.nan)


def test_agent_that_meets_nan_is_named_with_the_time():
    diagram = MakeKinematicDiagram(Cliff(), 3)
    # Error-controlled, as Drake's simulator is by default: this must not hang.
    simulator = Simulator(diagram)
    SetPositions(
        diagram, simulator.get_mutable_context(), [[0.0, 0.0], [-5.0, 0.0], [0.5, 0.0]]
    )
    message = r"::kinematic::guidance: the velocity of agent 2 .*t = 0\.[45]\d* s"
    with pytest.raises(NonFiniteValueError, match=message):
        simulator.AdvanceTo(2.0)


def test_a_navigator_names_the_agent_that_is_nowhere():
    network = straight_network([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0]], [(0, 1), (1, 2)])
    navigator = Navigator(Itinerary.parse("1,2", network), network.sigma)
    system = RouteNavigator(navigator, 2, period=0.05)
    context = system.CreateDefaultContext()
    states = [1.0, 0.0, 1.0, 0.0, 1.0, math.nan, 1.0, 0.0]
    system.get_input_port().FixValue(context, states)
    with pytest.raises(NonFiniteValueError, match=r"the position of agent 1 .* t = 0 s"):
        system.EvalUniquePeriodicDiscreteUpdate(context)


def test_bad_arguments_and_positions_are_refused(circle_field):
    diagram = MakeKinematicDiagram(circle_field, 3)
    context = diagram.CreateDefaultContext()
    with pytest.raises(ConfigurationError, match="num_agents"):
        MakeKinematicDiagram(circle_field, 0)
    with pytest.raises(ConfigurationError, match="speed"):
        MakeKinematicDiagram(circle_field, speed=-1.0)
    with pytest.raises(ConfigurationError, match=r"shape \(3, 2\)"):
        SetPositions(diagram, context, np.zeros((2, 3)))
    with pytest.raises(NonFiniteValueError, match="finite"):
        SetPositions(diagram, context, np.full((3, 2), math.nan))
