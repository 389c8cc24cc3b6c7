"""A quadrotor as a body of a MultibodyPlant, perhaps among others."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion_
from pydrake.geometry import Box, Cylinder, Rgba, Shape
from pydrake.math import RigidTransform, RollPitchYaw, RollPitchYaw_
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    ExternallyAppliedSpatialForceMultiplexer,
    MultibodyPlant,
    Propeller,
    PropellerInfo,
)
from pydrake.multibody.tree import ModelInstanceIndex, RigidBody
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem_, System

from sgvf_drake.exceptions import ConfigurationError
from systems.disturbances import Disturbance
from systems.moving_scene import QuadrotorShapes
from systems.quadrotor import (
    ATTITUDE,
    NUM_PROPELLERS,
    POSITION,
    RATES,
    STATE_SIZE,
    VELOCITY,
    QuadrotorParameters,
)
from systems.scalars import (
    CheckFinite,
    Sqrt,
    ToList,
    template,
)
from systems.vehicle import Quadrotor

BODY_STATE_SIZE = 13
QUATERNION, PLACE, ANGULAR_VELOCITY, TRANSLATION = (
    slice(0, 4),
    slice(4, 7),
    slice(7, 10),
    slice(10, 13),
)
"""A floating body's state: quaternion (w, x, y, z), p_WB in m, w_WB_W in rad/s, v_WB in m/s."""

OFF_CENTRE = 1e-6
"""Offsets of the centre of mass over the arm length, and products of inertia over the greatest
moment, that are rounding."""


@template
def FloatingBodyState_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Tells the state of a floating body of a MultibodyPlant as QuadrotorPlant does.

        .. pydrake_system::

            name: FloatingBodyState
            input_ports:
            - body_state
            output_ports:
            - state

        `body_state` (13) is that of the body's model instance: quaternion (w, x, y, z), p_WB in
        m, w_WB_W in rad/s, v_WB in m/s.

        `state` (12) is QuadrotorPlant's, with a yaw from -pi to pi.  It is direct feed-through.

        Raises:
            NonFiniteValueError: on evaluation, where the input is not finite.
            RuntimeError: on evaluation, at a pitch of 90 degrees, as QuadrotorPlant raises it.
        """

        def _construct(self) -> None:
            self._body_state = self.DeclareVectorInputPort("body_state", BODY_STATE_SIZE)
            self.DeclareVectorOutputPort(
                "state",
                STATE_SIZE,
                self._CalcState,
                {self.input_port_ticket(self._body_state.get_index())},
            )

        def _CalcState(self, context: Any, output: Any) -> None:
            body = self._body_state.Eval(context)
            CheckFinite(self, context, self._body_state, ToList(body))
            # An integrator does not keep the length of a quaternion.
            q = body[QUATERNION] / Sqrt(body[QUATERNION].dot(body[QUATERNION]))
            rpy = RollPitchYaw_[T](Quaternion_[T](q))
            rates = rpy.CalcRpyDtFromAngularVelocityInParent(body[ANGULAR_VELOCITY])
            output.SetFromVector(
                np.concatenate((body[PLACE], rpy.vector(), body[TRANSLATION], rates))
            )

    return Impl


FloatingBodyState = FloatingBodyState_[None]


class QuadrotorInPlant(Diagram):
    """Makes a floating body of a MultibodyPlant a quadrotor: its propellers, and its state.

    .. pydrake_system::

        name: QuadrotorInPlant
        input_ports:
        - propeller_force
        - body_poses
        - body_state
        output_ports:
        - state
        - spatial_forces

    `propeller_force` (4) and `state` (12) are QuadrotorPlant's.  The others belong to the
    MultibodyPlant, with which `AddMultibodyQuadrotor` connects them.

    Attributes:
        parameters: The `QuadrotorParameters` that the plant's model has, of which the
            propellers are those that were given.

    Args:
        plant: A finalized MultibodyPlant.
        model_instance: The quadrotor: one floating body, to which others may be welded, of
            this model or another.  The origin of its frame is the centre of mass, its z axis
            points up and its axes are the principal ones; propeller 0 is on +x, see
            `QuadrotorParameters`.
        parameters: The vehicle's propellers: arm length, constants and thrust-to-weight ratio.
            Mass, inertia and gravity are the model's.

    Raises:
        ConfigurationError: if the model cannot be flown as a quadrotor.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        model_instance: ModelInstanceIndex,
        parameters: QuadrotorParameters,
    ) -> None:
        super().__init__()
        self._plant, self._model_instance = plant, model_instance
        body = _FloatingBody(plant, model_instance)
        self.parameters = _ReadParameters(plant, model_instance, body, parameters)
        builder = DiagramBuilder()
        propellers: Any = builder.AddNamedSystem(
            "propellers", _MakePropellers(body, parameters)
        )
        state = builder.AddNamedSystem("state", FloatingBodyState())
        builder.ExportInput(propellers.get_command_input_port(), "propeller_force")
        builder.ExportInput(propellers.get_body_poses_input_port(), "body_poses")
        builder.ExportInput(state.get_input_port(), "body_state")
        builder.ExportOutput(state.get_output_port(), "state")
        builder.ExportOutput(propellers.get_spatial_forces_output_port(), "spatial_forces")
        builder.BuildInto(self)

    def SetVehicleState(self, root_context: Context, state: Any) -> None:
        """Sets the state of the vehicle, which the MultibodyPlant has.

        Args:
            root_context: The Context of the whole diagram.
            state: The state (12,), as QuadrotorPlant's.
        """
        rpy = RollPitchYaw(state[ATTITUDE])
        w_WB_W = rpy.CalcAngularVelocityInParentFromRpyDt(state[RATES])
        values: Any = np.concatenate(
            (rpy.ToQuaternion().wxyz(), state[POSITION], w_WB_W, state[VELOCITY])
        )
        context = self._plant.GetMyMutableContextFromRoot(root_context)
        self._plant.SetPositionsAndVelocities(context, self._model_instance, values)


def AddMultibodyQuadrotor(
    builder: DiagramBuilder,
    plant: MultibodyPlant,
    model_instance: ModelInstanceIndex,
    parameters: QuadrotorParameters | None = None,
    *,
    name: str | None = None,
) -> QuadrotorInPlant:
    """Makes a model of a MultibodyPlant a quadrotor, which `AddGuidance` can then fly.

    Several in one plant are added one after the other.  Other forces on bodies of the plant are
    to be connected before; they are added up.

    A discrete plant flies too, less exactly: see `docs/flight.md`.

    Args:
        builder: Is changed; `plant` is in it.
        plant: Is finalized.
        model_instance: The quadrotor; see `QuadrotorInPlant` for what it has to be.
        parameters: The propellers, as in `QuadrotorInPlant`; by default the paper's.
        name: The name of the sub-Diagram; None: that of the model instance.

    Returns:
        What was added, with ports `propeller_force` (4) and `state` (12) as QuadrotorPlant's.

    Raises:
        ConfigurationError: if an argument cannot be used; then nothing was added.
    """
    if not any(system is plant for system in builder.GetSystems()):
        raise ConfigurationError(f"the plant {plant.get_name()!r} is not in the builder")
    if not plant.is_finalized():
        raise ConfigurationError(f"the plant {plant.get_name()!r} is not finalized")
    name = name or plant.GetModelInstanceName(model_instance)
    if builder.HasSubsystemNamed(name):
        raise ConfigurationError(f"the diagram has a system {name!r} already: choose a `name`")
    quadrotor = QuadrotorInPlant(plant, model_instance, parameters or QuadrotorParameters())
    _RequireFree(builder, plant, model_instance)
    builder.AddNamedSystem(name, quadrotor)
    builder.Connect(plant.GetOutputPort("body_poses"), quadrotor.GetInputPort("body_poses"))
    builder.Connect(
        plant.get_state_output_port(model_instance), quadrotor.GetInputPort("body_state")
    )
    _ConnectForces(builder, quadrotor, plant)
    return quadrotor


class MultibodyQuadrotor(Diagram):
    """A quadrotor as a MultibodyPlant of its own, in the place of Drake's QuadrotorPlant.

    .. pydrake_system::

        name: MultibodyQuadrotor
        input_ports:
        - propeller_force
        output_ports:
        - state

    `propeller_force` (4) and `state` (12) are QuadrotorPlant's.

    Attributes:
        plant: The MultibodyPlant.
        parameters: The `QuadrotorParameters`.

    Args:
        parameters: The vehicle; by default the paper's.
        time_step: The step in s of a discrete plant; 0: it is continuous.
    """

    def __init__(
        self, parameters: QuadrotorParameters | None = None, time_step: float = 0.0
    ) -> None:
        super().__init__()
        self.parameters = parameters or QuadrotorParameters()
        builder = DiagramBuilder()
        plant: Any = builder.AddNamedSystem("plant", MultibodyPlant(time_step))
        self.plant = plant
        plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, -self.parameters.gravity])
        sdf = MultibodyQuadrotorSdf(self.parameters)
        (model_instance,) = Parser(plant).AddModelsFromString(sdf, "sdf")
        plant.Finalize()
        self._quadrotor = AddMultibodyQuadrotor(builder, plant, model_instance, self.parameters)
        builder.ExportInput(self._quadrotor.GetInputPort("propeller_force"), "propeller_force")
        builder.ExportOutput(self._quadrotor.GetOutputPort("state"), "state")
        builder.BuildInto(self)

    def SetVehicleState(self, root_context: Context, state: Any) -> None:
        """Sets the state of the vehicle.

        Args:
            root_context: The Context of the whole diagram.
            state: The state (12,), as QuadrotorPlant's.
        """
        self._quadrotor.SetVehicleState(root_context, state)


@dataclass(frozen=True)
class MultibodyVehicle(Quadrotor):
    """A quadrotor that is a body of Drake's MultibodyPlant, see `MultibodyQuadrotor`."""

    name = "multibody"

    def MakePlant(self, disturbance: Disturbance | None = None) -> System:
        """Returns the `MultibodyQuadrotor`, which flies in still air."""
        if disturbance is not None:
            raise ConfigurationError(
                "a multibody quadrotor flies in still air; a quadrotor can be disturbed"
            )
        return MultibodyQuadrotor(self.parameters)


def MultibodyQuadrotorSdf(parameters: QuadrotorParameters, name: str = "quadrotor") -> str:
    """Returns a model of a quadrotor in SDFormat: one body, and what is seen of it.

    Args:
        parameters: The vehicle: mass, inertia and size.
        name: The name of the model.
    """
    ixx, iyy, izz = parameters.inertia
    shapes = QuadrotorShapes(parameters.arm_length)
    return f"""<?xml version="1.0"?>
<sdf version="1.9">
  <model name="{name}">
    <link name="body">
      <inertial>
        <mass>{parameters.mass!r}</mass>
        <inertia>
          <ixx>{ixx!r}</ixx><iyy>{iyy!r}</iyy><izz>{izz!r}</izz>
          <ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>
        </inertia>
      </inertial>
{"".join(_VisualSdf(*shape) for shape in shapes)}    </link>
  </model>
</sdf>
"""


def _VisualSdf(name: str, shape: Shape, X_BG: RigidTransform, color: Rgba) -> str:
    if isinstance(shape, Box):
        geometry = f"<box><size>{_Numbers(shape.size())}</size></box>"
    else:
        assert isinstance(shape, Cylinder)
        geometry = (
            f"<cylinder><radius>{shape.radius()!r}</radius>"
            f"<length>{shape.length()!r}</length></cylinder>"
        )
    pose = _Numbers([*X_BG.translation(), *RollPitchYaw(X_BG.rotation()).vector()])
    return f"""      <visual name="{name}">
        <pose>{pose}</pose>
        <geometry>{geometry}</geometry>
        <material><diffuse>{_Numbers(color.rgba)}</diffuse></material>
      </visual>
"""


def _Numbers(values: Any) -> str:
    return " ".join(repr(float(value)) for value in values)


def _MakePropellers(body: RigidBody, parameters: QuadrotorParameters) -> Propeller:
    """Returns the four propellers of QuadrotorPlant on a body."""

    def Places() -> Iterator[PropellerInfo]:
        for number in range(NUM_PROPELLERS):
            angle = 2.0 * math.pi * number / NUM_PROPELLERS
            L, turn = parameters.arm_length, 1.0 if number % 2 == 0 else -1.0
            p_BP: Any = [L * math.cos(angle), L * math.sin(angle), 0.0]
            yield PropellerInfo(
                body.index(),
                RigidTransform(p_BP),
                parameters.force_constant,
                turn * parameters.moment_constant,
            )

    return Propeller(list(Places()))


def _FloatingBody(plant: MultibodyPlant, model_instance: ModelInstanceIndex) -> RigidBody:
    """Returns the one body of a model that floats, with all the rest welded to it."""
    model = f"the model {plant.GetModelInstanceName(model_instance)!r}"
    floating = [
        plant.get_body(index)
        for index in plant.GetBodyIndices(model_instance)
        if plant.get_body(index).is_floating_base_body()
    ]
    if len(floating) != 1:
        raise ConfigurationError(
            f"{model} must have one body that floats without a joint, it has {len(floating)}"
        )
    (body,) = floating
    welded = _Welded(plant, body)
    joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
    if plant.num_multibody_states(model_instance) != BODY_STATE_SIZE or any(
        joint.parent_body().index() in welded and joint.child_body().index() not in welded
        for joint in joints
    ):
        raise ConfigurationError(f"{model} has joints that move; weld them to fly it")
    return body


def _Welded(plant: MultibodyPlant, body: RigidBody) -> list[Any]:
    """Returns the indices of all bodies of the plant that move as one with a body."""
    return [other.index() for other in plant.GetBodiesWeldedTo(body)]


def _ReadParameters(
    plant: MultibodyPlant,
    model_instance: ModelInstanceIndex,
    body: RigidBody,
    parameters: QuadrotorParameters,
) -> QuadrotorParameters:
    """Returns the parameters with mass, inertia and gravity of a model."""
    model = f"the model {plant.GetModelInstanceName(model_instance)!r}"
    context = plant.CreateDefaultContext()
    inertia = plant.CalcSpatialInertia(context, body.body_frame(), _Welded(plant, body))
    p_BBcm = inertia.get_com()
    if np.linalg.norm(p_BBcm) > OFF_CENTRE * parameters.arm_length:
        raise ConfigurationError(
            f"{model} has its centre of mass at {p_BBcm.tolist()} m in the frame of its body "
            f"{body.name()!r}; it must be at the origin, amid the propellers"
        )
    I_B = inertia.CalcRotationalInertia().CopyToFullMatrix3()
    products = I_B - np.diag(np.diag(I_B))
    if np.abs(products).max() > OFF_CENTRE * I_B.max():
        raise ConfigurationError(
            f"{model} must have a diagonal inertia in the frame of its body {body.name()!r}, "
            f"got {I_B.tolist()} kg m^2"
        )
    gravity = plant.gravity_field().gravity_vector()
    if not plant.is_gravity_enabled(model_instance) or gravity[0] or gravity[1]:
        raise ConfigurationError(
            f"{model} must be pulled along -z by gravity, which is {gravity.tolist()} m/s^2"
        )
    moments: Any = tuple(np.diag(I_B).tolist())
    return replace(
        parameters, mass=inertia.get_mass(), inertia=moments, gravity=-float(gravity[2])
    )


def _RequireFree(
    builder: DiagramBuilder, plant: MultibodyPlant, model_instance: ModelInstanceIndex
) -> None:
    """Raises ConfigurationError unless the plant can take the forces of this quadrotor."""
    for system in builder.GetSystems():
        if (
            isinstance(system, QuadrotorInPlant)
            and system._plant is plant
            and system._model_instance == model_instance
        ):
            raise ConfigurationError(
                f"the model {plant.GetModelInstanceName(model_instance)!r} has propellers "
                "already"
            )
    port = plant.get_applied_spatial_force_input_port()
    connected = _Source(builder, plant) is not None
    if builder.IsConnectedOrExported(port) and not connected:
        raise ConfigurationError(
            f"the input {port.get_name()!r} of {plant.get_name()!r} is exported; the forces of "
            "propellers go there"
        )


def _Source(builder: DiagramBuilder, plant: MultibodyPlant) -> Any:
    """Returns the port that gives the plant's applied forces, or None."""
    port = plant.get_applied_spatial_force_input_port()
    source = builder.connection_map().get((plant, port.get_index()))
    return None if source is None else source[0].get_output_port(source[1])


def _ConnectForces(
    builder: DiagramBuilder, quadrotor: QuadrotorInPlant, plant: MultibodyPlant
) -> None:
    """Gives the plant the forces of propellers, beside those that it has."""
    port = plant.get_applied_spatial_force_input_port()
    forces, others = quadrotor.GetOutputPort("spatial_forces"), _Source(builder, plant)
    if others is not None:
        builder.Disconnect(others, port)
        both: System = builder.AddSystem(ExternallyAppliedSpatialForceMultiplexer(2))
        builder.Connect(others, both.get_input_port(0))
        builder.Connect(forces, both.get_input_port(1))
        forces = both.get_output_port()
    builder.Connect(forces, port)
