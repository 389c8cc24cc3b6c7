"""End a simulation when an agent leaves a sublevel set that should be invariant."""

from typing import Any, NamedTuple

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context, EventStatus, System

from sgvf_drake.arrays import FloatArray


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
