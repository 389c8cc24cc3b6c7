"""ONNX files against NumPy: every composition, recipe, activation and kind of strands."""

from dataclasses import replace
from itertools import product

import numpy as np
import onnx
from onnx.reference import ReferenceEvaluator
from onnx.reference.op_run import OpRun
import pytest
from scipy.special import erf

from sgvf_drake.exceptions import ConfigurationError
from sgvf_drake.export.onnx import (
    Session,
    calibration_points,
    export_onnx,
    make_model,
    sampled_difference,
)
from sgvf_drake.fields import (
    DirectedField,
    NormalisedComposition,
    PaperComposition,
    PursuitField,
    RobustComposition,
    load_field,
)
from sgvf_drake.fields.activation import ACTIVATIONS
from tests.fields import DIRECTED_KINDS, RECIPES, random_directed_field, random_field

COMPOSITIONS = (
    PaperComposition(0.8),
    NormalisedComposition(0.8),
    RobustComposition(0.8, 0.4, projects=False),
)


def with_activation(activation):
    field = random_field("paper")
    return replace(field, tangent_network=replace(field.tangent_network, activation=activation))


FIELDS = {
    **{
        f"{recipe} in {dim}-D, {ends} ends": random_field(recipe, dim=dim, ends=ends, support=9)
        for recipe, dim, ends in product(RECIPES, (2, 3), (0, 2))
    },
    **{
        f"{recipe} {composition}": replace(random_field(recipe), composition=composition)
        for recipe, composition in product(("robust", "exact"), COMPOSITIONS)
    },
    **{one.name: with_activation(one) for one in ACTIVATIONS if one.name != "GELU"},
    **{
        f"{kind} in {dim}-D": random_directed_field(kind, dim, ends=True)
        for kind, dim in product(DIRECTED_KINDS, (2, 3))
    },
}


def expected(field, inputs):
    """What NumPy makes of inputs, by the names of the outputs."""
    m, J = field.value_and_jacobian(*inputs)
    named = {"m": m, "jacobian": J}
    if isinstance(field, DirectedField):
        named["tangent"] = field.tangent(*inputs)
        named["jacobian_by_direction"] = field.jacobian_by_direction(*inputs)
    return named


@pytest.mark.parametrize("field", FIELDS.values(), ids=FIELDS)
def test_a_graph_is_the_field(field):
    inputs = calibration_points(field)
    known = expected(field, inputs)
    for dtype, tolerance in ((np.float64, 1e-12), (np.float32, 2e-4)):
        for jacobian in (False, True):
            model = make_model(field, dtype, jacobian=jacobian)
            names = [part.name for part in model.graph.output]
            assert ("jacobian" in names) == jacobian
            # Any number of points, none among them.
            for count in (0, 1, 50):
                some = [values[-count:] if count else values[:0] for values in inputs]
                found = dict(zip(names, Session(model)(*some), strict=True))
                for name, values in found.items():
                    right = known[name][-count:] if count else known[name][:0]
                    assert values.shape == right.shape
                    scale = max(1.0, np.abs(right).max(initial=0.0))
                    assert np.abs(values - right).max(initial=0.0) <= tolerance * scale


class Erf(OpRun):
    """The error function in double: the runtime has none, and the reference's is in single."""

    def _run(self, x):
        return (erf(x),)


def test_gelu_is_exported_in_single_and_right_in_double(tmp_path):
    (gelu,) = (one for one in ACTIVATIONS if one.name == "GELU")
    field = with_activation(gelu)
    with pytest.raises(ConfigurationError, match=r"GELU needs; .* --precision float"):
        export_onnx(field, tmp_path)
    facts = export_onnx(field, tmp_path, precision="float")
    for told in facts["files"].values():
        assert max(told["largest_difference"].values()) < 1e-4
    (x,) = calibration_points(field)
    model = make_model(field, np.float64, jacobian=True)
    m, J = ReferenceEvaluator(model, new_ops=[Erf]).run(None, {"x": x})
    right = field.value_and_jacobian(x)
    np.testing.assert_allclose(m, right[0], atol=1e-12)
    np.testing.assert_allclose(J, right[1], atol=1e-12)


@pytest.mark.parametrize("name", ["robust", "paper", "open"])
def test_files_of_trained_fields(tmp_path, name):
    field = load_field(f"tests/data/fields/{name}.safetensors")
    for precision, most in (("double", 1e-13), ("float", 1e-4)):
        facts = export_onnx(field, tmp_path, precision=precision)
        assert set(facts["files"]) == {"field.onnx", "field_jacobian.onnx"}
        for file, told in facts["files"].items():
            model = onnx.load(tmp_path / file)
            assert told["bytes"] == (tmp_path / file).stat().st_size
            assert told["largest_difference"]["m"] < most
            # What is told is what is found.
            assert sampled_difference(field, model) == told["largest_difference"]


def test_numbers_far_outside_of_the_box_are_numbers():
    field = load_field("tests/data/fields/robust.safetensors")
    far = field.cloud.center + 1e4 * np.array([[1.0, 0.0], [0.0, -1.0]])
    for dtype in (np.float64, np.float32):
        m, J = Session(make_model(field, dtype, jacobian=True))(far)
        assert np.isfinite(m).all()
        assert np.isfinite(J).all()


def test_eight_bits_are_the_field_roughly(tmp_path):
    field = load_field("tests/data/fields/exact.safetensors")
    facts = export_onnx(field, tmp_path, precision="int8")
    (file,) = facts["files"]
    kinds = {node.op_type for node in onnx.load(tmp_path / file).graph.node}
    assert {"QuantizeLinear", "DequantizeLinear"} <= kinds
    # The tangent alone is learned, of 8 bits a unit.
    assert 1e-3 < facts["files"][file]["largest_difference"]["m"] < 0.1


def test_what_cannot_be_exported_is_told(tmp_path):
    field = load_field("tests/data/fields/ring.safetensors")
    with pytest.raises(ConfigurationError, match="--precision cannot be 'half'"):
        export_onnx(field, tmp_path, precision="half")
    with pytest.raises(ConfigurationError, match="no hidden layers"):
        export_onnx(field, tmp_path, precision="int8")
    with pytest.raises(ConfigurationError, match="a PursuitField has no ONNX graph"):
        make_model(PursuitField(field.cloud), np.float64, jacobian=False)
    assert list(tmp_path.iterdir()) == []
