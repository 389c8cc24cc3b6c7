"""The flown way as it is sampled and drawn, against motions in closed form."""

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
import pytest
from systems.flight_trail import (
    DRAW_PERIOD,
    MAX_POINTS,
    SAMPLE_PERIOD,
    AddFlightTrail,
    FlightTrail,
)

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError

VELOCITY = np.array([0.5, -0.25, 0.125])
WIDTH = 0.03


class Paper:
    """Stands for Meshcat, and keeps what is drawn on it."""

    def __init__(self):
        self.drawn, self.deleted = [], []

    def SetTriangleMesh(self, path, vertices, faces, rgba):  # noqa: N802
        assert np.isfinite(vertices).all()
        self.drawn.append((path, vertices.T, faces.T))

    def Delete(self, path):  # noqa: N802
        self.deleted.append(path)

    def line(self):
        """The middle line of the last drawing."""
        return self.drawn[-1][1].reshape(6, -1, 3).mean(axis=0)


class Flight:
    """A vehicle that moves with a constant velocity from a start, and its trail."""

    def __init__(self, start=(0.0, 0.0, 1.0), duration=1000.0):
        way = np.zeros((12, 2))
        way[:3, 0] = start
        way[:3, 1] = np.array(start) + duration * VELOCITY
        motion = PiecewisePolynomial.FirstOrderHold([0.0, duration], way)
        builder = DiagramBuilder()
        source = builder.AddSystem(TrajectorySource(motion))
        self.paper = Paper()
        self.trail = AddFlightTrail(
            builder, source.get_output_port(), self.paper, "/way", WIDTH
        )
        self.start = np.array(start)
        self.diagram = builder.Build()
        self.simulator = Simulator(self.diagram)
        self.context = self.simulator.get_mutable_context()

    def points(self, context=None):
        root = self.context if context is None else context
        return self.trail.GetPoints(self.trail.GetMyContextFromRoot(root))

    def at(self, times):
        return self.start + np.outer(times, VELOCITY)


def test_the_points_are_the_positions_at_the_samples():
    flight = Flight()
    assert flight.points().shape == (0, 3)
    flight.simulator.AdvanceTo(3.0 + SAMPLE_PERIOD / 2)
    times = SAMPLE_PERIOD * np.arange(97)
    np.testing.assert_allclose(flight.points(), flight.at(times), atol=1e-12)


@pytest.mark.parametrize("periods", [MAX_POINTS, MAX_POINTS + 1, 3 * MAX_POINTS, 5000])
def test_a_long_trail_is_thinned_out_evenly(periods):
    flight = Flight()
    flight.simulator.AdvanceTo(SAMPLE_PERIOD * (periods - 0.5))
    stride = 2 ** int(np.ceil(np.log2(periods / MAX_POINTS)))
    times = SAMPLE_PERIOD * np.arange(0, periods, stride)
    assert MAX_POINTS / 2 <= len(times) <= MAX_POINTS
    np.testing.assert_allclose(flight.points(), flight.at(times), atol=1e-9)


def test_it_is_drawn_a_few_times_a_second_to_where_the_vehicle_is():
    flight = Flight()
    flight.simulator.AdvanceTo(2.0)
    # At the start there is one point, which is no line.
    assert flight.paper.deleted == ["/way"]
    assert len(flight.paper.drawn) == round(2.0 / DRAW_PERIOD)
    for number, (path, vertices, _) in enumerate(flight.paper.drawn, start=1):
        assert path == "/way"
        ends = vertices.reshape(6, -1, 3).mean(axis=0)[[0, -1]]
        expected = flight.at([0.0, number * DRAW_PERIOD])
        np.testing.assert_allclose(ends, expected, atol=1e-12)


@pytest.mark.parametrize(
    "draw",
    [
        lambda flight: flight.trail.DrawToEnd(flight.context),
        lambda flight: flight.diagram.ForcedPublish(flight.context),
    ],
)
def test_on_demand_it_is_drawn_to_its_end(draw):
    flight = Flight()
    flight.simulator.AdvanceTo(2.0 + 0.9 * DRAW_PERIOD)
    assert flight.paper.line()[-1] == pytest.approx(flight.at([2.0])[0])
    draw(flight)
    assert flight.paper.line()[-1] == pytest.approx(flight.at([2.0 + 0.9 * DRAW_PERIOD])[0])


def test_a_second_flight_starts_a_new_trail():
    flight = Flight()
    flight.simulator.AdvanceTo(70.0)
    flight.context.SetTime(0.0)
    flight.simulator.Initialize()
    assert flight.points().shape == (0, 3)
    assert flight.paper.deleted == ["/way"] * 2
    flight.simulator.AdvanceTo(1.0)
    times = SAMPLE_PERIOD * np.arange(32)
    np.testing.assert_allclose(flight.points(), flight.at(times), atol=1e-12)


def test_two_contexts_have_two_trails():
    flight = Flight()
    flight.simulator.AdvanceTo(1.0)
    other = flight.context.Clone()
    flight.simulator.AdvanceTo(2.0)
    assert flight.points(other).shape == (32, 3)
    assert flight.points().shape == (64, 3)
    Simulator(flight.diagram, other).AdvanceTo(1.5)
    assert flight.points().shape == (64, 3)


def test_the_ribbons_cover_the_line_across_each_axis():
    flight = Flight()
    flight.simulator.AdvanceTo(1.0)
    _, vertices, faces = flight.paper.drawn[-1]
    assert faces.min() == 0
    assert faces.max() == len(vertices) - 1
    a, b, c = vertices[faces].transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
    # A ribbon across the axis e on a straight line d has the area width |d x e|.
    crossed = np.cross(flight.at([1.0])[0] - flight.start, np.eye(3))
    assert area == pytest.approx(WIDTH * np.linalg.norm(crossed, axis=1).sum())
    # No point of it is farther from the line than half the width.
    distance = np.linalg.norm(vertices.reshape(6, -1, 3) - flight.paper.line(), axis=2)
    np.testing.assert_allclose(distance, WIDTH / 2.0)


def test_standing_still_is_drawn_too():
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource(np.zeros(12)))
    paper = Paper()
    AddFlightTrail(builder, source.get_output_port(), paper)
    Simulator(builder.Build()).AdvanceTo(1.0)
    np.testing.assert_allclose(paper.line(), np.zeros((33, 3)), atol=1e-15)


def test_a_state_that_is_not_finite_is_named():
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource(np.full(12, np.inf)))
    AddFlightTrail(builder, source.get_output_port(), Paper(), name="way")
    simulator = Simulator(builder.Build())
    with pytest.raises(NonFiniteValueError, match=r"way: input port 'state'.*t = 0 s"):
        simulator.AdvanceTo(1.0)


@pytest.mark.parametrize("width", [0.0, -0.1, np.nan])
def test_a_width_that_cannot_be_used_is_named(width):
    with pytest.raises(ConfigurationError, match="width must be finite and positive"):
        FlightTrail(Paper(), width=width)
