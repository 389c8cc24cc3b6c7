"""Guiding fields as ONNX graphs: m and its Jacobian, for any number of points at once.

A file needs an ONNX runtime and nothing of this package.  Inputs and outputs are in the unit
of the waypoints; the normalisation is part of the graph.

    x   (n, d)     positions
    g   (n, d)     intended directions, of directed fields
    m   (n, d)     the field
    tangent (n, d)                  of directed fields: the direction of the strand, to which a
                                    heading turns
    jacobian (n, d, d)              dm_i/dx_j
    jacobian_by_direction (n, d, d) dm_i/dg_j, of directed fields
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import helper

from sgvf_drake.arrays import FloatArray
from sgvf_drake.certificate.expansions import INVERSE_ROOT
from sgvf_drake.certificate.field_model import Algebra
from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.export.graph import Graph, Jet, add_network, log_cosh, tanh
from sgvf_drake.fields import (
    ComposedField,
    DirectedField,
    Perceptron,
    RobustComposition,
    ScoreInducedField,
    StrandMixture,
    StrandNetwork,
)
from sgvf_drake.fields.composition import DIRECTION_SOFTENING
from sgvf_drake.fields.storage import field_digest

VALUE_FILE, JACOBIAN_FILE = "field.onnx", "field_jacobian.onnx"
PRECISIONS = {"double": np.float64, "float": np.float32, "int8": np.float32}
"""Numbers of the graph; of int8 those outside of the networks."""

# What ONNX Runtime and others have read for years; newer operators are not needed.
OPSET, IR_VERSION = 17, 8
# Points at which a file is compared with NumPy, and how many noise levels from the path.
CHECK_POINTS, CHECK_REACH = 2000, 1.0


def export_onnx(
    field: ScoreInducedField,
    folder: Path,
    precision: str = "double",
    *,
    certificate: str | None = None,
) -> dict[str, Any]:
    """Writes a field as `field.onnx`, m alone, and `field_jacobian.onnx`, with derivatives.

    Of int8 there is m alone: products of derivatives are not what is quantised.

    Args:
        field: Of the position alone, or a directed one.
        folder: Where the files go.
        precision: `double`, `float`, or `int8` (see `quantised`).
        certificate: What is proved of the field in this precision, which the files tell.

    Returns:
        The names of the files, of inputs and outputs, and how far they are from NumPy, as
        plain values.

    Raises:
        ConfigurationError: If the precision is none of these, or GELU is asked for in double,
            whose error function no runtime has.
    """
    if precision not in PRECISIONS:
        raise ConfigurationError(
            f"--precision cannot be {precision!r}; of onnx it is one of {', '.join(PRECISIONS)}"
        )
    model = make_model(field, PRECISIONS[precision], jacobian=False)
    if precision == "double" and any(node.op_type == "Erf" for node in model.graph.node):
        raise ConfigurationError(
            "ONNX Runtime has no error function of double numbers, which GELU needs; export "
            "this field with --precision float"
        )
    models = {VALUE_FILE: model}
    if precision == "int8":
        # Imported here: it is slow to import, and only eight bits need it.
        from sgvf_drake.export.quantising import quantised

        models[VALUE_FILE] = quantised(model, calibration_points(field))
    else:
        models[JACOBIAN_FILE] = make_model(field, PRECISIONS[precision], jacobian=True)
    facts: dict[str, Any] = {
        "precision": precision,
        "files": {},
        "unit": "that of the waypoints",
    }
    for name, model in models.items():
        if certificate is not None:
            model.metadata_props.add(key="certificate", value=certificate)
        onnx.save(model, folder / name)
        facts["files"][name] = {
            "inputs": [part.name for part in model.graph.input],
            "outputs": [part.name for part in model.graph.output],
            "bytes": (folder / name).stat().st_size,
            "largest_difference": sampled_difference(field, model),
        }
    return facts


def make_model(field: ScoreInducedField, dtype: Any, *, jacobian: bool) -> onnx.ModelProto:
    """Returns the graph of a field.

    Args:
        field: Of the position alone, or a directed one.
        dtype: float64 or float32, of inputs, outputs and everything between.
        jacobian: Whether it gives the derivatives too.
    """
    graph, d = Graph(dtype), field.dim
    is_directed = isinstance(field, DirectedField)
    inputs = ["x", "g"] if is_directed else ["x"]
    variables = list(_variables(graph, inputs, d, jacobian=jacobian))
    z = variables[0].shifted(-field.cloud.center).scaled(1 / field.cloud.unit_length)
    outputs = {}
    match field:
        case DirectedField(strands=strands):
            S, N = _strands(strands, z, variables[1])
            m = GRAPH.composed(field, S, N, z)
            outputs["tangent"] = _tangent(field, Jet(graph, N.value, None)).value
        case ComposedField():
            m = GRAPH.field(field, z)
        case _:
            raise ConfigurationError(f"a {type(field).__name__} has no ONNX graph")
    outputs = {"m": m.value} | outputs
    if m.slopes is not None:
        across = graph.add("Transpose", m.slopes, perm=[0, 2, 1])
        for number, name in enumerate(("jacobian", "jacobian_by_direction")[: len(inputs)]):
            ends = (number * d, (number + 1) * d, -1)
            outputs[name] = graph.add("Slice", across, *map(graph.integers, ends))
    for name, node in outputs.items():
        graph.nodes.append(helper.make_node("Identity", [node], [name]))
    return _model(field, graph, inputs, list(outputs))


def _model(
    field: ScoreInducedField, graph: Graph, inputs: list[str], outputs: list[str]
) -> onnx.ModelProto:
    d = field.dim

    def described(name: str) -> onnx.ValueInfoProto:
        shape: list[str | int | None] = ["n", d, d] if name.startswith("jacobian") else ["n", d]
        return helper.make_tensor_value_info(name, graph.element_type, shape)

    whole = helper.make_graph(
        graph.nodes,
        "guiding_field",
        [described(name) for name in inputs],
        [described(name) for name in outputs],
        graph.constants,
    )
    model = helper.make_model(
        whole,
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="sgvf_drake",
        doc_string=__doc__,
    )
    told = {"recipe": field.recipe, "seed": str(field.seed), "field": field_digest(field)}
    helper.set_model_props(model, told)
    onnx.checker.check_model(model, full_check=True)
    return model


def _variables(graph: Graph, names: list[str], d: int, *, jacobian: bool) -> Iterator[Jet]:
    """Gives the inputs, each with its derivatives by all of them."""
    count = d * len(names)
    for number, name in enumerate(names):
        slopes = None
        if jacobian:
            # One copy a point, so that whatever is joined is of one size.
            batch = graph.add("Shape", names[0], start=0, end=1)
            shape = graph.add("Concat", batch, graph.integers(count, d), axis=0)
            own = np.eye(count, d, -d * number)
            slopes = graph.add("Expand", graph.constant(own), shape)
        yield Jet(graph, name, slopes)


def _network(of: Perceptron, z: Any, held: tuple[float, ...]) -> Any:
    for value in reversed(held):
        of = of.with_last_input(value)
    return add_network(z, of, f"network_{len(z.graph.nodes)}")


def _score(points: FloatArray, sigma: float, z: Any) -> Any:
    return _mixture(points, sigma, z, None)[0]


def _mixture(
    points: FloatArray, sigma: float, z: Jet, exponents: Jet | None
) -> tuple[Jet, Jet]:
    """Returns the score of a mixture, and the weights of its components.

    Args:
        points: (M, d).
        sigma: Noise level.
        z: The position.
        exponents: M functions that are added to the exponents of the weights; None: nothing.
    """
    # Differences before squares, which would cancel near the path.
    steps = [
        z.functions(slice(i, i + 1)).scaled(-1.0).shifted(points[:, i])
        for i in range(points.shape[1])
    ]
    for step in steps:
        square = (step * step).scaled(-0.5 / sigma**2)
        exponents = square if exponents is None else exponents + square
    assert exponents is not None
    weights = exponents.softmax()
    first, *others = (weights.dot(step) for step in steps)
    return first.joined(*others).scaled(1 / sigma**2), weights


def _strands(strands: StrandMixture | StrandNetwork, z: Jet, g: Jet) -> tuple[Jet, Jet]:
    """Returns the raw score and the tangent of directed strands."""
    if isinstance(strands, StrandNetwork):
        d = strands.network.num_inputs // 2
        output = _network(strands.network, z.joined(g), ())
        if strands.two_way:
            mirrored = _network(strands.network, z.joined(g.scaled(-1.0)), ())
            # The even part of the score, and the odd one of the tangent.
            output = (output + mirrored.scaled(np.repeat([1.0, -1.0], d))).scaled(0.5)
        S = output.functions(slice(d)).scaled(1 / strands.sigma)
        return S, output.functions(slice(d, None))
    along = g.affine(strands.sharpness[:, None] * strands.directions, None)
    one_way = strands.one_way.astype(float)
    exponents = along.scaled(one_way) + along.through(log_cosh).scaled(1 - one_way)
    share = along.through(tanh).scaled(1 - one_way).shifted(one_way)
    S, weights = _mixture(strands.points, strands.sigma, z, exponents)
    return S, (weights * share).affine(strands.directions.T, None)


def _tangent(field: DirectedField, N: Jet) -> Jet:
    """Returns the direction of the strand, `Composition.tangent`."""
    if not isinstance(field.composition, RobustComposition):
        return N
    square = N.dot(N).shifted(DIRECTION_SOFTENING**2)
    return square.apply(INVERSE_ROOT) * N


# In place of patches there is the position, of which the algebra asks nothing.
GRAPH: Any = Algebra[Any](
    lambda z: z,
    _network,
    lambda components, z: _score(components.points, components.sigma, z),
)
"""What fields are composed of, as nodes."""


class Session:
    """A graph in ONNX Runtime, on the processor, called with NumPy arrays.

    Attributes:
        model: The graph.
    """

    def __init__(self, model: onnx.ModelProto) -> None:
        """Loads a graph."""
        import onnxruntime

        self.model = model
        options = onnxruntime.SessionOptions()
        # Errors alone: it warns of what it does to constants.
        options.log_severity_level, options.intra_op_num_threads = 3, 1
        self._session: Any = onnxruntime.InferenceSession(
            model.SerializeToString(), options, providers=["CPUExecutionProvider"]
        )

    def __call__(self, *inputs: FloatArray) -> list[FloatArray]:
        """Returns all outputs in float64, of inputs in the order of the graph's."""
        feed = {}
        for part, values in zip(self.model.graph.input, inputs, strict=True):
            dtype = helper.tensor_dtype_to_np_dtype(part.type.tensor_type.elem_type)
            feed[part.name] = np.asarray(values, dtype)
        return [np.asarray(values, np.float64) for values in self._session.run(None, feed)]


def calibration_points(field: ScoreInducedField) -> list[FloatArray]:
    """Returns inputs all over the box, and as many within a noise level of the path."""
    rng, cloud = np.random.default_rng(0), field.cloud
    half = CHECK_POINTS // 2
    reach = CHECK_REACH * field.sigma * cloud.unit_length
    near = field.mixture.points[rng.integers(len(field.mixture.points), size=half)]
    x = np.concatenate(
        [
            rng.uniform(*cloud.box, (half, cloud.dim)),
            near + reach * rng.uniform(-1, 1, near.shape),
        ]
    )
    if not isinstance(field, DirectedField):
        return [x]
    g = rng.standard_normal(x.shape)
    return [x, g / np.linalg.norm(g, axis=1, keepdims=True)]


def sampled_difference(field: ScoreInducedField, model: onnx.ModelProto) -> dict[str, float]:
    """Returns how far the outputs of a graph are from NumPy at most, over sampled points.

    The derivatives are those by the user's unit.
    """
    inputs = calibration_points(field)
    names = [part.name for part in model.graph.output]
    outputs = dict(zip(names, Session(model)(*inputs), strict=True))
    m, J = field.value_and_jacobian(*inputs)  # type: ignore[attr-defined]
    expected = {"m": m, "jacobian": J}
    if isinstance(field, DirectedField):
        expected["tangent"] = field.tangent(*inputs)
        expected["jacobian_by_direction"] = field.jacobian_by_direction(*inputs)
    return {name: float(np.abs(outputs[name] - expected[name]).max()) for name in names}
