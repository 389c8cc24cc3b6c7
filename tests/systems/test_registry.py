"""What every system of the package promises: its port diagram, its Context, its conversion.

A system is added to these tests by one entry of `CASES`, or of `PLAIN` if it has no template.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import inspect
from pathlib import Path
import re
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common import RandomGenerator
from pydrake.common.cpp_template import TemplateClass
from pydrake.common.yaml import yaml_load
from pydrake.geometry import FrameId
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram, LeafSystem
import pytest

import sgvf_drake
from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
from sgvf_drake.paths.itinerary import Itinerary
from sgvf_drake.paths.navigator import Navigator
import systems
from systems import (
    DEFAULT_GAINS,
    Body,
    Branch,
    BranchSupervisor,
    CourseController,
    Disturbance,
    DisturbedQuadrotor,
    Dropout,
    FlightTrail,
    FloatingBodyState,
    FusedGuidance,
    GuidanceLoop,
    GuidanceSystem,
    HeadingSystem,
    IdealMotionCapture,
    KinematicGuidance,
    LyapunovMonitor,
    MakeFlightDiagram,
    MakeMeshcat,
    MotionCapture,
    MultibodyQuadrotor,
    MultibodyQuadrotorSdf,
    Pace,
    PlanarVehicle,
    PlanarVehicleInWind,
    PlanarVehicleParameters,
    QuadrotorGeometry,
    QuadrotorInPlant,
    QuadrotorParameters,
    RouteNavigator,
    Se3Controller,
    SensorParameters,
    SpacingController,
    StateEstimator,
)
from systems.branch_supervisor import DEFAULT_HOLD_AFTER
from systems.scalars import ToVector
from systems.supervision import HOLD_POSITION, Memory
from tests.networks import straight_network

from .flying import LAP, UNIT, CircleField

RNG = np.random.default_rng(11)
SAMPLE_TIME = 0.02  # s; of the next sample of the systems that take samples.
STATE = np.concatenate(([3.3, 2.9, 1.1], RNG.uniform(-0.1, 0.1, 9)))
MOTION = {"position": STATE[:3], "velocity": STATE[6:9]}
RINGS = tuple(Branch(3.0 + radius * UNIT, LAP * radius, True) for radius in (0.4, 0.8))
DIAGRAM = re.compile(r"^\.\. pydrake_system::\n\n((?:    .*\n|\n)+)", re.MULTILINE)


class Counted:
    """Counts the evaluations of a field or a function, also of its kin of another width."""

    def __init__(self, wrapped: Any, counts: list[int] | None = None) -> None:
        self._wrapped, self._counts = wrapped, [0] if counts is None else counts

    def __getattr__(self, name: str) -> Any:
        if name == "compiled":
            raise AttributeError("what is compiled cannot be counted")
        return getattr(self._wrapped, name)

    # Here, since `isinstance` asks no `__getattr__` for what a protocol names.
    @property
    def dim(self) -> int:
        return self._wrapped.dim

    @property
    def approach_length(self) -> float:
        return self._wrapped.approach_length

    @property
    def calls(self) -> int:
        return self._counts[0]

    def with_approach_length(self, length: float) -> "Counted":
        return Counted(self._wrapped.with_approach_length(length), self._counts)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        self._counts[0] += 1
        return self._wrapped(x)

    def value_and_jacobian(self, x: np.ndarray) -> Any:
        self._counts[0] += 1
        return self._wrapped.value_and_jacobian(x)

    def hessian(self, x: np.ndarray) -> Any:
        return self._wrapped.hessian(x)


class CountedVehicle(QuadrotorParameters):
    """A vehicle that counts what is read of it: the controller needs it for every force."""

    calls = 0

    def __getattribute__(self, name):
        if name not in ("__dict__", "__class__", "calls"):
            self.__dict__["calls"] = self.calls + 1
        return super().__getattribute__(name)


@dataclass(frozen=True)
class Case:
    """A system, and what the tests have to know about it.

    Attributes:
        make: Makes the system from the thing whose evaluations are counted.
        counted: What that is: a field, a function, a vehicle or nothing.
        inputs: A value for each input port, the first one that of what is counted.
        parameters: Another value for each parameter NAME with methods GetNAME and SetNAME.
        state: The discrete state in which it is looked at; None: that at the start.
        counts: Whether evaluating the outputs evaluates what is counted.
        idle: Inputs that nothing depends on.
    """

    make: Callable[[Any], Any]
    counted: str
    inputs: Mapping[str, Any]
    parameters: Mapping[str, Any]
    state: np.ndarray | None = None
    counts: bool = True
    idle: tuple[str, ...] = ()


def flown_supervisor() -> np.ndarray:
    """A memory between one and two laps, while a transfer is handed over to guidance."""
    memory = Memory.AtStart(0, 2)
    memory.speed, memory.flown = 0.45, 1.3 * RINGS[0].length
    memory.weight, memory.scale, memory.scale_rate = 0.6, 0.2, 0.1
    memory.position, memory.velocity = STATE[:3] + 0.05, STATE[6:9] + 0.02
    return memory.ToVector()


def moving_estimate() -> np.ndarray:
    """The state of an estimator that has just seen something move."""
    estimator = StateEstimator(0.02)
    context = estimator.CreateDefaultContext()
    estimator.SetEstimate(context, [1.0, 2.0, 3.0], [0.4, -0.2, 0.3])
    return context.get_discrete_state_vector().CopyToVector()


def quadrotor_in_plant() -> QuadrotorInPlant:
    plant = MultibodyPlant(0.0)
    (instance,) = Parser(plant).AddModelsFromString(
        MultibodyQuadrotorSdf(QuadrotorParameters()), "sdf"
    )
    plant.Finalize()
    return QuadrotorInPlant(plant, instance, QuadrotorParameters())


COMMANDS = {
    "velocity_command": np.array([0.3, -0.1, 0.2]),
    "acceleration_feedforward": np.array([0.2, 0.4, -0.1]),
}

EAST_THEN_NORTH = Itinerary.along(
    [1, 2],
    straight_network(
        [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [2.0, 0.0]], [(0, 1), (1, 2), (1, 3)]
    ),
)

# Constructor arguments are nowhere the defaults, so that a forgotten one shows.
CASES = {
    "GuidanceSystem": Case(
        lambda field: GuidanceSystem(field, 0.3, 1.4, False, 3.9),
        "field",
        # Less than the parameter, so that it has an effect.
        {**MOTION, "speed": np.array([0.25])},
        # The field is about 0.1 m wide, which 0.9 m/s widens and 0.3 m/s does not.
        {"Speed": 0.9, "Altitude": 1.2, "ApproachLength": 0.5},
    ),
    "Se3Controller": Case(
        lambda vehicle: Se3Controller(
            vehicle, DEFAULT_GAINS._replace(velocity_gain=2.0, disturbance_bandwidth=4.0)
        ),
        "vehicle",
        {
            "state": STATE,
            **COMMANDS,
            "command_derivatives": np.linspace(-0.5, 0.5, 24),
            "heading": np.array([0.1]),
            "predicted_velocity": STATE[6:9] - 0.1,
        },
        {
            "Gains": DEFAULT_GAINS._replace(damping_ratio=0.8, disturbance_bandwidth=5.0),
            "Body": Body(0.6, 5e-4, 7e-4, 9e-4),
        },
    ),
    "FusedGuidance": Case(
        lambda field: FusedGuidance(
            field,
            0.3,
            1.4,
            False,
            3.9,
            QuadrotorParameters(thrust_to_weight=3.5),
            DEFAULT_GAINS._replace(velocity_gain=2.0, disturbance_bandwidth=4.0),
        ),
        "field",
        {
            "state": STATE,
            "speed": np.array([0.25]),
            "heading": np.array([0.1]),
            "predicted_velocity": STATE[6:9] - 0.1,
        },
        {
            "Speed": 0.9,
            "Altitude": 1.2,
            "ApproachLength": 0.5,
            "Gains": DEFAULT_GAINS._replace(damping_ratio=0.8, disturbance_bandwidth=5.0),
            "Body": Body(0.6, 5e-4, 7e-4, 9e-4),
        },
    ),
    "PlanarVehicle": Case(
        lambda _: PlanarVehicle(PlanarVehicleParameters(2.0, 1.5, 0.3)),
        "nothing",
        {"turn_rate": np.array([0.3]), "wind": np.array([0.2, -0.4, 0.1])},
        {},
        counts=False,
        # It turns the vehicle later.
        idle=("turn_rate",),
    ),
    "CourseController": Case(
        lambda _: CourseController(PlanarVehicleParameters(2.0, 1.5, 0.3), 0.8),
        "nothing",
        {"state": np.array([3.3, 2.9, 1.1, 0.4, 1.5, 0.9, 0.1]), **COMMANDS},
        {"Gain": 1.1},
        counts=False,
    ),
    "KinematicGuidance": Case(
        lambda field: KinematicGuidance(field, 2, 0.3),
        "field",
        {"positions": np.array([3.3, 2.9, 2.5, 3.1])},
        {"Speed": 0.9},
    ),
    "LyapunovMonitor": Case(
        lambda function: LyapunovMonitor(function, 2, 4.0, 3),
        "function",
        {"state": RNG.uniform(-1.0, 1.0, 6), "velocity": RNG.uniform(-1.0, 1.0, 4)},
        {"Level": 7.0},
    ),
    "StateEstimator": Case(
        lambda _: StateEstimator(0.02, 0.04, 15.0),
        "nothing",
        {
            "measured_position": np.array([1.1, 1.9, 3.2]),
            "acceleration": np.array([0.5, 2.0, -1.0]),
        },
        {"Bandwidth": 40.0, "Delay": 0.1},
        moving_estimate(),
        counts=False,
    ),
    "Dropout": Case(
        # Lost later than all that is looked at: its output depends on the time as no other's.
        lambda _: Dropout(3, [(2.0, 3.0)], [1]),
        "nothing",
        {"input": np.array([1.0, 2.0, 3.0])},
        {},
        counts=False,
    ),
    "BranchSupervisor": Case(
        lambda field: BranchSupervisor(
            field,
            RINGS,
            (0, 1),
            1.5,
            QuadrotorParameters(thrust_to_weight=3.5),
            ([0.0, 0.0], [6.0, 6.0]),
            0.3,
            0.02,
        ),
        "field",
        {
            **MOTION,
            **COMMANDS,
            "speed": np.array([0.4]),
            # A little more, and the vehicle has to hold.
            "measurement_age": np.array([DEFAULT_HOLD_AFTER - 0.005]),
        },
        {"Branch": HOLD_POSITION, "Laps": 1.2, "HoldAfter": 0.1, "LandAfter": 0.12},
        flown_supervisor(),
        counts=False,
    ),
    "HeadingSystem": Case(
        lambda _: HeadingSystem((1.0, 2.0)),
        "nothing",
        {"position": STATE[:3], "velocity_command": COMMANDS["velocity_command"]},
        {},
        counts=False,
        # It looks at a point.
        idle=("velocity_command",),
    ),
    "FloatingBodyState": Case(
        lambda _: FloatingBodyState(),
        "nothing",
        {
            "body_state": np.array(
                [0.9, 0.1, -0.2, 0.3, *STATE[:3], 0.1, 0.2, -0.3, *STATE[6:9]]
            )
        },
        {},
        counts=False,
    ),
    "RouteNavigator": Case(
        lambda _: RouteNavigator(Navigator(EAST_THEN_NORTH, 0.1), 2, 0.05),
        "nothing",
        # One agent is about to turn, the other has turned; both are farther than the state.
        {"positions": np.array([0.8, 0.0, 1.0, 0.0, 1.0, 0.4, 0.0, 1.0])},
        {},
        np.array([0.0, 1.0, 0.7, 1.1, 0.0, 0.0]),
        counts=False,
    ),
    "SpacingController": Case(
        lambda _: SpacingController(
            RINGS[0], 2, Pace(0.4, 0.3, 0.6, 0.05), [1.0, 2.0], 0.2, 0.02
        ),
        "nothing",
        # A little farther than the state, the first over the end of the lap.
        {"position_0": np.array([3.4, 3.02, 1.0]), "position_1": np.array([3.0, 3.4, 1.0])},
        {"Pace": Pace(0.5, 0.2, 0.7, 0.06), "Shares": (0.4, 0.6)},
        np.array([2.46, 0.55, 0.4, 0.4]),
        counts=False,
    ),
}
PARAMETERS = [(name, parameter) for name in CASES for parameter in CASES[name].parameters]
# The systems that are no templates: for float only, or whole diagrams.
PLAIN = {
    "DisturbedQuadrotor": lambda: DisturbedQuadrotor(QuadrotorParameters(), Disturbance()),
    "FlightTrail": lambda: FlightTrail(MakeMeshcat(port=0)),
    "GuidanceLoop": lambda: GuidanceLoop(
        GuidanceSystem(CircleField()), Se3Controller(), IdealMotionCapture()
    ),
    "IdealMotionCapture": IdealMotionCapture,
    "MotionCapture": lambda: MotionCapture(SensorParameters()),
    "PlanarVehicleInWind": lambda: PlanarVehicleInWind(
        PlanarVehicleParameters(2.0, 1.5), Disturbance()
    ),
    "MultibodyQuadrotor": MultibodyQuadrotor,
    "QuadrotorInPlant": quadrotor_in_plant,
    "QuadrotorGeometry": lambda: QuadrotorGeometry(FrameId.get_new_id()),
}


class Subject:
    """A system of a case with the words that the tests use."""

    def __init__(self, case: Case, counted: Any) -> None:
        self.case, self.counted = case, counted
        self.system = case.make(counted)

    @property
    def calls(self) -> int:
        """Evaluations of what is counted."""
        return 0 if self.counted is None else self.counted.calls

    def context(self, system: Any = None, **parameters: Any) -> Any:
        """A new Context with fixed inputs."""
        system = system or self.system
        context = system.CreateDefaultContext()
        if self.case.state is not None:
            scalar = float if system is self.system else AutoDiffXd
            context.SetDiscreteState(ToVector(scalar, self.case.state))
        for name, value in self.case.inputs.items():
            system.GetInputPort(name).FixValue(context, value)
        for name, value in parameters.items():
            self.set(context, name, value, system)
        return context

    def set(self, context: Any, name: str, value: Any, system: Any = None) -> None:
        getattr(system or self.system, f"Set{name}")(context, value)

    def get(self, context: Any, name: str, system: Any = None) -> list[float]:
        """A parameter as plain floats."""
        value = getattr(system or self.system, f"Get{name}")(context)
        return floats(value if isinstance(value, tuple) else (value,))

    def outputs(self, context: Any, system: Any = None) -> np.ndarray:
        """All outputs one after the other, as plain floats."""
        system = system or self.system
        ports = [system.get_output_port(i) for i in range(system.num_output_ports())]
        return np.array(floats(v for port in ports for v in port.Eval(context)))

    def effects(self, context: Any, system: Any = None) -> np.ndarray:
        """All outputs, and behind them the discrete state after the next sample."""
        system = system or self.system
        outputs = self.outputs(context, system)
        if context.num_discrete_state_groups() == 0:
            return outputs
        later = context.Clone()
        later.SetTime(SAMPLE_TIME)
        state = system.EvalUniquePeriodicDiscreteUpdate(later)
        return np.concatenate((outputs, floats(state.value())))


def floats(values: Any) -> list[float]:
    return [float(v.value() if hasattr(v, "value") else v) for v in values]


@pytest.fixture
def make_subject(make_field):
    def make(name: str) -> Subject:
        case = CASES[name]
        counted = {
            # Wide enough at the first speed.
            "field": lambda: Counted(make_field("robust", gain=0.8)),
            "function": lambda: Counted(
                LyapunovFunction(
                    GaussianMixture(np.random.default_rng(7).uniform(-1.0, 1.0, (12, 2)), 0.4)
                )
            ),
            "vehicle": lambda: CountedVehicle(thrust_to_weight=3.5),
            "nothing": lambda: None,
        }[case.counted]()
        return Subject(case, counted)

    return make


@pytest.fixture(params=CASES)
def subject(request, make_subject):
    return make_subject(request.param)


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_parameter_lives_in_the_context(make_subject, name, parameter):
    subject = make_subject(name)
    value = subject.case.parameters[parameter]
    context, other = subject.context(), subject.context()
    before = subject.effects(context)
    initial = subject.get(context, parameter)
    # As if it had been so before anything was evaluated.
    changed = subject.context(**{parameter: value})
    expected = subject.effects(changed)
    assert np.abs(expected - before).max() > 1e-3
    subject.set(context, parameter, value)
    assert subject.get(context, parameter) == floats(np.ravel(value))
    np.testing.assert_array_equal(subject.effects(context), expected)
    # Another Context does not change with it, nor does a clone with the first.
    np.testing.assert_array_equal(subject.effects(other), before)
    clone = context.Clone()
    np.testing.assert_array_equal(subject.effects(clone), expected)
    clone.SetTimeStateAndParametersFrom(other)
    assert subject.get(clone, parameter) == initial
    np.testing.assert_array_equal(subject.effects(context), expected)
    # As Drake's own tools set it: not by the method, but in the Context's vectors.
    for index in range(other.num_numeric_parameter_groups()):
        other.get_mutable_numeric_parameter(index).SetFromVector(
            changed.get_numeric_parameter(index).CopyToVector()
        )
    np.testing.assert_array_equal(subject.effects(other), expected)


def test_conversion_carries_arguments_and_parameters(subject):
    converted = subject.system.ToAutoDiffXd()
    for changed in ({}, *({name: value} for name, value in subject.case.parameters.items())):
        context = subject.context(**changed)
        carried = subject.context(converted)
        carried.SetTimeStateAndParametersFrom(context)
        for differentiated in (carried, subject.context(converted, **changed)):
            for parameter in subject.case.parameters:
                found = subject.get(differentiated, parameter, converted)
                assert found == subject.get(context, parameter)
            np.testing.assert_allclose(
                subject.effects(differentiated, converted), subject.effects(context), rtol=1e-13
            )


def test_outputs_are_computed_again_only_when_something_changes(subject):
    context = subject.context()
    expected = subject.outputs(context)
    calls = subject.calls
    assert (calls > 0) == subject.case.counts
    for time in (0.0, 0.5, 1.0):
        # No output depends on the time.
        context.SetTime(time)
        np.testing.assert_array_equal(subject.outputs(context), expected)
    assert subject.calls == calls
    context.SetTime(0.0)
    before, changed = subject.effects(context), subject.context()
    for name, value in subject.case.inputs.items():
        calls = subject.calls
        subject.system.GetInputPort(name).FixValue(context, value + 0.01)
        subject.system.GetInputPort(name).FixValue(changed, value + 0.01)
        after = subject.effects(context)
        # The first input is what fields and functions are evaluated at.
        if subject.case.counts and name == next(iter(subject.case.inputs)):
            assert subject.calls > calls
        assert (np.abs(after - before).max() > 1e-6) == (name not in subject.case.idle)
        before = after
    np.testing.assert_array_equal(before, subject.effects(changed))


@pytest.mark.parametrize("seed", range(2))
def test_random_context_has_usable_parameters(subject, seed):
    context = subject.context()
    subject.system.SetRandomContext(context, RandomGenerator(seed))
    assert np.isfinite(subject.effects(context)).all()
    for parameter in subject.case.parameters:
        drawn = getattr(subject.system, f"Get{parameter}")(context)
        assert np.isfinite(subject.get(context, parameter)).all()
        # Its own method accepts it.
        subject.set(context, parameter, drawn)


@pytest.mark.parametrize("sensors", [None, SensorParameters()])
def test_random_context_of_a_flight_has_usable_parameters(make_field, sensors):
    diagram = MakeFlightDiagram(make_field("robust"), sensors=sensors)
    context = diagram.CreateDefaultContext()
    diagram.SetRandomContext(context, RandomGenerator(1))
    loop = diagram.GetSubsystemByName("guidance_loop")
    forces = loop.GetOutputPort("propeller_force").Eval(loop.GetMyContextFromRoot(context))
    assert np.all((forces >= 0.0) & (forces <= loop.controller.parameters.max_propeller_force))


# Ports and docstrings.


def exported_systems():
    """The classes of systems among the exported names; those of templates in float."""
    found = {}
    for name in systems.__all__:
        value = getattr(systems, name)
        if isinstance(value, TemplateClass):
            value, name = value[None], name.removesuffix("_")
        if inspect.isclass(value) and issubclass(value, LeafSystem | Diagram):
            found[name] = value
    return found


def read_diagram(system_class):
    """The diagram of a class as a mapping, or None."""
    match = DIAGRAM.search(inspect.cleandoc(system_class.__doc__ or "") + "\n")
    return None if match is None else yaml_load(data=inspect.cleandoc(match[1]))


def port_names(system):
    return {
        kind: [
            getattr(system, f"get_{kind[:-1]}")(i).get_name()
            for i in range(getattr(system, f"num_{kind}")())
        ]
        for kind in ("input_ports", "output_ports")
    }


def test_every_exported_system_is_a_case():
    templates = {name for name in systems.__all__ if f"{name}_" in systems.__all__}
    assert set(CASES) == templates
    assert set(CASES) | set(PLAIN) == set(exported_systems())


@pytest.mark.parametrize("name", exported_systems())
def test_docstring_opens_with_the_diagram_of_the_ports(make_subject, name):
    system_class = exported_systems()[name]
    # A summary of one line, and the diagram comes next.
    lines = inspect.cleandoc(system_class.__doc__).splitlines()
    assert lines[1:3] == ["", ".. pydrake_system::"]
    diagram = read_diagram(system_class)
    assert diagram.pop("name") == name
    expected = {"input_ports": [], "output_ports": [], **diagram}
    if name in PLAIN:
        assert port_names(PLAIN[name]()) == expected
        return
    system = make_subject(name).system
    assert port_names(system) == port_names(system.ToAutoDiffXd()) == expected
    assert list(CASES[name].inputs) == expected["input_ports"]


def test_a_system_without_a_diagram_is_noticed():
    class Bare(LeafSystem):
        """Has ports, and says nothing of them."""

    assert read_diagram(Bare) is None


# The package.


def test_systems_is_this_projects_package():
    # Another distribution on the index has the same import name.
    ours, theirs = Path(systems.__file__), Path(sgvf_drake.__file__)
    assert ours.parents[1] == theirs.parents[1]
    assert sorted(systems.__all__) == sorted(set(systems.__all__))
    for name in systems.__all__:
        assert getattr(systems, name) is not None
