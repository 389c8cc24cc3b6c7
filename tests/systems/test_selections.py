"""Parts of vectors: their entries and derivatives, evaluated only when an input changes."""

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import Demultiplexer, Multiplexer, PassThrough
import pytest

from systems.selections import AddConcatenation, AddSelections

SIZES = [3, 1, 2]
SIZE = sum(SIZES)
PARTS = {"end": slice(4, 6), "beginning": slice(0, 3), "whole": slice(0, 6)}


def concatenate(builder, ports):
    """All ports one after the other."""
    return [AddConcatenation(builder, "whole", ports)]


def select(builder, ports):
    """Overlapping parts of their concatenation, in another order."""
    whole = AddConcatenation(builder, "vector", ports)
    return AddSelections(builder, "parts", whole, PARTS).values()


def multiplex(builder, ports):
    whole = builder.AddSystem(Multiplexer(SIZES))
    for index, port in enumerate(ports):
        builder.Connect(port, whole.get_input_port(index))
    return [whole.get_output_port()]


def demultiplex(builder, ports):
    whole = AddConcatenation(builder, "vector", ports)
    parts = builder.AddSystem(Demultiplexer(SIZES))
    builder.Connect(whole, parts.get_input_port())
    return [parts.get_output_port(index) for index in range(len(SIZES))]


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


def make_diagram(add, count=False):
    """Inputs of these sizes, and what is made of them, perhaps behind a `Counter` each."""
    builder = DiagramBuilder()
    ports = []
    for size in SIZES:
        passed = builder.AddSystem(PassThrough(size))
        builder.ExportInput(passed.get_input_port())
        ports.append(passed.get_output_port())
    counters = []
    for port in add(builder, ports):
        output = port
        if count:
            counters.append(builder.AddSystem(Counter(port.size())))
            builder.Connect(port, counters[-1].get_input_port())
            output = counters[-1].get_output_port()
        builder.ExportOutput(output)
    return builder.Build(), counters


def fix(diagram, context, values):
    for index, part in enumerate(np.split(values, np.cumsum(SIZES)[:-1])):
        diagram.get_input_port(index).FixValue(context, part)


def outputs(diagram, context):
    ports = range(diagram.num_output_ports())
    return [diagram.get_output_port(index).Eval(context) for index in ports]


@pytest.mark.parametrize(
    ("add", "taken"), [(concatenate, [slice(0, SIZE)]), (select, list(PARTS.values()))]
)
def test_values_and_derivatives_are_those_of_the_entries(add, taken):
    # What is not finite stays where it is.
    values = np.array([0.1, np.inf, -2.0, 3.0, np.nan, 5.0])
    diagram, _ = make_diagram(add)
    context = diagram.CreateDefaultContext()
    fix(diagram, context, values)
    for found, entries in zip(outputs(diagram, context), taken, strict=True):
        np.testing.assert_array_equal(found, values[entries])
    converted = diagram.ToAutoDiffXd()
    context = converted.CreateDefaultContext()
    fix(converted, context, InitializeAutoDiff(values)[:, 0])
    for found, entries in zip(outputs(converted, context), taken, strict=True):
        assert isinstance(found[0], AutoDiffXd)
        np.testing.assert_array_equal(ExtractValue(found)[:, 0], values[entries])
        np.testing.assert_array_equal(ExtractGradient(found), np.eye(SIZE)[entries])


def calls_in_three_times(add):
    """How often what follows is evaluated at the start, at other times, and with new inputs."""
    diagram, counters = make_diagram(add, count=True)
    context, calls = diagram.CreateDefaultContext(), []
    for values in (np.arange(6.0), 1.0 + np.arange(6.0)):
        fix(diagram, context, values)
        for time in (0.0, 0.5, 1.0):
            context.SetTime(time)
            outputs(diagram, context)
            calls.append(counters[0].calls)
    return calls


@pytest.mark.parametrize("add", [concatenate, select])
def test_they_are_evaluated_only_when_an_input_changes(add):
    assert calls_in_three_times(add) == [1, 1, 1, 2, 2, 2]


@pytest.mark.parametrize("add", [multiplex, demultiplex])
def test_those_of_drake_that_they_replace_are_evaluated_at_every_time(add):
    # The reason for a Selector: when this fails, Multiplexer and Demultiplexer will do.
    assert calls_in_three_times(add) == [1, 2, 3, 4, 5, 6]
