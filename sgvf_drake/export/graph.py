"""Functions with their derivatives as nodes of an ONNX graph: a small algebra.

It has the operations of the certificate's models, so that what fields are composed of is
written once, in `certificate.field_model`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
import math
from typing import Any

import numpy as np
from onnx import NodeProto, TensorProto, helper, numpy_helper

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.expansions import (
    DECAY,
    FALL,
    INVERSE_ROOT,
    SECH_OF_ROOT,
    SQUASH,
)
from sgvf_drake.certificate.taylor_model import Numbers, Univariate
from sgvf_drake.fields.perceptron import Perceptron

# The functions of r^2 are flat at zero to far below the last bit of this.
SMALLEST = 1e-24
# The projection lets go of the score at one, and float holds the square of this.
LARGEST_FALL = 1e9


@dataclass(eq=False)
class Graph:
    """Nodes and constants of one type of floating-point numbers.

    Attributes:
        dtype: float64 or float32.
        nodes: In the order in which they are evaluated.
        constants: By name.
    """

    dtype: Any
    nodes: list[NodeProto] = field(default_factory=list)
    constants: list[TensorProto] = field(default_factory=list)

    @property
    def element_type(self) -> int:
        """The type of the numbers, as ONNX names it."""
        return int(helper.np_dtype_to_tensor_dtype(np.dtype(self.dtype)))

    def constant(self, values: Any) -> str:
        """Adds floating-point numbers; returns their name."""
        return self._stored(np.asarray(values, dtype=self.dtype))

    def integers(self, *values: int) -> str:
        """Adds whole numbers; returns their name."""
        return self._stored(np.array(values, dtype=np.int64))

    def add(self, kind: str, *inputs: str | float, name: str = "", **attributes: Any) -> str:
        """Adds a node of one output; returns the output's name.

        Args:
            kind: The operator.
            inputs: Names; numbers become constants.
            name: What the node is called, so that it can be found again.
            attributes: Those of the operator.
        """
        names = [part if isinstance(part, str) else self.constant(part) for part in inputs]
        output = f"{kind.lower()}_{len(self.nodes)}"
        node = helper.make_node(kind, names, [output], name=name or output, **attributes)
        self.nodes.append(node)
        return output

    def sum(self, value: str) -> str:
        """Adds the sum along the last axis, which stays with one entry."""
        return self.add("ReduceSum", value, self.integers(-1), keepdims=1)

    def across(self, value: str) -> str:
        """Adds an axis for the derivatives: (n, f) -> (n, 1, f)."""
        return self.add("Unsqueeze", value, self.integers(1))

    def _stored(self, values: np.ndarray) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(values, name))
        return name


@dataclass(frozen=True, eq=False)
class Jet:
    """f functions at n points, and their derivatives by k variables.

    Attributes:
        graph: Where the nodes are.
        value: The name of the values, (n, f).
        slopes: That of the derivatives, (n, k, f); None: nobody asks for them.
    """

    graph: Graph
    value: str
    slopes: str | None

    def functions(self, columns: slice) -> "Jet":
        """Returns some of the functions."""
        start, stop = columns.start or 0, columns.stop
        ends = (start, np.iinfo(np.int64).max if stop is None else stop)

        def part(whole: str) -> str:
            return self.graph.add("Slice", whole, *map(self.graph.integers, (*ends, -1)))

        return self._each(part)

    def joined(self, *others: "Jet") -> "Jet":
        """Returns these functions and those of others, in order."""
        jets = (self, *others)
        value = self.graph.add("Concat", *(jet.value for jet in jets), axis=-1)
        if self.slopes is None:
            return Jet(self.graph, value, None)
        slopes = [jet.slopes for jet in jets if jet.slopes is not None]
        return Jet(self.graph, value, self.graph.add("Concat", *slopes, axis=-1))

    def __add__(self, other: "Jet") -> "Jet":
        slopes = None
        if self.slopes is not None and other.slopes is not None:
            slopes = self.graph.add("Add", self.slopes, other.slopes)
        return Jet(self.graph, self.graph.add("Add", self.value, other.value), slopes)

    def __sub__(self, other: "Jet") -> "Jet":
        return self + other.scaled(-1.0)

    def __mul__(self, other: "Jet") -> "Jet":
        """Returns the products; one function multiplies all of the other's."""
        graph, slopes = self.graph, None
        if self.slopes is not None and other.slopes is not None:
            slopes = graph.add(
                "Add",
                graph.add("Mul", self.slopes, other._across),
                graph.add("Mul", self._across, other.slopes),
            )
        return Jet(graph, graph.add("Mul", self.value, other.value), slopes)

    def scaled(self, factor: Numbers) -> "Jet":
        """Returns the functions times numbers."""
        numbers = self.graph.constant(factor)
        return self._each(lambda part: self.graph.add("Mul", part, numbers))

    def shifted(self, offset: Numbers) -> "Jet":
        """Returns the functions plus numbers; one function plus many is many."""
        value = self.graph.add("Add", self.value, self.graph.constant(offset))
        return Jet(self.graph, value, self.slopes)

    def dot(self, other: "Jet") -> "Jet":
        """Returns the sum of the products of the functions, one function."""
        return (self * other)._each(self.graph.sum)

    def affine(self, weight: FloatArray, bias: FloatArray | None, name: str = "") -> "Jet":
        """Returns weight y + bias of the functions y, with a weight (outputs, f)."""
        across = self.graph.constant(weight.T)
        value = self.graph.add("MatMul", self.value, across, name=name)
        if bias is not None:
            value = self.graph.add("Add", value, self.graph.constant(bias))
        if self.slopes is None:
            return Jet(self.graph, value, None)
        named = f"{name}.slopes" if name else ""
        return Jet(self.graph, value, self.graph.add("MatMul", self.slopes, across, name=named))

    def apply(self, function: Univariate, *, least: float = -np.inf) -> "Jet":
        """Returns a function of the certificate's of each; `least` is for its bounds alone."""
        return self.through(FUNCTIONS[function])

    def through(self, function: "Function") -> "Jet":
        """Returns a function of each."""
        value, slope = function(self.graph, self.value)
        if self.slopes is None:
            return Jet(self.graph, value, None)
        slopes = self.graph.add("Mul", self.slopes, self.graph.across(slope()))
        return Jet(self.graph, value, slopes)

    def softmax(self) -> "Jet":
        """Returns the exponentials of the functions, over their sum."""
        graph = self.graph
        shares = graph.add("Softmax", self.value, axis=-1)
        if self.slopes is None:
            return Jet(graph, shares, None)
        weights = graph.across(shares)
        mean = graph.sum(graph.add("Mul", weights, self.slopes))
        slopes = graph.add("Mul", weights, graph.add("Sub", self.slopes, mean))
        return Jet(graph, shares, slopes)

    @cached_property
    def _across(self) -> str:
        return self.graph.across(self.value)

    def _each(self, change: Callable[[str], str]) -> "Jet":
        slopes = None if self.slopes is None else change(self.slopes)
        return Jet(self.graph, change(self.value), slopes)


Function = Callable[[Graph, str], tuple[str, Callable[[], str]]]
"""Adds the value of a function of one variable; returns it, and what adds its derivative."""


def add_network(jet: Jet, of: Perceptron, name: str) -> Jet:
    """Returns the outputs of a network of the functions; its products are `name`.0, .1, ..."""
    if of.features is not None:
        count, d = of.features.frequencies.shape
        # The cosine as a sine: not every runtime has both in double.
        frequencies = np.concatenate([of.features.frequencies] * 2)
        phases = np.concatenate([of.features.phases, of.features.phases + math.pi / 2])
        angles = jet.functions(slice(d)).affine(frequencies, phases, f"{name}.features")
        waves = angles.through(_quadrature(count))
        jet = waves if of.features.passed == 0 else waves.joined(jet.functions(slice(d, None)))
    activation, last = ACTIVATIONS[of.activation.name], len(of.weights) - 1
    for layer, (weight, bias) in enumerate(zip(of.weights, of.biases, strict=True)):
        jet = jet.affine(weight, bias, f"{name}.{layer}")
        if layer < last:
            jet = jet.through(activation)
    return jet


def _quadrature(count: int) -> Function:
    """Sines, of which the second half are a quarter turn ahead: each half's slopes."""

    def waves(graph: Graph, z: str) -> tuple[str, Callable[[], str]]:
        value = graph.add("Sin", z)

        def slope() -> str:
            sines, cosines = (
                graph.add("Slice", value, *map(graph.integers, (start, start + count, -1)))
                for start in (0, count)
            )
            return graph.add("Concat", cosines, graph.add("Neg", sines), axis=-1)

        return value, slope

    return waves


def tanh(graph: Graph, z: str) -> tuple[str, Callable[[], str]]:
    """Adds tanh z."""
    value = graph.add("Tanh", z)
    return value, lambda: _one_less(graph, graph.add("Mul", value, value))


def log_cosh(graph: Graph, z: str) -> tuple[str, Callable[[], str]]:
    """Adds log cosh z, without overflow."""
    size = graph.add("Abs", z)
    tail = _log_one_more(graph, graph.add("Mul", size, -2.0))
    value = graph.add("Sub", graph.add("Add", size, tail), math.log(2))
    return value, lambda: graph.add("Tanh", z)


def _silu(graph: Graph, z: str) -> tuple[str, Callable[[], str]]:
    gate = graph.add("Sigmoid", z)
    value = graph.add("Mul", z, gate)
    return value, lambda: graph.add(
        "Add", gate, graph.add("Mul", value, _one_less(graph, gate))
    )


def _sigmoid(graph: Graph, z: str) -> tuple[str, Callable[[], str]]:
    value = graph.add("Sigmoid", z)
    return value, lambda: graph.add("Mul", value, _one_less(graph, value))


def _softplus(graph: Graph, z: str) -> tuple[str, Callable[[], str]]:
    # ONNX Runtime has neither this nor ELU in double.
    tail = _log_one_more(graph, graph.add("Neg", graph.add("Abs", z)))
    return graph.add("Add", graph.add("Relu", z), tail), lambda: graph.add("Sigmoid", z)


def _gelu(graph: Graph, z: str) -> tuple[str, Callable[[], str]]:
    half = graph.add("Mul", graph.add("Erf", graph.add("Mul", z, math.sqrt(0.5))), 0.5)
    share = graph.add("Add", half, 0.5)

    def slope() -> str:
        bell = graph.add("Exp", graph.add("Mul", graph.add("Mul", z, z), -0.5))
        density = graph.add("Mul", bell, 1 / math.sqrt(2 * math.pi))
        return graph.add("Add", share, graph.add("Mul", z, density))

    return graph.add("Mul", z, share), slope


def _elu(graph: Graph, z: str) -> tuple[str, Callable[[], str]]:
    decay = graph.add("Exp", graph.add("Min", z, 0.0))
    # One of the two is zero.
    value = graph.add("Add", graph.add("Relu", z), graph.add("Sub", decay, 1.0))
    return value, lambda: decay


def _relu(graph: Graph, z: str) -> tuple[str, Callable[[], str]]:
    return graph.add("Relu", z), lambda: graph.add(
        "Cast", graph.add("Greater", z, 0.0), to=graph.element_type
    )


ACTIVATIONS: dict[str, Function] = {
    "SiLU": _silu,
    "Tanh": tanh,
    "Sigmoid": _sigmoid,
    "Softplus": _softplus,
    "GELU": _gelu,
    "ELU": _elu,
    "ReLU": _relu,
}
"""By the names of `fields.activation`."""


def _decay(graph: Graph, u: str) -> tuple[str, Callable[[], str]]:
    value = graph.add("Exp", graph.add("Neg", u))
    return value, lambda: graph.add("Neg", value)


def _fall(graph: Graph, u: str) -> tuple[str, Callable[[], str]]:
    """1 / (1 + u^4)."""
    u = graph.add("Min", u, LARGEST_FALL)
    square = graph.add("Mul", u, u)
    value = graph.add("Reciprocal", graph.add("Add", graph.add("Mul", square, square), 1.0))

    def slope() -> str:
        cube = graph.add("Mul", graph.add("Mul", u, square), -4.0)
        return graph.add("Mul", graph.add("Mul", cube, value), value)

    return value, slope


def _inverse_root(graph: Graph, u: str) -> tuple[str, Callable[[], str]]:
    value = graph.add("Reciprocal", graph.add("Sqrt", u))
    return value, lambda: graph.add("Mul", graph.add("Div", value, u), -0.5)


def _squash(graph: Graph, u: str) -> tuple[str, Callable[[], str]]:
    """Tanh r / r of u = r^2; the derivative cancels only where u's own is as small."""
    u = graph.add("Max", u, SMALLEST)
    r = graph.add("Sqrt", u)
    value = graph.add("Div", graph.add("Tanh", r), r)

    def slope() -> str:
        sech = _sech(graph, r)
        difference = graph.add("Sub", graph.add("Mul", sech, sech), value)
        return graph.add("Mul", graph.add("Div", difference, u), 0.5)

    return value, slope


def _sech_of_root(graph: Graph, u: str) -> tuple[str, Callable[[], str]]:
    r = graph.add("Sqrt", graph.add("Max", u, SMALLEST))
    value = _sech(graph, r)

    def slope() -> str:
        ratio = graph.add("Div", graph.add("Tanh", r), r)
        return graph.add("Mul", graph.add("Mul", value, ratio), -0.5)

    return value, slope


def _sech(graph: Graph, r: str) -> str:
    """By the decaying exponential, which cannot overflow."""
    decay = graph.add("Exp", graph.add("Neg", r))
    below = graph.add("Add", graph.add("Mul", decay, decay), 1.0)
    return graph.add("Div", graph.add("Mul", decay, 2.0), below)


def _log_one_more(graph: Graph, exponent: str) -> str:
    """Adds log(1 + e^z) of z below zero."""
    return graph.add("Log", graph.add("Add", graph.add("Exp", exponent), 1.0))


def _one_less(graph: Graph, value: str) -> str:
    return graph.add("Sub", 1.0, value)


FUNCTIONS: dict[Univariate, Function] = {
    DECAY: _decay,
    FALL: _fall,
    INVERSE_ROOT: _inverse_root,
    SQUASH: _squash,
    SECH_OF_ROOT: _sech_of_root,
}
"""Those that compositions have."""
