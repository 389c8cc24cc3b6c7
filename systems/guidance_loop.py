"""The loop around a vehicle: sensors, guidance, perhaps a supervisor, and controller."""

from typing import Any, NamedTuple

from pydrake.examples import QuadrotorPlant
from pydrake.systems.framework import DiagramBuilder, OutputPort, System

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import Field, SteerableField
from systems.controller import Se3Controller
from systems.guidance import DEFAULT_ALTITUDE, DEFAULT_SPEED, GuidanceSystem
from systems.quadrotor import QuadrotorParameters
from systems.sensing import (
    DEFAULT_SAMPLE_PERIOD,
    AddMotionCapture,
    MotionCapture,
    SensorParameters,
)

COMMANDS = ("velocity_command", "acceleration_feedforward")
"""Ports of guidance, of a supervisor and of the controller."""


class GuidanceParts(NamedTuple):
    """What `AddGuidance` adds to a diagram.

    Attributes:
        guidance: The `GuidanceSystem`.
        controller: The `Se3Controller`.
        motion_capture: The ZeroOrderHold that samples the vehicle's state; the PassThrough
            in its place where nothing is sampled, or the `MotionCapture` with sensors.
        supervisor: The `BranchSupervisor`, or None.
    """

    guidance: Any
    controller: Any
    motion_capture: Any
    supervisor: Any

    @property
    def velocity_command(self) -> OutputPort:
        """The velocity that the controller is given."""
        return (self.supervisor or self.guidance).GetOutputPort("velocity_command")


def AddGuidance(
    builder: DiagramBuilder,
    field: Field,
    plant: System,
    parameters: QuadrotorParameters | None = None,
    *,
    speed: float = DEFAULT_SPEED,
    altitude: float = DEFAULT_ALTITUDE,
    sample_period: float = DEFAULT_SAMPLE_PERIOD,
    feedforward: bool = True,
    saturate: bool = True,
    sensors: SensorParameters | None = None,
    supervisor: Any = None,
    measured_port: OutputPort | None = None,
) -> GuidanceParts:
    """Makes a vehicle in a diagram follow a guiding vector field.

    Adds the systems "motion_capture", "guidance", "controller" and, if one is given,
    "supervisor", and connects them in a loop with the plant.  Everything but the motion
    capture is direct feed-through.

    Name the plant "plant" to set the start with `SetHover` or `SetVehicleState`, which the
    motion capture then knows too.  Where only the plant's state is set, whatever is logged
    at the start sees a vehicle at the origin.

    Args:
        builder: Is changed; `plant` is in it.
        field: The guiding field, of dimension 2 or 3, in metres.
        plant: A QuadrotorPlant, or a system with its ports: input `propeller_force` (4)
            and output `state` (12).
        parameters: The vehicle.  By default those of the plant, if it is a QuadrotorPlant,
            with the paper's thrust-to-weight ratio.
        speed: In m/s, at which the field is followed.
        altitude: In m; only for a field of dimension 2.
        sample_period: Of an ideal motion capture, and so of the whole loop, in s; 0 leaves
            sampling out, so that the loop is continuous.
        feedforward: As in `GuidanceSystem`.
        saturate: As in `Se3Controller`.
        sensors: Noise, delay and rates of the measurements; None: the ideal motion capture.
        supervisor: A `BranchSupervisor` for the same field, which is added.
        measured_port: The state that is measured; by default that of the plant.  This is
            where a `Dropout` comes in.

    Returns:
        The systems that were added.

    Raises:
        ConfigurationError: if an argument cannot be used.
    """
    if parameters is None:
        if not isinstance(plant, QuadrotorPlant):
            raise ConfigurationError(
                "parameters must be given for a plant that is not a QuadrotorPlant"
            )
        parameters = QuadrotorParameters.FromPlant(plant)
    guidance = builder.AddNamedSystem(
        "guidance", GuidanceSystem(field, speed, altitude, feedforward)
    )
    controller = builder.AddNamedSystem(
        "controller", Se3Controller(parameters, saturate=saturate)
    )
    state_port = measured_port or plant.GetOutputPort("state")
    capture: Any
    if sensors is None:
        capture = AddMotionCapture(builder, state_port, sample_period)
        state = onboard = capture.get_output_port()
    else:
        capture = builder.AddNamedSystem("motion_capture", MotionCapture(sensors))
        builder.Connect(state_port, capture.GetInputPort("state"))
        state, onboard = (capture.GetOutputPort(n) for n in ("state", "onboard_state"))
        _Connect(builder, controller, capture, "acceleration")
    builder.Connect(state, guidance.GetInputPort("state"))
    builder.Connect(onboard, controller.GetInputPort("state"))
    commander = guidance
    if supervisor is not None:
        commander = builder.AddNamedSystem("supervisor", supervisor)
        builder.Connect(state, supervisor.GetInputPort("state"))
        _Connect(builder, guidance, supervisor, *COMMANDS, "speed")
        if isinstance(field, SteerableField):
            _Connect(builder, guidance, supervisor, "heading")
            _Connect(builder, supervisor, guidance, "intended_direction")
        if sensors is not None:
            _Connect(builder, capture, supervisor, "measurement_age")
    _Connect(builder, commander, controller, *COMMANDS)
    _Connect(builder, controller, plant, "propeller_force")
    return GuidanceParts(guidance, controller, capture, supervisor)


def _Connect(builder: DiagramBuilder, source: System, target: System, *names: str) -> None:
    """Connects the ports of these names."""
    for name in names:
        builder.Connect(source.GetOutputPort(name), target.GetInputPort(name))
