"""The flight: tracking error and real-time factor, measured in one run.

Run by `make bench`; the tables are printed and saved in build/bench.
"""

from collections.abc import Callable
import time
from typing import Any

import numpy as np
import pandas as pd
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput
import pytest

import sgvf_drake as sgvf
from sgvf_drake.experiments import choose_reference, fly
from systems import (
    AddMotionCapture,
    MakeFlightDiagram,
    MakeSimulator,
    QuadrotorParameters,
    SetHover,
)

pytestmark = pytest.mark.benchmark

Save = Callable[[pd.DataFrame, str], None]
SEEDS = (0, 1, 2)
SIMULATED_S = 60.0


class EmptyController(LeafSystem):
    """The ports of guidance and controller, and as little Python behind them as can be."""

    def __init__(self, parameters: QuadrotorParameters) -> None:
        super().__init__()
        self._hover = np.full(4, parameters.hover_force)
        state = self.DeclareVectorInputPort("state", 12)
        source = {self.input_port_ticket(state.get_index())}
        self._state = state
        self.DeclareVectorOutputPort("velocity_command", 3, self._calc_command, source)
        self.DeclareVectorOutputPort("propeller_force", 4, self._calc_force, source)

    def _calc_command(self, context: Context, output: Any) -> None:
        output.SetFromVector(self._state.Eval(context)[6:9])

    def _calc_force(self, context: Context, output: Any) -> None:
        self._state.Eval(context)
        output.SetFromVector(self._hover)


def make_empty_diagram() -> Diagram:
    """The flight diagram with the empty controller: same plant, same hold, same logs."""
    parameters = QuadrotorParameters()
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", parameters.MakePlant())
    controller = builder.AddNamedSystem("controller", EmptyController(parameters))
    hold = AddMotionCapture(builder, plant.GetOutputPort("state"))
    builder.Connect(hold.get_output_port(), controller.GetInputPort("state"))
    builder.Connect(
        controller.GetOutputPort("propeller_force"), plant.GetInputPort("propeller_force")
    )
    for port in (
        plant.GetOutputPort("state"),
        controller.GetOutputPort("velocity_command"),
        controller.GetOutputPort("propeller_force"),
    ):
        LogVectorOutput(port, builder, 0.01)
    return builder.Build()


def real_time_factor(diagram: Diagram) -> float:
    simulator = MakeSimulator(diagram)
    SetHover(diagram, simulator.get_mutable_context(), [1.25, 0.0, 1.0])
    begin = time.perf_counter()
    simulator.AdvanceTo(SIMULATED_S)
    return SIMULATED_S / (time.perf_counter() - begin)


def train(seed: int) -> sgvf.GuidingField:
    cloud, _ = sgvf.make_shape("concentric-flight")
    return sgvf.train(cloud, sgvf.TrainingConfig(seed=seed)).field


def test_tracking_error_of_both_rings(save: Save) -> None:
    rows = []
    for seed in SEEDS:
        field = train(seed)
        reference, _ = choose_reference(field)
        for speed in (0.45, 2.0):
            result = fly(field, reference, speed)
            rows += [{"seed": seed, "speed": speed, **f.summary} for f in result.flights]
    table = pd.DataFrame(rows).drop(columns=["start_m", "speed_command_m_s"])
    save(table, "flight")
    slow, fast = table[table["speed"] == 0.45], table[table["speed"] == 2.0]
    assert slow["cross_track_rms_m"].max() <= 0.01
    assert slow["cross_track_max_m"].max() <= 0.03
    assert (slow["saturated_fraction_after_take_off"] == 0).all()
    assert fast["cross_track_rms_m"].max() <= 0.02


def test_real_time_factor_beside_an_empty_controller(save: Save) -> None:
    field = train(0)
    diagrams = {"learned field": MakeFlightDiagram(field), "empty": make_empty_diagram()}
    rows = [
        {"diagram": name, "repeat": repeat, "real_time_factor": real_time_factor(diagram)}
        for repeat in range(3)
        for name, diagram in diagrams.items()
    ]
    table = pd.DataFrame(rows)
    save(table, "real_time_factor")
    best = table.groupby("diagram")["real_time_factor"].max()
    print(f"learned / empty: {best['learned field'] / best['empty']:.3f}")
    assert (table["real_time_factor"] > 0).all()
