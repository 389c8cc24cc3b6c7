"""What a quadrotor looks like: a frame in a SceneGraph that follows the vehicle's state."""

import math
from typing import Any

from pydrake.common.value import AbstractValue
from pydrake.geometry import (
    Box,
    Cylinder,
    FrameId,
    FramePoseVector,
    GeometryFrame,
    GeometryInstance,
    MakePhongIllustrationProperties,
    Rgba,
    SceneGraph,
    Shape,
    SourceId,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.framework import DiagramBuilder, LeafSystem, OutputPort

from systems.quadrotor import NUM_PROPELLERS, STATE_SIZE, QuadrotorParameters
from systems.scalars import CheckFinite, CheckPositiveParameter

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


class QuadrotorGeometry(LeafSystem):
    """Tells a SceneGraph where the frame of a quadrotor is.

    .. pydrake_system::

        name: QuadrotorGeometry
        input_ports:
        - state
        output_ports:
        - geometry_pose

    `state` (12) is QuadrotorPlant's: position p_WB in m, roll-pitch-yaw in rad, velocity
    v_WB in m/s and the rates of roll-pitch-yaw in rad/s; z is up.

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
        poses.set_value(self._frame_id, RigidTransform(RollPitchYaw(state[3:6]), state[:3]))


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
        name: Of the frame and of the system "<name>_geometry".
        scale: Times which the vehicle is drawn larger than it is.

    Returns:
        The system that was added.

    Raises:
        ConfigurationError: if the scale is not finite and positive.
    """
    CheckPositiveParameter("scale", scale)
    source_id = scene_graph.RegisterSource(name)
    frame_id = scene_graph.RegisterFrame(source_id, GeometryFrame(name))
    _RegisterShapes(scene_graph, source_id, frame_id, scale * parameters.arm_length)
    geometry: Any = builder.AddNamedSystem(f"{name}_geometry", QuadrotorGeometry(frame_id))
    builder.Connect(state_port, geometry.get_input_port())
    builder.Connect(geometry.get_output_port(), scene_graph.get_source_pose_port(source_id))
    return geometry


def _RegisterShapes(
    scene_graph: SceneGraph, source_id: SourceId, frame_id: FrameId, L: float
) -> None:
    """Gives the frame its shapes, for an arm length L in m."""

    def Register(name: str, shape: Shape, X_BG: RigidTransform, color: Rgba) -> None:
        instance = GeometryInstance(X_BG, shape, name)
        instance.set_illustration_properties(MakePhongIllustrationProperties(color.rgba))
        scene_graph.RegisterGeometry(source_id, frame_id, instance)

    x, y, z = (L * size for size in BODY_SIZE)
    Register("body", Box(x, y, z), RigidTransform(), BODY_COLOR)
    for axis, rpy in (("x", (0.0, math.pi / 2, 0.0)), ("y", (math.pi / 2, 0.0, 0.0))):
        X_BG = RigidTransform(RollPitchYaw(*rpy).ToRotationMatrix())
        Register(f"arm_{axis}", Cylinder(ARM_RADIUS * L, 2.0 * L), X_BG, BODY_COLOR)
    for number in range(NUM_PROPELLERS):
        angle = 2.0 * math.pi * number / NUM_PROPELLERS
        p_BG: Any = [L * math.cos(angle), L * math.sin(angle), PROPELLER_HEIGHT * L]
        Register(
            f"propeller_{number}",
            Cylinder(PROPELLER_RADIUS * L, PROPELLER_THICKNESS * L),
            RigidTransform(p_BG),
            PROPELLER_COLOR if number else FRONT_COLOR,
        )
