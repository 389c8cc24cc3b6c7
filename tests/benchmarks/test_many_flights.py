"""Two hundred flights in one process: memory and time of each.

A diagram that is built once and whose Context is reset for every flight keeps no memory; one
that is built anew for every flight keeps what Drake and Python hold of it in cycles.
"""

from collections.abc import Callable, Iterator
import gc
import time

import numpy as np
import pandas as pd
import psutil
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Diagram
import pytest

from systems import MakeFlightDiagram, MakeSimulator, SetHover

pytestmark = pytest.mark.benchmark

Save = Callable[[pd.DataFrame, str], None]
NUM_FLIGHTS = 200
SIMULATED_S = 3.0
SPEED = 0.45
# The garbage collector takes longer than a flight, so it is not called after each.
GROUP = 10
# The first flights fill caches and the pools of the allocator.
WARM_UP = 20
# What a sample of the resident memory may differ by for reasons of the operating system.
ALLOWED_GROWTH_MB = 3.0
LOGS = ("state_log", "velocity_command_log", "propeller_force_log")


class Orbit:
    """A field of length one around the unit circle: a flight without a network."""

    dim = 2

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return self.value_and_jacobian(x)[0]

    def value_and_jacobian(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = np.hypot(*x)
        n = x / r
        t = np.array([-n[1], n[0]])
        z = 2.0 * (1.0 - r)
        c = 1.0 / np.sqrt(1.0 + z * z)
        s = z * c
        return s * n + c * t, np.outer(s * t - c * n, 2.0 * c * c * n + t / r)

    def hessian(self, x: np.ndarray) -> np.ndarray:
        raise NotImplementedError


def resident_mb() -> float:
    gc.collect()
    return psutil.Process().memory_info().rss / 1e6


def starts() -> Iterator[np.ndarray]:
    """The same for every way to fly: hover within 0.4 m of the circle."""
    rng = np.random.default_rng(0)
    for _ in range(NUM_FLIGHTS):
        angle, radius = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.6, 1.4)
        yield np.array([radius * np.cos(angle), radius * np.sin(angle), rng.uniform(0.8, 1.2)])


def fly(diagram: Diagram, simulator: Simulator, start: np.ndarray) -> np.ndarray:
    """One flight in the simulator's Context, from time 0; the state at the end."""
    context = simulator.get_mutable_context()
    diagram.SetDefaultContext(context)
    context.SetTime(0.0)
    SetHover(diagram, context, start)
    for name in LOGS:
        diagram.GetSubsystemByName(name).FindMutableLog(context).Clear()
    simulator.Initialize()
    simulator.AdvanceTo(SIMULATED_S)
    log = diagram.GetSubsystemByName("state_log").FindLog(context)
    assert log.num_samples() == round(SIMULATED_S / 0.01) + 1
    return log.data()[:, -1].copy()


def built_once() -> Iterator[np.ndarray]:
    diagram = MakeFlightDiagram(Orbit(), speed=SPEED)
    simulator = MakeSimulator(diagram)
    for start in starts():
        yield fly(diagram, simulator, start)


def built_anew() -> Iterator[np.ndarray]:
    for start in starts():
        diagram = MakeFlightDiagram(Orbit(), speed=SPEED)
        yield fly(diagram, MakeSimulator(diagram), start)


def measure(flights: Iterator[np.ndarray]) -> tuple[pd.DataFrame, np.ndarray]:
    """Memory and mean wall time of every group of flights, and where all flights ended."""
    rows, ends = [], []
    begin = time.perf_counter()
    for number, end in enumerate(flights, start=1):
        ends.append(end)
        if number % GROUP == 0:
            wall = (time.perf_counter() - begin) / GROUP
            rows.append({"flight": number, "wall_s": wall, "resident_mb": resident_mb()})
            begin = time.perf_counter()
    return pd.DataFrame(rows), np.array(ends)


def slope(table: pd.DataFrame, column: str) -> float:
    """By which a column grows from flight to flight after the warm-up."""
    late = table[table["flight"] >= WARM_UP]
    return float(np.polyfit(late["flight"], late[column], 1)[0])


def test_many_flights_keep_no_memory(save: Save) -> None:
    once, ends_once = measure(built_once())
    anew, ends_anew = measure(built_anew())
    groups = pd.concat({"once": once, "anew": anew}, names=["built"]).reset_index(0)
    save(groups, "many_flights_groups")
    rows = []
    for name, table in (("once", once), ("anew", anew)):
        memory = table.set_index("flight")["resident_mb"]
        rows.append(
            {
                "built": name,
                "flights": NUM_FLIGHTS,
                "simulated_s": SIMULATED_S,
                "wall_s_median": table["wall_s"].median(),
                "wall_us_per_flight_growth": 1e6 * slope(table, "wall_s"),
                "memory_kb_per_flight": 1e3 * slope(table, "resident_mb"),
                "memory_mb_20_to_200": memory[NUM_FLIGHTS] - memory[WARM_UP],
            }
        )
    summary = pd.DataFrame(rows)
    save(summary, "many_flights")
    # A flight knows nothing of those before it.
    np.testing.assert_array_equal(ends_once, ends_anew)
    growth = summary.set_index("built")["memory_mb_20_to_200"]
    assert growth["once"] < ALLOWED_GROWTH_MB
    assert len(np.unique(ends_once, axis=0)) == NUM_FLIGHTS
