"""Whole flights: put together, started from a state, and simulated."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd
from pydrake.geometry import Meshcat
from pydrake.systems.analysis import ApplySimulatorConfig, Simulator_, SimulatorConfig
from pydrake.systems.framework import (
    Context,
    Diagram,
    Diagram_,
    DiagramBuilder,
    OutputPort,
    System,
    System_,
)
from pydrake.systems.primitives import (
    Demultiplexer,
    LogVectorOutput,
    PassThrough,
    PassThrough_,
)

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.fields.base import Field, SteerableField
from systems.guidance_loop import AddGuidance
from systems.lyapunov_monitor import AddLyapunovMonitor, DifferentiableFunction
from systems.quadrotor import STATE_SIZE, VELOCITY, QuadrotorParameters
from systems.scalars import ToFloat
from systems.sensing import DEFAULT_SAMPLE_PERIOD, MotionCapture
from systems.visualization import AddFlightVisualization

INTEGRATION_STEP = 0.005
"""s; the fixed step of "runge_kutta3".  Halving it moves a flight on a circle of 1 m by less
than 1 um at 2 m/s, and by less than 10 um at 4 m/s."""


def MakeFlightDiagram(
    field: Field,
    parameters: QuadrotorParameters | None = None,
    *,
    log_period: float | None = DEFAULT_SAMPLE_PERIOD,
    lyapunov: DifferentiableFunction | None = None,
    level: float = math.inf,
    meshcat: Meshcat | None = None,
    **guidance: Any,
) -> Diagram:
    """Returns the diagram of a quadrotor that follows a guiding vector field.

    The systems are named "plant" (Drake's QuadrotorPlant), "motion_capture", "guidance"
    and "controller", and the logs (VectorLogSink) "state_log", "velocity_command_log" and
    "propeller_force_log"; see `AddGuidance`.  A log sees the commands that hold until its
    sample: at a time of sampling, those of the sample before.  The output port `state` (12)
    is the plant's.  With a "supervisor" there are the logs "mode_log" and "branch_log" too, and
    with a directed field "edge_log" and "arc_log".

    With a Lyapunov function of dimension d there is a `LyapunovMonitor` "lyapunov" of the
    vehicle's first d coordinates, and the logs "V_log" and "V_dot_log".  It watches the true
    state, not the sampled one; see `StopOnExit` for what it can end.

    See `SetHover` for the start and `MakeSimulator` for the simulation.

    Args:
        field: The guiding field, of dimension 2 or 3, in metres.
        parameters: The vehicle; by default the paper's.
        log_period: Of the logs in s; 0 logs every step, and None leaves the logs out.
        lyapunov: A Lyapunov function V of dimension 2 or 3; None: there is no monitor.
        level: Of the sublevel set of V that is watched.
        meshcat: Shows the flight; see `AddFlightVisualization`.  The diagram can then not be
            converted to AutoDiffXd.
        **guidance: `speed`, `altitude`, `sample_period`, `feedforward`, `saturate`, `sensors`
            and `supervisor` as in `AddGuidance`.

    Raises:
        ConfigurationError: if an argument cannot be used.
    """
    parameters = parameters or QuadrotorParameters()
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", parameters.MakePlant())
    parts = AddGuidance(builder, field, plant, parameters, **guidance)
    builder.ExportOutput(plant.GetOutputPort("state"), "state")
    if log_period is not None:
        logged = [
            plant.GetOutputPort("state"),
            parts.velocity_command,
            parts.controller.GetOutputPort("propeller_force"),
        ]
        if parts.supervisor is not None:
            names = ["mode", "branch"]
            names += ["edge", "arc"] if isinstance(field, SteerableField) else []
            logged += [parts.supervisor.GetOutputPort(name) for name in names]
        for port in logged:
            LogVectorOutput(port, builder, log_period).set_name(f"{port.get_name()}_log")
    if lyapunov is not None:
        AddLyapunovMonitor(
            builder,
            lyapunov,
            plant.GetOutputPort("state"),
            _VelocityPort(builder, plant, lyapunov.dim),
            level=level,
            log_period=log_period,
        )
    if meshcat is not None:
        AddFlightVisualization(builder, plant.GetOutputPort("state"), parameters, meshcat)
    diagram = builder.Build()
    diagram.set_name("flight")
    return diagram


def _VelocityPort(builder: DiagramBuilder, plant: System, dim: int) -> OutputPort:
    """Returns a port with the first entries of v_WB, taken from the vehicle's state."""
    if dim not in (2, 3):
        raise ConfigurationError(
            f"a vehicle needs a Lyapunov function of dimension 2 or 3, got {dim}"
        )
    sizes = [VELOCITY.start, dim, STATE_SIZE - VELOCITY.start - dim]
    parts = builder.AddNamedSystem("state_parts", Demultiplexer(sizes))
    builder.Connect(plant.GetOutputPort("state"), parts.get_input_port())
    return parts.get_output_port(1)


def SetHover(diagram: Diagram, context: Context, position: ArrayLike) -> None:
    """Sets a flight to hover, level and at rest.

    Args:
        diagram: From `MakeFlightDiagram`, or any with systems "plant" and "motion_capture".
        context: The Context of the diagram.
        position: p_WB of shape (3,) in m.

    Raises:
        ConfigurationError: if the shape is wrong.
        NonFiniteValueError: if the position is not finite.
    """
    p_WB = np.asarray(position, dtype=np.float64)
    if p_WB.shape != (3,):
        raise ConfigurationError(f"position must have shape (3,), got {p_WB.shape}")
    SetVehicleState(diagram, context, np.concatenate((p_WB, np.zeros(STATE_SIZE - 3))))


def SetVehicleState(diagram: Diagram, context: Context, state: ArrayLike) -> None:
    """Sets the state of the vehicle, and of the motion capture that has just seen it.

    Args:
        diagram: From `MakeFlightDiagram`, or any with systems "plant" and "motion_capture".
        context: The Context of the diagram.
        state: The state (12,), as QuadrotorPlant's.

    Raises:
        ConfigurationError: if the shape is wrong, or the diagram is a converted or cloned one
            with sensors.
        NonFiniteValueError: if the state is not finite.
    """
    values: Any = np.asarray(state, dtype=np.float64)
    if values.shape != (STATE_SIZE,):
        raise ConfigurationError(f"state must have shape ({STATE_SIZE},), got {values.shape}")
    if not np.isfinite(values).all():
        raise NonFiniteValueError(f"the vehicle's state must be finite: {values.tolist()}")
    plant = diagram.GetSubsystemByName("plant")
    plant.GetMyMutableContextFromRoot(context).SetContinuousState(values)
    capture: Any = diagram.GetSubsystemByName("motion_capture")
    if isinstance(capture, (PassThrough, PassThrough_[AutoDiffXd])):
        return
    _CheckBuilt(capture)
    capture.SetVectorState(capture.GetMyMutableContextFromRoot(context), values)


def SetNoiseSeed(diagram: Diagram, context: Context, seed: int) -> None:
    """Sets the seed of a flight's measurements, so that it repeats exactly.

    Measurements without noise need none, and take none.

    Args:
        diagram: From `MakeFlightDiagram`, or any with a system "motion_capture".
        context: The Context of the diagram.
        seed: Not negative.

    Raises:
        ConfigurationError: if the diagram is a converted or cloned one with sensors.
    """
    capture: Any = diagram.GetSubsystemByName("motion_capture")
    _CheckBuilt(capture)
    if isinstance(capture, MotionCapture):
        capture.SetNoiseSeed(capture.GetMyMutableContextFromRoot(context), seed)


def _CheckBuilt(capture: Any) -> None:
    """Raises ConfigurationError on what Drake has made of a `MotionCapture`."""
    if isinstance(capture, (Diagram, Diagram_[AutoDiffXd])) and not isinstance(
        capture, MotionCapture
    ):
        raise ConfigurationError(
            "converted or cloned sensors have no start and no seed to set: set them in a "
            "Context of the diagram that was built, and take them over by "
            "SetTimeStateAndParametersFrom"
        )


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
