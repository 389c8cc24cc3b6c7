"""Entries of vectors, taken apart and put together by Drake's Selector.

Drake's Demultiplexer and Multiplexer would do, but their outputs count as dependent on the
time: behind them, everything is evaluated anew in every stage of the integrator, even where the
inputs are held between samples.  Those of a Selector depend on its inputs alone.
"""

from collections.abc import Iterable, Mapping, Sequence

from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import Selector, SelectorParams


def AddSelections(
    builder: DiagramBuilder, name: str, port: OutputPort, parts: Mapping[str, slice]
) -> dict[str, OutputPort]:
    """Adds a system of this name that takes parts of a vector; returns the port of each part.

    Args:
        builder: Gets the system.
        name: That of the system.
        port: Gives the vector.
        parts: Which entries the outputs of these names have.
    """
    entries = range(port.size())
    outputs = {part: [(0, entry) for entry in entries[taken]] for part, taken in parts.items()}
    return _AddSelector(builder, name, [port], outputs)


def AddConcatenation(
    builder: DiagramBuilder, name: str, ports: Sequence[OutputPort]
) -> OutputPort:
    """Adds a system of this name that puts vectors one after the other; returns its output."""
    entries = [(i, entry) for i, port in enumerate(ports) for entry in range(port.size())]
    return _AddSelector(builder, name, ports, {name: entries})[name]


def _AddSelector(
    builder: DiagramBuilder,
    name: str,
    ports: Sequence[OutputPort],
    outputs: Mapping[str, Iterable[tuple[int, int]]],
) -> dict[str, OutputPort]:
    """Adds a Selector; an output is said by the input and the offset there of each entry."""
    params = SelectorParams(
        inputs=[SelectorParams.InputPortParams(size=port.size()) for port in ports],
        outputs=[
            SelectorParams.OutputPortParams(
                name=output,
                selections=[
                    SelectorParams.OutputSelection(input_port_index=i, input_offset=offset)
                    for i, offset in entries
                ],
            )
            for output, entries in outputs.items()
        ],
    )
    selector = builder.AddNamedSystem(name, Selector(params))
    for index, port in enumerate(ports):
        builder.Connect(port, selector.get_input_port(index))
    return {output: selector.GetOutputPort(output) for output in outputs}
