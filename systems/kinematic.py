"""Agents that move exactly as the field says: the paper's single integrators."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.systems.framework import (
    BasicVector_,
    Context,
    Diagram,
    DiagramBuilder,
    LeafSystem_,
)
from pydrake.systems.primitives import Integrator, LogVectorOutput

from sgvf_drake.exceptions import ConfigurationError, NonFiniteValueError
from sgvf_drake.fields.base import Field, MotionField
from sgvf_drake.paths.navigator import Navigator
from systems.lyapunov_monitor import AddLyapunovMonitor, DifferentiableFunction
from systems.navigation import RouteNavigator
from systems.scalars import (
    CheckFiniteAgents,
    CheckNonNegativeParameter,
    EvalFieldValue,
    Scalar,
    template,
)

DEFAULT_NAVIGATION_PERIOD = 0.01
"""s; at unit speed and a noise level of a tenth, agents are looked at ten times in it."""


@template
def KinematicGuidance_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Moves n agents along a guiding vector field with one call of the field.

        .. pydrake_system::

            name: KinematicGuidance
            input_ports:
            - positions
            output_ports:
            - velocities

        `positions` (n d) holds the n positions one after the other, in the field's unit of
        length; `velocities` (n d) holds speed m(p) for each in the same order.

        With the motion of a directed field (`DirectedField.with_memory`), of dimension d, a
        position is one of d / 2 coordinates and as many of the agent's heading.  The headings
        turn to a further input, `intended_directions` (n d / 2), or, where such a direction is
        zero or the port is not connected, to the tangent of the strand that is followed.

        The one numeric parameter (index `parameter_index`) is the speed.

        Args:
            field: The guiding field, of any dimension d, or a motion.
            num_agents: n.
            speed: In the field's unit of length per second.

        Raises:
            ConfigurationError: if an argument cannot be used.
            NonFiniteValueError: on evaluation, where a position or a velocity is not
                finite; the message names the agent.
        """

        def _construct(
            self,
            field: Field,
            num_agents: int = 1,
            speed: float = 1.0,
        ) -> None:
            if num_agents < 1:
                raise ConfigurationError(f"num_agents must be at least 1, got {num_agents}")
            CheckNonNegativeParameter("speed", speed)
            self._field: Any = field
            # One agent is asked for as a point: a field may be faster without a batch.
            self._shape = (field.dim,) if num_agents == 1 else (num_agents, field.dim)
            size = num_agents * field.dim
            self._positions = self.DeclareVectorInputPort("positions", size)
            self._intended: Any = None
            if isinstance(field, MotionField):
                self._intended = self.DeclareVectorInputPort("intended_directions", size // 2)
            self.parameter_index = self.DeclareNumericParameter(BasicVector_[T]([speed]))
            self._velocities = self.DeclareVectorOutputPort(
                "velocities",
                size,
                self._CalcVelocities,
                {self.all_input_ports_ticket(), self.all_parameters_ticket()},
            )

        @property
        def num_agents(self) -> int:
            """The number of agents n."""
            return 1 if len(self._shape) == 1 else self._shape[0]

        def GetSpeed(self, context: Any) -> Scalar:
            """Returns the speed in units of length per second."""
            return context.get_numeric_parameter(self.parameter_index).GetAtIndex(0)

        def SetSpeed(self, context: Any, speed: Scalar) -> None:
            """Sets the speed; this system's own Context is wanted."""
            CheckNonNegativeParameter("speed", speed)
            context.get_mutable_numeric_parameter(self.parameter_index).SetAtIndex(0, speed)

        def _CalcVelocities(self, context: Any, output: Any) -> None:
            positions = self._positions.Eval(context).reshape(self._shape)
            self._CheckAgents(context, "the position", positions)
            rates = EvalFieldValue(self._field, positions)
            if self._intended is not None and self._intended.HasValue(context):
                self._TurnToIntended(context, positions, rates)
            velocities = self.GetSpeed(context) * rates
            self._CheckAgents(context, "the velocity", velocities)
            output.SetFromVector(velocities.reshape(-1))

        def _TurnToIntended(
            self, context: Any, positions: np.ndarray, rates: np.ndarray
        ) -> None:
            """Changes the rates of the headings that have a direction to turn to."""
            d = self._field.dim // 2
            intended = self._intended.Eval(context).reshape(*self._shape[:-1], d)
            self._CheckAgents(context, "the intended direction", intended)
            given = (intended != 0).any(axis=-1, keepdims=True)
            turns = (intended - positions[..., d:]) / self._field.memory_length
            rates[..., d:] = np.where(given, turns, rates[..., d:])

        def _CheckAgents(self, context: Any, quantity: str, values: np.ndarray) -> None:
            CheckFiniteAgents(self, context, quantity, values.reshape(self.num_agents, -1))

    return Impl


KinematicGuidance = KinematicGuidance_[None]


def MakeKinematicDiagram(
    field: Field,
    num_agents: int = 1,
    speed: float = 1.0,
    log_period: float | None = None,
    *,
    lyapunov: DifferentiableFunction | None = None,
    level: float = math.inf,
    navigator: Navigator | None = None,
    navigation_period: float = DEFAULT_NAVIGATION_PERIOD,
) -> Diagram:
    """Returns a diagram of n agents with dp/dt = speed m(p) (paper, equation 3).

    The state and the output port `positions` (n d) hold the positions one after the other,
    in the field's unit of length.  The systems are named "agents" (Drake's Integrator) and
    "guidance" (`KinematicGuidance`); see `SetPositions` for the start.  With a Lyapunov
    function there is a `LyapunovMonitor` "lyapunov"; see `StopOnExit` for what it can end.

    Args:
        field: The guiding field, of any dimension d.
        num_agents: n.
        speed: In the field's unit of length per second.
        log_period: Of the VectorLogSink "positions_log" in s, and with a Lyapunov function
            of "V_log" and "V_dot_log"; 0 logs every step, and None leaves the logs out.
        lyapunov: A Lyapunov function V of dimension d; None: there is no monitor.
        level: Of the sublevel set of V that is watched.
        navigator: With the motion of a directed field: what tells the agents where to go, by a
            `RouteNavigator` "navigator"; None: they go straight on.
        navigation_period: Of that system, in s.

    Raises:
        ConfigurationError: if an argument cannot be used.
    """
    builder = DiagramBuilder()
    guidance = builder.AddNamedSystem("guidance", KinematicGuidance(field, num_agents, speed))
    agents = builder.AddNamedSystem("agents", Integrator(num_agents * field.dim))
    builder.Connect(agents.get_output_port(), guidance.GetInputPort("positions"))
    builder.Connect(guidance.GetOutputPort("velocities"), agents.get_input_port())
    builder.ExportOutput(agents.get_output_port(), "positions")
    if navigator is not None:
        if not isinstance(field, MotionField):
            raise ConfigurationError("only the motion of a directed field is navigated")
        route = builder.AddNamedSystem(
            "navigator", RouteNavigator(navigator, num_agents, navigation_period)
        )
        builder.Connect(agents.get_output_port(), route.GetInputPort("positions"))
        builder.Connect(
            route.GetOutputPort("intended_directions"),
            guidance.GetInputPort("intended_directions"),
        )
    if log_period is not None:
        LogVectorOutput(agents.get_output_port(), builder, log_period).set_name("positions_log")
    if lyapunov is not None:
        AddLyapunovMonitor(
            builder,
            lyapunov,
            agents.get_output_port(),
            guidance.GetOutputPort("velocities"),
            num_agents=num_agents,
            level=level,
            log_period=log_period,
        )
    diagram = builder.Build()
    diagram.set_name("kinematic")
    return diagram


def SetPositions(diagram: Diagram, context: Context, positions: ArrayLike) -> None:
    """Sets the positions of the agents of a kinematic diagram.

    Args:
        diagram: From `MakeKinematicDiagram`.
        context: The Context of the diagram.
        positions: Of shape (n, d), or (d,) for one agent, in the field's unit of length.

    Raises:
        ConfigurationError: if the shape is wrong.
        NonFiniteValueError: if a position is not finite.
    """
    values: Any = np.asarray(positions, dtype=np.float64)
    agents = diagram.GetSubsystemByName("agents")
    guidance: Any = diagram.GetSubsystemByName("guidance")
    shape = (guidance.num_agents, context.num_continuous_states() // guidance.num_agents)
    if values.shape != shape and (shape[0] != 1 or values.shape != shape[1:]):
        raise ConfigurationError(f"positions must have shape {shape}, got {values.shape}")
    if not np.isfinite(values).all():
        raise NonFiniteValueError(f"positions must be finite, got {values.tolist()}")
    agents.GetMyMutableContextFromRoot(context).SetContinuousState(values.reshape(-1))
