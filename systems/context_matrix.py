"""Matrices that lie in the Context, so that one diagram serves simulations that differ in them.

Drake's MatrixGain and LinearSystem keep their matrices in the system, so that other ones ask
for another diagram.  Here the matrix is the value of a ConstantVectorSource, which is a
parameter in the Context.
"""

from typing import Any

import numpy as np
from pydrake.common import RandomDistribution
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import (
    ConstantVectorSource,
    LinearTransformDensity,
    Multiplexer,
)

from sgvf_drake.arrays import FloatArray


def AddMatrix(
    builder: DiagramBuilder,
    name: str,
    matrix: FloatArray,
    *inputs: OutputPort,
    offset: OutputPort | None = None,
) -> OutputPort:
    """Adds a matrix times the vector of all inputs; returns the port of the product.

    Args:
        builder: Gets the systems.
        name: What `SetMatrix` knows the matrix by.
        matrix: The one of the default Context, (rows, columns).
        *inputs: Vectors of as many entries as there are columns, in all.
        offset: Is added to the product, of as many entries as there are rows; None: nothing.
    """
    rows, columns = matrix.shape
    source = builder.AddNamedSystem(f"{name}_matrix", ConstantVectorSource(_ByColumns(matrix)))
    # The only system of Drake that takes its matrix from a port; that its input is random, as
    # its name has it, is asked for nowhere.
    product: Any = builder.AddNamedSystem(
        name, LinearTransformDensity(RandomDistribution.kGaussian, columns, rows)
    )
    builder.Connect(source.get_output_port(), product.get_input_port_A())
    if offset is not None:
        builder.Connect(offset, product.get_input_port_b())
    if len(inputs) == 1:
        builder.Connect(inputs[0], product.get_input_port_w_in())
    else:
        stack = builder.AddNamedSystem(
            f"{name}_inputs", Multiplexer([port.size() for port in inputs])
        )
        for index, port in enumerate(inputs):
            builder.Connect(port, stack.get_input_port(index))
        builder.Connect(stack.get_output_port(), product.get_input_port_w_in())
    return product.get_output_port_w_out()


def SetMatrix(diagram: Diagram, context: Context, name: str, matrix: FloatArray) -> None:
    """Sets a matrix of `AddMatrix`.

    Args:
        diagram: The one that was built with it.
        context: This diagram's own.
        name: That of the matrix.
        matrix: The new one, of the same shape.
    """
    source: Any = diagram.GetSubsystemByName(f"{name}_matrix")
    own = diagram.GetMutableSubsystemContext(source, context)
    source.get_mutable_source_value(own).SetFromVector(_ByColumns(matrix))


def Matrix(diagram: Diagram, context: Context, name: str) -> FloatArray:
    """Returns a matrix of `AddMatrix`; the arguments are those of `SetMatrix`."""
    source: Any = diagram.GetSubsystemByName(f"{name}_matrix")
    values = source.get_source_value(
        diagram.GetSubsystemContext(source, context)
    ).CopyToVector()
    rows = diagram.GetSubsystemByName(name).GetOutputPort("w_out").size()
    return np.asarray(values.reshape(rows, -1, order="F"))


def _ByColumns(matrix: FloatArray) -> Any:
    """Returns the entries as LinearTransformDensity reads them."""
    return matrix.ravel(order="F")
