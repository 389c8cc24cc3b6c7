"""What every system promises of its Context: parameters, clones, conversion, caching.

A system is added to these tests by one entry of `CASES`.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common import RandomGenerator
import pytest

from sgvf_drake.fields import GaussianMixture
from sgvf_drake.lyapunov import LyapunovFunction
import systems
from systems import (
    DEFAULT_GAINS,
    GuidanceSystem,
    KinematicGuidance,
    LyapunovMonitor,
    MakeFlightDiagram,
    QuadrotorParameters,
    Se3Controller,
)
from systems.se3_law import Body

RNG = np.random.default_rng(11)
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
        inputs: A value for each input port.
        parameters: Another value for each parameter NAME with methods GetNAME and SetNAME.
    """

    make: Callable[[Any], Any]
    counted: str
    inputs: Mapping[str, Any]
    parameters: Mapping[str, Any]


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
}
PARAMETERS = [(name, parameter) for name in CASES for parameter in CASES[name].parameters]


class Subject:
    """A system of a case with the words that the tests use."""

    def __init__(self, case: Case, counted: Any) -> None:
        self.case, self.counted = case, counted
        self.system = case.make(counted)

    def context(self, system: Any = None, **parameters: Any) -> Any:
        """A new Context with fixed inputs."""
        system = system or self.system
        context = system.CreateDefaultContext()
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
    before = subject.outputs(context)
    subject.set(context, parameter, value)
    assert subject.get(context, parameter) == _floats(np.ravel(value))
    after = subject.outputs(context)
    assert np.abs(after - before).max() > 1e-3
    # As if it had been so before anything was evaluated.
    untouched = subject.context(**{parameter: value})
    np.testing.assert_array_equal(after, subject.outputs(untouched))


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_parameter_set_in_the_vector_takes_effect_at_once(make_subject, name, parameter):
    """As Drake's own tools set it: not by the method, but in the Context's vectors."""
    subject = make_subject(name)
    context = subject.context()
    before = subject.outputs(context)
    changed = subject.context(**{parameter: subject.case.parameters[parameter]})
    for index in range(context.num_numeric_parameter_groups()):
        context.get_mutable_numeric_parameter(index).SetFromVector(
            changed.get_numeric_parameter(index).CopyToVector()
        )
    after = subject.outputs(context)
    np.testing.assert_array_equal(after, subject.outputs(changed))
    assert np.abs(after - before).max() > 1e-3


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_clone_carries_the_parameter_and_is_its_own(make_subject, name, parameter):
    subject = make_subject(name)
    value = subject.case.parameters[parameter]
    context = subject.context(**{parameter: value})
    expected = subject.outputs(context)
    clone = context.Clone()
    assert subject.get(clone, parameter) == subject.get(context, parameter)
    np.testing.assert_array_equal(subject.outputs(clone), expected)
    initial = subject.system.CreateDefaultContext()
    clone.SetTimeStateAndParametersFrom(initial)
    assert subject.get(clone, parameter) == subject.get(initial, parameter)
    assert subject.get(context, parameter) == _floats(np.ravel(value))
    np.testing.assert_array_equal(subject.outputs(context), expected)


def test_conversion_carries_the_arguments(subject):
    converted = subject.system.ToAutoDiffXd()
    context, float_context = subject.context(converted), subject.context()
    for parameter in subject.case.parameters:
        assert subject.get(context, parameter, converted) == subject.get(
            float_context, parameter
        )
    np.testing.assert_allclose(
        subject.outputs(context, converted), subject.outputs(float_context), rtol=1e-13
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
        subject.outputs(converted_context, converted), subject.outputs(context), rtol=1e-13
    )


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_plain_floats_can_be_set_in_a_differentiated_context(make_subject, name, parameter):
    subject = make_subject(name)
    value = subject.case.parameters[parameter]
    converted = subject.system.ToAutoDiffXd()
    context = subject.context(converted, **{parameter: value})
    assert subject.get(context, parameter, converted) == _floats(np.ravel(value))
    np.testing.assert_allclose(
        subject.outputs(context, converted),
        subject.outputs(subject.context(**{parameter: value})),
        rtol=1e-13,
    )


def test_nothing_is_computed_again_while_nothing_changes(subject):
    context = subject.context()
    expected = subject.outputs(context)
    calls = subject.counted.calls
    assert calls > 0
    for time in (0.0, 0.5, 1.0):
        # No output depends on the time.
        context.SetTime(time)
        np.testing.assert_array_equal(subject.outputs(context), expected)
    assert subject.counted.calls == calls


def test_outputs_are_computed_again_when_an_input_changes(subject):
    context = subject.context()
    before = subject.outputs(context)
    for name, value in subject.case.inputs.items():
        calls = subject.counted.calls
        subject.system.GetInputPort(name).FixValue(context, value + 0.01)
        after = subject.outputs(context)
        # The first input is what fields and functions are evaluated at.
        if name == next(iter(subject.case.inputs)):
            assert subject.counted.calls > calls
        assert np.abs(after - before).max() > 1e-6
        before = after
    changed = subject.context()
    for name, value in subject.case.inputs.items():
        subject.system.GetInputPort(name).FixValue(changed, value + 0.01)
    np.testing.assert_array_equal(before, subject.outputs(changed))


@pytest.mark.parametrize(("name", "parameter"), PARAMETERS)
def test_two_contexts_do_not_influence_each_other(make_subject, name, parameter):
    subject = make_subject(name)
    value = subject.case.parameters[parameter]
    one, other = subject.context(), subject.context()
    initial = subject.outputs(one)
    subject.set(other, parameter, value)
    changed = subject.outputs(other)
    np.testing.assert_array_equal(subject.outputs(one), initial)
    first = next(iter(subject.case.inputs))
    subject.system.GetInputPort(first).FixValue(one, subject.case.inputs[first] + 0.01)
    moved = subject.outputs(one)
    assert np.abs(moved - initial).max() > 1e-6
    np.testing.assert_array_equal(subject.outputs(other), changed)
    subject.system.GetInputPort(first).FixValue(one, subject.case.inputs[first])
    np.testing.assert_array_equal(subject.outputs(one), initial)


@pytest.mark.parametrize("seed", range(5))
def test_random_context_has_usable_parameters(subject, seed):
    context = subject.context()
    subject.system.SetRandomContext(context, RandomGenerator(seed))
    assert np.isfinite(subject.outputs(context)).all()
    for parameter in subject.case.parameters:
        drawn = getattr(subject.system, f"Get{parameter}")(context)
        assert np.isfinite(subject.get(context, parameter)).all()
        # Its own method accepts it.
        subject.set(context, parameter, drawn)


def test_random_context_of_a_flight_has_usable_parameters(make_field):
    diagram = MakeFlightDiagram(make_field("robust"))
    context = diagram.CreateDefaultContext()
    diagram.SetRandomContext(context, RandomGenerator(1))
    controller = diagram.GetSubsystemByName("controller")
    forces = controller.GetOutputPort("propeller_force").Eval(controller.GetMyContextFromRoot(context))
    assert np.all((forces >= 0.0) & (forces <= controller.parameters.max_propeller_force))


def test_every_system_with_parameters_is_a_case():
    exported = {name for name in systems.__all__ if f"{name}_" in systems.__all__}
    assert set(CASES) == exported
