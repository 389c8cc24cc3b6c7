"""Whole flights: put together, started from a state, and simulated."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common import RandomGenerator
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator_, SimulatorConfig
from pydrake.systems.framework import (
    Context,
    Diagram,
    DiagramBuilder,
    OutputPort,
    System,
    System_,
)
from pydrake.systems.primitives import Demultiplexer, LogVectorOutput

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.fields.base import Field
from systems.disturbances import Disturbance
from systems.guidance_loop import REPORTS, AddGuidance, GuidanceLoop
from systems.lyapunov_monitor import AddLyapunovMonitor, DifferentiableFunction
from systems.quadrotor import STATE_SIZE, QuadrotorParameters
from systems.scalars import ToFloat
from systems.sensing import DEFAULT_SAMPLE_PERIOD, DrawNoise
from systems.vehicle import Quadrotor, Vehicle
from systems.visualization import AddFlightVisualization

INTEGRATION_STEP = 0.005
"""s; the fixed step of "runge_kutta3".  Halving it moves a flight on a circle of 1 m by less
than 1 um at 2 m/s, and by less than 10 um at 4 m/s."""


def MakeFlightDiagram(
    field: Field,
    parameters: QuadrotorParameters | Vehicle | None = None,
    *,
    disturbance: Disturbance | None = None,
    log_period: float | None = DEFAULT_SAMPLE_PERIOD,
    lyapunov: DifferentiableFunction | None = None,
    level: float = math.inf,
    meshcat: Meshcat | None = None,
    **guidance: Any,
) -> Diagram:
    """Returns the diagram of a vehicle that follows a guiding vector field.

    The systems are named "plant" (Drake's QuadrotorPlant, or a `DisturbedQuadrotor`) and
    "guidance_loop", and the logs (VectorLogSink) "state_log", "velocity_command_log" and
    "propeller_force_log", or that of another actuation; see `AddGuidance`.  A log sees the
    commands that hold until its sample: at a time of sampling, those of the sample before.
    The output port `state` is the plant's.  With a "supervisor" there are the logs "mode_log"
    and "branch_log" too, and with a directed field "edge_log" and "arc_log".

    With a Lyapunov function of dimension d there is a `LyapunovMonitor` "lyapunov" of the
    vehicle's first d coordinates, and the logs "V_log" and "V_dot_log".  It watches the true
    state, not the sampled one; see `StopOnExit` for what it can end.

    See `SetHover` and `SetVehicleState` for the start and `MakeSimulator` for the simulation.

    Args:
        field: The guiding field, of dimension 2 or 3, in metres.
        parameters: The vehicle, as the controller believes it: a quadrotor's parameters, or
            any `Vehicle`; by default the paper's quadrotor.
        disturbance: Wind, drag, motor lag and what else is not as believed; None: nothing is.
        log_period: Of the logs in s; 0 logs every step, and None leaves the logs out.
        lyapunov: A Lyapunov function V of dimension 2 or 3; None: there is no monitor.
        level: Of the sublevel set of V that is watched.
        meshcat: Shows the flight of a quadrotor; see `AddFlightVisualization`.  The diagram can
            then not be converted to AutoDiffXd.
        **guidance: `speed`, `altitude`, `sample_period`, `feedforward`, `jerk_feedforward`,
            `saturate`, `gains`, `sensors`, `supervisor` and `heading` as in `AddGuidance`.

    Raises:
        ConfigurationError: if an argument cannot be used.
    """
    parameters = parameters or QuadrotorParameters()
    vehicle = parameters if isinstance(parameters, Vehicle) else Quadrotor(parameters)
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", vehicle.MakePlant(disturbance))
    loop = AddGuidance(builder, field, plant, parameters, **guidance)
    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    if log_period is not None:
        names = ("velocity_command", loop.actuation, *REPORTS)
        logged = (loop.GetOutputPort(name) for name in names if loop.HasOutputPort(name))
        for port in (plant.GetOutputPort("state"), *logged):
            LogVectorOutput(port, builder, log_period).set_name(f"{port.get_name()}_log")
    if lyapunov is not None:
        AddLyapunovMonitor(
            builder,
            lyapunov,
            plant.GetOutputPort("state"),
            _VelocityPort(builder, plant, vehicle.velocity.start, lyapunov.dim),
            level=level,
            log_period=log_period,
        )
    if meshcat is not None:
        if not isinstance(vehicle, Quadrotor):
            raise ConfigurationError(f"Meshcat shows quadrotors only, and no {vehicle.name}")
        state = plant.GetOutputPort("state")
        AddFlightVisualization(builder, state, vehicle.parameters, meshcat)
    diagram = builder.Build()
    diagram.set_name("flight")
    return diagram


def _VelocityPort(builder: DiagramBuilder, plant: System, first: int, dim: int) -> OutputPort:
    """Returns a port with the first entries of v_WB, taken from the vehicle's state."""
    if dim not in (2, 3):
        raise ConfigurationError(
            f"a vehicle needs a Lyapunov function of dimension 2 or 3, got {dim}"
        )
    state = plant.GetOutputPort("state")
    sizes = [n for n in (first, dim, state.size() - first - dim) if n]
    parts = builder.AddNamedSystem("state_parts", Demultiplexer(sizes))
    builder.Connect(state, parts.get_input_port())
    return parts.get_output_port(1)


def SetHover(
    diagram: Diagram, context: Context, position: ArrayLike, loop: str | None = None
) -> None:
    """Sets a quadrotor to hover, level and at rest; see `SetVehicleState` for others.

    Args:
        diagram: From `MakeFlightDiagram`, or any with a `GuidanceLoop`.
        context: The Context of the diagram.
        position: p_WB of shape (3,) in m.
        loop: The name of the loop around the vehicle; None: there is only one.

    Raises:
        ConfigurationError: if the shape is wrong, if the vehicle cannot hover, or as in
            `SetVehicleState`.
        NonFiniteValueError: if the position is not finite.
    """
    p_WB = np.asarray(position, dtype=np.float64)
    if p_WB.shape != (3,):
        raise ConfigurationError(f"position must have shape (3,), got {p_WB.shape}")
    if _FindLoop(diagram, loop).GetInputPort("state").size() != STATE_SIZE:
        raise ConfigurationError("only a quadrotor hovers; set this vehicle's whole state")
    SetVehicleState(diagram, context, np.concatenate((p_WB, np.zeros(STATE_SIZE - 3))), loop)


def SetVehicleState(
    diagram: Diagram, context: Context, state: ArrayLike, loop: str | None = None
) -> None:
    """Sets the state of a vehicle, and of the motion capture that has just seen it.

    Where only the plant's state is set, whatever is logged at the start sees a vehicle at the
    origin.

    Args:
        diagram: From `MakeFlightDiagram`, or any with a `GuidanceLoop`.
        context: The Context of the diagram.
        state: That of the vehicle: (12,), as QuadrotorPlant's, or of another `Vehicle`.
        loop: The name of the loop around the vehicle; None: there is only one.

    Raises:
        ConfigurationError: if the shape is wrong, if there is no such loop, or if the diagram
            is a converted or cloned one.
        NonFiniteValueError: if the state is not finite.
    """
    values: Any = np.asarray(state, dtype=np.float64)
    found = _FindLoop(diagram, loop)
    size = found.GetInputPort("state").size()
    if values.shape != (size,):
        raise ConfigurationError(f"state must have shape ({size},), got {values.shape}")
    if not np.isfinite(values).all():
        raise NonFiniteValueError(f"the vehicle's state must be finite: {values.tolist()}")
    plant: Any = FindPlant(diagram, found)
    if hasattr(plant, "SetVehicleState"):
        plant.SetVehicleState(context, values)
    else:
        plant.GetMyMutableContextFromRoot(context).SetContinuousState(values)
    found.SetVectorState(found.GetMyMutableContextFromRoot(context), values)


def SetNoiseSeed(
    diagram: Diagram, context: Context, seed: int, loop: str | None = None
) -> None:
    """Sets the seed of a vehicle's measurements and gusts, so that a flight repeats exactly.

    Without noise it changes nothing.

    Args:
        diagram: From `MakeFlightDiagram`, or any with a `GuidanceLoop`.
        context: The Context of the diagram.
        seed: Not negative.
        loop: The name of the loop around the vehicle; None: there is only one.

    Raises:
        ConfigurationError: if there is no such loop, or if the diagram is a converted or
            cloned one.
    """
    found, generator = _FindLoop(diagram, loop), RandomGenerator(seed)
    for system in (found.motion_capture, FindPlant(diagram, found)):
        if isinstance(system, Diagram):
            DrawNoise(system, system.GetMyMutableContextFromRoot(context), generator)


def _FindLoop(diagram: Diagram, name: str | None) -> GuidanceLoop:
    """Returns the loop of this name, or the only one."""
    loops = {
        system.get_name(): system
        for system in diagram.GetSystems()
        if isinstance(system, GuidanceLoop)
    }
    if name is None and len(loops) == 1:
        name = next(iter(loops))
    if name in loops:
        return loops[name]
    if not loops:
        raise ConfigurationError(
            "the diagram has no GuidanceLoop; for a converted or cloned one, set start and "
            "seed in a Context of the diagram that was built, and take them over by "
            "SetTimeStateAndParametersFrom"
        )
    raise ConfigurationError(
        f"the diagram has the loops {', '.join(sorted(loops))}: "
        + ("say which one" if name is None else f"none is {name!r}")
    )


def FindPlant(diagram: Diagram, loop: GuidanceLoop) -> System:
    """Returns the vehicle that a loop commands.

    Raises:
        ConfigurationError: if it commands none in this diagram.
    """
    port = loop.GetOutputPort(loop.actuation).get_index()
    for (target, _), source in diagram.connection_map().items():
        if source == (loop, port) and target.HasOutputPort("state"):
            return target
    raise ConfigurationError(f"{loop.get_name()!r} commands no vehicle in this diagram")


def MakeSimulator(diagram: Any, context: Any = None, step: float = INTEGRATION_STEP) -> Any:
    """Returns a simulator with the fixed-step integrator that the results were made with.

    Args:
        diagram: From `MakeFlightDiagram` or `MakeKinematicDiagram`, or one of them in
            AutoDiffXd, for the derivatives of a simulation.
        context: Of the diagram; by default a new one.
        step: Of the integrator in s.

    Returns:
        Drake's Simulator_[T], for the diagram's scalar type T.
    """
    simulator_class = Simulator_[
        AutoDiffXd if isinstance(diagram, System_[AutoDiffXd]) else float
    ]
    simulator = simulator_class(*(arg for arg in (diagram, context) if arg is not None))
    config = SimulatorConfig(
        integration_scheme="runge_kutta3",
        max_step_size=step,
        use_error_control=False,
        # Otherwise the configuration sets the Context back to zero.
        start_time=ToFloat(simulator.get_context().get_time()),
    )
    ApplySimulatorConfig(config, simulator)
    return simulator
