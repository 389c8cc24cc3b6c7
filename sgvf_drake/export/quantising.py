"""Networks of ONNX graphs in 8-bit integers, as neural processors have them."""

from collections.abc import Sequence
import logging
from pathlib import Path
import tempfile
from typing import Any

import numpy as np
import onnx
from onnxruntime.quantization import (
    CalibrationDataReader,
    QuantFormat,
    QuantType,
    quantize_static,
)

from sgvf_drake.arrays import FloatArray
from sgvf_drake.exceptions import ConfigurationError


class _Points(CalibrationDataReader):
    """Inputs over which the ranges of all units are measured, in one batch."""

    def __init__(self, feed: dict[str, Any]) -> None:
        self._batches = iter([feed])

    def get_next(self) -> Any:
        return next(self._batches, None)


def quantised(model: onnx.ModelProto, inputs: Sequence[FloatArray]) -> onnx.ModelProto:
    """Returns a graph whose networks have weights and units of 8 bits.

    The layer that sees the position stays as it is, since 8 bits of that are a 256th of the
    box, and so does what puts m together.

    Args:
        model: A graph in float32, from `onnx.make_model`.
        inputs: Points over which the ranges of the units are measured.

    Raises:
        ConfigurationError: If no layer sees units.
    """
    products = _products(model)
    if not products:
        raise ConfigurationError("the field has no hidden layers, which int8 is for")
    names = [part.name for part in model.graph.input]
    feed = {name: values.astype(np.float32) for name, values in zip(names, inputs, strict=True)}
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "float.onnx", Path(folder) / "int8.onnx"
        onnx.save(model, source)
        # It recommends a step before that changes nothing here.
        logging.disable(logging.WARNING)
        try:
            quantize_static(
                source,
                target,
                _Points(feed),
                quant_format=QuantFormat.QDQ,
                op_types_to_quantize=["MatMul"],
                nodes_to_quantize=products,
                per_channel=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
            )
        finally:
            logging.disable(logging.NOTSET)
        return onnx.load(target)


def _products(model: onnx.ModelProto) -> list[str]:
    """Returns the names of the products of layers of networks that see units."""
    names = [node.name for node in model.graph.node if node.op_type == "MatMul"]
    with_features = {name.rpartition(".")[0] for name in names if name.endswith(".features")}
    return [
        name
        for name in names
        if "." in name
        and not name.endswith(".features")
        and (not name.endswith(".0") or name.rpartition(".")[0] in with_features)
    ]
