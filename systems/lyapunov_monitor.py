"""A Lyapunov function watched along a simulation, which can end where a level is crossed."""

import math
from typing import Any, NamedTuple, Protocol

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import (
    BasicVector_,
    Context,
    DiagramBuilder,
    EventStatus,
    LeafSystem_,
    OutputPort,
    System,
)
from pydrake.systems.primitives import LogVectorOutput

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError
from systems.scalars import (
    CheckFiniteAgents,
    Join,
    Scalar,
    Split,
    ToFloat,
    template,
)


class DifferentiableFunction(Protocol):
    """A function V: R^d -> R; `sgvf_drake.lyapunov.LyapunovFunction` is one."""

    @property
    def dim(self) -> int:
        """The dimension d of the space."""

    def __call__(self, x: FloatArray) -> FloatArray:
        """Returns V: (n, d) -> (n,)."""

    def gradient(self, x: FloatArray) -> FloatArray:
        """Returns grad V: (n, d) -> (n, d)."""

    def gradient_and_hessian(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Returns grad V (n, d) and its Jacobian (n, d, d); only needed under AutoDiffXd."""


@template
def LyapunovMonitor_(T: type) -> Any:  # noqa: D103 (the class below says it)
    class Impl(LeafSystem_[T]):
        """Evaluates a Lyapunov function V along the motion of n agents.

        .. pydrake_system::

            name: LyapunovMonitor
            input_ports:
            - state
            - velocity
            output_ports:
            - V
            - V_dot
            - margin

        `state` (n state_size) holds the states of the n agents one after the other; the
        first d entries of each are the position, in the unit of length of V.  That suits
        agents whose state is their position, and QuadrotorPlant (state_size 12).

        `velocity` (n d) holds the rates of the positions in the same order, per second.

        `V` (n) is V(p), without a unit.  `V_dot` (n) is grad V(p) . velocity in 1/s
        (paper, Lemma 1).  `margin` (n) is level - V: an agent is in the sublevel set
        {V <= level} as long as it is not negative.

        The one numeric parameter (index `parameter_index`) holds the level; see `SetLevel`.
        All outputs are direct feed-through.  V and V_dot do not share an evaluation: V
        alone, which `StopOnExit` reads after every step, costs half of both or less.

        Args:
            function: V, of any dimension d.
            num_agents: n.
            level: Of the sublevel set that is watched; infinity for the whole space.
            state_size: Of one agent; d by default.

        Raises:
            ConfigurationError: if an argument cannot be used.
            NonFiniteValueError: on evaluation, where a position, a velocity, V or V_dot is
                not finite; the message names the agent.
        """

        def _construct(
            self,
            function: DifferentiableFunction,
            num_agents: int = 1,
            level: float = math.inf,
            state_size: int | None = None,
        ) -> None:
            dim = function.dim
            state_size = dim if state_size is None else state_size
            if num_agents < 1:
                raise ConfigurationError(f"num_agents must be at least 1, got {num_agents}")
            if state_size < dim:
                raise ConfigurationError(
                    f"state_size must be at least the dimension {dim}, got {state_size}"
                )
            _CheckLevel(level)
            self._function = function
            self._num_agents = num_agents
            self._state = self.DeclareVectorInputPort("state", num_agents * state_size)
            self._velocity = self.DeclareVectorInputPort("velocity", num_agents * dim)
            self.parameter_index = self.DeclareNumericParameter(BasicVector_[T]([level]))
            # Named one by one: the defaults take in the time, and every input for V.
            state, velocity = (
                self.input_port_ticket(port.get_index())
                for port in (self._state, self._velocity)
            )
            self._V = self.DeclareVectorOutputPort("V", num_agents, self._CalcV, {state})
            self.DeclareVectorOutputPort("V_dot", num_agents, self._CalcVDot, {state, velocity})
            self.DeclareVectorOutputPort(
                "margin", num_agents, self._CalcMargin, {state, self.all_parameters_ticket()}
            )

        @property
        def function(self) -> DifferentiableFunction:
            """The function V."""
            return self._function

        @property
        def num_agents(self) -> int:
            """The number of agents n."""
            return self._num_agents

        def GetLevel(self, context: Any) -> Scalar:
            """Returns the level."""
            return context.get_numeric_parameter(self.parameter_index).GetAtIndex(0)

        def SetLevel(self, context: Any, level: Scalar) -> None:
            """Sets the level; this system's own Context is wanted."""
            _CheckLevel(level)
            context.get_mutable_numeric_parameter(self.parameter_index).SetAtIndex(0, level)

        def EvalPositions(self, context: Any) -> np.ndarray:
            """Returns the positions of the agents, (n, d), in the unit of length of V."""
            states = self._state.Eval(context).reshape(self._num_agents, -1)
            return states[:, : self._function.dim]

        def _EvalCheckedPositions(self, context: Any) -> np.ndarray:
            positions = self.EvalPositions(context)
            CheckFiniteAgents(self, context, "the position", positions)
            return positions

        def _CalcV(self, context: Any, output: Any) -> None:
            V = _EvalFunction(self._function, self._EvalCheckedPositions(context))
            CheckFiniteAgents(self, context, "V", V)
            output.SetFromVector(V)

        def _CalcVDot(self, context: Any, output: Any) -> None:
            positions = self._EvalCheckedPositions(context)
            velocities = self._velocity.Eval(context).reshape(positions.shape)
            CheckFiniteAgents(self, context, "the velocity", velocities)
            V_dot = _EvalRate(self._function, positions, velocities)
            CheckFiniteAgents(self, context, "V_dot", V_dot)
            output.SetFromVector(V_dot)

        def _CalcMargin(self, context: Any, output: Any) -> None:
            output.SetFromVector(self.GetLevel(context) - self._V.Eval(context))

    return Impl


LyapunovMonitor = LyapunovMonitor_[None]


def AddLyapunovMonitor(
    builder: DiagramBuilder,
    function: DifferentiableFunction,
    state_port: OutputPort,
    velocity_port: OutputPort,
    *,
    num_agents: int = 1,
    level: float = math.inf,
    log_period: float | None = None,
) -> Any:
    """Adds a `LyapunovMonitor` named "lyapunov" to a diagram, and logs of V and V_dot.

    Args:
        builder: Is changed.
        function: V, of dimension d.
        state_port: The states of the agents (n state_size), which start with the positions.
        velocity_port: The rates of the positions (n d).
        num_agents: n.
        level: Of the sublevel set that is watched.
        log_period: Of the VectorLogSinks "V_log" and "V_dot_log" in s; 0 logs every step,
            and None leaves the logs out.

    Returns:
        The `LyapunovMonitor`, connected to the ports.

    Raises:
        ConfigurationError: if an argument cannot be used, or the ports do not fit.
    """
    state_size, rest = divmod(state_port.size(), max(num_agents, 1))
    if rest or velocity_port.size() != num_agents * function.dim:
        raise ConfigurationError(
            f"{num_agents} agents in {function.dim} dimensions do not fit a state of size "
            f"{state_port.size()} and a velocity of size {velocity_port.size()}"
        )
    monitor = builder.AddNamedSystem(
        "lyapunov", LyapunovMonitor(function, num_agents, level, state_size)
    )
    builder.Connect(state_port, monitor.GetInputPort("state"))
    builder.Connect(velocity_port, monitor.GetInputPort("velocity"))
    if log_period is not None:
        for name in ("V", "V_dot"):
            port = monitor.GetOutputPort(name)
            LogVectorOutput(port, builder, log_period).set_name(f"{name}_log")
    return monitor


class SublevelExit(NamedTuple):
    """Where and when an agent left a sublevel set {V <= level}.

    Attributes:
        agent: Its number.
        time: In s, at the end of the first step that ended outside.
        time_inside: In s, at the beginning of that step: the crossing lies between the two.
        position: At `time`, (d,) in the unit of length of V.
        V: At `time`.
        level: The level that was crossed.
    """

    agent: int
    time: float
    time_inside: float
    position: FloatArray
    V: float
    level: float

    def __str__(self) -> str:
        return (
            f"agent {self.agent} left the sublevel set V <= {self.level:.6g} at "
            f"t = {self.time:.6g} s: V = {self.V:.6g} at {self.position.tolist()}"
        )


class ExitWatch:
    """What `StopOnExit` gives to a simulator; called with the root Context of each step.

    Attributes:
        exit: The exit that ended the simulation; None: there was none so far.
    """

    def __init__(self, monitor: Any) -> None:
        self.exit: SublevelExit | None = None
        self._monitor = monitor
        self._inside = np.zeros(monitor.num_agents, bool)
        self._level: float | None = None
        self._time = -np.inf

    def __call__(self, root_context: Context) -> EventStatus | None:
        """Returns that termination was reached once an agent has left; see `StopOnExit`."""
        context = self._monitor.GetMyContextFromRoot(root_context)
        if self.exit is None:
            self.exit = self._FindExit(context)
        if self.exit is None:
            return None
        return EventStatus.ReachedTermination(self._monitor, str(self.exit))

    def _FindExit(self, context: Context) -> SublevelExit | None:
        level, time = self._monitor.GetLevel(context), context.get_time()
        margin = self._monitor.GetOutputPort("margin").Eval(context)
        inside = margin >= 0.0
        # An agent has not left a set that was another one before.
        left = self._inside & ~inside if level == self._level else np.zeros_like(inside)
        time_inside = self._time
        self._inside, self._level, self._time = inside, level, time
        if not left.any():
            return None
        agent = int(np.argmin(np.where(left, margin, np.inf)))
        return SublevelExit(
            agent,
            time,
            time_inside,
            self._monitor.EvalPositions(context)[agent].copy(),
            float(self._monitor.GetOutputPort("V").Eval(context)[agent]),
            level,
        )


def StopOnExit(simulator: Simulator, monitor: System | None = None) -> ExitWatch:
    """Lets a simulation end when an agent leaves the sublevel set of a `LyapunovMonitor`.

    ``AdvanceTo`` then returns early, with a status whose reason is
    ``kReachedTerminationCondition`` and whose message says who left, where and when.
    A trajectory that starts outside has to enter first.  Of several that leave in one step,
    the one farthest outside is reported.

    Drake calls a simulator's monitor after each step, so the simulation ends within one step
    of the crossing.  What ended stays ended: every later ``AdvanceTo`` returns after one step.
    For another run, call this again.

    Args:
        simulator: Its monitor is set; one that it had is replaced.
        monitor: The `LyapunovMonitor`; by default the subsystem "lyapunov".

    Returns:
        The watch, whose `exit` says where and when.
    """
    if monitor is None:
        diagram: Any = simulator.get_system()
        monitor = diagram.GetSubsystemByName("lyapunov")
    watch = ExitWatch(monitor)
    simulator.set_monitor(watch)
    return watch


def _CheckLevel(level: Scalar) -> None:
    if math.isnan(ToFloat(level)):
        raise ConfigurationError(f"level must be a number or infinite, got {level}")


def _EvalFunction(function: DifferentiableFunction, x: np.ndarray) -> np.ndarray:
    """Returns V(x) of shape (n,) in the scalar type of x (n, d)."""
    if x.dtype != object:
        return function(x)
    values, dx = Split(x)
    return Join(function(values), np.einsum("ni,nik->nk", function.gradient(values), dx))


def _EvalRate(function: DifferentiableFunction, x: np.ndarray, x_dot: np.ndarray) -> np.ndarray:
    """Returns grad V(x) . x_dot of shape (n,) in the scalar type of x and x_dot (n, d).

    With the Hessian H of V, its gradient is (H x_dot) . dx + grad V . dx_dot.
    """
    if x.dtype != object:
        return np.asarray((function.gradient(x) * x_dot).sum(axis=1))
    # Together, because one of them may be a constant, whose gradient has another size.
    (x, x_dot), (dx, dx_dot) = Split(np.stack((x, x_dot)))
    gradient, H = function.gradient_and_hessian(x)
    by_position = np.einsum("nij,nj,nik->nk", H, x_dot, dx)
    by_velocity = np.einsum("ni,nik->nk", gradient, dx_dot)
    return Join((gradient * x_dot).sum(axis=1), by_position + by_velocity)
