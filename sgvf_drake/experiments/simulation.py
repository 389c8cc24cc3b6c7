"""Advance a Drake simulation and tell how far it is."""

import time

from pydrake.systems.analysis import Simulator

from sgvf_drake.progress import Progress

# Reports of one simulation.
REPORTS = 100


def advance(
    simulator: Simulator, duration: float, period: float, stage: str, progress: Progress
) -> float:
    """Advances a simulation from time zero; returns its wall time in seconds.

    Args:
        simulator: The simulator.
        duration: Time to advance to, seconds.
        period: A period at which the simulation has events anyway, seconds.  It is stopped
            only at multiples of it, so that reporting changes no step of the integrator.
        stage: What to call it.
        progress: Told how far it is.
    """
    samples = max(1, int(duration / period / REPORTS))
    begin = time.perf_counter()
    for index in range(1, int(duration / period / samples) + 1):
        simulator.AdvanceTo(index * samples * period)
        progress(stage, index * samples * period, duration)
    simulator.AdvanceTo(duration)
    progress(stage, duration, duration)
    return time.perf_counter() - begin
