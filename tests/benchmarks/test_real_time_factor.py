"""How much faster than real time a flight is simulated, and where the time goes.

Run by `make bench`; the table is printed and saved in build/bench.  The same plant, motion
capture, logs and integrator, and in the place of guidance and controller:

- learned field: what users fly;
- empty: the ports of both, and as little Python behind them as can be: the ceiling of any
  controller in Python;
- no Python: a constant force from Drake's own source: the ceiling of the simulation.
"""

import time

import numpy as np
import pandas as pd
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
import pytest

from systems import (
    AddMotionCapture,
    MakeFlightDiagram,
    MakeSimulator,
    QuadrotorParameters,
    SetHover,
)

pytestmark = pytest.mark.benchmark

SAMPLE_PERIOD = 0.01
SIMULATED_S = 30.0
REPEATS = 3
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
    hold = AddMotionCapture(builder, plant.GetOutputPort("state"), SAMPLE_PERIOD)
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
    """The vehicle's state at the end, and simulated over wall time."""
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, START)
    simulator.Initialize()
    begin = time.perf_counter()
    simulator.AdvanceTo(SIMULATED_S)
    factor = SIMULATED_S / (time.perf_counter() - begin)
    own = diagram.GetSubsystemByName("plant").GetMyContextFromRoot(context)
    return own.get_continuous_state_vector().CopyToVector(), factor


def test_real_time_factor(save, flight_field):
    diagrams = {
        "learned field": MakeFlightDiagram(flight_field, speed=0.45),
        "empty": make_ceiling_diagram(in_python=True),
        "no Python": make_ceiling_diagram(in_python=False),
    }
    results = {name: [] for name in diagrams}
    for _ in range(REPEATS):
        for name, diagram in diagrams.items():
            results[name].append(simulate(diagram))
    best = {name: max(factor for _, factor in runs) for name, runs in results.items()}
    rows = [
        {
            "diagram": name,
            "real_time_factor": factor,
            "share_of_empty": factor / best["empty"],
            "us_per_sample": 1e6 * SAMPLE_PERIOD / factor,
        }
        for name, factor in best.items()
    ]
    save(pd.DataFrame(rows), "real_time_factor")
    # A repeated flight is the same flight.
    (end, _), *others = results["learned field"]
    for other, _ in others:
        np.testing.assert_array_equal(other, end)
