"""What two hundred flights keep of a process: their memory and their time.

A diagram that is built once and whose Context is reset for every flight keeps no memory; one
that is built anew for every flight keeps what Drake and Python hold of it in cycles.
"""

import gc
import time

import numpy as np
import pandas as pd
import psutil
import pytest

from systems import MakeFlightDiagram, MakeSimulator, SetHover

from .measuring import Circle, timed

pytestmark = pytest.mark.benchmark

SAMPLE_PERIOD = 0.01

# Many flights. The first fill caches and the pools of the allocator, and the garbage
# collector takes longer than a flight, so it is not called after each.
NUM_FLIGHTS, WARM_UP, GROUP, SHORT_S = 200, 20, 10, 3.0
# What a sample of the resident memory may differ by for reasons of the operating system.
ALLOWED_GROWTH_MB = 3.0
LOGS = ("state_log", "velocity_command_log", "propeller_force_log")


def starts():
    """The same for every way to fly: hover within 0.4 m of the circle."""
    rng = np.random.default_rng(0)
    for _ in range(NUM_FLIGHTS):
        angle, radius = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.6, 1.4)
        yield np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.8, 1.2)])


def built():
    diagram = MakeFlightDiagram(Circle(), speed=0.45)
    return diagram, MakeSimulator(diagram)


def fly(diagram, simulator, start):
    """One flight in the simulator's Context, from time 0; the state at the end."""
    context = simulator.get_mutable_context()
    diagram.SetDefaultContext(context)
    context.SetTime(0.0)
    SetHover(diagram, context, start)
    for name in LOGS:
        diagram.GetSubsystemByName(name).FindMutableLog(context).Clear()
    simulator.Initialize()
    simulator.AdvanceTo(SHORT_S)
    log = diagram.GetSubsystemByName("state_log").FindLog(context)
    assert log.num_samples() == round(SHORT_S / SAMPLE_PERIOD) + 1
    return log.data()[:, -1].copy()


def measure(flights):
    """Memory and mean wall time of every group of flights, and where all flights ended."""
    rows, ends = [], []
    for number in range(GROUP, NUM_FLIGHTS + 1, GROUP):
        group, seconds = timed(lambda: [next(flights) for _ in range(GROUP)], time.perf_counter)
        ends += group
        gc.collect()
        resident_mb = psutil.Process().memory_info().rss / 1e6
        rows.append({"flight": number, "wall_s": seconds / GROUP, "resident_mb": resident_mb})
    return pd.DataFrame(rows).set_index("flight"), np.array(ends)


def test_many_flights_keep_no_memory(save):
    ways = {
        "once": (fly(*parts, start) for parts in [built()] for start in starts()),
        "anew": (fly(*built(), start) for start in starts()),
    }
    rows, all_ends = [], []
    for name, flights in ways.items():
        table, ends = measure(flights)
        all_ends.append(ends)
        late = table.loc[WARM_UP:]
        rows.append(
            {
                "built": name,
                "wall_s_median": table["wall_s"].median(),
                "wall_us_per_flight_growth": 1e6 * np.polyfit(late.index, late["wall_s"], 1)[0],
                "memory_kb_per_flight": 1e3 * np.polyfit(late.index, late["resident_mb"], 1)[0],
                "memory_mb_20_to_200": np.ptp(late["resident_mb"].iloc[[0, -1]]),
            }
        )
    summary = save(rows, "many_flights")
    # A flight knows nothing of those before it.
    np.testing.assert_array_equal(*all_ends)
    assert summary.set_index("built")["memory_mb_20_to_200"]["once"] < ALLOWED_GROWTH_MB
    assert len(np.unique(all_ends[0], axis=0)) == NUM_FLIGHTS
