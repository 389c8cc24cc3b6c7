"""How fast one flight is simulated, and where its time goes.

The real-time factor is that of the same plant, motion capture, logs and integrator, with one of
these in the place of guidance and controller:

- learned field: what users fly, `FusedGuidance`;
- composed loop: `GuidanceSystem` and `Se3Controller`, as with a supervisor between them;
- empty: the ports of both, and as little Python behind them as can be: the ceiling of any
  controller in Python;
- no Python: a constant force from Drake's own source: the ceiling of the simulation.

With sensors the controller runs at 500 Hz and the field at 100 Hz.
"""

from functools import partial
import time
import timeit

import numpy as np
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, ZeroOrderHold
import pytest

from systems import (
    MakeFlightDiagram,
    MakeSimulator,
    QuadrotorParameters,
    SensorParameters,
    SetHover,
    SetNoiseSeed,
)

from .measuring import timed

pytestmark = pytest.mark.benchmark

SAMPLE_PERIOD = 0.01
SIMULATED_S = 30.0
# Diagrams take turns, since other processes come and go; the best turn of each counts.
TURNS, TURN_S = 300, 0.1
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


def started(diagram):
    """A simulator of a diagram at the start of its flight."""
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    if diagram.HasSubsystemNamed("guidance_loop"):
        SetHover(diagram, context, START)
        SetNoiseSeed(diagram, context, 0)
    else:
        plant = diagram.GetSubsystemByName("plant").GetMyMutableContextFromRoot(context)
        plant.SetContinuousState([*START, *np.zeros(9)])
    simulator.AdvanceTo(TURN_S)
    return simulator


def state_of(simulator):
    context = simulator.get_context()
    return context.get_continuous_state_vector().CopyToVector()[:12]


def test_real_time_factor(save, flight_field):
    learned = {"field": flight_field, "speed": 0.45}
    measured = {**learned, "sensors": SensorParameters()}
    simulators = {
        name: started(diagram)
        for name, diagram in {
            "empty": make_ceiling_diagram(in_python=True),
            "learned field": MakeFlightDiagram(**learned),
            "composed loop": MakeFlightDiagram(**learned, fused=False),
            "no Python": make_ceiling_diagram(in_python=False),
            "learned field, sensors": MakeFlightDiagram(**measured),
            "composed loop, sensors": MakeFlightDiagram(**measured, fused=False),
        }.items()
    }
    seconds = dict.fromkeys(simulators, np.inf)
    for turn in range(2, TURNS + 1):
        for name, simulator in simulators.items():
            end = turn * TURN_S
            _, taken = timed(lambda s=simulator, t=end: s.AdvanceTo(t), time.perf_counter)
            seconds[name] = min(seconds[name], taken)
    factors = {name: TURN_S / taken for name, taken in seconds.items()}
    rows = [
        {
            "diagram": name,
            "real_time_factor": factor,
            "share_of_empty": factor / factors["empty"],
            "us_per_sample": 1e6 * SAMPLE_PERIOD / factor,
        }
        for name, factor in factors.items()
    ]
    table = save(rows, "real_time_factor")
    assert len(table) == len(simulators)
    # It is the same flight either way.
    for sensors in ("", ", sensors"):
        fused, composed = (
            state_of(simulators[f"{name}{sensors}"])
            for name in ("learned field", "composed loop")
        )
        np.testing.assert_allclose(fused, composed, rtol=0, atol=1e-9)


def test_time_of_derivatives(save, flight_field, robust_field, paper_field):
    """Of one value of a field alone, with J v along one direction, and with J."""
    rows = []
    fields = {"exact": flight_field, "robust": robust_field, "paper": paper_field}
    for name, field in fields.items():
        evaluate, x = field.compiled().evaluate, np.array(field.cloud.center) + 0.3
        row = {"field": name}
        for count, derivatives in enumerate(("value_us", "value_and_Jv_us", "value_and_J_us")):
            directions = np.eye(field.dim)[:count]
            call = partial(evaluate, x, directions)
            call()
            taken = timeit.repeat(call, number=20, repeat=500)
            row[derivatives] = 1e6 * min(taken) / 20
        rows.append(row)
    save(rows, "derivatives")
