"""How much faster than real time a flight is simulated, and where the time goes.

Run by `make bench`; the tables are printed and saved in build/bench.  The same plant, motion
capture, logs and integrator, and in the place of guidance and controller:

- learned field: what users fly;
- learned field in torch: the same field, its networks evaluated by torch at one point and
  differentiated by autograd, as one would without a field of NumPy;
- empty: the ports of both, and as little Python behind them as can be: the ceiling of any
  controller in Python;
- no Python: a constant force from Drake's own source: the ceiling of the simulation.
"""

from collections.abc import Callable
import time
from typing import Any

import numpy as np
import pandas as pd
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, LeafSystem, System
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput
import pytest
import torch

import sgvf_drake as sgvf
from sgvf_drake.fields.composition import (
    DIRECTION_SOFTENING,
    PROJECTION_POWER,
    PROJECTION_RANGE,
)
from systems import (
    AddMotionCapture,
    FieldForSpeed,
    GuidanceSystem,
    MakeFlightDiagram,
    MakeSimulator,
    QuadrotorParameters,
    Se3Controller,
    SetHover,
)

pytestmark = pytest.mark.benchmark

Save = Callable[[pd.DataFrame, str], None]
SPEED = 0.45
SAMPLE_PERIOD = 0.01
SIMULATED_S = 30.0
REPEATS = 3
EVALUATIONS = 2_000
START = (1.25, 0.0, 1.0)


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


def make_ceiling_diagram(in_python: bool) -> Diagram:
    """The flight diagram without guidance and controller: same plant, hold and logs."""
    parameters = QuadrotorParameters()
    builder = DiagramBuilder()
    plant = builder.AddNamedSystem("plant", parameters.MakePlant())
    hold = AddMotionCapture(builder, plant.GetOutputPort("state"), SAMPLE_PERIOD)
    if in_python:
        controller = builder.AddSystem(EmptyController(parameters))
        builder.Connect(hold.get_output_port(), controller.GetInputPort("state"))
        force, command = (
            controller.GetOutputPort(name) for name in ("propeller_force", "velocity_command")
        )
    else:
        hover, rest = np.full(4, parameters.hover_force), np.zeros(3)
        force, command = (
            builder.AddSystem(ConstantVectorSource(value)).get_output_port()
            for value in (hover, rest)
        )
    builder.Connect(force, plant.GetInputPort("propeller_force"))
    for port in (plant.GetOutputPort("state"), command, force):
        LogVectorOutput(port, builder, SAMPLE_PERIOD)
    return builder.Build()


class TorchPerceptron(torch.nn.Module):
    """A network of a field as torch runs it."""

    def __init__(self, network: Any) -> None:
        super().__init__()
        self._features = network.features
        if network.features is not None:
            self._frequencies = torch.as_tensor(network.features.frequencies.T.copy())
            self._phases = torch.as_tensor(network.features.phases)
        layers: list[torch.nn.Module] = []
        for weight, bias in zip(network.weights, network.biases, strict=True):
            layer = torch.nn.Linear(*weight.shape[::-1], dtype=torch.float64)
            layer.load_state_dict(
                {"weight": torch.as_tensor(weight), "bias": torch.as_tensor(bias)}
            )
            layers += [layer, torch.nn.SiLU()]
        self._layers = torch.nn.Sequential(*layers[:-1]).requires_grad_(False)

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        if self._features is None:
            return self._layers(z)
        angles = z @ self._frequencies + self._phases
        return self._layers(torch.cat([torch.sin(angles), torch.cos(angles)]))


class TorchField:
    """A field of the recipe "robust", evaluated by torch and differentiated by autograd."""

    def __init__(self, field: sgvf.GuidingField) -> None:
        self.dim = field.dim
        self._center = torch.as_tensor(field.cloud.center.copy())
        self._unit = field.cloud.unit_length
        self._score = TorchPerceptron(field.score_model.network.with_last_input(1.0))
        self._score_scale = field.score_model.scale
        self._tangent = TorchPerceptron(field.tangent_network)
        self._composition = field.composition

    def __call__(self, x: np.ndarray) -> np.ndarray:
        return self._m(torch.as_tensor(x)).numpy()

    def value_and_jacobian(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        point = torch.tensor(x, requires_grad=True)
        m = self._m(point)
        rows = [torch.autograd.grad(m_i, point, retain_graph=True)[0] for m_i in m]
        return m.detach().numpy(), torch.stack(rows).numpy()

    def hessian(self, x: np.ndarray) -> np.ndarray:
        raise NotImplementedError

    def _m(self, x: torch.Tensor) -> torch.Tensor:
        z = (x - self._center) / self._unit
        S, N = self._score(z) / self._score_scale, self._tangent(z)
        c = self._composition
        v = N / torch.sqrt(N @ N + DIRECTION_SOFTENING**2)
        ratio = (c.sigma / PROJECTION_RANGE) ** 2 * (S @ S)
        S = S - (S @ v) / (1.0 + ratio ** (PROJECTION_POWER // 2)) * v
        size = torch.sqrt(S @ S)
        a = c.gain * size
        return torch.tanh(a) * S / size + c.tangent_share * v / torch.cosh(a)


@pytest.fixture(scope="module")
def learned() -> sgvf.GuidingField:
    """Two rings of 1 m and 2 m."""
    cloud, _ = sgvf.make_shape("concentric-flight")
    return sgvf.train(cloud).field


def simulate(diagram: Diagram) -> tuple[np.ndarray, float]:
    """The vehicle's state at the end, and simulated over wall time."""
    simulator = MakeSimulator(diagram)
    context = simulator.get_mutable_context()
    SetHover(diagram, context, START)
    simulator.Initialize()
    begin = time.perf_counter()
    simulator.AdvanceTo(SIMULATED_S)
    factor = SIMULATED_S / (time.perf_counter() - begin)
    plant = diagram.GetSubsystemByName("plant")
    own = plant.GetMyContextFromRoot(context)
    return own.get_continuous_state_vector().CopyToVector(), factor


def test_field_in_torch_is_the_same_field(learned: sgvf.GuidingField) -> None:
    in_torch = TorchField(learned)
    for x in np.random.default_rng(0).uniform(-2.5, 2.5, (50, 2)):
        m, J = learned.value_and_jacobian(x)
        m_torch, J_torch = in_torch.value_and_jacobian(x)
        np.testing.assert_allclose(m_torch, m, atol=1e-10)
        np.testing.assert_allclose(J_torch, J, atol=1e-10 * np.abs(J).max() + 1e-10)


def test_real_time_factor(save: Save, learned: sgvf.GuidingField) -> None:
    diagrams = {
        "learned field": MakeFlightDiagram(learned, speed=SPEED),
        "learned field in torch": MakeFlightDiagram(
            TorchField(FieldForSpeed(learned, SPEED)), speed=SPEED
        ),
        "empty": make_ceiling_diagram(in_python=True),
        "no Python": make_ceiling_diagram(in_python=False),
    }
    results: dict[str, list[tuple[np.ndarray, float]]] = {name: [] for name in diagrams}
    for _ in range(REPEATS):
        for name, diagram in diagrams.items():
            results[name].append(simulate(diagram))
    best = {name: max(factor for _, factor in runs) for name, runs in results.items()}
    table = pd.DataFrame(
        {
            "diagram": best.keys(),
            "real_time_factor": best.values(),
            "share_of_empty": [factor / best["empty"] for factor in best.values()],
            "us_per_sample": [1e6 * SAMPLE_PERIOD / factor for factor in best.values()],
        }
    )
    save(table, "real_time_factor")
    # A repeated flight is the same flight, and torch flies what NumPy flies.
    end = results["learned field"][0][0]
    for name in ("learned field", "learned field in torch"):
        for other, _ in results[name]:
            np.testing.assert_allclose(other, end, atol=1e-6)


def test_time_of_one_evaluation(save: Save, learned: sgvf.GuidingField) -> None:
    """Of the parts of a flight; those of systems include setting a new input."""
    rng = np.random.default_rng(0)
    states = rng.uniform(-0.2, 0.2, (EVALUATIONS, 12)) + np.array([1.0, 0.0, 1.0, *[0.0] * 9])
    flown = FieldForSpeed(learned, SPEED)
    in_torch = TorchField(flown)
    guidance, controller = GuidanceSystem(learned, SPEED), Se3Controller()
    commands = {"velocity_command": np.zeros(3), "acceleration_feedforward": np.zeros(3)}
    parts = {
        "field in NumPy": lambda x: flown.value_and_jacobian(x[:2]),
        "field in torch": lambda x: in_torch.value_and_jacobian(x[:2]),
        "GuidanceSystem": make_evaluation(guidance, {}),
        "Se3Controller": make_evaluation(controller, commands),
    }
    rows = []
    for name, evaluate in parts.items():
        walls = []
        for _ in range(REPEATS):
            begin = time.perf_counter()
            for x in states:
                evaluate(x)
            walls.append((time.perf_counter() - begin) / EVALUATIONS)
        rows.append({"part": name, "us": 1e6 * min(walls)})
    save(pd.DataFrame(rows), "evaluation_time")
    # They were evaluated indeed, and at the same points.
    x = states[0]
    m, J = parts["field in NumPy"](x)
    command, acceleration, *_ = parts["GuidanceSystem"](x)
    np.testing.assert_allclose(command[:2], SPEED * m, atol=1e-12)
    np.testing.assert_allclose(acceleration[:2], SPEED * J @ x[6:8], atol=1e-12)
    propeller_force, _ = parts["Se3Controller"](x)
    assert propeller_force.sum() > 0.0


def make_evaluation(
    system: System, inputs: dict[str, np.ndarray]
) -> Callable[[np.ndarray], list[np.ndarray]]:
    """All outputs of a system as a function of the input "state"."""
    context = system.CreateDefaultContext()
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(context, value)
    state = system.GetInputPort("state")
    ports = [system.get_output_port(i) for i in range(system.num_output_ports())]

    def evaluate(x: np.ndarray) -> list[np.ndarray]:
        state.FixValue(context, x)
        return [port.Eval(context) for port in ports]

    return evaluate
