"""What moves in a picture of a flight: the vehicle, and the way that it has flown."""

from collections.abc import Iterator
import math
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    Box,
    Cylinder,
    FrameId,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    MakePhongIllustrationProperties,
    Meshcat,
    Rgba,
    SceneGraph,
    Shape,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    LeafSystem,
    OutputPort,
)

from sgvf_drake.arrays import FloatArray, IntArray
from systems.quadrotor import (
    ATTITUDE,
    NUM_PROPELLERS,
    POSITION,
    STATE_SIZE,
    QuadrotorParameters,
)
from systems.scalars import CheckFinite, CheckPositiveParameter, idle

BODY_SIZE = (0.9, 0.5, 0.3)
"""Of the body's box along x, y and z, in arm lengths: longer than wide, to tell its heading."""

ARM_RADIUS = 0.06
"""In arm lengths."""

PROPELLER_RADIUS = 0.6
"""In arm lengths; neighbours would touch at 1/sqrt(2)."""

PROPELLER_THICKNESS = 0.06
"""In arm lengths."""

PROPELLER_HEIGHT = 0.2
"""Of the discs over the centre of mass, in arm lengths."""

BODY_COLOR = Rgba(0.15, 0.15, 0.18)
PROPELLER_COLOR = Rgba(0.0, 0.45, 0.70)
FRONT_COLOR = Rgba(0.90, 0.37, 0.0)

TRAIL_PATH = "/trail"

TRAIL_COLOR = Rgba(0.0, 0.45, 0.70)

TRAIL_WIDTH = 0.04
"""m; as wide as the waypoints in a scene of 4 m are drawn."""

SAMPLE_PERIOD = 1.0 / 32.0
"""s; at 4 m/s on a circle of 1 m the chord is 2 mm off the arc."""

DRAW_PERIOD = 1.0 / 4.0
"""s; each drawing sends the whole line."""

MAX_POINTS = 2048
"""A minute at the first sample period; even, so that it can be halved."""


@idle
class QuadrotorGeometry(LeafSystem):
    """Tells a SceneGraph where the frame of a quadrotor is.

    .. pydrake_system::

        name: QuadrotorGeometry
        input_ports:
        - state
        output_ports:
        - geometry_pose

    `state` (12) is QuadrotorPlant's.

    `geometry_pose` is a FramePoseVector with the pose X_WB of one frame.  It is direct
    feed-through.

    It exists for float only, as pictures do; convert a diagram to AutoDiffXd without it.
    `AddQuadrotorGeometry` makes the frame and what is seen of it.

    Args:
        frame_id: The frame, registered with a SceneGraph.

    Raises:
        NonFiniteValueError: on evaluation, where the state is not finite.
    """

    def __init__(self, frame_id: FrameId) -> None:
        super().__init__()
        self._frame_id = frame_id
        self._state: Any = self.DeclareVectorInputPort("state", STATE_SIZE)
        self.DeclareAbstractOutputPort(
            "geometry_pose",
            lambda: AbstractValue.Make(FramePoseVector()),
            self._CalcGeometryPose,
            {self.input_port_ticket(self._state.get_index())},
        )

    def _CalcGeometryPose(self, context: Any, output: Any) -> None:
        state = self._state.Eval(context)
        CheckFinite(self, context, self._state, state.tolist())
        poses = output.get_mutable_value()
        poses.clear()
        poses.set_value(
            self._frame_id, RigidTransform(RollPitchYaw(state[ATTITUDE]), state[POSITION])
        )


def AddQuadrotorGeometry(
    builder: DiagramBuilder,
    state_port: OutputPort,
    scene_graph: SceneGraph,
    parameters: QuadrotorParameters,
    name: str = "quadrotor",
    *,
    scale: float = 1.0,
) -> QuadrotorGeometry:
    """Adds a quadrotor of simple shapes to a SceneGraph: body, arms and four propellers.

    The propellers stand in QuadrotorPlant's "+" layout, and propeller 0, in front, has
    another colour.  The shapes have the illustration role only: nothing collides.

    Args:
        builder: Is changed; `scene_graph` is in it.
        state_port: The vehicle's state (12), as QuadrotorPlant's.
        scene_graph: Is changed.
        parameters: The vehicle, whose arm length sets the size.
        name: Name of the frame and of the system "<name>_geometry".
        scale: Times which the vehicle is drawn larger than it is.

    Returns:
        The system that was added.

    Raises:
        ConfigurationError: if the scale is not finite and positive.
    """
    CheckPositiveParameter("scale", scale)
    source_id = scene_graph.RegisterSource(name)
    frame_id = scene_graph.RegisterFrame(source_id, GeometryFrame(name))
    for shape_name, shape, X_BG, color in QuadrotorShapes(scale * parameters.arm_length):
        instance = GeometryInstance(X_BG, shape, shape_name)
        instance.set_illustration_properties(MakePhongIllustrationProperties(color.rgba))
        scene_graph.RegisterGeometry(source_id, frame_id, instance)
    geometry: Any = builder.AddNamedSystem(f"{name}_geometry", QuadrotorGeometry(frame_id))
    builder.Connect(state_port, geometry.get_input_port())
    builder.Connect(geometry.get_output_port(), scene_graph.get_source_pose_port(source_id))
    return geometry


def QuadrotorShapes(L: float) -> Iterator[tuple[str, Shape, RigidTransform, Rgba]]:
    """Yields name, shape, pose X_BG and colour of what is seen of a quadrotor.

    Args:
        L: The arm length in m.
    """
    x, y, z = (L * size for size in BODY_SIZE)
    yield "body", Box(x, y, z), RigidTransform(), BODY_COLOR
    for axis, rpy in (("x", (0.0, math.pi / 2, 0.0)), ("y", (math.pi / 2, 0.0, 0.0))):
        X_BG = RigidTransform(RollPitchYaw(*rpy).ToRotationMatrix())
        yield f"arm_{axis}", Cylinder(ARM_RADIUS * L, 2.0 * L), X_BG, BODY_COLOR
    for number in range(NUM_PROPELLERS):
        angle = 2.0 * math.pi * number / NUM_PROPELLERS
        p_BG: Any = [L * math.cos(angle), L * math.sin(angle), PROPELLER_HEIGHT * L]
        yield (
            f"propeller_{number}",
            Cylinder(PROPELLER_RADIUS * L, PROPELLER_THICKNESS * L),
            RigidTransform(p_BG),
            PROPELLER_COLOR if number else FRONT_COLOR,
        )


@idle
class FlightTrail(LeafSystem):
    """Draws the way that a vehicle has flown as one line in Meshcat.

    .. pydrake_system::

        name: FlightTrail
        input_ports:
        - state

    `state` (12) is QuadrotorPlant's; the first three entries are p_WB in m.

    The positions are sampled every `SAMPLE_PERIOD` and drawn every `DRAW_PERIOD`, and when
    the system is forced to publish; see `DrawToEnd`.  When there are `MAX_POINTS`, every
    second one is dropped and the period of the samples doubles, so that the cost of a long
    flight is bounded.

    The points are discrete state, which the initialization of a simulation clears: a second
    flight starts a new trail.  The system exists for float only, as pictures do.

    Meshcat does not animate lines: a recording shows the whole trail from its beginning on.

    Args:
        meshcat: Is drawn to.
        path: Of the line in Meshcat's scene.
        width: Of the line in m.

    Raises:
        ConfigurationError: if the width is not finite and positive.
        NonFiniteValueError: on a sample, where the state is not finite.
    """

    def __init__(
        self, meshcat: Meshcat, path: str = TRAIL_PATH, width: float = TRAIL_WIDTH
    ) -> None:
        super().__init__()
        CheckPositiveParameter("width", width)
        # Drake's stubs misname the type of every array.
        self._meshcat: Any = meshcat
        self._path = path
        self._width = width
        self._state: Any = self.DeclareVectorInputPort("state", STATE_SIZE)
        self._points: Any = self.DeclareDiscreteState(3 * MAX_POINTS)
        # How many points there are, how many samples lie from one to the next, and how many
        # samples there were.
        counts: Any = [0.0, 1.0, 0.0]
        self._counts: Any = self.DeclareDiscreteState(BasicVector(counts))
        self.DeclareInitializationDiscreteUpdateEvent(self._Clear)
        self.DeclarePeriodicDiscreteUpdateEvent(SAMPLE_PERIOD, 0.0, self._Sample)
        self.DeclarePeriodicPublishEvent(DRAW_PERIOD, 0.0, self._Draw)
        self.DeclareForcedPublishEvent(self._Draw)

    def GetPoints(self, context: Context) -> FloatArray:
        """Returns the points of the trail so far, (n, 3) in m.

        Args:
            context: This system's own.
        """
        num_points = int(context.get_discrete_state(self._counts).GetAtIndex(0))
        points = context.get_discrete_state(self._points).CopyToVector()
        return points[: 3 * num_points].reshape(-1, 3)

    def DrawToEnd(self, root_context: Context) -> None:
        """Draws the trail up to where the vehicle is now, as after a flight.

        The diagram's own ForcedPublish does so too, but then every log samples once more.

        Args:
            root_context: Of the whole diagram.
        """
        self.ForcedPublish(self.GetMyContextFromRoot(root_context))

    def _Clear(self, context: Context, discrete: Any) -> None:
        discrete.get_mutable_value(self._counts)[:] = [0.0, 1.0, 0.0]

    def _Sample(self, context: Context, discrete: Any) -> None:
        points = discrete.get_mutable_value(self._points).reshape(-1, 3)
        counts = discrete.get_mutable_value(self._counts)
        num_points, stride, num_samples = (int(count) for count in counts)
        if num_samples % stride == 0:
            if num_points == MAX_POINTS:
                num_points //= 2
                points[:num_points] = points[::2]
                stride *= 2
            points[num_points] = self._EvalPosition(context)
            num_points += 1
        counts[:] = num_points, stride, num_samples + 1

    def _Draw(self, context: Context) -> None:
        points = np.vstack((self.GetPoints(context), self._EvalPosition(context)))
        if len(points) < 2:
            # What the flight before has left there.
            self._meshcat.Delete(self._path)
            return
        vertices, faces = _Ribbons(points, self._width)
        self._meshcat.SetTriangleMesh(self._path, vertices.T, faces.T, TRAIL_COLOR)

    def _EvalPosition(self, context: Context) -> FloatArray:
        state = self._state.Eval(context)
        CheckFinite(self, context, self._state, state.tolist())
        return state[POSITION]


def _Ribbons(points: FloatArray, width: float) -> tuple[FloatArray, IntArray]:
    """Returns the vertices (6 n, 3) and triangles (6 (n - 1), 3) of three ribbons on a line.

    One ribbon lies across each axis, so that one is seen broad from wherever it is looked
    at, and standing still needs no care.  A browser draws plain lines one pixel wide.
    """
    n = len(points)
    offsets = width / 2.0 * np.array([-np.eye(3), np.eye(3)])
    # Vertex (axis, side, point) has the index (2 axis + side) n + point.
    vertices = points + offsets.transpose(1, 0, 2)[:, :, np.newaxis, :]
    first = (np.arange(n - 1) + 2 * n * np.arange(3)[:, np.newaxis]).ravel()
    near = np.column_stack((first, first + 1, first + n))
    far = np.column_stack((first + 1, first + n + 1, first + n))
    return vertices.reshape(-1, 3), np.vstack((near, far))


def AddFlightTrail(
    builder: DiagramBuilder,
    state_port: OutputPort,
    meshcat: Meshcat,
    path: str = TRAIL_PATH,
    width: float = TRAIL_WIDTH,
    name: str = "trail",
) -> FlightTrail:
    """Adds a `FlightTrail`, called `name`, to a builder and returns it.

    It is connected to `state_port`, the vehicle's state (12) as QuadrotorPlant's; the other
    arguments are those of `FlightTrail`.
    """
    trail: Any = builder.AddNamedSystem(name, FlightTrail(meshcat, path, width))
    builder.Connect(state_port, trail.get_input_port())
    return trail
