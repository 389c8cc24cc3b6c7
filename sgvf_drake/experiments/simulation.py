"""Advance a Drake simulation, tell how far it is, and read its logs; agents in a field."""

import time
from typing import Any

from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import Context, Diagram

from sgvf_drake.arrays import FloatArray
from sgvf_drake.fields import Field
from sgvf_drake.progress import Progress, no_progress
from systems import MakeKinematicDiagram, MakeSimulator, SetPositions

# Reports of one simulation.
REPORTS = 100

_REACHED_TERMINATION = SimulatorStatus.ReturnReason.kReachedTerminationCondition


def advance(
    simulator: Simulator, duration: float, period: float, stage: str, progress: Progress
) -> float:
    """Advances a simulation from time zero; returns its wall time in seconds.

    A simulation that a monitor ends, as `systems.StopOnExit` does, is not taken further; the
    time of its Context tells how far it came, and progress is told no more.

    Args:
        simulator: The simulator.
        duration: Time to advance to, seconds.
        period: A period at which the simulation has events anyway, seconds.  It is stopped
            only at multiples of it, so that reporting changes no step of the integrator.
        stage: What to call it.
        progress: Is told how far it is.
    """
    samples = max(1, int(duration / period / REPORTS))
    stops = [
        index * samples * period for index in range(1, int(duration / period / samples) + 1)
    ]
    begin = time.perf_counter()
    for stop in (*stops, duration):
        if simulator.AdvanceTo(stop).reason() == _REACHED_TERMINATION:
            break
        progress(stage, stop, duration)
    return time.perf_counter() - begin


def read_log(diagram: Diagram, context: Context, name: str) -> tuple[FloatArray, FloatArray]:
    """Returns the times (T,) and the values (T, k) of a VectorLogSink in a diagram."""
    sink: Any = diagram.GetSubsystemByName(name)
    log = sink.FindLog(context)
    return log.sample_times().copy(), log.data().T.copy()


def simulate_agents(
    field: Field,
    starts: FloatArray,
    unit_length: float,
    *,
    way: float,
    step: float,
    log_period: float,
    progress: Progress = no_progress,
    **navigation: Any,
) -> tuple[FloatArray, FloatArray, float]:
    """Simulates kinematic agents that travel one U a second where |m| is one.

    The steps of the simulation therefore fit a path in millimetres as well as one in
    kilometres.

    Args:
        field: The field.
        starts: (n, k) states.
        unit_length: U in the unit of the field.
        way: How far they would get at full speed, U.
        step: Of the integrator, U at full speed.
        log_period: Between two samples, U at full speed.
        progress: Is told how far the simulation is.
        **navigation: `navigator` and `navigation_period` of `MakeKinematicDiagram`.

    Returns:
        The ways (T,) at full speed until each sample, U; the states (T, n, k); and the wall
        time of the simulation, seconds.

    Raises:
        NonFiniteValueError: If the field is not finite somewhere on the way.
    """
    diagram = MakeKinematicDiagram(
        field, len(starts), speed=unit_length, log_period=log_period, **navigation
    )
    simulator = MakeSimulator(diagram, step=step)
    context = simulator.get_mutable_context()
    SetPositions(diagram, context, starts)
    wall_s = advance(simulator, way, log_period, "follow", progress)
    times, states = read_log(diagram, context, "positions_log")
    return times, states.reshape(-1, *starts.shape), wall_s
