"""Concatenation beside Drake's Multiplexer: the same values, evaluated less often."""

import numpy as np
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Multiplexer, Multiplexer_
import pytest

from systems.concatenation import Concatenation

SIZES = [3, 1, 2]


def fix(system, context, values):
    for index, part in enumerate(np.split(values, np.cumsum(SIZES)[:-1])):
        system.get_input_port(index).FixValue(context, part)


def output(system, values):
    context = system.CreateDefaultContext()
    fix(system, context, values)
    return system.get_output_port().Eval(context)


class Counter(LeafSystem):
    """Counts how often what depends on its input, and on nothing else, is evaluated."""

    def __init__(self, size):
        super().__init__()
        self.calls = 0
        port = self.DeclareVectorInputPort("input", size)

        def calc(context, output):
            self.calls += 1
            output.SetFromVector(port.Eval(context))

        self.DeclareVectorOutputPort(
            "output", size, calc, {self.input_port_ticket(port.get_index())}
        )


def calls_in_three_times(system):
    """How often what follows a system is evaluated at the start, at other times, anew."""
    builder = DiagramBuilder()
    builder.AddSystem(system)
    counter = builder.AddSystem(Counter(sum(SIZES)))
    builder.Connect(system.get_output_port(), counter.get_input_port())
    diagram = builder.Build()
    context = diagram.CreateDefaultContext()
    own = system.GetMyMutableContextFromRoot(context)
    port, found = counter.get_output_port(), []
    for values in (np.arange(6.0), 1.0 + np.arange(6.0)):
        fix(system, own, values)
        for time in (0.0, 0.5, 1.0):
            context.SetTime(time)
            result = port.Eval(counter.GetMyContextFromRoot(context))
            np.testing.assert_array_equal(result, values)
            found.append(counter.calls)
    return found


def test_values_are_those_of_the_multiplexer():
    values = np.random.default_rng(0).standard_normal(6)
    expected = output(Multiplexer(SIZES), values)
    np.testing.assert_array_equal(output(Concatenation(SIZES), values), expected)


def test_derivatives_are_those_of_the_multiplexer():
    x = InitializeAutoDiff(np.random.default_rng(0).standard_normal(6))[:, 0]
    found = output(Concatenation(SIZES).ToAutoDiffXd(), x)
    expected = output(Multiplexer_[type(x[0])](SIZES), x)
    np.testing.assert_array_equal(ExtractValue(found), ExtractValue(expected))
    np.testing.assert_array_equal(ExtractGradient(found), ExtractGradient(expected))


def test_it_is_evaluated_only_when_an_input_changes():
    assert calls_in_three_times(Concatenation(SIZES)) == [1, 1, 1, 2, 2, 2]


def test_a_multiplexer_is_evaluated_at_every_time():
    # The reason for a system of our own: when this fails, Drake's will do.
    assert calls_in_three_times(Multiplexer(SIZES)) == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize("index", range(len(SIZES)))
def test_every_input_changes_the_output_at_once(index):
    system = Concatenation(SIZES)
    context = system.CreateDefaultContext()
    fix(system, context, np.zeros(6))
    assert not system.get_output_port().Eval(context).any()
    system.get_input_port(index).FixValue(context, np.ones(SIZES[index]))
    expected = np.concatenate([np.full(n, float(i == index)) for i, n in enumerate(SIZES)])
    np.testing.assert_array_equal(system.get_output_port().Eval(context), expected)
