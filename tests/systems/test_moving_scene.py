"""What moves in a picture: the vehicle, against SciPy's rotations and the plant's own mixing,
and the way that it has flown, against motions in closed form."""

import math

import numpy as np
from pydrake.geometry import Cylinder, Role, SceneGraph
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, TrajectorySource
from pydrake.trajectories import PiecewisePolynomial
import pytest
from scipy.spatial.transform import Rotation

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from systems import QuadrotorParameters
from systems.moving_scene import (
    DRAW_PERIOD,
    FRONT_COLOR,
    MAX_POINTS,
    SAMPLE_PERIOD,
    AddFlightTrail,
    AddQuadrotorGeometry,
    FlightTrail,
)

VELOCITY = np.array([0.5, -0.25, 0.125])
WIDTH = 0.03
PARAMETERS = QuadrotorParameters(arm_length=0.2)


class Picture:
    """A SceneGraph with quadrotors in given states, by name."""

    def __init__(self, scale=1.0, **states):
        builder = DiagramBuilder()
        self.scene_graph = builder.AddSystem(SceneGraph())
        for name, state in states.items():
            source = builder.AddSystem(ConstantVectorSource(state))
            AddQuadrotorGeometry(
                builder,
                source.get_output_port(),
                self.scene_graph,
                PARAMETERS,
                name,
                scale=scale,
            )
        self.diagram = builder.Build()
        self.context = self.diagram.CreateDefaultContext()
        self.inspector = self.scene_graph.model_inspector()

    def pose(self, name):
        own = self.scene_graph.GetMyContextFromRoot(self.context)
        query = self.scene_graph.get_query_output_port().Eval(own)
        frame = next(
            f for f in self.inspector.GetAllFrameIds() if self.inspector.GetName(f) == name
        )
        return query.GetPoseInWorld(frame)

    def shapes(self):
        """The geometries by name."""
        ids = self.inspector.GetAllGeometryIds(Role.kIllustration)
        return {self.inspector.GetName(g).split("::")[-1]: g for g in ids}

    def propellers(self):
        shapes = self.shapes()
        return [shapes[f"propeller_{number}"] for number in range(4)]


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_the_propellers_stand_where_their_forces_act(scale):
    picture = Picture(scale, quadrotor=np.zeros(12))
    centers = np.array(
        [picture.inspector.GetPoseInFrame(g).translation() for g in picture.propellers()]
    )
    # The torque of a unit force along z is p x e_z.
    torque = np.cross(centers, [0.0, 0.0, 1.0])
    mixing = PARAMETERS.MixingMatrix()
    np.testing.assert_allclose(torque[:, :2].T, scale * mixing[1:3], atol=1e-15)
    assert (centers[:, 2] > 0.0).all()


def test_frames_have_the_poses_of_their_states():
    states = {f"number_{i}": np.random.default_rng(i).uniform(-1.4, 1.4, 12) for i in range(3)}
    picture = Picture(**states)
    for name, state in states.items():
        X_WB = picture.pose(name)
        # Extrinsic rotations about x, y, z are roll, then pitch, then yaw.
        R_WB = Rotation.from_euler("xyz", state[3:6]).as_matrix()
        np.testing.assert_allclose(X_WB.rotation().matrix(), R_WB, atol=1e-14)
        np.testing.assert_array_equal(X_WB.translation(), state[:3])


def test_the_shapes_are_those_of_a_quadrotor():
    picture = Picture(quadrotor=np.zeros(12))
    inspector, shapes, propellers = picture.inspector, picture.shapes(), picture.propellers()
    # Flat discs that are equal and do not touch.
    discs = [inspector.GetShape(g) for g in propellers]
    assert all(isinstance(disc, Cylinder) for disc in discs)
    assert len({(disc.radius(), disc.length()) for disc in discs}) == 1
    assert 2.0 * discs[0].radius() < math.sqrt(2.0) * PARAMETERS.arm_length
    assert discs[0].length() < 0.2 * discs[0].radius()
    for g in propellers:
        R_BG = inspector.GetPoseInFrame(g).rotation().matrix()
        np.testing.assert_array_equal(R_BG, np.eye(3))
    # Only the propeller in front has its colour.
    colors = {
        name: inspector.GetIllustrationProperties(g).GetProperty("phong", "diffuse")
        for name, g in shapes.items()
    }
    assert [name for name, color in colors.items() if color == FRONT_COLOR] == ["propeller_0"]
    front = inspector.GetPoseInFrame(propellers[0]).translation()
    assert front[0] > 0.0
    assert front[1] == 0.0
    # The arms reach from motor to motor.
    for name, axis in (("arm_x", 0), ("arm_y", 1)):
        along = inspector.GetPoseInFrame(shapes[name]).rotation().matrix()[:, 2]
        assert abs(along[axis]) == pytest.approx(1.0)
        assert inspector.GetShape(shapes[name]).length() == 2.0 * PARAMETERS.arm_length
    # Nothing can collide.
    assert len(shapes) == 7
    assert inspector.NumGeometriesWithRole(Role.kProximity) == 0


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_a_size_that_cannot_be_used_is_named(value):
    with pytest.raises(ConfigurationError, match="scale must be finite and positive"):
        Picture(value, quadrotor=np.zeros(12))
    with pytest.raises(ConfigurationError, match="width must be finite and positive"):
        FlightTrail(Paper(), width=value)


def test_a_state_that_is_not_finite_is_named():
    state = np.zeros(12)
    state[7] = np.nan
    with pytest.raises(NonFiniteValueError, match=r"quadrotor_geometry: input port 'state'"):
        Picture(quadrotor=state).pose("quadrotor")
    with pytest.raises(NonFiniteValueError, match=r"way: input port 'state'.*t = 0 s"):
        draw_constant(state)


# The trail.


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


@pytest.mark.parametrize("periods", [97, MAX_POINTS, MAX_POINTS + 1, 2 * MAX_POINTS + 1])
def test_a_long_trail_is_thinned_out_evenly(periods):
    flight = Flight()
    assert flight.points().shape == (0, 3)
    flight.simulator.AdvanceTo(SAMPLE_PERIOD * (periods - 0.5))
    stride = 2 ** max(int(np.ceil(np.log2(periods / MAX_POINTS))), 0)
    times = SAMPLE_PERIOD * np.arange(0, periods, stride)
    assert min(periods, MAX_POINTS / 2) <= len(times) <= MAX_POINTS
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
    flight.simulator.AdvanceTo(2.0)
    flight.context.SetTime(0.0)
    flight.simulator.Initialize()
    assert flight.points().shape == (0, 3)
    assert flight.paper.deleted == ["/way"] * 2
    flight.simulator.AdvanceTo(1.0)
    times = SAMPLE_PERIOD * np.arange(32)
    np.testing.assert_allclose(flight.points(), flight.at(times), atol=1e-12)


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


def draw_constant(state):
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource(state))
    paper = Paper()
    AddFlightTrail(builder, source.get_output_port(), paper, name="way")
    Simulator(builder.Build()).AdvanceTo(1.0)
    return paper


def test_standing_still_is_drawn_too():
    line = draw_constant(np.zeros(12)).line()
    np.testing.assert_allclose(line, np.zeros((33, 3)), atol=1e-15)


def test_two_contexts_have_two_trails():
    flight = Flight()
    flight.simulator.AdvanceTo(1.0)
    other = flight.context.Clone()
    flight.simulator.AdvanceTo(2.0)
    assert flight.points(other).shape == (32, 3)
    Simulator(flight.diagram, other).AdvanceTo(1.5)
    assert flight.points().shape == (64, 3)
