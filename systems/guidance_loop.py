"""The loop around a vehicle: sensors, guidance, perhaps a supervisor, and controller."""

from typing import Any

from pydrake.examples import QuadrotorPlant
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort, System
from pydrake.systems.primitives import Integrator, ZeroOrderHold

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.fields.base import Field, SteerableField
from systems.controller import DEFAULT_GAINS, Se3Controller
from systems.fused_guidance import EVALUATED, FusedGuidance
from systems.guidance import DEFAULT_ALTITUDE, GuidanceSystem, HasCompiledForm
from systems.quadrotor import ATTITUDE, VELOCITY, QuadrotorParameters
from systems.se3_law import Gains
from systems.selections import AddSelections
from systems.sensing import DEFAULT_SAMPLE_PERIOD, SensorParameters
from systems.vehicle import Quadrotor, Vehicle

MOTION = ("position", "velocity")
"""Ports of a motion capture, of guidance and of a supervisor."""

COMMANDS = ("velocity_command", "acceleration_feedforward")
"""Ports of guidance, of a supervisor and of the controller."""

REPORTS = ("mode", "branch", "edge", "arc")
"""Ports at which a supervisor tells what it does."""


class GuidanceLoop(Diagram):
    """Makes a vehicle follow a path: what is between its state and its actuation.

    .. pydrake_system::

        name: GuidanceLoop
        input_ports:
        - state
        - speed
        - heading
        output_ports:
        - measured_state
        - position
        - velocity_command
        - acceleration_feedforward
        - propeller_force

    `state` (12) is what is measured, QuadrotorPlant's, and `propeller_force` (4) its input.
    `measured_state` (12), `velocity_command` (3) in m/s and `acceleration_feedforward` (3) in
    m/s^2 in W are what the controller is given, and `position` (3) in m is what guidance is
    given.  Another `Vehicle` has a state of another size, and in place of `propeller_force` the
    port of its actuation.

    What else a supervisor tells is an output too: `mode`, `branch`, and on a directed field
    `edge` and `arc`.  What may stay unconnected is an input: `speed` (1) in m/s of guidance;
    `next_edge` of a supervisor and, without sensors, its `measurement_age`; without a
    supervisor `intended_direction` of guidance; and `heading` of a controller that has one.

    The systems inside have the names of the attributes.  Everything but the motion capture is
    direct feed-through.  What Drake converts or clones is a plain Diagram of the same systems.

    Attributes:
        guidance: The `GuidanceSystem`, or the system in its place.
        controller: The `Se3Controller`; where it is fused with guidance, the `FusedGuidance`
            that both are, of the name "guidance".
        motion_capture: The `IdealMotionCapture`, or with sensors the `MotionCapture`.  Before a
            `FusedGuidance` what samples ideally is Drake's ZeroOrderHold of the state.
        supervisor: The `BranchSupervisor`, or None.
        heading: The `HeadingSystem`, or None.
        actuation: The name of the port that commands the vehicle.

    Args:
        guidance: A system with input ports `position` (3) and `velocity` (3), and output
            ports `velocity_command` (3) and `acceleration_feedforward` (3), in W and SI units.
        controller: A system with these two as inputs, an input `state` (12) and an output
            `propeller_force` (4), or for another vehicle its own state and actuation; or the
            very `FusedGuidance` that is the guidance.
        motion_capture: An `IdealMotionCapture` or a `MotionCapture`; before a `FusedGuidance`
            perhaps a ZeroOrderHold.
        supervisor: A `BranchSupervisor`, or None.
        heading: A `HeadingSystem`, for a controller with an input `heading` (1), or None.
        actuation: The name of the controller's output.
        jerk_feedforward: Whether the controller is told the `command_derivatives` of guidance.

    Raises:
        ConfigurationError: if a port is missing.
    """

    def __init__(
        self,
        guidance: System,
        controller: System,
        motion_capture: Any,
        supervisor: Any = None,
        heading: Any = None,
        actuation: str = Quadrotor.actuation,
        jerk_feedforward: bool = False,
    ) -> None:
        super().__init__()
        self.actuation, self._is_fused = actuation, controller is guidance
        if not self._is_fused:
            asked = COMMANDS if supervisor is None else (*COMMANDS, "speed")
            _CheckPorts(guidance, "guidance", MOTION, asked)
            _CheckPorts(controller, "the controller", ("state", *COMMANDS), (actuation,))
        if jerk_feedforward:
            _CheckPorts(guidance, "guidance", (), ("command_derivatives",))
            _CheckPorts(controller, "the controller", ("command_derivatives",), ())
        if heading is not None:
            _CheckPorts(heading, "heading", ("position", "velocity_command"), ("heading",))
            _CheckPorts(controller, "a controller that is told a heading", ("heading",), ())
        builder = DiagramBuilder()
        self.guidance: Any = builder.AddNamedSystem("guidance", guidance)
        self.controller: Any = guidance
        self.motion_capture: Any = builder.AddNamedSystem("motion_capture", motion_capture)
        self.supervisor: Any = None
        self._outputs: dict[str, OutputPort] = {}
        if self._is_fused:
            self._ConnectFused(builder)
        else:
            self.controller = builder.AddNamedSystem("controller", controller)
            self._ConnectTwo(builder, supervisor)
        if jerk_feedforward:
            _Connect(builder, guidance, controller, "command_derivatives")
        self._predictor: Any = None
        if controller.HasInputPort("predicted_velocity"):
            self._AddPredictor(builder)
        if motion_capture.HasInputPort("acceleration"):
            port = motion_capture.GetInputPort("acceleration")
            builder.Connect(self._outputs["acceleration"], port)
        self.heading: Any = None
        if heading is not None:
            self._AddHeading(builder, heading)
        self._Export(builder)
        builder.BuildInto(self)

    def _ConnectFused(self, builder: DiagramBuilder) -> None:
        """Connects guidance and controller in one with what they are given."""
        capture, fused = self.motion_capture, self.guidance
        state = capture.GetOutputPort("y" if isinstance(capture, ZeroOrderHold) else "state")
        builder.Connect(state, fused.GetInputPort("state"))
        seen = capture if capture.HasOutputPort("position") else fused
        self._outputs = {
            "state": state,
            "position": seen.GetOutputPort("position"),
            **AddSelections(builder, "evaluated", fused.GetOutputPort("evaluation"), EVALUATED),
        }

    def _ConnectTwo(self, builder: DiagramBuilder, supervisor: Any) -> None:
        """Connects guidance and controller, and a supervisor between them."""
        capture, guidance, controller = self.motion_capture, self.guidance, self.controller
        _Connect(builder, capture, guidance, *MOTION)
        _Connect(builder, capture, controller, "state")
        commander = guidance
        if supervisor is not None:
            commander = self.supervisor = builder.AddNamedSystem("supervisor", supervisor)
            self._ConnectSupervisor(builder)
        _Connect(builder, commander, controller, *COMMANDS)
        for source, names in (
            (capture, ("state", "position")),
            (commander, COMMANDS),
            (controller, (self.actuation, "acceleration")),
        ):
            for name in names:
                if source.HasOutputPort(name):
                    self._outputs[name] = source.GetOutputPort(name)

    def _AddHeading(self, builder: DiagramBuilder, heading: Any) -> None:
        self.heading = builder.AddNamedSystem("heading", heading)
        _Connect(builder, self.motion_capture, heading, "position")
        port = heading.GetInputPort("velocity_command")
        builder.Connect(self._outputs["velocity_command"], port)
        _Connect(builder, heading, self.controller, "heading")

    def _Export(self, builder: DiagramBuilder) -> None:
        """Makes ports of what is connected with nothing inside, and of what is told."""
        builder.ExportInput(self.motion_capture.get_input_port(0), "state")
        for system, name in (
            (self.guidance, "speed"),
            (self.guidance, "intended_direction"),
            (self.supervisor, "next_edge"),
            (self.supervisor, "measurement_age"),
            (self.controller, "heading"),
        ):
            if system is not None and system.HasInputPort(name):
                port = system.GetInputPort(name)
                if not builder.IsConnectedOrExported(port):
                    builder.ExportInput(port, name)
        builder.ExportOutput(self._outputs["state"], "measured_state")
        builder.ExportOutput(self._outputs["position"], "position")
        for name in (*COMMANDS, self.actuation):
            builder.ExportOutput(self._outputs[name], name)
        for name in REPORTS:
            if self.supervisor is not None and self.supervisor.HasOutputPort(name):
                builder.ExportOutput(self.supervisor.GetOutputPort(name), name)

    def _AddPredictor(self, builder: DiagramBuilder) -> None:
        predictor = self._predictor = builder.AddNamedSystem("predictor", Integrator(3))
        builder.Connect(self._outputs["acceleration"], predictor.get_input_port())
        port = self.controller.GetInputPort("predicted_velocity")
        builder.Connect(predictor.get_output_port(), port)

    def _ConnectSupervisor(self, builder: DiagramBuilder) -> None:
        capture, guidance, supervisor = self.motion_capture, self.guidance, self.supervisor
        _Connect(builder, capture, supervisor, *MOTION)
        _Connect(builder, guidance, supervisor, *COMMANDS, "speed")
        if guidance.HasOutputPort("heading"):
            _Connect(builder, guidance, supervisor, "heading")
            _Connect(builder, supervisor, guidance, "intended_direction")
        if capture.HasOutputPort("measurement_age"):
            _Connect(builder, capture, supervisor, "measurement_age")

    def SetVectorState(self, context: Context, state: Any) -> None:
        """Makes the motion capture, and what predicts the velocity, have seen a state.

        Args:
            context: This system's own.
            state: The state of the vehicle.
        """
        capture, predictor = self.motion_capture, self._predictor
        capture.SetVectorState(self.GetMutableSubsystemContext(capture, context), state)
        if predictor is not None:
            own = self.GetMutableSubsystemContext(predictor, context)
            predictor.set_integral_value(own, state[VELOCITY])
        if self.heading is not None:
            own = self.GetMutableSubsystemContext(self.heading, context)
            self.heading.SetHeading(own, state[ATTITUDE][2])


def AddGuidance(
    builder: DiagramBuilder,
    guidance: Field | SteerableField | System,
    plant: System,
    parameters: QuadrotorParameters | Vehicle | None = None,
    *,
    name: str = "guidance_loop",
    speed: float | None = None,
    altitude: float = DEFAULT_ALTITUDE,
    sample_period: float = DEFAULT_SAMPLE_PERIOD,
    feedforward: bool = True,
    jerk_feedforward: bool = False,
    saturate: bool = True,
    gains: Gains = DEFAULT_GAINS,
    sensors: SensorParameters | None = None,
    supervisor: Any = None,
    heading: Any = None,
    measured_port: OutputPort | None = None,
    fused: bool = True,
) -> GuidanceLoop:
    """Makes a vehicle in a diagram follow a guiding vector field.

    Adds a `GuidanceLoop` and connects it with the plant.  Several vehicles in one diagram have
    a loop each, of different names.  See `SetHover` for the start.

    Args:
        builder: Is changed; `plant` is in it.
        guidance: The guiding field, of dimension 2 or 3, in metres; or a system in the place of
            `GuidanceSystem`, with the ports that `GuidanceLoop` asks for.
        plant: A QuadrotorPlant, or a system with its ports: input `propeller_force` (4)
            and output `state` (12); for another vehicle, as its `MakePlant` makes it.
        parameters: The vehicle: a quadrotor's parameters, or any `Vehicle`.  By default those
            of the plant, if it is a QuadrotorPlant, with the paper's thrust-to-weight ratio,
            and those that a `QuadrotorInPlant` or a `MultibodyQuadrotor` has.
        name: The name of the loop in the builder.
        speed: At which a field is followed, m/s; None: the vehicle's own.
        altitude: In m; only for a field of dimension 2.
        sample_period: Of an ideal motion capture, and so of the whole loop, in s; 0 leaves
            sampling out, so that the loop is continuous.
        feedforward: As in `GuidanceSystem`.
        jerk_feedforward: Whether a quadrotor is told the derivatives of the command too, so
            that it turns exactly as the field asks; see `Se3Controller`.  It is for fields that
            are not directed, without a supervisor.
        saturate: As in `Se3Controller`, of a quadrotor's parameters.
        gains: As in `Se3Controller`, of a quadrotor's parameters.
        sensors: Noise, delay and rates of the measurements; None: the ideal motion capture.
        supervisor: A `BranchSupervisor` for the same field, which is added.
        heading: A `HeadingSystem`, which is added: where the vehicle looks; None: where the
            gains say.
        measured_port: The state that is measured; by default that of the plant.  This is
            where a `Dropout` comes in.
        fused: Whether guidance and controller of a quadrotor become one `FusedGuidance` where
            nothing stands between them: the guidance is a field with a compiled form, and there
            is neither a supervisor nor a `heading`.  False keeps two systems, which is slower,
            and what is needed where the input `heading` is made of `velocity_command` outside.

    Returns:
        The loop.

    Raises:
        ConfigurationError: if an argument cannot be used; then nothing was added.
    """
    actuation = parameters.actuation if isinstance(parameters, Vehicle) else Quadrotor.actuation
    _CheckPlace(builder, plant, name, actuation)
    vehicle = _VehicleOf(plant, parameters, gains, saturate)
    if plant.GetOutputPort("state").size() != len(vehicle.state_columns):
        raise ConfigurationError(
            f"the state of a {vehicle.name} is {', '.join(vehicle.state_columns)}; that of "
            f"{plant.get_name()!r} has {plant.GetOutputPort('state').size()} entries"
        )
    if jerk_feedforward and (supervisor is not None or not feedforward):
        raise ConfigurationError(
            "`jerk_feedforward` adds to the feed-forward of a field, and a supervisor has none"
        )
    speed = vehicle.own_speed if speed is None else speed
    guide: Any = guidance
    controller: Any = vehicle.MakeController()
    is_fused = False
    if not isinstance(guidance, System):
        flown = (guidance, speed, altitude, feedforward, vehicle.approach_rate)
        between = supervisor is not None or heading is not None or jerk_feedforward
        can_be = HasCompiledForm(guidance) and type(controller) is Se3Controller
        is_fused = fused and can_be and not between
        if is_fused:
            guide = controller = FusedGuidance(*flown, **controller.arguments)
        else:
            guide = GuidanceSystem(*flown)
        vehicle.CheckGuided(guidance.dim, speed)
    capture = vehicle.MakeMotionCapture(sample_period, sensors, is_fused)
    loop = GuidanceLoop(
        *(guide, controller, capture, supervisor, heading, actuation, jerk_feedforward)
    )
    builder.AddNamedSystem(name, loop)
    builder.Connect(measured_port or plant.GetOutputPort("state"), loop.GetInputPort("state"))
    _Connect(builder, loop, plant, actuation)
    return loop


def _VehicleOf(
    plant: System,
    parameters: QuadrotorParameters | Vehicle | None,
    gains: Gains,
    saturate: bool,
) -> Vehicle:
    """Returns the vehicle of a plant."""
    if isinstance(parameters, Vehicle):
        if gains != DEFAULT_GAINS or not saturate:
            raise ConfigurationError("`gains` and `saturate` belong to the vehicle given")
        return parameters
    if parameters is None:
        parameters = _ReadParameters(plant)
    return Quadrotor(parameters, gains, saturate)


def _ReadParameters(plant: Any) -> QuadrotorParameters:
    """Returns the parameters of a plant that knows its own."""
    if isinstance(plant, QuadrotorPlant):
        return QuadrotorParameters.FromPlant(plant)
    parameters = getattr(plant, "parameters", None)
    if isinstance(parameters, QuadrotorParameters):
        return parameters
    raise ConfigurationError(
        "parameters must be given for a plant that is not a QuadrotorPlant or of a "
        "MultibodyPlant"
    )


def _CheckPlace(builder: DiagramBuilder, plant: System, name: str, actuation: str) -> None:
    """Raises ConfigurationError unless a loop of this name can be put around the plant.

    Drake ends the process on what is found out only when the diagram is built.
    """
    if builder.HasSubsystemNamed(name):
        raise ConfigurationError(
            f"the diagram has a system {name!r} already: choose another `name` for this loop"
        )
    if not any(system is plant for system in builder.GetSystems()):
        raise ConfigurationError(f"the plant {plant.get_name()!r} is not in the builder")
    _CheckPorts(plant, "the plant", (actuation,), ("state",))
    if builder.IsConnectedOrExported(plant.GetInputPort(actuation)):
        raise ConfigurationError(
            f"the port {actuation!r} of {plant.get_name()!r} is commanded already"
        )


def _CheckPorts(
    system: System, role: str, inputs: tuple[str, ...], outputs: tuple[str, ...]
) -> None:
    """Raises ConfigurationError unless a system has the ports of these names."""
    for kind, names, has in (
        ("input", inputs, system.HasInputPort),
        ("output", outputs, system.HasOutputPort),
    ):
        for name in names:
            if not has(name):
                raise ConfigurationError(
                    f"{role} needs an {kind} port {name!r}; {_NameOf(system)} has none"
                )


def _NameOf(system: System) -> str:
    """Returns the name of a system's class; Drake adds that of the scalar to a template's."""
    return type(system).__name__.partition("_\N{MATHEMATICAL BOLD SCRIPT CAPITAL T}")[0]


def _Connect(builder: DiagramBuilder, source: System, target: System, *names: str) -> None:
    """Connects the ports of these names."""
    for name in names:
        builder.Connect(source.GetOutputPort(name), target.GetInputPort(name))
