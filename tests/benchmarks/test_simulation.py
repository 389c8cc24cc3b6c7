"""How fast flights are simulated and where the time goes; what two hundred of them keep.

The real-time factor is that of the same plant, motion capture, logs and integrator, with one of
these in the place of guidance and controller:

- learned field: what users fly;
- empty: the ports of both, and as little Python behind them as can be: the ceiling of any
  controller in Python;
- no Python: a constant force from Drake's own source: the ceiling of the simulation.

A diagram that is built once and whose Context is reset for every flight keeps no memory; one
that is built anew for every flight keeps what Drake and Python hold of it in cycles.
"""

import gc
import time

import numpy as np
import pandas as pd
import psutil
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, ZeroOrderHold
import pytest

from systems import (
    MakeFlightDiagram,
    MakeSimulator,
    QuadrotorParameters,
    SetHover,
)

from .measuring import Circle, best_of, timed

pytestmark = pytest.mark.benchmark

SAMPLE_PERIOD = 0.01
SIMULATED_S = 30.0
START = (1.25, 0.0, 1.0)
HOVER = np.full(4, QuadrotorParameters().hover_force)


class EmptyController(LeafSystem):
    """The ports of guidance and controller, and as little Python behind them as can be."""

    def __init__(self):
        super().__init__()
        self._state = self.DeclareVectorInputPort("state", 12)
        source = {self.input_port_ticket(self._state.get_index())}
        self.DeclareVectorOutputPort("velocity_command", 3, self._calc_command, source)
        self.DeclareVectorOutputPort("propeller_force", 4, self._calc_force, source)

    def _calc_command(self, context, output):
        output.SetFromVector(self._state.Eval(context)[6:9])

    def _calc_force(self, context, output):
        self._state.Eval(context)
        output.SetFromVector(HOVER)


def make_ceiling_diagram(in_python):
    """The flight diagram without guidance and controller: same plant, hold and logs."""
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", QuadrotorParameters().MakePlant())
    hold = builder.AddSystem(ZeroOrderHold(SAMPLE_PERIOD, 12))
    builder.Connect(plant.GetOutputPort("state"), hold.get_input_port())
    if in_python:
        controller = builder.AddSystem(EmptyController())
        builder.Connect(hold.get_output_port(), controller.GetInputPort("state"))
        force, command = (
            controller.GetOutputPort(name) for name in ("propeller_force", "velocity_command")
        )
    else:
        force, command = (
            builder.AddSystem(ConstantVectorSource(value)).get_output_port()
            for value in (HOVER, np.zeros(3))
        )
    builder.Connect(force, plant.GetInputPort("propeller_force"))
    for port in (plant.GetOutputPort("state"), command, force):
        LogVectorOutput(port, builder, SAMPLE_PERIOD)
    return builder.Build()


def simulate(diagram):
    """The vehicle's state at the end."""
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, START)
    simulator.AdvanceTo(SIMULATED_S)
    own = diagram.GetSubsystemByName("plant").GetMyContextFromRoot(context)
    return own.get_continuous_state_vector().CopyToVector()


def test_real_time_factor(save, flight_field):
    rows = []
    for name, diagram in {
        "empty": make_ceiling_diagram(in_python=True),
        "learned field": MakeFlightDiagram(flight_field, speed=0.45),
        "no Python": make_ceiling_diagram(in_python=False),
    }.items():
        ends, seconds = best_of(lambda made=diagram: simulate(made), clock=time.perf_counter)
        factor = SIMULATED_S / seconds
        rows.append(
            {
                "diagram": name,
                "real_time_factor": factor,
                "share_of_empty": factor / (rows[0]["real_time_factor"] if rows else factor),
                "us_per_sample": 1e6 * SAMPLE_PERIOD / factor,
            }
        )
        # A repeated flight is the same flight.
        for end in ends[1:]:
            np.testing.assert_array_equal(end, ends[0])
    save(rows, "real_time_factor")


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
