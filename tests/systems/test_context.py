"""What every system promises of its Context: parameters, clones, conversion, caching.

A system is added to these tests by one entry of `CASES`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common import RandomGenerator
import pytest

from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
import systems
from systems import (
    DEFAULT_GAINS,
    Branch,
    BranchSupervisor,
    Dropout,
    GuidanceSystem,
    KinematicGuidance,
    LyapunovMonitor,
    MakeFlightDiagram,
    QuadrotorParameters,
    Se3Controller,
    SensorParameters,
    StateEstimator,
)
from systems.branch_supervisor import DEFAULT_HOLD_AFTER
from systems.scalars import ToVector
from systems.se3_law import Body
from systems.supervisor_memory import HOLD_POSITION, Memory

RNG = np.random.default_rng(11)
SAMPLE_TIME = 0.02  # s; of the next sample of the systems that take samples.
ANGLES = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
STATE = np.concatenate(([3.3, 2.9, 1.1], RNG.uniform(-0.1, 0.1, 9)))


class CountingField:
    """A field that counts its evaluations, also those of its kin of another width."""

    def __init__(self, field: Any, counts: list[int] | None = None) -> None:
        self._field = field
        self._counts = [0] if counts is None else counts
        self.dim = field.dim

    @property
    def calls(self) -> int:
        return self._counts[0]

    @property
    def approach_length(self) -> float:
        return self._field.approach_length

    def with_approach_length(self, length: float) -> "CountingField":
        return CountingField(self._field.with_approach_length(length), self._counts)

    def __call__(self, x):
        self._counts[0] += 1
        return self._field(x)

    def value_and_jacobian(self, x):
        self._counts[0] += 1
        return self._field.value_and_jacobian(x)

    def hessian(self, x):
        return self._field.hessian(x)


class CountingFunction:
    """A Lyapunov function that counts the evaluations of its value."""

    def __init__(self) -> None:
        points = np.random.default_rng(7).uniform(-1.0, 1.0, (12, 2))
        self._function = LyapunovFunction(GaussianMixture(points, 0.4))
        self.dim, self.calls = 2, 0

    def __call__(self, x):
        self.calls += 1
        return self._function(x)

    def gradient(self, x):
        return self._function.gradient(x)

    def gradient_and_hessian(self, x):
        return self._function.gradient_and_hessian(x)


class CountingVehicle(QuadrotorParameters):
    """A vehicle that counts what is read of it: the controller needs it for every force."""

    def __getattribute__(self, name):
        if name not in ("__dict__", "__class__", "calls"):
            self.__dict__["calls"] = self.calls + 1
        return super().__getattribute__(name)

    calls = 0


@dataclass(frozen=True)
class Case:
    """A system, and what the tests have to know about it.

    Attributes:
        make: Makes the system from the thing whose evaluations are counted.
        counted: What that is: a field, a function or a vehicle.
        inputs: A value for each input port, the first one that of what is counted.
        parameters: Another value for each parameter NAME with methods GetNAME and SetNAME.
        state: The discrete state in which it is looked at; None: that at the start.
        counts: Whether evaluating the outputs evaluates what is counted.
    """

    make: Callable[[Any], Any]
    counted: str
    inputs: Mapping[str, Any]
    parameters: Mapping[str, Any]
    state: np.ndarray | None = None
    counts: bool = True


RINGS = tuple(
    Branch(
        3.0 + radius * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)]),
        2.0 * np.pi * radius,
        True,
    )
    for radius in (0.4, 0.8)
)


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


# Constructor arguments are nowhere the defaults, so that a forgotten one shows.
CASES = {
    "GuidanceSystem": Case(
        lambda field: GuidanceSystem(field, 0.3, 1.4),
        "field",
        {"state": STATE},
        # The field is about 0.1 m wide, which 0.9 m/s widens and 0.3 m/s does not.
        {"Speed": 0.9, "Altitude": 1.2, "ApproachLength": 0.5},
    ),
    "Se3Controller": Case(
        lambda vehicle: Se3Controller(
            vehicle, DEFAULT_GAINS._replace(velocity_gain=2.0, heading=0.1)
        ),
        "vehicle",
        {
            "state": STATE,
            "velocity_command": np.array([0.3, -0.1, 0.2]),
            "acceleration_feedforward": np.array([0.2, 0.4, -0.1]),
        },
        {
            "Gains": DEFAULT_GAINS._replace(damping_ratio=0.8, heading=-0.2),
            "Body": Body(0.6, 5e-4, 7e-4, 9e-4),
        },
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
            "state": STATE,
            "velocity_command": np.array([0.3, -0.1, 0.2]),
            "acceleration_feedforward": np.array([0.2, 0.4, -0.1]),
            "speed": np.array([0.4]),
            # A little more, and the vehicle has to hold.
            "measurement_age": np.array([DEFAULT_HOLD_AFTER - 0.005]),
        },
        {"Branch": HOLD_POSITION, "Laps": 1.2, "HoldAfter": 0.1, "LandAfter": 0.12},
        flown_supervisor(),
        counts=False,
    ),
}
PARAMETERS = [(name, parameter) for name in CASES for parameter in CASES[name].parameters]


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
        return _floats(value if isinstance(value, tuple) else (value,))

    def outputs(self, context: Any, system: Any = None) -> np.ndarray:
        """All outputs one after the other, as plain floats."""
        system = system or self.system
        ports = [system.get_output_port(i) for i in range(system.num_output_ports())]
        return np.array(_floats(v for port in ports for v in port.Eval(context)))

    def effects(self, context: Any, system: Any = None) -> np.ndarray:
        """All outputs, and behind them the discrete state after the next sample."""
        system = system or self.system
        outputs = self.outputs(context, system)
        if context.num_discrete_state_groups() == 0:
            return outputs
        later = context.Clone()
        later.SetTime(SAMPLE_TIME)
        state = system.EvalUniquePeriodicDiscreteUpdate(later)
        return np.concatenate((outputs, _floats(state.value())))


def _floats(values: Any) -> list[float]:
    return [float(v.value() if hasattr(v, "value") else v) for v in values]


@pytest.fixture
def make_subject(make_field):
    def make(name: str) -> Subject:
        case = CASES[name]
        counted = {
            # Wide enough at the first speed.
            "field": lambda: CountingField(make_field("robust", gain=0.8)),
            "function": CountingFunction,
            "vehicle": lambda: CountingVehicle(thrust_to_weight=3.5),
            "nothing": lambda: None,
        }[case.counted]()
        return Subject(case, counted)

    return make


@pytest.fixture(params=CASES)
def subject(request, make_subject):
    return make_subject(request.param)


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_changed_parameter_takes_effect_at_once(make_subject, name, parameter):
    subject = make_subject(name)
    value = subject.case.parameters[parameter]
    context = subject.context()
    before = subject.effects(context)
    subject.set(context, parameter, value)
    assert subject.get(context, parameter) == _floats(np.ravel(value))
    after = subject.effects(context)
    assert np.abs(after - before).max() > 1e-3
    # As if it had been so before anything was evaluated.
    untouched = subject.context(**{parameter: value})
    np.testing.assert_array_equal(after, subject.effects(untouched))


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_parameter_set_in_the_vector_takes_effect_at_once(make_subject, name, parameter):
    """As Drake's own tools set it: not by the method, but in the Context's vectors."""
    subject = make_subject(name)
    context = subject.context()
    before = subject.effects(context)
    changed = subject.context(**{parameter: subject.case.parameters[parameter]})
    for index in range(context.num_numeric_parameter_groups()):
        context.get_mutable_numeric_parameter(index).SetFromVector(
            changed.get_numeric_parameter(index).CopyToVector()
        )
    after = subject.effects(context)
    np.testing.assert_array_equal(after, subject.effects(changed))
    assert np.abs(after - before).max() > 1e-3


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_clone_carries_the_parameter_and_is_its_own(make_subject, name, parameter):
    subject = make_subject(name)
    value = subject.case.parameters[parameter]
    context = subject.context(**{parameter: value})
    expected = subject.effects(context)
    clone = context.Clone()
    assert subject.get(clone, parameter) == subject.get(context, parameter)
    np.testing.assert_array_equal(subject.effects(clone), expected)
    initial = subject.system.CreateDefaultContext()
    clone.SetTimeStateAndParametersFrom(initial)
    assert subject.get(clone, parameter) == subject.get(initial, parameter)
    assert subject.get(context, parameter) == _floats(np.ravel(value))
    np.testing.assert_array_equal(subject.effects(context), expected)


def test_conversion_carries_the_arguments(subject):
    converted = subject.system.ToAutoDiffXd()
    context, float_context = subject.context(converted), subject.context()
    for parameter in subject.case.parameters:
        assert subject.get(context, parameter, converted) == subject.get(
            float_context, parameter
        )
    np.testing.assert_allclose(
        subject.effects(context, converted), subject.effects(float_context), rtol=1e-13
    )


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_conversion_carries_the_context(make_subject, name, parameter):
    subject = make_subject(name)
    context = subject.context(**{parameter: subject.case.parameters[parameter]})
    converted = subject.system.ToAutoDiffXd()
    converted_context = subject.context(converted)
    converted_context.SetTimeStateAndParametersFrom(context)
    assert subject.get(converted_context, parameter, converted) == subject.get(
        context, parameter
    )
    np.testing.assert_allclose(
        subject.effects(converted_context, converted), subject.effects(context), rtol=1e-13
    )


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_plain_floats_can_be_set_in_a_differentiated_context(make_subject, name, parameter):
    subject = make_subject(name)
    value = subject.case.parameters[parameter]
    converted = subject.system.ToAutoDiffXd()
    context = subject.context(converted, **{parameter: value})
    assert subject.get(context, parameter, converted) == _floats(np.ravel(value))
    np.testing.assert_allclose(
        subject.effects(context, converted),
        subject.effects(subject.context(**{parameter: value})),
        rtol=1e-13,
    )


def test_nothing_is_computed_again_while_nothing_changes(subject):
    context = subject.context()
    expected = subject.outputs(context)
    calls = subject.calls
    assert (calls > 0) == subject.case.counts
    for time in (0.0, 0.5, 1.0):
        # No output depends on the time.
        context.SetTime(time)
        np.testing.assert_array_equal(subject.outputs(context), expected)
    assert subject.calls == calls


def test_outputs_are_computed_again_when_an_input_changes(subject):
    context = subject.context()
    before = subject.effects(context)
    for name, value in subject.case.inputs.items():
        calls = subject.calls
        subject.system.GetInputPort(name).FixValue(context, value + 0.01)
        after = subject.effects(context)
        # The first input is what fields and functions are evaluated at.
        if subject.case.counts and name == next(iter(subject.case.inputs)):
            assert subject.calls > calls
        assert np.abs(after - before).max() > 1e-6
        before = after
    changed = subject.context()
    for name, value in subject.case.inputs.items():
        subject.system.GetInputPort(name).FixValue(changed, value + 0.01)
    np.testing.assert_array_equal(before, subject.effects(changed))


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_two_contexts_do_not_influence_each_other(make_subject, name, parameter):
    subject = make_subject(name)
    value = subject.case.parameters[parameter]
    one, other = subject.context(), subject.context()
    initial = subject.effects(one)
    subject.set(other, parameter, value)
    changed = subject.effects(other)
    np.testing.assert_array_equal(subject.effects(one), initial)
    first = next(iter(subject.case.inputs))
    subject.system.GetInputPort(first).FixValue(one, subject.case.inputs[first] + 0.01)
    moved = subject.effects(one)
    assert np.abs(moved - initial).max() > 1e-6
    np.testing.assert_array_equal(subject.effects(other), changed)
    subject.system.GetInputPort(first).FixValue(one, subject.case.inputs[first])
    np.testing.assert_array_equal(subject.effects(one), initial)


@pytest.mark.parametrize("seed", range(5))
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
    controller = diagram.GetSubsystemByName("controller")
    forces = controller.GetOutputPort("propeller_force").Eval(
        controller.GetMyContextFromRoot(context)
    )
    assert np.all((forces >= 0.0) & (forces <= controller.parameters.max_propeller_force))


def test_every_system_with_parameters_is_a_case():
    exported = {name for name in systems.__all__ if f"{name}_" in systems.__all__}
    assert set(CASES) == exported
